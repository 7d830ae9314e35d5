"""Train SCENES with RECIPE from each seed of SEEDS (default: SEED), then write the results: ``make bench``.

A run of Dagster's job ``benchmark`` has one seed, as every run of this project has, so that its rules of
skipping, resuming and failing hold for benchmarks as they are; what is up to date is not trained again.
"""

import os
import subprocess
import sys
from pathlib import Path

from benchmarks.results_table import ROOT, write
from nvsf_core.kitti360.catalogue import home_from_environment


def main() -> int:
    """Exit code of the worst run; the results of the others are written all the same."""
    seeds = (os.environ.get("SEEDS") or os.environ.get("SEED") or "0").split()
    dagster = Path(sys.executable).parent / "dagster"
    worst = 0
    for seed in seeds:
        print(f"benchmark: seed {seed}", flush=True)
        environment = os.environ | {"SEED": seed, "DAGSTER_MODULE_NAME": "pipelines.definitions"}
        done = subprocess.run([dagster, "job", "execute", "-j", "benchmark"], env=environment, check=False)
        worst = max(worst, abs(done.returncode))
    print(write(home_from_environment(os.environ), ROOT))
    return worst


if __name__ == "__main__":
    sys.exit(main())
