"""A scan from where nobody drove: ``python examples/own_view.py SCENE RECIPE LEFT_M OUT.ply``.

The scene was trained before (examples/one_scene.py); its middle instant is scanned that many metres to the
left of the recorded path.
"""

import os
import sys
from pathlib import Path

from nvsf_core.clouds.ply import write_ply
from nvsf_core.drives.catalogue import ViewEntry, home_from_environment
from nvsf_core.simulation.sweep_simulation import simulate_sweep
from nvsf_core.stages import find_scene, plan_run
from nvsf_core.stages.field import load_trained
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.views.plan import asked_view

if __name__ == "__main__":
    scene, recipe, left_m, target = sys.argv[1:]
    run = plan_run(find_scene(scene), home_from_environment(os.environ), recipe=recipe)
    recording = read_recording(run.store)
    model = load_trained(run.store.require(f"field/{recipe}/0"), recording, with_camera=False)
    middle = int(recording.posed_frame[len(recording.posed_frame) // 2])
    view = asked_view(recording, ViewEntry(name="mine", shift_m=(0.0, float(left_m), 0.0), frames=(middle,)))
    if recording.lidar is None or view is None or view.sweeps is None:
        sys.exit(f"{scene} has no LiDAR")
    sweep = simulate_sweep(model, recording.lidar, view.sweeps, float(view.sweeps.time_s[0]))
    write_ply(Path(target), sweep.points_m, sweep.intensity)
    print(f"frame {middle}, {left_m} m to the left: {len(sweep.points_m):,} returns in {target}")
