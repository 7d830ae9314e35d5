"""The residual recipes' pano: the mean over firing phases (`pano_estimate`), corrected by a small network."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from nvsf_core._types import Scalar
from nvsf_core.errors import RecipeError
from nvsf_core.fields.layers import CellNetwork
from nvsf_core.fields.lidar_field import LidarField
from nvsf_core.geometry.se3 import invert_pose, pose_from_parts
from nvsf_core.kernels.threads import in_parts
from nvsf_core.metrics.hit import hit_image_metrics
from nvsf_core.metrics.range_and_intensity import intensity_image_metrics, range_image_metrics
from nvsf_core.models.family import TrainedPart, TrainingSession, fit, training_device
from nvsf_core.models.holdout import compare, recorded_pano, validation_numbers
from nvsf_core.models.residual.cell_step import CellExample, cell_step
from nvsf_core.models.residual.pano_estimate import PanoEstimate, estimate_pano
from nvsf_core.models.residual.pano_neighbours import (
    PARTS,
    Neighbours,
    RecordedPanos,
    ask_neighbours,
    cell_features,
    corrected_pano,
    hit_prior,
    intensity_prior,
    phases_alone,
)
from nvsf_core.recipe.residual import PanoSpec, ResidualRecipe
from nvsf_core.recording.drive import LidarRecording
from nvsf_core.sensors.linear_pano import LinearPano
from nvsf_core.simulation.ray_renderers import field_renderer
from nvsf_core.simulation.raydrop import cells_return
from nvsf_core.simulation.scene_model import PanoRenderer, SceneModel, SweepCorrector
from nvsf_core.simulation.sweep_simulation import fire_sweep
from nvsf_core.simulation.view_plan import recorded_sweep
from nvsf_core.training.loop import fresh_state, side_by_side

_METRICS = {"psnr_db": True, "hit_accuracy": True, "intensity_psnr_db": True}
CORRECTED = "pano_corrected"
"""Name of the fact: the outputs of the network (`PARTS`) that are used."""
_TYPICAL_RANGE_M, _LEAST_COST = 20.0, 0.2
"""Weight of a wrong hit: its range divided by the first, plus the second."""
_FEWEST_SCANS = 3
"""With fewer training scans a pano that is left out has too few others to be estimated from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOutPano:
    """A training pano: its estimate without its own scan, and what was recorded."""

    estimate: PanoEstimate
    neighbours: Neighbours
    true_range_m: np.ndarray
    """(66, 1030) float32, 0 = empty."""
    true_intensity: np.ndarray
    """(66, 1030) float32."""

    def example(self) -> CellExample:
        """The example to train on; a wrong hit has a weight by its range, because it is off by that."""
        returned, expected_m = self.true_range_m > 0.0, self.estimate.median_m
        cost = np.where(returned, self.true_range_m, expected_m) / _TYPICAL_RANGE_M + _LEAST_COST
        return CellExample(
            features=cell_features(self.estimate, self.neighbours),
            hit_logit=hit_prior(self.estimate),
            intensity_logit=intensity_prior(self.estimate),
            weight=torch.from_numpy(np.where(expected_m > 0.0, cost, 0.0).astype(np.float32)),
            returned=torch.from_numpy(returned),
            true_intensity=torch.from_numpy(self.true_intensity),
        )


