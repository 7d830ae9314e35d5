"""The report's section on views without truth: words, figures and errors by support."""

import math
import re
from datetime import UTC, datetime

from nvsf_core.metrics.table import mean_rows
from nvsf_core.metrics.trust.cues import BAND, DISAGREES, GUESSED, PARALLAX, PROTOCOL, SCORE
from nvsf_core.reporting.scene_outputs import FieldRun
from nvsf_core.reporting.trust import trust_section


def _row(split: str, protocol: str, metric: str, value: float, *, region: str = "all", sensor: str = "lidar",
         frame: int = 4, n_valid: int = 1) -> dict:  # fmt: skip
    return {
        "scene": "street", "split": split, "protocol": protocol, "region": region, "sensor": sensor,
        "recipe": "quick", "seed": 0, "metric": metric, "value": value, "unit": "1", "n_valid": n_valid,
        "frame": frame, "train_seconds": 1.0, "render_seconds": 1.0, "parameters": 1, "model_mb": 1.0,
    }  # fmt: skip


def _trust(split: str, sensor: str, score: float, guessed: float) -> list[dict]:
    rows = [_row(split, PROTOCOL, SCORE, score, sensor=sensor)]
    rows.append(_row(split, PROTOCOL, GUESSED, guessed, sensor=sensor))
    for region, value in zip(BAND, (0.08, 0.1, 0.14), strict=True):
        for cue in (SCORE, DISAGREES.name, PARALLAX.name):
            rows.append(_row(split, PROTOCOL, cue, value, region=region, sensor=sensor))
    rows += [_row(split, PROTOCOL, cue.name, score, sensor=sensor) for cue in (DISAGREES, PARALLAX)]
    return rows


def _section(rows: list[dict]) -> str:
    run = FieldRun(
        recipe="quick", seed=0, commit="abc", machine="", measured=datetime.now(UTC), means=mean_rows(rows),
        curve={}, pictures=[], by_support=[row for row in rows if row["region"].startswith("support_")],
    )  # fmt: skip
    return trust_section(run)


def _lines(page: str) -> dict[str, str]:
    """Text of each line of the first table, by its first cell."""
    body = page.split("<tbody>")[1].split("</tbody>")[0]
    cells = [
        [re.sub("<[^>]+>", "", one) for one in re.findall(r"<td.*?>(.*?)</td>", line)]
        for line in body.split("</tr>") if line
    ]  # fmt: skip
    return {line[0]: " | ".join(line[1:]) for line in cells}


def test_each_view_has_a_line_with_the_worst_word_of_its_sensors_and_the_reason() -> None:
    rows = _trust("shift_3m", "image_00", 0.13, 0.0) + _trust("shift_3m", "image_01", 0.09, 0.002)
    rows += _trust("test", "image_00", 0.09, 0.0) + _trust("vlp16", "lidar", 0.3, 0.32)
    page = _section(rows)
    lines = _lines(page)
    assert list(lines) == ["held-out frames", "shift_3m", "vlp16"]
    assert lines["shift_3m"].startswith("– | with care | Pictures: ")
    assert lines["held-out frames"].startswith("– | as recorded | It fits")
    assert lines["vlp16"].startswith("do not use | – | 32 % of its rays look at what nobody recorded")
    assert "1.30" in page and "(0.080–0.140)" in page


def test_scans_and_pictures_that_are_doubted_both_have_their_reasons() -> None:
    rows = _trust("up_1m", "lidar", 0.13, 0.02) + _trust("up_1m", "image_00", 0.13, 0.03)
    rows += _trust("low", "lidar", 0.13, 0.02) + _trust("low", "image_00", 0.09, 0.0)
    lines = _lines(_section(rows))
    assert re.match(
        r"with care \| with care \| Scans: 2.0 % of its rays .*Pictures: 3.0 % of", lines["up_1m"]
    )
    assert "Scans: 2.0 % of its rays" in lines["low"] and "Pictures" not in lines["low"]


def test_errors_by_support_stand_beside_the_verdicts() -> None:
    rows = _trust("shift_1m", "lidar", 0.1, 0.0)
    known = {
        "support_seen": ((0.9, 300), (1.0, 100)), "support_extrapolated": ((0.1, 1),),
        "support_guessed": ((0.4, 1000), (math.nan, 0)),
    }  # fmt: skip
    for region, found in known.items():
        for frame, (value, n_valid) in enumerate(found):
            row = _row("shift_1m", "raw", "f_score", value, region=region, frame=frame, n_valid=n_valid)
            rows.append(row)
    page = re.sub("</?span.*?>", "", _section(rows))
    assert "Are the marks right?" in page
    # Each point counts once, and a single one says nothing.
    cells = r"<td>0\.925 \(28\.6%\)</td><td>– \(0\.1%\)</td><td>0\.400 \(71\.4%\)</td>"
    assert re.search(rf"F-score\) ↑</td>{cells}", page)
    assert re.search(rf"<code>shift_1m</code>, lidar: .*F-score\) ↑</td>{cells}", page)


def test_a_run_without_verdicts_has_no_section() -> None:
    assert _section([_row("test", "raw", "f_score", 0.9)]) == ""
