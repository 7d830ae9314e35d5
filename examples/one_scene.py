"""Train one scene without Dagster: ``python examples/one_scene.py SCENE RECIPE``, for example demo quick."""

import sys

from nvsf_core.stages import run_scene

if __name__ == "__main__":
    scene, recipe = sys.argv[1:]
    for outcome in run_scene(scene, recipe=recipe, seed=0):
        done = "up to date" if outcome.skipped else f"{outcome.seconds:.1f} s"
        print(f"{outcome.stage}: {done}, {outcome.path}")