def train_pano(
    session: TrainingSession, network: CellNetwork, field: LidarField, recipe: ResidualRecipe,
    lidar: LidarRecording, correct: SweepCorrector | None,
) -> TrainedPart:  # fmt: skip
    """Train on panos of training scans, each estimated without its own scan; then choose the outputs to use.

    Args:
        session: Of the scene.
        network: Is trained.
        field: Already trained.
        recipe: With a pano and its training.
        lidar: The recording.
        correct: The raydrop network, if any.

    Raises:
        RecipeError: The recipe trains no pano.
    """
    spec = recipe.pano
    training = None if spec is None else spec.training
    if spec is None or training is None:
        raise RecipeError(f"recipe {recipe.name}: expected a pano with training, found none")
    started, device = time.perf_counter(), training_device()
    network.to(device)
    panos = recorded_panos(lidar)
    if len(panos.time_s) < _FEWEST_SCANS:
        few: dict[str, Scalar] = {"pano_corrected": "nothing: too few scans to learn from"}
        prepared_s = time.perf_counter() - started
        return TrainedPart(states={}, preparation_seconds=prepared_s, metadata=few, facts={CORRECTED: []})
    scans = np.unique(np.linspace(0, len(panos.time_s) - 1, spec.frames).round().astype(np.int64))
    session.say("pano", f"estimating {len(scans)} training panos")
    left_out = in_parts(
        lambda place: leave_out(field, recipe, lidar, panos, int(scans[place]), correct), len(scans)
    )
    validation = validation_numbers(len(left_out), spec.judge_every, spec.judge_every // 2)
    examples = [one.example().to(device) for number, one in enumerate(left_out) if number not in validation]
    state = fresh_state(network, training, session.seed * 5 + 3)
    preparation = time.perf_counter() - started
    fit(
        session, "pano", state, training,
        lambda _, generator: side_by_side(
            training.parts, generator, lambda own: cell_step(network, examples, training, recipe.losses, own)
        ),
    )  # fmt: skip
    validating = time.perf_counter()
    metadata, corrected = choose(network, [left_out[number] for number in validation])
    preparation += time.perf_counter() - validating
    facts: dict[str, object] = {CORRECTED: corrected}
    return TrainedPart(
        states={"pano": state}, preparation_seconds=preparation, metadata=metadata, facts=facts
    )


def choose(network: CellNetwork, left_out: Sequence[LeftOutPano]) -> tuple[dict[str, Scalar], list[str]]:
    """The scores on validation panos, and which outputs of the network are used, each decided by itself.

    Hit is used if it raises the range image's PSNR and does not lower the hit accuracy; intensity if it
    raises the intensity image's PSNR.
    """

    def corrects(*parts: str) -> Callable[[LeftOutPano], tuple[float, float, float]]:
        return lambda one: _score(corrected_pano(network, one.estimate, one.neighbours, parts), one)

    hit, brightness = PARTS
    candidates = {"phases": corrects(), hit: corrects(hit), brightness: corrects(brightness)}
    found = compare(_METRICS, left_out, candidates)
    loses_no_hits = found.of(hit, "hit_accuracy") >= found.of("phases", "hit_accuracy")
    wins = {
        hit: found.is_better(hit, "psnr_db", "phases") and loses_no_hits,
        brightness: found.is_better(brightness, "intensity_psnr_db", "phases"),
    }
    corrected = [part for part in PARTS if wins[part]]
    shown = compare(_METRICS, left_out, {"shown": corrects(*corrected)})
    metadata = {
        **shown.figures({"shown": "pano_judged_"}),
        **found.figures({"phases": "pano_judged_phases_"}),
    }
    metadata["pano_corrected"] = ", ".join(corrected) or "nothing: learning did not beat the phases"
    return metadata, corrected


def pano_renderer(
    model: SceneModel,
    lidar: LidarRecording,
    spec: PanoSpec,
    network: CellNetwork | None,
    corrected: Sequence[str] = (),
) -> PanoRenderer:
    """Renders panos: the estimate, corrected by the network if the sensor is in its own place.

    Args:
        model: Renders the sensor's rays.
        lidar: The recording.
        spec: Of the recipe.
        network: Trained, or None.
        corrected: The outputs of the network that are used.
    """
    panos = recorded_panos(lidar) if network is not None and corrected else None

    def show(pose: np.ndarray, time_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        recorded = pose_from_parts(*lidar.sweeps.trajectory.at(np.array([time_s])))[0]
        mount = invert_pose(recorded) @ pose
        is_in_place = bool(np.allclose(mount, np.eye(4), atol=1e-6))
        estimate = expected_pano(model, lidar, spec, time_s, None if is_in_place else mount)
        if network is None or panos is None or not is_in_place:
            return phases_alone(estimate)
        neighbours = _neighbours(lidar, panos, spec, estimate, time_s)
        return corrected_pano(network, estimate, neighbours, corrected)

    return show


def expected_pano(
    model: SceneModel,
    lidar: LidarRecording,
    spec: PanoSpec,
    time_s: float,
    mount: np.ndarray | None,
    *,
    leave_out_s: float | None = None,
) -> PanoEstimate:
    """The estimate of the pano at a time.

    Args:
        model: Renders the sensor's rays.
        lidar: The recording.
        spec: Phases, and parts of a phase.
        time_s: Seconds since the first frame.
        mount: (4, 4) pose of the sensor in its recorded frame; None = in its own place.
        leave_out_s: Time of a training scan that is treated as if it were held out.
    """
    plan = recorded_sweep(lidar.sweeps.table, time_s, mount)
    return estimate_pano(
        lambda phase: fire_sweep(model, lidar, plan, time_s, phase=phase, leave_out_s=leave_out_s),
        LinearPano(reference_quirks=True), spec.phases, parts=spec.parts,
    )  # fmt: skip


def leave_out(
    field: LidarField, recipe: ResidualRecipe, lidar: LidarRecording, panos: RecordedPanos, scan: int,
    correct: SweepCorrector | None,
) -> LeftOutPano:  # fmt: skip
    """Estimate a training pano as if its scan were held out, but for the field and its surfaces.

    Args:
        field: Trained.
        recipe: With a pano.
        lidar: The recording.
        panos: Of all training scans.
        scan: Number of the scan among the training scans.
        correct: The raydrop network, if any.
    """
    assert recipe.pano is not None
    time_s, moving = float(panos.time_s[scan]), lidar.moving(leave_out=scan)
    render = field_renderer(
        field, lidar.evidence.static, moving, most=recipe.evidence.lidar_candidates, far_m=lidar.far_m
    )
    model = SceneModel(lidar=render, camera=None, prior_scans=recipe.evidence.votes, correct=correct)
    estimate = expected_pano(model, lidar, recipe.pano, time_s, None, leave_out_s=time_s)
    return LeftOutPano(
        estimate=estimate,
        neighbours=_neighbours(lidar, panos, recipe.pano, estimate, time_s, leave_out_s=time_s),
        true_range_m=panos.range_m[scan],
        true_intensity=panos.intensity[scan],
    )


def recorded_panos(lidar: LidarRecording) -> RecordedPanos:
    """All training scans projected to panos as the papers do."""
    sweeps = lidar.sweeps
    training = np.flatnonzero(sweeps.is_training)
    images = [recorded_pano(lidar, number) for number in range(len(training))]
    return RecordedPanos(
        time_s=sweeps.arrays["time_s"][training].astype(np.float64),
        range_m=np.stack([range_m for range_m, _ in images]),
        intensity=np.stack([intensity for _, intensity in images]),
        trajectory=sweeps.trajectory,
        period_s=sweeps.period_s,
        clocks=sweeps.training_clocks,
        turn_up_rad=sweeps.elevation_correction_rad,
    )


def _neighbours(
    lidar: LidarRecording,
    panos: RecordedPanos,
    spec: PanoSpec,
    estimate: PanoEstimate,
    time_s: float,
    *,
    leave_out_s: float | None = None,
) -> Neighbours:
    scans = lidar.evidence.prior.nearest_scans(time_s, spec.neighbours, leave_out_s=leave_out_s)
    return ask_neighbours(panos, scans, estimate.median_m, time_s, LinearPano(reference_quirks=True))


def _score(
    shown: tuple[np.ndarray, np.ndarray, np.ndarray], truth: LeftOutPano
) -> tuple[float, float, float]:
    """Range PSNR in dB, hit accuracy and intensity PSNR in dB of a pano, by the protocol `lidar4d`."""
    range_m, intensity, hit = shown
    shows_return = cells_return(hit)
    ranges = range_image_metrics(np.where(shows_return, range_m, 0.0), truth.true_range_m)
    hits = hit_image_metrics(hit, truth.true_range_m > 0.0)
    bright = intensity_image_metrics(np.where(shows_return, intensity, 0.0), truth.true_intensity)
    return ranges["range_psnr_db"].value, hits["hit_accuracy"].value, bright["intensity_psnr_db"].value
