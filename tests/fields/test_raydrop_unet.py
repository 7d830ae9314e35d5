"""Laws of the U-Net that refines hit probabilities."""

import pytest
import torch

from nvsf_core.errors import RecipeError, ShapeError
from nvsf_core.fields.raydrop_unet import RaydropUnet


def _unet(channels: int = 8) -> RaydropUnet:
    return RaydropUnet(channels, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("size", [(16, 16), (33, 70), (66, 103)])
def test_every_pano_keeps_its_size(size: tuple[int, int]) -> None:
    pano = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        logits = _unet().eval()(pano)
    assert logits.shape == (2, *size) and torch.isfinite(logits).all()


def test_without_training_it_draws_nothing_at_random() -> None:
    pano = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(1))
    first, again = _unet().eval(), _unet().eval()
    with torch.no_grad():
        assert torch.equal(first(pano), again(pano))
        torch.manual_seed(0)
        state = torch.get_rng_state()
        first(pano)
        _unet()
        assert torch.equal(state, torch.get_rng_state())


def test_training_is_repeatable_by_the_global_seed() -> None:
    pano = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(1))
    losses = []
    for _ in range(2):
        torch.manual_seed(3)
        unet = _unet().train()
        loss = unet(pano).square().mean()
        loss.backward()
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in unet.parameters())
        losses.append(loss.item())
    assert losses[0] == losses[1]


def test_it_learns_a_mask() -> None:
    torch.manual_seed(0)
    unet = _unet().train()
    pano = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(1))
    hit = (pano[:, 0] > 0.5).float()
    optimiser = torch.optim.Adam(unet.parameters(), lr=1e-3)
    losses = []
    for _ in range(25):
        loss = torch.nn.functional.binary_cross_entropy_with_logits(unet(pano), hit)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_what_it_cannot_do_it_refuses() -> None:
    with pytest.raises(ShapeError, match="at least 16"):
        _unet()(torch.zeros(1, 3, 15, 64))
    with pytest.raises(ShapeError):
        _unet()(torch.zeros(1, 2, 32, 32))
    with pytest.raises(RecipeError):
        RaydropUnet(0, torch.Generator())


def test_an_untrained_unet_expects_what_it_was_told() -> None:
    unet = RaydropUnet(8, torch.Generator().manual_seed(0)).eval()
    pano = torch.rand(1, 3, 32, 64, generator=torch.Generator().manual_seed(1))
    for share in (0.0, 0.2, 0.88, 1.0):
        unet.expect(share)
        with torch.no_grad():
            hit = torch.sigmoid(unet(pano)).mean().item()
        assert abs(hit - share) < 0.15, (share, hit)
