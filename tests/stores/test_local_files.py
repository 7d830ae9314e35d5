from pathlib import Path

import numpy as np
import zarr

from nvsf_core.stores.arrays import LocalFiles, read_arrays, write_arrays


def _written(path: Path, store: object, arrays: dict[str, np.ndarray]) -> dict[str, bytes]:
    group = zarr.open_group(store, mode="w")
    for name, array in arrays.items():
        group.create_array(name, data=array, chunks=(max(1, len(array) // 3),))
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_files_are_those_that_zarrs_own_store_writes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = {"small": rng.random(7), "large": rng.random(400_000), "empty": np.zeros(0, np.int32)}
    ours = _written(tmp_path / "a", LocalFiles(tmp_path / "a"), arrays)
    assert ours == _written(tmp_path / "b", str(tmp_path / "b"), arrays)
    assert min(map(len, ours.values())) < 64 << 10 < max(map(len, ours.values()))
    read = zarr.open_group(LocalFiles(tmp_path / "b", read_only=True), mode="r")
    assert all(np.array_equal(read[name][...], array) for name, array in arrays.items())
    assert np.array_equal(read["large"][-5:], arrays["large"][-5:])


def test_an_array_is_read_where_another_one_s_metadata_are_damaged(tmp_path: Path) -> None:
    write_arrays(tmp_path / "x.zarr", {"wanted": np.arange(5), "other": np.arange(3)})
    (tmp_path / "x.zarr/other/zarr.json").write_text("{")
    assert read_arrays(tmp_path / "x.zarr", "wanted")["wanted"].tolist() == [0, 1, 2, 3, 4]
