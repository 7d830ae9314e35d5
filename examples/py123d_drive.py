"""A log of py123d as plain files, run where py123d 0.7 is installed (docs/drives.md, "Other data sets").

``python examples/py123d_drive.py PY123D_DATA_ROOT LOG FOLDER``, then ``nvsf import FOLDER --out DRIVE``.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
from py123d.api import SceneFilter, get_filtered_scenes

if __name__ == "__main__":
    (scene,) = get_filtered_scenes(SceneFilter(log_names=[sys.argv[2]]), sys.argv[1])
    out, frames, cameras = Path(sys.argv[3]), range(scene.number_of_iterations), {}
    poses = ["frame,time_s," + ",".join(f"m{row}{column}" for row in range(3) for column in range(4))]
    (out / "scans").mkdir(parents=True)
    for frame in frames:
        scan = scene.get_lidar_at_iteration(frame, "lidar_top")
        at = scan.metadata.lidar_to_imu_se3.transformation_matrix
        xyz = (scan.xyz - at[:3, 3]) @ at[:3, :3]  # py123d gives points in the IMU's frame
        np.column_stack([xyz, scan.intensity / 255.0]).astype("<f4").tofile(out / f"scans/{frame:010d}.bin")
        car = scene.get_ego_state_se3_at_iteration(frame)
        pose = (car.imu_se3.transformation_matrix @ at)[:3].ravel().tolist()
        poses.append(",".join(map(repr, [frame, 1e-6 * float(car.timestamp.time_us), *pose])))
    for key, camera in scene.get_camera_metadatas().items():
        given, images = camera.to_dict(), out / "images" / camera.camera_name
        if given["camera_model"] == "pinhole":
            lens = dict(zip(("fx", "fy", "cx", "cy"), given["intrinsics"][:4], strict=True))
            bend = dict(zip(("k1", "k2", "p1", "p2", "k3"), given["distortion"], strict=True))
            to_lidar = (np.linalg.inv(at) @ camera.camera_to_imu_se3.transformation_matrix).ravel().tolist()
            lens |= {"width": camera.width, "height": camera.height, "distortion": bend}
            cameras[camera.camera_name] = lens | {"camera_to_lidar": to_lidar}
            images.mkdir(parents=True)
            for frame in frames:
                if (image := scene.get_camera_at_iteration(frame, key)) is not None:
                    cv2.imwrite(str(images / f"{frame:010d}.png"), image.rgb_image[..., ::-1])
    (out / "poses.csv").write_text("\n".join(poses) + "\n")
    (out / "cameras.json").write_text(json.dumps(cameras))
