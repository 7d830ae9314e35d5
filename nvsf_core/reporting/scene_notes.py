"""Notes of the report on one scene: what its scans prove, and the baselines that were not run."""

from collections.abc import Iterable

from nvsf_core.reporting.html import escape, number, plain_table
from nvsf_core.reporting.scene_outputs import SceneOutputs

_PAPER_SCENES = frozenset(
    f"kitti360_{frame}" for frame in (1538, 1728, 1908, 3353, 2350, 4950, 8120, 10200, 10750, 11400)
)
"""KITTI-360's ten scenes that papers report on, as the catalogue names them."""


def holds_paper_scene(names: Iterable[str]) -> bool:
    """Whether one of KITTI-360's ten scenes that papers report on is among these."""
    return not _PAPER_SCENES.isdisjoint(names)


def evidence_table(scene: SceneOutputs) -> str:
    """HTML table of what the training scans prove; empty if unknown."""
    rows = [(key, value) for key, value in scene.proven.items() if "\n" not in str(value)]
    if not rows:
        return ""
    cells = [[escape(key.replace("_", " ")), _value(value)] for key, value in rows]
    table = plain_table(["what", "value"], cells, words=(1,))
    return f"<h3>What the training scans prove</h3>{table}"


def not_run(scene: SceneOutputs) -> str:
    """HTML with the reason why a baseline is not in the tables; empty if all were run."""
    reasons = [str(record.metadata.get(record.stage, "")) for record in scene.records]
    said = [reason for reason in reasons if reason.startswith("not run")]
    return "".join(f'<p class="soft"><code>mesh</code>: {escape(reason)}</p>' for reason in said)


def _value(value: object) -> str:
    if isinstance(value, float):
        return number(value, 3)
    if isinstance(value, int) and not isinstance(value, bool):
        return number(value, 0)
    return escape(value)
