"""Mean errors of a scene's held-out frames: ``python examples/read_metrics.py SCENE RECIPE PROTOCOL``.

`metrics.parquet` holds one row a frame, method and metric; docs/data_contract.md lists its columns.
"""

import os
import sys

import pyarrow.parquet as pq

from nvsf_core.drives.catalogue import home_from_environment

if __name__ == "__main__":
    scene, recipe, protocol = sys.argv[1:]
    folder = home_from_environment(os.environ) / scene / "scene_metrics"
    path = folder / recipe / "0" / "metrics.parquet"
    if not path.is_file():
        there = sorted(one.parts[-3] for one in folder.glob("*/0/metrics.parquet"))
        sys.exit(
            f"expected {path}, found seed 0 of these recipes: {', '.join(there) or 'none'}; train it first"
        )
    rows = [
        row for row in pq.read_table(path).to_pylist() if row["split"] == "test" and row["region"] == "all"
    ]
    protocols = sorted({row["protocol"] for row in rows})
    if protocol not in protocols:
        sys.exit(f"expected a protocol of {path}: {', '.join(protocols) or 'none'}; found {protocol!r}")
    means = {}
    for row in rows:
        # NaN is undefined, never 0: it is left out here, and counted in n_valid.
        if row["protocol"] == protocol and row["value"] == row["value"]:
            means.setdefault((row["metric"], row["recipe"]), []).append(row["value"])
    for (metric, method), values in sorted(means.items()):
        print(f"{metric:28} {method:14} {sum(values) / len(values):10.4f}  ({len(values)} frames)")
