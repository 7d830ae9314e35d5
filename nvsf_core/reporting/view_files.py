"""What the report shows of a view beyond pictures of one instant: a page of its scans, and an animation."""

from dataclasses import replace
from pathlib import Path

from nvsf_core.metrics.table import HELD_OUT
from nvsf_core.reporting.html import escape, figure, image
from nvsf_core.reporting.scan_page.clouds import instants_of
from nvsf_core.reporting.scan_page.page import scan_page
from nvsf_core.reporting.scene_outputs import SceneOutputs, ViewPictures
from nvsf_core.reporting.strip import strip_of

PAGES = "views"
"""Folder, in the report's, with a folder a scene."""
_HELD_OUT = (
    "Left: scans that the car recorded and the model never saw. Right: what the model renders there. Error: "
    "distance to the nearest point of the other side."
)
_ASKED = (
    "Right: what the model renders where nobody drove. Left: the nearest recorded scan, moved into the same "
    "place. Error: on the right the distance to the nearest point of three recorded scans, on the left to "
    "the nearest synthetic point; where one sensor sees what the other cannot, it is large and nothing is "
    "wrong."
)
_STEERING = (
    " Drag: turn. Shift and drag: move. Wheel: nearer or farther. Points are in the sensor's frame, as a "
    "driver publishes them."
)


def with_view_files(folder: Path, home: Path, scene: SceneOutputs) -> SceneOutputs:
    """Write the page of each view of a scene's newest run; returns the scene with pages and animations.

    A view of which neither can be made is left as it is, with the reason.
    """
    if not scene.runs:
        return scene
    newest = scene.runs[0]
    views = home / scene.name / "novel_views" / newest.recipe / str(newest.seed)
    root = home / scene.name
    pictures = [_view(folder, root, views / one.view, scene.name, one) for one in newest.pictures]
    return replace(scene, runs=[replace(newest, pictures=pictures), *scene.runs[1:]])


def _view(folder: Path, root: Path, view: Path, scene: str, pictures: ViewPictures) -> ViewPictures:
    try:
        strip, name = strip_of(root, view), ""
        if pictures.sensor:
            name = f"{PAGES}/{scene}/{view.name}.html"
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            words = (_HELD_OUT if view.name == HELD_OUT else _ASKED) + _STEERING
            title = f"{scene}, {'held-out frames' if view.name == HELD_OUT else f'view {view.name}'}"
            (folder / name).write_text(scan_page(title, words, instants_of(root, view)), encoding="utf-8")
    except OSError:
        raise  # a full disk is no fault of the view
    except Exception as error:  # what is stored may be of earlier code, and must not cost the report
        return replace(pictures, note=f"scans not shown in three dimensions: {error!r:.200}")
    return replace(pictures, scan_page=name, strip=strip)


def files_section(view: ViewPictures) -> str:
    """HTML of a view's animation and of the link to its page."""
    parts = []
    if view.strip is not None:
        caption = "Instant by instant: what was recorded nearest by, beside what the model renders."
        parts.append(figure([image(view.strip, f"animation of {view.view}", "wide", "webp")], caption))
    if view.scan_page:
        parts.append(
            f'<p><a href="{escape(view.scan_page)}">The scans in three dimensions</a>, recorded beside '
            "synthetic, by intensity, support or error.</p>"
        )
    if view.note:
        parts.append(f'<p class="soft">{escape(view.note)}</p>')
    return "".join(parts)
