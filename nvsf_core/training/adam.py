"""Adam over torch's own fused step, without what torch's class loads: two to four seconds in each process."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """Adam (Kingma and Ba 2015, algorithm 1) with `torch.optim.Adam(fused=True)`'s arithmetic, bit for bit.

    Torch's class imports its compiler, `torch._dynamo`, when it is made; its function `adam` does not. The
    two attributes below are the part of torch's class that a training uses and a checkpoint holds.

    Attributes:
        param_groups: Each with its `params` (tensors), learning rate `lr` and `betas`, read at each step.
        state: Of each parameter that was ever changed: `step` (), `exp_avg` and `exp_avg_sq` (of its shape).
    """

    def __init__(
        self,
        groups: Sequence[dict[str, Any]],
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        """Without state: it appears with a parameter's first gradient.

        Args:
            groups: Dictionaries with `params` and `lr`; further keys are the caller's.
            betas: Decay of the averages of gradients and of their squares, per step; of all groups.
            eps: Added to the root of the averaged squares.
        """
        self.param_groups: list[dict[str, Any]] = [group | {"betas": betas} for group in groups]
        self.state: dict[Tensor, dict[str, Tensor]] = {}
        self._eps = eps

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def step(self) -> None:
        """Change each parameter that has a gradient."""
        for group in self.param_groups:
            changed = [p for p in group["params"] if p.grad is not None]
            states = [self._state(p) for p in changed]
            beta1, beta2 = group["betas"]
            with torch.no_grad():
                adam(
                    changed,
                    [p.grad for p in changed],
                    [state["exp_avg"] for state in states],
                    [state["exp_avg_sq"] for state in states],
                    [],
                    [state["step"] for state in states],
                    fused=True, amsgrad=False, maximize=False, weight_decay=0.0,
                    beta1=beta1, beta2=beta2, lr=group["lr"], eps=self._eps,
                )  # fmt: skip

    def _state(self, parameter: Tensor) -> dict[str, Tensor]:
        if parameter not in self.state:
            self.state[parameter] = {
                "step": torch.zeros((), dtype=torch.float32, device=parameter.device),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }
        return self.state[parameter]
