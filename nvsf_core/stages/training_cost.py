"""What training a residual recipe is expected to cost: a model fitted to five measured runs."""

from nvsf_core.recipe import ResidualRecipe, TrainingSpec

FITTED_ON = "2 cores of an AMD EPYC"
# Fitted on an idle machine to five runs of commit d98851e: `quick` on demo, k360_street and
# kitti0005_van_cyclist (77, 86 and 87 s), `lean` on the latter two (950 and 1029 s).
_PREPARATION_S = 17.0
_SECONDS_A_SAMPLE = 0.93e-6
"""One surface of one LiDAR ray in one step, forward, backward and Adam's share."""
_SECONDS_A_PLANE_PIXEL = 20e-6
_SECONDS_A_BLENDED_PIXEL = 33e-6
_SECONDS_A_REFINED_DEPTH = 6.3e-6
"""One depth that is compared once more at one blended pixel."""
_SECONDS_A_PANO_CELL = 1.1e-6
_SECONDS_A_PANO_TURN = 0.6
"""One turn that is fired to make what the pano, or the network of hits, learns from."""
_CAMERA_PARAMETERS = 111_000
"""Of the camera's networks in these runs: larger ones cost in proportion."""
_BASE_MB = 1060.0
_REFINEMENT_MB = 360.0
"""What comparing depths once more takes."""
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
        total += size * _drawn(recipe.depth_training) * _SECONDS_A_PLANE_PIXEL
        total += size * _drawn(recipe.camera_training) * _SECONDS_A_BLENDED_PIXEL
        refined = _drawn(recipe.camera_training) * recipe.camera.refinements * recipe.camera.members
        total += refined * _SECONDS_A_REFINED_DEPTH
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
    return _BASE_MB + _MB_A_RETURN * returns + (_REFINEMENT_MB if refines else 0.0)


def _drawn(training: TrainingSpec) -> int:
    return training.steps * training.rays
