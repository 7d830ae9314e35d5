"""Mean errors of a scene's held-out frames: ``python examples/read_metrics.py SCENE RECIPE PROTOCOL``.

`metrics.parquet` holds one row a frame, method and metric; docs/data_contract.md lists its columns.
"""

import os
import sys

import pyarrow.parquet as pq

from nvsf_core.drives.catalogue import home_from_environment

if __name__ == "__main__":
    scene, recipe, protocol = sys.argv[1:]
    path = home_from_environment(os.environ) / scene / "scene_metrics" / recipe / "0" / "metrics.parquet"
    rows = [row for row in pq.read_table(path).to_pylist() if row["protocol"] == protocol]
    means = {}
    for row in rows:
        # NaN is undefined, never 0: it is left out here, and counted in n_valid.
        if row["split"] == "test" and row["region"] == "all" and row["value"] == row["value"]:
            means.setdefault((row["metric"], row["recipe"]), []).append(row["value"])
    for (metric, method), values in sorted(means.items()):
        print(f"{metric:28} {method:14} {sum(values) / len(values):10.4f}  ({len(values)} frames)")
