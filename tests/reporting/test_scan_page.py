"""The page of scans draws what it was given, in a real browser without a network."""

import re
from pathlib import Path

import numpy as np
from PIL import Image

from nvsf_core.rendering.support import Support
from nvsf_core.reporting.scan_page.clouds import RECORDED, Cloud, Instant
from nvsf_core.reporting.scan_page.page import MOST_BYTES, scan_page
from tests.browser import open_page

_SIZE = (900, 600)


def _wall(forward_m: float, support: int, error_m: float, count: int = 160) -> Cloud:
    """A wall across the way, 16 m wide and 6 m high."""
    left, up = (one.ravel() for one in np.meshgrid(np.linspace(-8, 8, count), np.linspace(-2, 4, count)))
    points_m = np.stack([np.full(left.shape, forward_m), left, up], axis=1)
    some = np.full(len(left), 1.0)
    return Cloud(points_m, some, np.full(len(left), support, np.uint8), error_m * some)


def _instants() -> list[Instant]:
    return [
        Instant(
            time_s=0.5, frame=5, recorded=_wall(12.0, RECORDED, 0.0), synthetic=_wall(12.0, Support.SEEN, 0.0)
        ),
        Instant(time_s=0.6, frame=6, recorded=None, synthetic=_wall(9.0, Support.GUESSED, 2.0)),
    ]


def _shown(folder: Path, link: str) -> np.ndarray:
    """The picture (h, w, 3) of the page, opened by a link."""
    page, picture = folder / "page.html", folder / "page.png"
    page.write_text(scan_page("street, view <left>", "Words & more.", _instants()), encoding="utf-8")
    open_page(page, f"--screenshot={picture}", f"--window-size={_SIZE[0]},{_SIZE[1]}", link=link)
    return np.asarray(Image.open(picture).convert("RGB")).astype(int)


def _share(picture: np.ndarray, colour: tuple[int, int, int]) -> float:
    """Share of a picture's pixels that have about a colour."""
    return float(np.mean(np.abs(picture - colour).max(axis=2) < 12))


def test_recorded_and_synthetic_points_stand_beside_each_other_by_support(tmp_path: Path) -> None:
    picture = _shown(tmp_path, "#instant=0&mode=support")
    left, right = picture[100:450, : _SIZE[0] // 2], picture[100:450, _SIZE[0] // 2 :]
    assert _share(left, (200, 205, 212)) > 0.05 > _share(left, (48, 120, 190))
    assert _share(right, (48, 120, 190)) > 0.05 > _share(right, (200, 205, 212))


def test_another_instant_and_colour_are_drawn_as_the_link_says(tmp_path: Path) -> None:
    picture = _shown(tmp_path, "#instant=1&mode=error")
    left, right = picture[100:450, : _SIZE[0] // 2], picture[100:450, _SIZE[0] // 2 :]
    # Two metres off is the last colour of the scale; on the left nothing was recorded.
    assert _share(right, (165, 0, 38)) > 0.05 and _share(left, (165, 0, 38)) == 0.0
    text = open_page(tmp_path / "page.html", "--dump-dom", link="#instant=1&mode=error")
    assert re.search(r'id="status">0\.60 s, 0 points recorded, 25,600 points synthetic<', text)
    assert "not recorded" in text and "street, view &lt;left&gt;" in text and "Words &amp; more." in text


def test_many_points_are_thinned_until_the_page_is_small(tmp_path: Path) -> None:
    large = _wall(12.0, Support.SEEN, 0.1, count=1000)
    page = scan_page(
        "many", "", [Instant(time_s=0.0, frame=k, recorded=large, synthetic=large) for k in (1, 2)]
    )
    assert 0.7 * MOST_BYTES < len(page) <= MOST_BYTES
    assert '"every":4' in page and '"recorded":[0,250000],"synthetic":[250000,250000]' in page
    assert "://" not in page
