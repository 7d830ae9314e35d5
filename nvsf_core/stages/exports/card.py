"""The card of a data set: what it is, what made it, how wrong it is, what it must not be used for.

`card.json` is for programs, `card.md` says the same to people. Both are made from the manifest's entries
alone, so that they never say anything else than it does.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nvsf_core.drives.view_parts import tilted_words
from nvsf_core.metrics.table import HEADLINES, HELD_OUT
from nvsf_core.metrics.trust.verdict import Trust, verdicts
from nvsf_core.rendering.rendered import Support
from nvsf_core.stages.exports.manifest import number_of, stored_number

JSON_NAME, MARKDOWN_NAME = "card.json", "card.md"
NO_LICENCE = "not stated: the scene's entry in the catalogue has no `licence`"
_SHOWN = ("lidar4d_scan", "raw", "image")
"""Protocols whose errors stand on the card; `metrics.parquet` has all."""
_BY_SUPPORT = ("f_score", "hit_accuracy", "image_psnr_db")
"""Metrics that are shown by support, too."""
_GUESSED_NOTICED = 0.001

_NEVER = (
    "As a record of what happened at this place and time: it is the output of a model.",
    "As the only evidence that a system works on real data, or is safe: it is as good as the errors below.",
    "To identify persons or vehicles.",
)


def write_card(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write `card.json` and `card.md` of a data set."""
    card = card_of(manifest)
    (folder / JSON_NAME).write_text(json.dumps(card, indent=1, allow_nan=False), encoding="utf-8")
    (folder / MARKDOWN_NAME).write_text(_markdown(card), encoding="utf-8")


