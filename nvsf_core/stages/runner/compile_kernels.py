"""Compile all numba kernels ahead: `python -m` this module, as the end of `make install` does.

Numba compiles a kernel at its first call and caches the result beside its source. All of them take most of a
minute, which the first drive would wait for. The small drive used here has the data types of real ones; that
it passes the stages also shows that the installation works.
"""

import tempfile
from pathlib import Path

from nvsf_core.demo.drive import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.demo.motion import EgoSpeed
from nvsf_core.drives.catalogue import SceneEntry
from nvsf_core.models.baselines.reproject import reprojection
from nvsf_core.recipe.presets import preset
from nvsf_core.simulation.sweep_simulation import simulate_sweep
from nvsf_core.simulation.view_plan import recorded_sweep
from nvsf_core.stages.inputs import read_recording
from nvsf_core.stages.runner.run import plan_run, run_named_stage
from nvsf_core.stages.views.view import held_out_view

_STAGES = ("frames", "sweeps", "pano", "undistorted", "evidence", "field")
"""Together with two simulated sweeps they call every kernel."""
_FRAMES = 8
_TRAFFIC = 6
"""Additional moving cars: moving objects have kernels of their own."""
_SPEED = EgoSpeed(times_s=(0.1, 0.3), speeds_m_s=(0.0, 9.0))
"""First it stands: stationary scans have a kernel of their own."""
_SIZE = DemoSize(
    frames=_FRAMES, lasers=tuple(range(0, 64, 2)), firings=525, cameras=("image_00",), width=64, height=48,
    fisheye_side=0,
)  # fmt: skip


def compile_kernels() -> None:
    """Run the stages on a small drive with moving cars, in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="nvsf-") as folder:
        root = Path(folder) / "drive"
        write_demo(root, size=_SIZE, traffic=_TRAFFIC, speed=_SPEED)
        scene = SceneEntry(
            name="compile", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=_FRAMES - 1,
            test_frames=(_FRAMES // 2,),
        )  # fmt: skip
        run = plan_run(scene, Path(folder) / "home", recipe=preset("smoke"))
        for name in _STAGES:
            run_named_stage(name, run, lambda _: None)
        recording = read_recording(run.store)
        lidar, view = recording.lidar, held_out_view(recording, scene.test_frames)
        assert lidar is not None and view is not None and view.sweeps is not None
        model = reprojection(recording)
        for plan in (view.sweeps, recorded_sweep(lidar.sweeps.table, 0.0)):
            simulate_sweep(model, lidar, plan, float(plan.time_s[0]))


if __name__ == "__main__":
    compile_kernels()
