import subprocess
import sys

import torch
from torch import Tensor

from nvsf_core.training.adam import Adam

_RATES = (1e-2, 3e-3)


def test_steps_are_those_of_torchs_class_bit_for_bit() -> None:
    ours, theirs = _parameters(), _parameters()
    options = {"betas": (0.9, 0.99), "eps": 1e-15}
    optimiser = Adam(_groups(ours), **options)
    expected = torch.optim.Adam(_groups(theirs), **options, fused=True)
    generator = torch.Generator().manual_seed(1)
    for step in range(12):
        for one, other in zip(ours, theirs, strict=True):
            one.grad = torch.randn(one.shape, generator=generator)
            other.grad = one.grad.clone()
        if step % 3 == 1:
            ours[0].grad = theirs[0].grad = None
        for group, like in zip(optimiser.param_groups, expected.param_groups, strict=True):
            group["lr"] = like["lr"] = group["lr"] * 0.9
        optimiser.step()
        expected.step()
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(one, other)
        assert optimiser.state[one].keys() == expected.state[other].keys()
        for key, value in optimiser.state[one].items():
            assert torch.equal(value, expected.state[other][key])


def test_state_appears_with_the_first_gradient_and_gradients_can_be_forgotten() -> None:
    first, second = _parameters()[:2]
    optimiser = Adam([{"params": [first, second], "lr": 0.1}])
    before = second.detach().clone()
    first.grad = torch.ones_like(first)
    optimiser.step()
    assert set(optimiser.state) == {first}
    assert torch.equal(second, before)
    optimiser.zero_grad()
    after = first.detach().clone()
    optimiser.step()
    assert torch.equal(first, after)


def test_a_training_loads_neither_torchs_compiler_nor_sympy() -> None:
    """Each costs a process seconds before its first step."""
    program = """
import sys
import torch
from nvsf_core.fields.layers import bias_free
from nvsf_core.training.adam import Adam

network = bias_free((3, 4, 1), torch.Generator().manual_seed(0))
optimiser = Adam([{"params": list(network.parameters()), "lr": 0.1}])
network(torch.ones(2, 3)).sum().backward()
optimiser.step()
print([name for name in ("sympy", "torch._dynamo") if name in sys.modules])
"""
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def _parameters() -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = ((5, 3), (7,), (2, 2, 2))
    return [torch.randn(shape, generator=generator).requires_grad_() for shape in shapes]


def _groups(parameters: list[Tensor]) -> list[dict[str, object]]:
    return [
        {"params": parameters[:1], "lr": _RATES[0], "initial_lr": _RATES[0]},
        {"params": parameters[1:], "lr": _RATES[1], "initial_lr": _RATES[1]},
    ]
