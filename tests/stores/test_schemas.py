"""The data contract is one: code, document, and what lies on disk."""

import numpy as np
import pytest

from nvsf_core.metrics.table import COLUMNS
from nvsf_core.stages import STAGE_NAMES
from nvsf_core.stores.contract_page import as_markdown
from nvsf_core.stores.schemas import CONTRACT, violations

SPECS = {spec.path: spec for spec in CONTRACT}


def test_the_document_is_what_the_code_says(repo):
    assert (repo / "docs/data_contract.md").read_text() == as_markdown()


def test_the_contract_speaks_of_stages_only():
    assert {spec.stage for spec in CONTRACT} <= set(STAGE_NAMES)


def test_metric_columns_are_those_of_the_metrics():
    spec = SPECS["scene_metrics/<recipe>/<seed>/metrics.parquet"]
    assert tuple(entry.name for entry in spec.fields) == COLUMNS


def _images(**changes):
    arrays = {
        "image_00_rgb": np.zeros((2, 4, 6, 3), np.uint8),
        "image_00_valid": np.ones((4, 6), bool),
        "image_00_frame": np.zeros(2, np.int64),
        "image_00_camera_to_world": np.zeros((2, 4, 4)),
        "image_02_frame": np.zeros(7, np.int64),
    }
    return arrays | changes


def test_what_keeps_the_contract_breaks_nothing():
    assert violations(SPECS["undistorted/images.zarr"], _images()) == []


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"image_00_rgb": np.zeros((2, 4, 6, 3), np.float32)}, "expected type u1, found f4"),
        ({"image_00_valid": np.ones((4, 5), bool)}, "axis 1 (width): expected 6, found 5"),
        ({"image_00_frame": np.zeros((2, 1), np.int64)}, "expected 1 axes"),
    ],
)
def test_a_breach_is_named(changes, word):
    assert any(word in line for line in violations(SPECS["undistorted/images.zarr"], _images(**changes)))


def test_an_absent_array_is_named():
    assert violations(SPECS["pano/pano.zarr"], {})[0].startswith("frame: expected i8")
