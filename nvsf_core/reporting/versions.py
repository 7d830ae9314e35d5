"""The page that compares the versions of each data set: what changed, and how the metrics moved."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from nvsf_core.reporting.html import escape, higher_is_better, number, page, plain_table

Manifest = Mapping[str, Any]
_METRICS = (
    # protocol, metric, title, digits
    ("lidar4d_scan", "chamfer_m2", "Chamfer [m²]", 4),
    ("lidar4d_scan", "f_score", "F-score", 3),
    ("lidar4d_scan", "range_psnr_db", "range PSNR [dB]", 2),
    ("lidar4d_scan", "hit_accuracy", "hits", 4),
    ("image", "image_psnr_db", "image PSNR [dB]", 2),
)
_MOST_VERSIONS = 20
_MOST_NAMED = 6
_SHORT = 8
"""Digits of a commit that are shown."""
_SAME = "nothing but the file names"


@dataclass(frozen=True, slots=True, kw_only=True)
class VersionFacts:
    """One version of a data set, as its manifest tells of it."""

    scene: str
    view: str
    name: str
    made_s: float
    """When it was made, seconds since 1970."""
    megabytes: float
    scans: int
    images: int
    manifest: Manifest
    """Empty if it cannot be read."""
    removed: str = ""
    """When and by which rule it was removed; empty if it is there."""


def versions_html(versions: Sequence[VersionFacts]) -> str:
    """The page, as text; versions of one scene and view in the order in which they were made."""
    groups: dict[tuple[str, str], list[VersionFacts]] = {}
    for one in versions:
        groups.setdefault((one.scene, one.view), []).append(one)
    links = "".join(
        f'<a href="#{escape(f"{scene}-{view}")}">{escape(scene)} {escape(view)}</a>' for scene, view in groups
    )
    parts = [
        f'<h1>Versions of the data sets</h1><nav><a href="index.html">Report</a>{links}</nav>',
        "<p>A data set is never rewritten: what is made again with another recipe, seed, drive, view or code"
        " becomes a version of its own. Each row is compared with the one below it, which was made before."
        " Metrics are the model's means over the held-out frames, whatever the view; ▲ is better than"
        " before, ▼ worse.</p>",
    ]
    parts += [_section(scene, view, found) for (scene, view), found in groups.items()]
    if not groups:
        parts.append("<p>There is no data set yet.</p>")
    return page("NVSF data set versions", "\n".join(parts))


def _section(scene: str, view: str, versions: Sequence[VersionFacts]) -> str:
    ordered = sorted(versions, key=lambda one: (one.made_s, one.name))[-_MOST_VERSIONS:]
    left_out = len(versions) - len(ordered)
    head = ["version", "made", "changed", "scans", "images", "MB", *(title for *_, title, _ in _METRICS)]
    rows = []
    for before, now in zip([None, *ordered[:-1]], ordered, strict=True):
        made = f"{datetime.fromtimestamp(now.made_s, UTC):%Y-%m-%d %H:%M}"
        counts = [str(now.scans), str(now.images)]
        words = "the first one here" if before is None else "; ".join(changes(before.manifest, now.manifest))
        name = f"<code>{escape(now.name)}</code>"
        if now.removed:
            name += f'<br><span class="soft">{escape(now.removed)}</span>'
        cells = [name, made, escape(words), *counts, f"{now.megabytes:.1f}"]
        rows.append([*cells, *_moved(before, now)])
    note = f'<p class="soft">{left_out} older versions are not shown.</p>' if left_out else ""
    table = plain_table(head, reversed(rows), words=(2,))
    place, title = escape(f"{scene}-{view}"), escape(f"{scene}, {view}")
    return f'<section id="{place}"><h2>{title}</h2>{table}{note}</section>'


def changes(before: Manifest, now: Manifest) -> list[str]:
    """What differs between two versions, in words."""
    if not before or not now:
        return ["the manifest of one of the two cannot be read"]
    found = [*_recipe_changes(before, now)]
    found += [
        f"{words} {before.get(key)} → {now.get(key)}"
        for key, words in (("seed", "seed"), ("draw_seed", "draw seed"))
        if before.get(key) != now.get(key)
    ]
    found += _drive_changes(before.get("source_checksums", {}), now.get("source_checksums", {}))
    found += [f"view: {words}" for words in _key_changes(before.get("view", {}), now.get("view", {}))]
    commits = [str(one.get("commit", "unknown"))[:_SHORT] for one in (before, now)]
    found += [f"commit {' → '.join(commits)}"] if commits[0] != commits[1] else []
    found += _software_changes(before.get("software", {}), now.get("software", {}))
    inputs = _differing(before.get("rendered_from", {}), now.get("rendered_from", {}))
    found += [f"content of {', '.join(inputs)}"] if inputs else []
    return found or [_SAME]


def _recipe_changes(before: Manifest, now: Manifest) -> Iterable[str]:
    old, new = before.get("recipe", {}), now.get("recipe", {})
    if old.get("name") != new.get("name"):
        yield f"recipe {old.get('name')} → {new.get('name')}"
    elif old.get("identity") != new.get("identity"):
        yield from (f"recipe: {words}" for words in _key_changes(old, new, ("identity",)))


def _drive_changes(before: Manifest, now: Manifest) -> Iterable[str]:
    """Recorded files that were added, removed or changed, counted."""
    counts = {
        "more": len(now.keys() - before.keys()),
        "fewer": len(before.keys() - now.keys()),
        "changed": sum(before[name] != now[name] for name in before.keys() & now.keys()),
    }
    words = [f"{count} {kind}" for kind, count in counts.items() if count]
    return [f"recorded files: {', '.join(words)}"] if words else []


def _software_changes(before: Manifest, now: Manifest) -> Iterable[str]:
    for name in _differing(before, now):
        yield f"{name} {before.get(name, 'unknown')} → {now.get(name, 'unknown')}"


def _key_changes(before: Manifest, now: Manifest, leave_out: Sequence[str] = ()) -> list[str]:
    """Values that differ, by their keys; of parts of parts, too."""
    old, new = _flat(before), _flat(now)
    keys = [key for key in _differing(old, new) if key not in leave_out]
    named = [f"{key} {old.get(key)} → {new.get(key)}" for key in keys[:_MOST_NAMED]]
    return named + ([f"{len(keys) - _MOST_NAMED} more"] if len(keys) > _MOST_NAMED else [])


def _flat(values: Manifest, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def _differing(before: Manifest, now: Manifest) -> list[str]:
    return sorted(key for key in {*before, *now} if before.get(key) != now.get(key))


def _moved(before: VersionFacts | None, now: VersionFacts) -> Iterable[str]:
    """A cell for each metric: its value, and by how much it moved."""
    for protocol, metric, _, digits in _METRICS:
        value = _value(now.manifest, protocol, metric)
        old = math.nan if before is None else _value(before.manifest, protocol, metric)
        moved = value - old
        if math.isnan(moved) or abs(moved) < 0.5 * 10.0**-digits:
            yield number(value, digits)
            continue
        mark = "▲" if (moved > 0.0) == higher_is_better(metric) else "▼"
        yield f'{number(value, digits)} <span class="soft">{mark} {moved:+.{digits}f}</span>'


def _value(manifest: Manifest, protocol: str, metric: str) -> float:
    """Mean over sensors of a metric on the held-out frames; NaN where it was not measured."""
    found = [
        row["value"]
        for row in manifest.get("field_metrics", [])
        if (row.get("protocol"), row.get("metric"), row.get("region"), row.get("split"))
        == (protocol, metric, "all", "test")
        and row.get("value") is not None
    ]
    return sum(found) / len(found) if found else math.nan
