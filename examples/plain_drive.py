"""A small drive as plain files: ``python examples/plain_drive.py FOLDER`` (docs/drives.md).

Thirty-two lasers between houses of a street, 12 frames, a metre apart; a scan is of one instant. Then:
``NVSF_SCENES=FOLDER/scenes.toml nvsf train my_street --recipe short``. All scans are without noise and of the
same azimuths, so a copied neighbour is hard to beat: of the checks `model_is_better_than_copying` may fail.
"""

import sys
from pathlib import Path

import numpy as np

FRAMES, STEP_M, PERIOD_S, COLUMNS = 12, 1.0, 0.1, 720
TURN_RAD = (np.arange(COLUMNS) + 1e-3) * 2.0 * np.pi / COLUMNS
SHARE = np.random.default_rng(0).uniform(0.0, 1.0, (29, 4))
# Least and greatest corner of each box, metres: houses that differ, else all places look alike, and the road.
HOUSES = [
    ((3 * n - 42, (-1) ** n * 8 - 2 + a, 0), (3 * n - 39 + 3 * b, (-1) ** n * 8 + 2 - c, 2 + 5 * d))
    for n, (a, b, c, d) in enumerate(SHARE[1:])
]
BOX_M = np.array([*HOUSES, ((-99, -99, -1), (99, 99, 0))])
FRAME_KEYS = "first_frame = 0\nlast_frame = 11\ntest_frames = [3, 8]\n"
SCENE = f'[[scene]]\nname = "my_street"\nkind = "plain"\nroot = "."\ncompensate = false\n{FRAME_KEYS}'

if __name__ == "__main__":
    folder, rows = Path(sys.argv[1]), ["frame,time_s,x,y,z,qx,qy,qz,qw"]
    (folder / "scans").mkdir(parents=True)
    azimuth, elevation = np.meshgrid(TURN_RAD, np.radians(np.arange(8.5, -23.5, -1.0)))
    flat = np.cos(elevation)
    ray = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 1, 3)
    for frame in range(FRAMES):
        faces_m = (BOX_M - [frame * STEP_M, 0.0, 1.8]) / ray[:, None]  # of each box, two along each axis
        enter_m, leave_m = faces_m.min(2).max(2), faces_m.max(2).min(2)
        seen_m = np.where((enter_m <= leave_m) & (enter_m > 0.0), enter_m, 99.0)
        points = np.column_stack([ray[:, 0] * seen_m.min(1)[:, None], 0.2 + 0.6 * SHARE[seen_m.argmin(1), 0]])
        points[seen_m.min(1) < 60.0].astype("<f4").tofile(folder / "scans" / f"{frame:010d}.bin")
        rows.append(f"{frame},{frame * PERIOD_S},{frame * STEP_M},0,1.8,0,0,0,1")
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")
    (folder / "scenes.toml").write_text(SCENE)
