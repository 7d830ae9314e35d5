"""Paths of a drive's files in KITTI-360's layout, for reading and writing."""

from dataclasses import dataclass
from pathlib import Path

PERSPECTIVE_CAMERAS = ("image_00", "image_01")
"""Recorded through a pinhole lens; their files are already rectified."""
FISHEYE_CAMERAS = ("image_02", "image_03")
"""Recorded through a fisheye lens; their files are raw."""
CAMERAS = PERSPECTIVE_CAMERAS + FISHEYE_CAMERAS
LAST_FRAME = 9_999_999_999
"""Largest frame number: file names have ten digits."""


@dataclass(frozen=True, slots=True)
class DriveLayout:
    """Paths of one sequence below a KITTI-360 root, whether they exist or not."""

    root: Path
    """Folder that holds `calibration`, `data_poses`, `data_3d_raw`, `data_2d_raw`, `data_3d_bboxes`."""
    sequence: str
    """For example `2013_05_28_drive_0000_sync`."""

    @property
    def calibration_dir(self) -> Path:
        """Folder of the calibration files."""
        return self.root / "calibration"

    @property
    def perspective_path(self) -> Path:
        """Intrinsics and rectification of `image_00` and `image_01`."""
        return self.calibration_dir / "perspective.txt"

    @property
    def cam_to_pose_path(self) -> Path:
        """Mounting of every unrectified camera in the pose frame."""
        return self.calibration_dir / "calib_cam_to_pose.txt"

    @property
    def cam_to_velo_path(self) -> Path:
        """Mounting of the unrectified camera 0 in the LiDAR frame."""
        return self.calibration_dir / "calib_cam_to_velo.txt"

    def fisheye_path(self, camera: str) -> Path:
        """MEI calibration of a fisheye camera."""
        return self.calibration_dir / f"{camera}.yaml"

    @property
    def poses_path(self) -> Path:
        """Pose frame to world, one line a frame."""
        return self.root / "data_poses" / self.sequence / "poses.txt"

    @property
    def cam0_to_world_path(self) -> Path:
        """Rectified camera 0 to world, one line a frame; used to check the poses."""
        return self.root / "data_poses" / self.sequence / "cam0_to_world.txt"

    @property
    def velodyne_dir(self) -> Path:
        """Folder of the scans' timestamps and of `data`."""
        return self.root / "data_3d_raw" / self.sequence / "velodyne_points"

    def scan_path(self, frame: int) -> Path:
        """One LiDAR scan: float32 x, y, z, reflectance."""
        return self.velodyne_dir / "data" / f"{frame:010d}.bin"

    def column_dir(self, name: str) -> Path:
        """`ring` or `time` of the scans' points, a file a scan: of trees that this project wrote."""
        return self.velodyne_dir / name

    def column_path(self, name: str, frame: int) -> Path:
        """A file of `column_dir`."""
        return self.column_dir(name) / f"{frame:010d}.bin"

    def timestamps_path(self, kind: str = "") -> Path:
        """Times of the scans' poses; with `kind` = `start` or `end`, of the sweeps' begin or end."""
        return self.velodyne_dir / (f"timestamps_{kind}.txt" if kind else "timestamps.txt")

    def camera_dir(self, camera: str) -> Path:
        """Folder of a camera's images: rectified for perspective cameras, raw for fisheyes."""
        kind = "data_rect" if camera in PERSPECTIVE_CAMERAS else "data_rgb"
        return self.root / "data_2d_raw" / self.sequence / camera / kind

    def image_path(self, camera: str, frame: int) -> Path:
        """One image of a camera."""
        return self.camera_dir(camera) / f"{frame:010d}.png"

    def camera_timestamps_path(self, camera: str) -> Path:
        """Times of a camera's exposures."""
        return self.camera_dir(camera).parent / "timestamps.txt"

    def instance_path(self, camera: str, frame: int) -> Path:
        """Labelled object of each pixel of an image: semanticId * 1000 + instanceId."""
        kind = self.root / "data_2d_semantics" / "train" / self.sequence / camera / "instance"
        return kind / f"{frame:010d}.png"

    @property
    def boxes_dir(self) -> Path:
        """Folder of the annotated boxes of all sequences."""
        return self.root / "data_3d_bboxes"

    def boxes_path(self, split: str) -> Path:
        """3-D boxes; `split` is `train` or `train_full`."""
        return self.boxes_dir / split / f"{self.sequence}.xml"

    @property
    def boxes_paths(self) -> tuple[Path, ...]:
        """Box files that exist, sorted by name, so that the choice does not depend on the disk's order."""
        return tuple(sorted(self.boxes_dir.glob(f"*/{self.sequence}.xml")))
