"""What training a residual recipe is expected to cost: a model fitted to six measured runs."""

from nvsf_core.recipe import ResidualRecipe, TrainingSpec

FITTED_ON = "2 cores of an AMD EPYC"
# Fitted on an idle machine to five runs of commit d98851e, `quick` on demo, k360_street and
# kitti0005_van_cyclist (77, 86 and 87 s) and `lean` on the latter two (950 and 1029 s, four sources), and to
# `lean` on k360_street of commit b971b62 (1250 s, six sources, judging counted).
_PREPARATION_S = 17.0
_SECONDS_A_SAMPLE = 0.93e-6
"""One surface of one LiDAR ray in one step, forward, backward and Adam's share."""
_SECONDS_A_PLANE_PIXEL = 20e-6
_SECONDS_A_BLENDED_PIXEL = 33e-6
_SECONDS_A_REFINED_DEPTH = 1.6e-6
"""One depth that is compared once more at one blended pixel of one source."""
_JUDGING_SHARE = 0.12
"""Of the seconds that the camera learns: left-out images are shown with and without what was learned."""
_SECONDS_A_PANO_CELL = 1.1e-6
_SECONDS_A_PANO_TURN = 0.6
"""One turn that is fired to make what the pano, or the network of hits, learns from."""
_CAMERA_PARAMETERS = 111_000
"""Of the camera's networks in these runs: larger ones cost in proportion."""
_BASE_MB = 1060.0
_REFINEMENT_MB = 120.0
"""What comparing depths once more takes, a source."""
_MB_A_RETURN = 4.2e-4


def expected_seconds(recipe: ResidualRecipe, parameters: dict[str, int], samples: float) -> float:
    """Steps x rays x samples, and the camera's and the pano's pixels; an estimate, not a promise.

    Args:
        recipe: To be trained.
        parameters: Numbers of each part that is trained: `lidar`, `camera`, `hits`, `pano`; absent = not
            trained.
        samples: Mean surfaces that a ray looks at.
    """
    total = _PREPARATION_S
    if "lidar" in parameters:
        total += _drawn(recipe.lidar_training) * _SECONDS_A_SAMPLE * samples
    if "camera" in parameters:
        size = parameters["camera"] / _CAMERA_PARAMETERS
        spec, blended = recipe.camera, _drawn(recipe.camera_training)
        learning = size * _drawn(recipe.depth_training) * _SECONDS_A_PLANE_PIXEL
        learning += size * blended * _SECONDS_A_BLENDED_PIXEL
        learning += blended * spec.refinements * spec.members * spec.sources * _SECONDS_A_REFINED_DEPTH
        total += (1.0 + _JUDGING_SHARE) * learning
    if "pano" in parameters and recipe.pano is not None and recipe.pano.training is not None:
        total += recipe.pano.frames * recipe.pano.phases * _SECONDS_A_PANO_TURN
        total += _drawn(recipe.pano.training) * _SECONDS_A_PANO_CELL
    if "hits" in parameters and recipe.hits is not None:
        total += recipe.hits.frames * _SECONDS_A_PANO_TURN
        total += _drawn(recipe.hits.training) * _SECONDS_A_PANO_CELL
    return total


def expected_memory_mb(recipe: ResidualRecipe, parameters: dict[str, int], returns: int) -> float:
    """Peak of the training process; images weigh little beside returns.

    Args:
        recipe: To be trained.
        parameters: As of `expected_seconds`.
        returns: Of all scans.
    """
    refines = "camera" in parameters and recipe.camera.refinements > 0
    refinement = _REFINEMENT_MB * recipe.camera.sources if refines else 0.0
    return _BASE_MB + _MB_A_RETURN * returns + refinement


def _drawn(training: TrainingSpec) -> int:
    return training.steps * training.rays
