"""The training loop. A training that is killed and resumed gives the same bits as one that is not."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from nvsf_core.errors import DivergedError, StoreError
from nvsf_core.kernels.threads import in_parts, use_threads
from nvsf_core.losses.total import LossBreakdown
from nvsf_core.recipe.residual import TrainingSpec
from nvsf_core.training.adam import Adam
from nvsf_core.training.weight_average import WeightAverage

_SAY_EVERY_S = 4.0
_RECORD_EVERY = 10
_FEWEST_RECORDED = 10
"""A training of fewer records has every step recorded: those of single batches say nothing of its trend."""
_AVERAGE_EVERY = 10
"""Steps between two weights that are averaged: those of neighbouring steps are nearly the same."""
_ADAM_KEYS = ("step", "exp_avg", "exp_avg_sq")

Part = Callable[[], Iterable[LossBreakdown]]
"""A part of a step that other threads may compute beside other parts; its losses one after the other."""
Step = Callable[[int, torch.Generator], Sequence[Part]]
"""Given a step's number and the generator, the step's parts. All gradients are added, in their order. Only
a step's single part may draw from the generator; several draw before, or from generators of their own."""
_SEEDS = 2**62
Save = Callable[[dict[str, Tensor], dict[str, object]], None]


@dataclass(slots=True)
class TrainingState:
    """All state of a training: what a checkpoint holds."""

    model: nn.Module
    optimiser: Adam
    generator: torch.Generator
    step: int = 0
    seconds: float = 0.0
    curve: list[dict[str, float]] = field(default_factory=list)
    average: WeightAverage | None = None
    """Of the model's weights; None where the recipe renders with the weights themselves."""

    def tensors(self) -> dict[str, Tensor]:
        """Model, optimiser and generator as named tensors."""
        named = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        for index, parameter in enumerate(self._parameters()):
            for key, value in self.optimiser.state.get(parameter, {}).items():
                named[f"adam.{index}.{key}"] = value
        named["generator"] = self.generator.get_state()
        return named if self.average is None else named | self.average.tensors()

    def facts(self) -> dict[str, object]:
        """Step, seconds and training curve: the part of a checkpoint that is not tensors."""
        return {"step": self.step, "seconds": self.seconds, "curve": self.curve}

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, object]) -> None:
        """Restore what `tensors()` and `facts()` gave.

        Raises:
            StoreError: They do not fit this model and optimiser; the state is unchanged then.
        """
        fault = self._fault(tensors, facts)
        if fault is not None:
            raise StoreError(f"{fault}; the checkpoint is damaged or another model's")
        model = {name[6:]: value for name, value in tensors.items() if name.startswith("model.")}
        self.model.load_state_dict(model)
        for index, parameter in enumerate(self._parameters()):
            prefix = f"adam.{index}."
            found = {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
            if found:
                # Files are read to the CPU; a fused step wants its state beside the weights.
                self.optimiser.state[parameter] = {k: v.to(parameter.device) for k, v in found.items()}
        self.generator.set_state(tensors["generator"])
        if self.average is not None:
            self.average.restore(tensors)
        self.step = int(facts["step"])  # type: ignore[call-overload]
        self.seconds = float(facts["seconds"])  # type: ignore[arg-type]
        self.curve = list(facts["curve"])  # type: ignore[call-overload]

    def _fault(self, tensors: dict[str, Tensor], facts: dict[str, object]) -> str | None:
        """Why training cannot continue from a checkpoint; None if it can."""
        expected = {
            name: value.shape for name, value in self.tensors().items() if not name.startswith("adam.")
        }
        for index, parameter in enumerate(self._parameters()):
            for key in _ADAM_KEYS:
                name = f"adam.{index}.{key}"
                if name in tensors:
                    expected[name] = torch.Size() if key == "step" else parameter.shape
        found = {name: value.shape for name, value in tensors.items()}
        odd = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
        if odd:
            name = odd[0]
            return f"{name}: expected shape {expected.get(name)}, found {found.get(name)}"
        broken = [name for name, value in tensors.items() if not bool(value.isfinite().all())]
        if broken:
            return f"{broken[0]}: expected finite numbers, found NaN or infinity"
        step, seconds, curve = (facts.get(name) for name in ("step", "seconds", "curve"))
        if not isinstance(step, int) or not isinstance(seconds, int | float) or not isinstance(curve, list):
            return f"expected step, seconds and curve, found {step!r:.40}, {seconds!r:.40} and {curve!r:.40}"
        return None

    def _parameters(self) -> list[nn.Parameter]:
        return [p for group in self.optimiser.param_groups for p in group["params"]]


def make_optimiser(model: nn.Module, spec: TrainingSpec) -> Adam:
    """Adam with one learning rate for hash tables (parameters named `grid.*`) and one for networks."""
    tables = [p for name, p in model.named_parameters() if name.startswith("grid.")]
    networks = [p for name, p in model.named_parameters() if not name.startswith("grid.")]
    groups = [{"params": tables, "lr": spec.table_rate}, {"params": networks, "lr": spec.network_rate}]
    for group in groups:
        group["initial_lr"] = group["lr"]
    return Adam(groups, betas=(0.9, 0.99), eps=1e-15)


def side_by_side(
    parts: int, generator: torch.Generator, loss: Callable[[torch.Generator], LossBreakdown]
) -> list[Part]:
    """Parts of a step whose loss is the mean of theirs, each with a generator that the step's seeds."""

    def part(seed: int) -> Part:
        return lambda: [loss(torch.Generator().manual_seed(seed)).scaled(1.0 / parts)]

    return [part(int(seed)) for seed in torch.randint(_SEEDS, (parts,), generator=generator).tolist()]


def fresh_state(model: nn.Module, spec: TrainingSpec, seed: int) -> TrainingState:
    """The state of a model before its first step; the seed decides what its steps sample."""
    average = WeightAverage(model, decay=None) if spec.averaged_share > 0.0 else None
    generator = torch.Generator().manual_seed(seed)
    return TrainingState(model, make_optimiser(model, spec), generator, average=average)


def train(
    state: TrainingState,
    spec: TrainingSpec,
    step: Step,
    save: Save,
    say: Callable[[str], None],
    observe: Callable[[TrainingState], None] | None = None,
) -> None:
    """Run the remaining steps; save every `checkpoint_s` seconds and at the end.

    Weights are saved only after the next step's loss and gradients with them were finite, so that a training
    that is about to diverge never replaces the last good checkpoint.

    Args:
        state: Is changed in place.
        spec: Steps, learning rates and their decay, seconds between checkpoints.
        step: Gives the loss of a step.
        save: Writes a checkpoint of tensors and facts.
        say: Prints a line of progress, every few seconds.
        observe: Called with the state after each step; its time does not count as training.

    Raises:
        DivergedError: A loss term, a gradient, a parameter or Adam's statistics are not finite; names the
            step, the term and the tensor. The last checkpoint is kept, and no weight was updated.
    """
    use_threads()
    began = time.perf_counter() - state.seconds
    saved = said = time.perf_counter()
    first = state.step
    started = time.perf_counter()
    record_every = _RECORD_EVERY if spec.steps >= _FEWEST_RECORDED * _RECORD_EVERY else 1
    while state.step < spec.steps:
        share = spec.final_share ** (state.step / max(1, spec.steps))
        for group in state.optimiser.param_groups:
            group["lr"] = group["initial_lr"] * share
        state.optimiser.zero_grad()
        generator_state = state.generator.get_state()
        is_due = state.step > first and time.perf_counter() - saved >= spec.checkpoint_s
        before = _copied(state) if is_due else None
        try:
            loss, terms = _descend(state.model, step(state.step, state.generator))
        except DivergedError as error:
            raise DivergedError(f"step {state.step}: {error} ({_first_broken(state)})") from error
        if not _has_finite_gradients(state.model):
            state.generator.set_state(generator_state)
            raise DivergedError(f"step {state.step}: {_blame(state, step)}")
        if before is not None:
            _require_finite(state)
            save(*before)
            saved = time.perf_counter()
        state.optimiser.step()
        state.step += 1
        if state.average is not None and _is_averaged(spec, state.step):
            state.average.update()
        now = time.perf_counter()
        state.seconds = now - began
        rays_per_s = (state.step - first) * spec.rays / (now - started)
        if state.step % record_every == 0 or state.step == spec.steps:
            point = {"step": state.step, "seconds": state.seconds, "loss": loss, "rays_per_s": rays_per_s}
            state.curve.append(point | terms)
        if now - said >= _SAY_EVERY_S:
            said = now
            left_s = (spec.steps - state.step) * spec.rays / rays_per_s
            say(
                f"step {state.step}/{spec.steps}, {left_s:.0f} s left, loss {loss:.4f}, "
                f"{rays_per_s:,.0f} rays/s"
            )
        if state.step == spec.steps:
            _require_finite(state)
            save(state.tensors(), state.facts())
        if observe is not None:
            paused = time.perf_counter()
            observe(state)
            spent = time.perf_counter() - paused
            began, started = began + spent, started + spent


def _copied(state: TrainingState) -> tuple[dict[str, Tensor], dict[str, object]]:
    """A copy of what a checkpoint holds: a step changes weights, averages and the generator in place."""
    tensors = {name: value.detach().clone() for name, value in state.tensors().items()}
    return tensors, state.facts() | {"curve": list(state.curve)}


def _descend(model: nn.Module, parts: Sequence[Part]) -> tuple[float, dict[str, float]]:
    """Add up the gradients of a step's parts, always in the same order; the step's loss and its terms."""
    weights = [p for p in model.parameters() if p.requires_grad]
    loss, terms = 0.0, dict[str, float]()
    found = in_parts(lambda part: _gradients(weights, parts[part]), len(parts))
    for gradients, part_loss, part_terms in found:
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.grad = _sum(weight.grad, gradient)
        loss += part_loss
        for name, value in part_terms.items():
            terms[name] = terms.get(name, 0.0) + value
    for weight in weights:
        weight.grad = _laid_out_like(weight, weight.grad)
    return loss, terms


def _laid_out_like(weight: Tensor, gradient: Tensor | None) -> Tensor | None:
    """A gradient with its weight's strides, as `backward()` would leave it.

    Adam's fused step reads both memories side by side, whatever their strides say. A convolution of
    channels-last images has channels-last gradients, and the gradient of a sum is one number for all.
    """
    if gradient is None or gradient.stride() == weight.stride():
        return gradient
    return torch.empty_like(weight).copy_(gradient)


def _gradients(
    weights: list[nn.Parameter], part: Part
) -> tuple[list[Tensor | None], float, dict[str, float]]:
    """Gradients of a part's losses by all weights (None for those it does not use), its loss and terms."""
    gradients: list[Tensor | None] = [None] * len(weights)
    loss, terms = 0.0, dict[str, float]()
    for one in part():
        found = torch.autograd.grad(one.total, weights, allow_unused=True)
        gradients = [_sum(before, more) for before, more in zip(gradients, found, strict=True)]
        loss += float(one.total.detach())
        for name, value in one.terms.items():
            terms[name] = terms.get(name, 0.0) + value
    return gradients, loss, terms


def _sum(one: Tensor | None, other: Tensor | None) -> Tensor | None:
    if one is None or other is None:
        return other if one is None else one
    return one + other


def _has_finite_gradients(model: nn.Module) -> bool:
    """Whether all gradients are finite. Only if one of their sums is not is every value looked at."""
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    if not gradients or bool(torch.stack([g.sum() for g in gradients]).isfinite().all()):
        return True
    return all(bool(g.isfinite().all()) for g in gradients)


def _blame(state: TrainingState, step: Step) -> str:
    """Repeat a step one loss term at a time, and name the first whose gradient is not finite."""
    named = [(name, p) for name, p in state.model.named_parameters() if p.requires_grad]
    advice = "is not finite; lower the step size or look at its input"
    losses = (loss for part in step(state.step, state.generator) for loss in part())
    for loss in losses:
        for term, value in loss.reduced.items():
            found = torch.autograd.grad(
                value, [p for _, p in named], retain_graph=True, allow_unused=True
            )  # fmt: skip
            for (name, _), gradient in zip(named, found, strict=True):
                if gradient is not None and not torch.isfinite(gradient).all():
                    return f"loss term {term!r}: its gradient by weights {name!r} {advice}"
    return f"all terms together: {_first_broken(state)} although each term's own is finite"


def _require_finite(state: TrainingState) -> None:
    """Check weights and Adam's running statistics before they are saved.

    A weight whose statistics overflowed is never updated again.
    """
    for name, parameter in state.model.named_parameters():
        if not torch.isfinite(parameter).all():
            raise DivergedError(f"step {state.step}: weights {name!r} are not finite; lower the step size")
    for name, parameter in state.model.named_parameters():
        for key, value in state.optimiser.state.get(parameter, {}).items():
            if not torch.isfinite(value).all():
                raise DivergedError(
                    f"step {state.step}: Adam's {key!r} of {name!r} is not finite: a gradient was too large "
                    "to be squared in float32; lower the step size"
                )


def _first_broken(state: TrainingState) -> str:
    """In words, the first weight or gradient that is not finite, or that it must be the batch."""
    broken = [name for name, p in state.model.named_parameters() if not torch.isfinite(p).all()]
    if broken:
        return f"weights {broken[0]!r} are not finite"
    for name, parameter in state.model.named_parameters():
        if parameter.grad is not None and not torch.isfinite(parameter.grad).all():
            return f"the gradient of {name!r} is not finite"
    return "all weights are finite: the batch is not, or overflows"


def _is_averaged(spec: TrainingSpec, step: int) -> bool:
    """Whether the weights after a step are one of those whose mean is taken."""
    left = spec.steps - step
    return left < spec.averaged_share * spec.steps and left % _AVERAGE_EVERY == 0
