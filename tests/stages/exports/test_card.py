"""The card of a data set says what it is, how wrong, and what it must not be used for."""

import json
import math
from pathlib import Path
from typing import Any

from nvsf_core.metrics.trust.cues import PROTOCOL, SCORE
from nvsf_core.stages.exports.card import NO_LICENCE, write_card


def _manifest(**other: Any) -> dict[str, Any]:
    means = {
        "scene": "street", "split": "test", "region": "all", "sensor": "lidar", "unit": "m2", "n_frames": 4,
        "n_defined": 4, "recipe": "quick", "seed": 0,
    }  # fmt: skip
    trust = {"split": "left", "protocol": PROTOCOL, "metric": SCORE, "unit": "1"}
    rows = [
        means | {"protocol": "lidar4d_scan", "metric": "chamfer_m2", "value": 0.0213},
        means | {"protocol": "lidar4d_scan", "metric": "f_score", "unit": "1", "value": None, "n_defined": 0},
        means | {"protocol": "masked", "metric": "chamfer_m2", "value": 9.0},
        means | trust | {"value": 5.0},
        *(
            means | trust | {"region": f"recorded_{part}", "value": value}
            for part, value in (("low", 0.5), ("median", 1.0), ("high", 1.5))
        ),
    ]  # fmt: skip
    return {
        "schema_version": 3, "scene": "street", "sequence": "drive", "version": "manual-0011",
        "view": {"name": "left", "sensor": "VLP-16", "exports": ["bin"]}, "sensor": "VLP-16",
        "scans": [{
            "returns": 200, "time_s": 0.1, "support_seen": 150, "support_extrapolated": 30,
            "support_guessed": 20,
        }],
        "images": [{"camera": "image_00", "pixels": 100, "time_s": 0.2}],
        "drawn": {"hits": "drawn from the hit probability"}, "source_checksums": {"scan 1": "aa"},
        "licence": "CC BY-NC-SA 3.0", "commit": "abc", "software": {"nvsf": "0.1.0"},
        "recipe": {"name": "quick", "identity": "0123456789abcdef"}, "seed": 0, "draw_seed": 0,
        "field_metrics": rows, **other,
    }  # fmt: skip


def _written(folder: Path, manifest: dict[str, Any]) -> tuple[dict[str, Any], str]:
    write_card(folder, manifest)
    return json.loads((folder / "card.json").read_text()), (folder / "card.md").read_text()


def test_a_card_states_errors_support_and_origin(tmp_path: Path) -> None:
    card, text = _written(tmp_path, _manifest())
    assert card["name"] == "street/left/manual-0011"
    assert card["support"]["returns"] == {
        "support_guessed": 0.1, "support_extrapolated": 0.15, "support_seen": 0.75,
    }  # fmt: skip
    assert "pixels" not in card["support"], "its images have none"
    found = {(one["protocol"], one["metric"]): one["value"] for one in card["errors"]}
    assert found == {("lidar4d_scan", "chamfer_m2"): 0.0213, ("lidar4d_scan", "f_score"): None}
    assert card["what"]["seconds_of_the_scene"] == [0.1, 0.2]
    for words in ("0.0213 m2", "undefined", "CC BY-NC-SA 3.0", "commit `abc`", "recipe `quick`", "75.0%"):
        assert words in text, words


def test_a_card_says_what_the_data_are_not_for(tmp_path: Path) -> None:
    card, text = _written(tmp_path, _manifest())
    assert [one["verdict"] for one in card["trust"]] == ["do not use"]
    refused = " ".join(card["not_for"])
    for words in ("too far from it", "10.0% of its returns", "a real VLP-16", "identify persons"):
        assert words in refused and words in text, words
    assert "nothing was blurred" in card["faces_and_licence_plates"]


def test_a_card_of_scans_without_a_return_says_so_and_nothing_of_support(tmp_path: Path) -> None:
    counts = {"support_seen": 0, "support_extrapolated": 0, "support_guessed": 0}
    scans = [{"returns": 0, "time_s": 0.1, **counts}]
    card, text = _written(tmp_path, _manifest(scans=scans))
    assert any("1 of 1 hold none" in line for line in card["not_for"])
    assert "- of the returns: no scan holds one" in text and "without support" not in text
    assert not any("hold none" in line for line in _written(tmp_path, _manifest())[0]["not_for"])


def test_a_camera_of_unknown_support_is_named_beside_the_others_shares(tmp_path: Path) -> None:
    counts = {"support_seen": 90, "support_extrapolated": 0, "support_guessed": 10}
    known = {"camera": "cam", "pixels": 100, "time_s": 0.2, **counts}
    images = [known, {"camera": "camb", "pixels": 100, "time_s": 0.2}]
    card, text = _written(tmp_path, _manifest(images=images))
    assert card["support"]["pixels"]["support_guessed"] == 0.1
    assert card["support_unknown"] == ["camb"]
    assert any(
        "of its pixels" in line and "nothing is known of those of camb" in line for line in card["not_for"]
    )
    assert "- of the pixels of `camb`: not known, so not counted here; no files in `support`" in text
    card, text = _written(tmp_path, _manifest(images=[known]))
    assert "support_unknown" not in card and "camb" not in text


def test_a_card_says_that_scans_of_kitti_are_not_compensated(tmp_path: Path) -> None:
    exported = {"name": "left", "sensor": None, "exports": ["bin", "kitti"]}
    card, _ = _written(tmp_path, _manifest(view=exported))
    assert any("compensated for the car's motion" in line for line in card["not_for"])
    at_once = _manifest(view=exported, sweep_period_s=0.0)
    for manifest in (_manifest(), at_once):
        assert not any("compensated" in line for line in _written(tmp_path, manifest)[0]["not_for"])


def test_a_card_without_licence_errors_and_images_says_so(tmp_path: Path) -> None:
    manifest = _manifest(licence=None, field_metrics=[], images=[])
    card, text = _written(tmp_path, manifest)
    assert card["source"]["licence"] == NO_LICENCE and NO_LICENCE in text
    assert any("licence is known" in line for line in card["not_for"])
    assert "Not measured" in text and card["errors"] == [] and card["trust"] == []
    assert card["faces_and_licence_plates"].startswith("No images")


def test_an_infinite_error_is_called_infinite_and_not_undefined(tmp_path: Path) -> None:
    first, *others = _manifest()["field_metrics"]
    card, text = _written(tmp_path, _manifest(field_metrics=[{**first, "value": "inf"}, *others]))
    assert card["errors"][0]["value"] == "inf"
    assert "| `chamfer_m2` | infinite | 4 of 4 |" in text


def test_no_number_on_a_card_is_nan(tmp_path: Path) -> None:
    rows = [{**row, "value": math.nan} for row in _manifest()["field_metrics"]]
    card, _ = _written(tmp_path, _manifest(field_metrics=rows))
    assert all(one["value"] is None for one in card["errors"])
    assert [one["verdict"] for one in card["trust"]] == ["not known"]


def test_a_licence_is_words_and_no_markup(tmp_path: Path) -> None:
    licence = "<script>alert(1)</script> [x](javascript:alert(1)) | a & b"
    card, text = _written(tmp_path, _manifest(licence=licence))
    assert card["source"]["licence"] == licence
    assert "<script" not in text and "[x]" not in text
    assert "&lt;script>alert(1)&lt;/script> &#91;x](javascript:alert(1)) &#124; a & b." in text
