"""Stage `mesh`: the Poisson mesh of the training scans, for the baseline of that name."""

import numpy as np

from nvsf_core.clouds.mesh import Mesh, poisson_mesh
from nvsf_core.errors import DataError, MissingLibraryError
from nvsf_core.recording.drive import Sweeps
from nvsf_core.stages.inputs import read_sweeps
from nvsf_core.stages.runner.stage import StageOutput, Task
from nvsf_core.stores.arrays import read_arrays, write_arrays
from nvsf_core.stores.scene_store import SceneStore

SPACING_M = 0.1
"""Voxel size in which points are averaged."""
DEPTH = 10
"""Depth of the octree: cells of about 18 cm in a street 170 m long (docs/decisions/0011-mesh-baseline.md)."""
TRIM_M = 0.25
"""Triangles farther than this from every point only fill holes, and are removed."""
_FOLDER = "mesh.zarr"


def read_mesh(store: SceneStore) -> Mesh | None:
    """The scene's mesh; None if it could not be made.

    Raises:
        StoreError: The stage was never run.
    """
    arrays = read_arrays(store.require("mesh") / _FOLDER)
    return Mesh(**arrays) if arrays else None


def run(task: Task) -> StageOutput:
    """Reconstruct the mesh of the training scans; the stage `mesh`."""
    sweeps = read_sweeps(task.store)
    try:
        if sweeps is None:
            raise DataError("this drive has no LiDAR")
        mesh = _make(sweeps)
    except (MissingLibraryError, DataError) as error:
        # A missing baseline must not stop the training.
        write_arrays(task.folder / _FOLDER, {})
        reason = str(error).removeprefix("not run: ")
        task.progress(f"[{task.scene.name}] mesh: not run: {reason}")
        return StageOutput(metadata={"mesh": f"not run: {reason}"})
    arrays = {"vertices_m": mesh.vertices_m, "triangles": mesh.triangles, "intensity": mesh.intensity}
    write_arrays(task.folder / _FOLDER, arrays)
    return StageOutput(
        metadata={
            "mesh": f"Poisson of depth {DEPTH}, points {SPACING_M} m apart, trimmed at {TRIM_M} m",
            "vertices": len(mesh.vertices_m),
            "triangles": len(mesh.triangles),
            "model_mb": sum(array.nbytes for array in arrays.values()) / 1e6,
        }
    )


def _make(sweeps: Sweeps) -> Mesh:
    a = sweeps.arrays
    used = np.repeat(sweeps.is_training, np.diff(a["offsets"])) & sweeps.is_of_world()
    direction = a["direction"][used]
    return poisson_mesh(
        a["origin_m"][used] + direction * a["range_m"][used, None],
        -direction,
        sweeps.even_intensity(used),
        spacing_m=SPACING_M,
        depth=DEPTH,
        trim_m=TRIM_M,
    )