def card_of(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The card's facts, as strict JSON holds them."""
    rows = [{**row, "value": number_of(row["value"])} for row in manifest.get("field_metrics", [])]
    support = {
        "returns": _shares(manifest["scans"], "returns"),
        "pixels": _shares(manifest["images"], "pixels"),
    }
    unknown = _without_support(manifest["images"])
    said = [one for one in verdicts(rows) if one.view == manifest["view"]["name"]]
    trust = [{"sensor": one.sensor, "verdict": one.trust.words, "why": one.why} for one in said]
    return {
        "schema_version": manifest["schema_version"],
        "name": f"{manifest['scene']}/{manifest['view']['name']}/{manifest['version']}",
        "what": _what(manifest),
        "source": {
            "recording": manifest["sequence"],
            "scene": manifest["scene"],
            "files": len(manifest["source_checksums"]),
            "licence": manifest["licence"] or NO_LICENCE,
        },
        "made_by": {
            "model": "NVSF, trained on this scene alone",
            "version": manifest["software"]["nvsf"],
            "commit": manifest["commit"],
            "recipe": manifest["recipe"]["name"],
            "recipe_identity": manifest["recipe"]["identity"],
            "seed": manifest["seed"],
            "draw_seed": manifest["draw_seed"],
        },
        "support": {kind: shares for kind, shares in support.items() if shares},
        **({"support_unknown": unknown} if unknown else {}),
        "errors": [_error(row) for row in rows if _is_shown(row)],
        "trust": trust,
        "not_for": [*_NEVER, *_not_for(manifest, support, [one.trust for one in said])],
        "faces_and_licence_plates": _people(manifest),
    }


def _what(manifest: Mapping[str, Any]) -> dict[str, Any]:
    view, scans, images = manifest["view"], manifest["scans"], manifest["images"]
    instants = [row["time_s"] for row in [*scans, *images] if "time_s" in row]
    return {
        "kind": "Synthetic LiDAR scans and camera images, rendered by a model of a recorded street",
        "view": view,
        "lidar": manifest["sensor"] or None,
        "cameras": sorted({row["camera"] for row in images}),
        "scans": len(scans),
        "returns": sum(row["returns"] for row in scans),
        "images": len(images),
        "seconds_of_the_scene": [min(instants), max(instants)] if instants else [],
        "sampled": manifest["drawn"],
        "formats": _formats(manifest),
        "camera_names": manifest.get("camera_names", {}),
    }


def _formats(manifest: Mapping[str, Any]) -> list[str]:
    """Formats that it is in: what its view asks for, but for whole trees that a joined data set has not."""
    absent = manifest.get("not_joined", [])
    return [name for name in manifest["view"]["exports"] if name not in absent]


def _shares(rows: Sequence[Mapping[str, Any]], total: str) -> dict[str, float]:
    """Share of each support over all rows that state it; empty if none does."""
    names = [one.region for one in Support]
    known = [row for row in rows if names[0] in row]
    count = sum(row[total] for row in known)
    return {name: sum(row[name] for row in known) / count for name in names} if count else {}


def _without_support(images: Sequence[Mapping[str, Any]]) -> list[str]:
    """Cameras none of whose pixels' support is known, as of one with too few images to learn from."""
    known = {row["camera"] for row in images if Support.SEEN.region in row}
    return sorted({row["camera"] for row in images} - known)


def _is_shown(row: Mapping[str, Any]) -> bool:
    protocol, metric = row["protocol"], row["metric"]
    is_main = protocol in _SHOWN and metric in HEADLINES[protocol]
    is_by_support = row["region"] in [one.region for one in Support] and metric in _BY_SUPPORT
    return is_main and (row["region"] == "all" or is_by_support)


def _error(row: Mapping[str, Any]) -> dict[str, Any]:
    keys = ("split", "protocol", "region", "sensor", "metric", "unit", "n_frames", "n_defined")
    return {**{key: row[key] for key in keys}, "value": stored_number(row["value"])}


def _not_for(
    manifest: Mapping[str, Any], support: Mapping[str, Mapping[str, float]], trust: Sequence[Trust]
) -> list[str]:
    """What this data set in particular must not be used for."""
    found = []
    if Trust.DO_NOT_USE in trust:
        found.append("For anything but looking at: compared with the recording, it is too far from it.")
    empty = sum(row["returns"] == 0 for row in manifest["scans"])
    if empty:
        found.append(f"For what needs returns in every scan: {empty} of {len(manifest['scans'])} hold none.")
    for kind, shares in support.items():
        guessed = shares.get(Support.GUESSED.region, 0.0)
        if guessed > _GUESSED_NOTICED:
            unknown = _without_support(manifest["images"]) if kind == "pixels" else []
            but = f"; nothing is known of those of {', '.join(unknown)}" if unknown else ""
            found.append(
                f"Without leaving out what is guessed: {guessed:.1%} of its {kind} show what nobody recorded;"
                f" files in `support` mark them{but}."
            )
    if manifest["view"]["sensor"] is not None and manifest["scans"]:
        found.append(
            f"As the measurements of a real {manifest['sensor']}: its rays are that sensor's, what returns "
            "and how bright is learned from the recording one."
        )
    # 0: each scan is of one instant, as the scene's were taken to be.
    is_moving = manifest.get("sweep_period_s", math.inf) > 0.0
    if "kitti" in _formats(manifest) and manifest["scans"] and is_moving:
        found.append(
            "As scans of KITTI's odometry benchmark, which are compensated for the car's motion: those in "
            "`kitti` are not; `velodyne_time` beside them has each point's time."
        )
    poses = (manifest["view"].get("pose_file") or {}).get("poses")
    tilted = tilted_words(poses) if poses else ""
    if tilted:
        found.append(f"As what a car's sensor sees, unless its path is meant so: {tilted}.")
    if not manifest["licence"]:
        found.append("For publication, before the recording's licence is known: it applies to what is made.")
    return found


def _people(manifest: Mapping[str, Any]) -> str:
    if not manifest["images"]:
        return "No images; persons are shapes of LiDAR points, as recorded."
    return (
        "As recorded: images are made from recorded pixels, nothing was blurred or removed here. What the "
        "recording blurred stays so."
    )


def _markdown(card: Mapping[str, Any]) -> str:
    what, source, made = card["what"], card["source"], card["made_by"]
    sensors = ", ".join([*([what["lidar"]] if what["lidar"] else []), *what["cameras"]])
    lines = [
        f"# {card['name']}",
        "",
        f"**What.** {what['kind']}: view `{what['view']['name']}`; scans: {what['scans']}, with "
        f"{what['returns']:,} returns; images: {what['images']}; sensors: {sensors}; formats: "
        f"{', '.join(what['formats']) or 'none'}.{_camera_words(what['camera_names'])}",
        "",
        f"**From what.** {source['files']} recorded files of `{source['recording']}`, scene "
        f"`{source['scene']}`; the manifest has the checksum of each. Licence of the recording: "
        f"{_inert(source['licence'])}.",
        "",
        f"**Made by.** {made['model']}: recipe `{made['recipe']}` ({made['recipe_identity'][:12]}), seed "
        f"{made['seed']}, seed of what is sampled {made['draw_seed']}; nvsf {made['version']}, commit "
        f"`{made['commit']}`.",
        "",
        f"**Faces and licence plates.** {card['faces_and_licence_plates']}",
        "",
        "## What it must not be used for",
        "",
        *(f"- {line}" for line in card["not_for"]),
        "",
        "## How wrong it is",
        "",
        *_error_lines(card["errors"]),
        "",
        "## What the recording knows of it",
        "",
        *_support_lines(
            card["support"], card.get("support_unknown", []), what["scans"] > 0 and what["returns"] == 0
        ),
    ]
    if card["trust"]:
        lines += ["", "## Compared with the recording", ""]
        lines += [f"- {one['sensor']}: **{one['verdict']}**. {one['why']}" for one in card["trust"]]
    return "\n".join(lines) + "\n"


def _inert(words: str) -> str:
    """Words of the catalogue, of which no Markdown makes HTML, a link or a table."""
    # As HTML's entities: not every Markdown takes a backslash before `<`.
    return words.replace("<", "&lt;").replace("[", "&#91;").replace("|", "&#124;")


def _camera_words(names: Mapping[str, Mapping[str, str | None]]) -> str:
    """Which camera is called what in which format, and which is left out of it, where any is."""
    found = []
    for exported, of_format in names.items():
        renamed = [f"`{own}` is `{there}`" for own, there in of_format.items() if there not in (None, own)]
        left_out = [f"`{own}` is left out" for own, there in of_format.items() if there is None]
        if renamed or left_out:
            found.append(f" In `{exported}` camera {', '.join([*renamed, *left_out])}.")
    return "".join(found)


def _error_lines(errors: Sequence[Mapping[str, Any]]) -> list[str]:
    if not errors:
        return [
            "Not measured with this data set. `nvsf train` measures the scene's held-out frames; its report "
            "has the errors."
        ]
    rows = ["| of | protocol | sensor | region | metric | mean | frames |", "|" + " --- |" * 7]
    for one in errors:
        value = _in_words(number_of(one["value"]), one["unit"])
        of = "held-out frames" if one["split"] == HELD_OUT else f"view `{one['split']}`"
        rows.append(
            f"| {of} | `{one['protocol']}` | {one['sensor']} | {one['region']} | `{one['metric']}` | {value} "
            f"| {one['n_defined']} of {one['n_frames']} |"
        )
    return [*rows, "", "Held-out frames were recorded and kept from training; the model is measured on them."]


def _in_words(value: float, unit: str) -> str:
    """A mean error as the card shows it."""
    if math.isnan(value):
        return "undefined"
    if math.isinf(value):
        return "infinite" if value > 0.0 else "-infinite"
    return f"{value:.4g}" if unit == "1" else f"{value:.4g} {unit}"


def _support_lines(
    support: Mapping[str, Mapping[str, float]], unknown: Sequence[str], has_no_return: bool
) -> list[str]:
    if not support and not has_no_return:
        return ["Not known: it was rendered without support."]
    words = {
        Support.SEEN: "seen: recorded from about there",
        Support.EXTRAPOLATED: "extrapolated: recorded from elsewhere",
        Support.GUESSED: "guessed: never recorded",
    }
    return [
        *(["- of the returns: no scan holds one"] if has_no_return else []),
        *(
            f"- of the {kind}: "
            + "; ".join(f"{shares[one.region]:.1%} {text}" for one, text in words.items())
            for kind, shares in support.items()
        ),
        *(
            f"- of the pixels of `{one}`: not known, so not counted here; no files in `support`"
            for one in unknown
        ),
    ]
