"""A tiny drive as plain files: ``python examples/plain_drive.py FOLDER`` (docs/drives.md).

Sixteen lasers in a street that ends at a wall, 6 frames, half a metre apart. Then:
``NVSF_SCENES=FOLDER/scenes.toml nvsf train my_street --recipe smoke``
"""

import sys
from pathlib import Path

import numpy as np

FRAMES, STEP_M, PERIOD_S, COLUMNS = 6, 0.5, 0.1, 180
ELEVATION_RAD = np.radians(np.arange(15.0, -16.0, -2.0))
SCENE = """[[scene]]
name = "my_street"
kind = "plain"
root = "."
first_frame = 0
last_frame = 5
test_frames = [3]
"""

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    (folder / "scans").mkdir(parents=True)
    azimuth, elevation = np.meshgrid(np.arange(COLUMNS) * 2.0 * np.pi / COLUMNS, ELEVATION_RAD)
    flat = np.cos(elevation)
    ray = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)
    rows = ["frame,time_s,x,y,z,qx,qy,qz,qw"]
    for frame in range(FRAMES):
        with np.errstate(divide="ignore"):
            wall_m, road_m = 6.0 / np.abs(ray[:, 1]), np.where(ray[:, 2] < 0.0, -1.8 / ray[:, 2], np.inf)
            wall_m = np.minimum(wall_m, np.where(ray[:, 0] > 0.0, (20.0 - STEP_M * frame) / ray[:, 0], 99.0))
        range_m = np.minimum(wall_m, road_m)
        points = np.column_stack([ray * range_m[:, None], 0.2 + 0.4 * (wall_m < road_m)])
        points[range_m < 60.0].astype("<f4").tofile(folder / "scans" / f"{frame:010d}.bin")
        rows.append(f"{frame},{frame * PERIOD_S},{frame * STEP_M},0,1.8,0,0,0,1")
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")
    (folder / "scenes.toml").write_text(SCENE)
