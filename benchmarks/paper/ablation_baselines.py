"""The baselines under the ablation's protocol: a scene's published held-out views, thinned alike."""

from pathlib import Path

from benchmarks.paper.ablation_scoring import (
    Scene,
    Scored,
    averaged_rgb,
    rows_of,
    score_image,
    score_pano,
    sparse,
)
from benchmarks.paper.ablation_table import Row
from nvsf_core.errors import DataError
from nvsf_core.metrics.protocols import PanoImage
from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.stores.arrays import read_arrays
from nvsf_core.stores.scene_store import SceneStore


def baseline_rows(scene: Scene, name: str) -> list[Row]:
    """A baseline's errors; it has no seed, and learned nothing.

    Raises:
        DataError: No view of the scene is published, or none by this baseline.
    """
    return rows_of(_scored(scene, _newest_views(scene.run.store, name)), scene.run.scene.name, name, 0)


def _newest_views(store: SceneStore, name: str) -> Path:
    """The arrays of a baseline's held-out views, whatever recipe they were published beside."""
    # A killed writer leaves hidden folders behind.
    found = store.path("novel_views").glob(f"[!.]*/[!.]*/{HELD_OUT}/{name}.zarr")
    newest = max(found, key=lambda path: path.stat().st_mtime_ns, default=None)
    if newest is None:
        raise DataError(
            f"{store.path('novel_views')}: expected held-out views by {name}, found none; "
            f"make train SCENES={store.scene} RECIPE=quick publishes them"
        )
    return newest


def _scored(scene: Scene, views: Path) -> Scored:
    panos = ("pano_range_m", "pano_intensity", "pano_hit")
    a = read_arrays(views, "frame", *panos)
    for row, frame in enumerate(a["frame"].tolist()):
        range_m, intensity, hit = (a[key][row] for key in panos)
        yield from score_pano(scene, frame, sparse(PanoImage(range_m=range_m, intensity=intensity, hit=hit)))
    folder = scene.run.store.require("undistorted") / "images.zarr"
    for camera in scene.recording.cameras:
        shown = read_arrays(views, f"{camera}_rgb", f"{camera}_frame")
        keys = [f"{camera}_{part}" for part in ("rgb", "valid", "frame")]
        rgb, valid, frames = (read_arrays(folder, *keys)[key] for key in keys)
        for image, frame in zip(shown[f"{camera}_rgb"], shown[f"{camera}_frame"].tolist(), strict=True):
            yield "all", score_image(averaged_rgb(image), rgb[frames == frame][0], valid)
