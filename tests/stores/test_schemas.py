"""The data contract is one: code, document, and what lies on disk."""

import numpy as np
import pytest

from nvsf_core.metrics.table import COLUMNS
from nvsf_core.stages import STAGE_NAMES
from nvsf_core.stores.contract_page import as_markdown
from nvsf_core.stores.schemas import CONTRACT, field_faults, violations

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


@pytest.mark.parametrize("camera", ["front", "rear_left", "image_00"])
def test_images_of_a_camera_of_any_name_are_checked(camera):
    spec = SPECS["novel_views/<recipe>/<seed>/<view>/<method>.zarr"]
    arrays = {f"{camera}_rgb": np.zeros((2, 4, 6, 3), np.uint8), f"{camera}_frame": np.zeros(2, np.int64)}
    assert violations(spec, arrays, whole=False) == []
    for broken, words in (
        (
            {f"{camera}_range_m": np.zeros((2, 4, 6), np.float32)},
            f"{camera}_range_m: expected type f2, found f4",
        ),
        ({f"{camera}_frame": np.zeros(3, np.int64)}, f"{camera}_frame: axis 0 (images): expected 2, found 3"),
    ):
        assert violations(spec, arrays | broken, whole=False) == [words]
    (fault,) = field_faults(spec, f"{camera}_support", np.dtype("f4"), (2, 4, 6))
    assert fault == f"{camera}_support: expected type u1, found f4"


def test_arrays_of_the_lidar_are_not_those_of_a_camera_of_their_name():
    spec = SPECS["novel_views/<recipe>/<seed>/<view>/<method>.zarr"]
    arrays = {
        "grid_range_m": np.zeros((1, 8, 64), np.float32), "ray_range_m": np.zeros(5, np.float32),
        "grid_support": np.zeros((1, 8, 64), np.uint8), "lidar_render_seconds": np.zeros(1),
    }  # fmt: skip
    assert violations(spec, arrays, whole=False) == []


def test_an_absent_array_is_named():
    assert violations(SPECS["pano/pano.zarr"], {})[0].startswith("frame: expected i8")
