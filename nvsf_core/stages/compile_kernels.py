"""Compile all kernels ahead: ``python -m nvsf_core.stages.compile_kernels``, the end of ``make install``.

Numba compiles a kernel when it is first called and keeps the result beside its source. All of them take
most of a minute, which the first drive of a new installation would wait for; and that a drive passes
through the stages shows that the installation works. What is small about this drive leaves every data
type as it is.
"""

import tempfile
from pathlib import Path

from nvsf_core.kitti360.catalogue import SceneEntry
from nvsf_core.kitti360.demo import DEMO_SEQUENCE, DemoSize, write_demo
from nvsf_core.recipe import preset
from nvsf_core.stages.flow import plan_run, run_named_stage

_STAGES = ("frames", "sweeps", "pano", "undistorted", "evidence", "field")
"""They call every kernel; later stages render with the same ones."""
_FRAMES = 8
_TRAFFIC = 6
"""Cars beside the demo's own: things that move have kernels of their own."""
_SIZE = DemoSize(
    frames=_FRAMES, lasers=tuple(range(0, 64, 2)), firings=525, cameras=("image_00",), width=64, height=48,
    fisheye_side=0,
)  # fmt: skip


def compile_kernels() -> None:
    """Take a small drive with moving cars through the stages that compute, in a folder that is removed."""
    with tempfile.TemporaryDirectory(prefix="nvsf-") as folder:
        root = Path(folder) / "drive"
        write_demo(root, size=_SIZE, traffic=_TRAFFIC)
        scene = SceneEntry(
            name="compile", root=root, sequence=DEMO_SEQUENCE, first_frame=0, last_frame=_FRAMES - 1,
            test_frames=(_FRAMES // 2,),
        )  # fmt: skip
        run = plan_run(scene, Path(folder) / "home", recipe=preset("smoke"))
        for name in _STAGES:
            run_named_stage(name, run, lambda _: None)


if __name__ == "__main__":
    compile_kernels()
