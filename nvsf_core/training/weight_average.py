"""Averages of a model's weights over its training; a recipe that keeps one renders with it."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from nvsf_core.errors import StoreError


class WeightAverage:
    """An average of a model's parameters: an exponential one, or the mean of all updates.

    average <- average - (1 - d_k) (average - weights) at the k-th update, counted from 1. With a decay
    d_k = min(decay, (1 + k) / (10 + k)): the first few follow the weights closely. Without one
    d_k = 1 - 1 / k: the mean of the weights at all updates (Polyak and Juditsky 1992). Buffers are not
    averaged.
    """

    def __init__(self, model: nn.Module, decay: float | None) -> None:
        """Start from the present weights; with a decay of 0 no average is kept, None = all count alike."""
        self.decay = decay
        self.updates = 0
        self._model = model
        self._average = [p.detach().clone() for p in model.parameters()] if decay != 0.0 else []

    @torch.no_grad()
    def update(self) -> None:
        """Add the model's present weights to the average."""
        self.updates += 1
        k = float(self.updates)
        decay = 1.0 - 1.0 / k if self.decay is None else min(self.decay, (1.0 + k) / (10.0 + k))
        for average, parameter in zip(self._average, self._model.parameters(), strict=False):
            average.lerp_(parameter, 1.0 - decay)

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Inside the `with` block the model has the averaged weights; afterwards, also on errors, its own.

        The two are swapped, not copied. Without an average (decay 0) or before the first update nothing is
        swapped.
        """
        self.put_in_place()
        try:
            yield
        finally:
            self.put_in_place()

    def put_in_place(self) -> None:
        """Swap the model's weights and their average, where there is one; a second call swaps them back."""
        if self.updates == 0:
            return
        for average, parameter in zip(self._average, self._model.parameters(), strict=False):
            average.data, parameter.data = parameter.data, average.data

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
