"""Exponential moving average of a model's weights; a recipe that keeps one renders with it."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from nvsf_core.errors import StoreError


class WeightAverage:
    """An exponential moving average of a model's parameters, updated once an epoch.

    average <- average - (1 - d_k) (average - weights), d_k = min(decay, (1 + k) / (10 + k)) at the k-th
    update, counted from 1: the first few follow the weights closely. Buffers are not averaged.
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        """Start from the model's present weights; with a decay of 0 no average is kept."""
        self.decay = decay
        self.updates = 0
        self._model = model
        self._average = [p.detach().clone() for p in model.parameters()] if decay > 0.0 else []

    @torch.no_grad()
    def update(self) -> None:
        """Add the model's present weights to the average; call it at the end of an epoch."""
        self.updates += 1
        decay = min(self.decay, (1.0 + self.updates) / (10.0 + self.updates))
        for average, parameter in zip(self._average, self._model.parameters(), strict=False):
            average.lerp_(parameter, 1.0 - decay)

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Inside the `with` block the model has the averaged weights; afterwards, also on errors, its own.

        The two are swapped, not copied. Without an average (decay 0) or before the first update nothing is
        swapped.
        """
        swapped = self.updates > 0 and bool(self._average)
        if swapped:
            self._swap()
        try:
            yield
        finally:
            if swapped:
                self._swap()

    def tensors(self) -> dict[str, Tensor]:
        """The averaged parameters, named `ema.<parameter>`, and the number of updates, `ema_updates`."""
        names = [name for name, _ in self._model.named_parameters()]
        named = {f"ema.{name}": value for name, value in zip(names, self._average, strict=False)}
        return named | {"ema_updates": torch.tensor(self.updates)}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the average from `tensors()` of an earlier run; other names are ignored.

        Raises:
            StoreError: The average of a parameter is absent or has another shape.
        """
        for name, average in zip(
            (name for name, _ in self._model.named_parameters()), self._average, strict=False
        ):
            found = tensors.get(f"ema.{name}")
            if found is None or found.shape != average.shape:
                raise StoreError(
                    f"expected the average of {name!r} {tuple(average.shape)}, found "
                    f"{None if found is None else tuple(found.shape)}; the checkpoint is another model's"
                )
            average.copy_(found)
        self.updates = int(tensors["ema_updates"])

    def _swap(self) -> None:
        for k, parameter in enumerate(self._model.parameters()):
            self._average[k], parameter.data = parameter.data, self._average[k]
