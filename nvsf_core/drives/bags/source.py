"""A drive in a bag of ROS 1 or ROS 2, or in an MCAP file: point clouds, images, camera infos, transforms.

Frames are the point clouds, counted from 0 in the order of their stamps. An image belongs to the scan whose
middle is nearest, and is placed by the path at its own time.
"""

import re
from dataclasses import replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from nvsf_core.drives.bags.index import (
    BagIndex,
    Stamped,
    header_of,
    index_of,
    open_bag,
    read_fault,
)
from nvsf_core.drives.bags.messages import (
    IMAGES,
    POINT_CLOUD,
    cloud_columns,
    has_two_cameras,
    image_rgb,
    is_of_p,
    lens_facts,
    stamp_s,
)
from nvsf_core.drives.bags.rectified_places import place_words, rectified_place
from nvsf_core.drives.drive import DriveFacts, Recorded
from nvsf_core.drives.kitti360.calibration import Calibration, CameraCalibration
from nvsf_core.drives.kitti360.frames import NOMINAL_PERIOD_S
from nvsf_core.drives.kitti360.images import decode_picture
from nvsf_core.drives.kitti360.scans import Scan
from nvsf_core.drives.lenses import Lens, lens_of
from nvsf_core.drives.plain.source import scan_of_columns
from nvsf_core.drives.posed import AbstractPosedDrive, PosePath, median_step_s
from nvsf_core.drives.section import Section
from nvsf_core.errors import CalibrationError, DataError

_NOT_A_NAME = re.compile(r"image(?:_(?:raw|rect|rectified|color|mono))*|compressed|sensors?|driver")
_BRIGHTEST = (1.0, 255.0, 65535.0)
"""Largest intensities of LiDARs: of calibrated ones, of one byte, of two."""
_LOOKED_AT = 5


class BagDrive(AbstractPosedDrive):
    """Reads the point clouds of one topic, and every camera with a camera info."""

    @cached_property
    def _index(self) -> BagIndex:
        return index_of(self.scene.root)

    @cached_property
    def _lidar_topic(self) -> str | None:
        return self._index.lidar_topic(self.scene.lidar_topic)

    @cached_property
    def _scans(self) -> list[Stamped]:
        topic = self._lidar_topic
        return [] if topic is None else self._index.scans[topic]

    @cached_property
    def _topics(self) -> dict[str, str]:
        """Camera to the topic of its images; of a raw and a compressed topic the compressed one."""
        found: dict[str, str] = {}
        for topic in sorted(self._index.images, key=len):
            found[camera_name(topic)] = topic
        return found

    @cached_property
    def _images(self) -> dict[str, dict[int, Stamped]]:
        """Camera to frame to image."""
        frames = np.array(list(self._seconds.values())) + self.stamp_shift_s
        found: dict[str, dict[int, Stamped]] = {}
        numbers = list(self._seconds)
        nearest_s = 0.5 * (median_step_s([one.stamp_s for one in self._scans]) or NOMINAL_PERIOD_S)
        for name, topic in self._topics.items():
            own: dict[int, Stamped] = {}
            for image in self._index.images[topic]:
                at = int(np.abs(frames - image.stamp_s).argmin())
                apart_s = abs(float(frames[at]) - image.stamp_s)
                before = own.get(numbers[at])
                is_nearer = before is None or apart_s < abs(float(frames[at]) - before.stamp_s)
                if apart_s <= nearest_s and is_nearer:
                    own[numbers[at]] = image
            found[name] = own
        return found

    def has_data(self) -> bool:
        """Whether the bag is there; what is wrong with it, the stage `frames` says."""
        return self.scene.root.exists()

    def section(self) -> Section:
        """The bag's files."""
        root = self.scene.root
        files = (root,) if root.is_file() else tuple(sorted(one for one in root.glob("*") if one.is_file()))
        frames = list(self._seconds) if files else []
        return Section(
            files=files, folders=(root,) if root.exists() else (), missing=(), gaps=(),
            recorded=(frames[0], frames[-1]) if frames else None,
        )  # fmt: skip

    def frame_seconds(self) -> dict[int, float]:
        """Stamps of the point clouds; without any, of the first camera's images."""
        messages = self._scans or next(iter(self._index.images.values()), [])
        return {k: one.stamp_s for k, one in enumerate(_distinct(messages))}

    @property
    def times_source(self) -> str:
        """For messages."""
        return f"headers of {self._lidar_topic or next(iter(self._index.images), 'nothing')}"

    def pose_path(self) -> PosePath | None:
        """Poses by `/tf` or an odometry; None if nothing above the LiDAR moves."""
        return self._index.tree.path(self._lidar_frame)

    @property
    def _lidar_frame(self) -> str:
        index = self._index
        topic = self._lidar_topic or next(iter(index.images), "")
        return index.frame_ids.get(topic, "")

    def has_scans(self) -> bool:
        """Whether there is a point cloud."""
        return bool(self._scans)

    def other_scans(self) -> str:
        """The bag's other topics of point clouds, and which key reads one of them."""
        others = sorted(set(self._index.scans) - {self._lidar_topic})
        return f"not read: {', '.join(others)} (`lidar_topic` of the scene, --topic)" if others else ""

    def recorded_sensor(self) -> str:
        """Bags do not say."""
        return ""

    @cached_property
    def _mounted(self) -> tuple[Calibration, dict[str, Lens]]:
        wanted = self._topics if self.scene.cameras is None else self.scene.cameras
        unknown = sorted(set(self.scene.rectified) - set(self._topics))
        if unknown:
            raise CalibrationError(
                f"rectified: no images of camera {unknown[0]}; there are {[*self._topics]}"
            )
        cameras, lenses, notes = {}, {}, []
        for name in wanted:
            try:
                if name not in self._topics:
                    raise CalibrationError(f"camera {name}: no topic of images; there are {[*self._topics]}")
                lenses[name], to_lidar, doubts = self._camera(name)
                notes += doubts
                cameras[name] = CameraCalibration(
                    name=name, intrinsics=lenses[name].intrinsics, to_pose=to_lidar
                )
            except CalibrationError as error:
                if self.scene.cameras is not None:
                    raise
                notes.append(f"{name} left out: {error}")
        if self.other_scans():
            notes.append(f"point clouds of {self._lidar_topic}; {self.other_scans()}")
        notes += self._index.tree.notes_on(self._lidar_frame)
        notes += [f"{count} messages of {topic} are damaged" for topic, count in self._index.faults.items()]
        found = Calibration(
            lidar_to_pose=np.eye(4), lidar_is_assumed=False, cameras=cameras, notes=tuple(notes)
        )
        return found, lenses

    def _camera(self, name: str) -> tuple[Lens, np.ndarray, list[str]]:
        """A camera's lens, its pose in the LiDAR's frame, and what is doubtful."""
        index, topic = self._index, self._topics[name]
        info = next(
            (own for own in index.infos if camera_name(own.replace("camera_info", "image")) == name), None
        )
        if info is None:
            raise CalibrationError(f"expected a camera info beside {topic}, found none")
        unread = index.encoding_faults.get(topic)
        if unread is not None:
            raise CalibrationError(f"{topic}: {unread}")
        to_lidar = index.tree.between(index.frame_ids[topic], self._lidar_frame)
        if to_lidar is None:
            raise CalibrationError(
                f"expected fixed transforms from {index.frame_ids[topic]!r} to {self._lidar_frame!r} in "
                "/tf_static, found none"
            )
        is_rectified = name in self.scene.rectified or "/rect" in topic or "_rect" in topic
        facts = lens_facts(index.infos[info], info, is_rectified=is_rectified)
        doubts = []
        if is_of_p(index.infos[info], is_rectified=is_rectified):
            place = rectified_place(index, info, index.frame_ids[topic])
            to_lidar = to_lidar @ place
            if not np.allclose(place, np.eye(4), atol=1e-6):
                doubts.append(
                    f"{name}: {place_words(place)} {index.frame_ids[topic]!r}, by R and P of {info}"
                )
        if not is_rectified and "_raw" not in topic and has_two_cameras(index.infos[info]):
            doubts.append(
                f"{topic}: taken to be as the camera saw it (K, D), whose P is of another camera; if it is "
                f"rectified already, say so: rectified = [{name!r}] in the scene, or --rectified {name}"
            )
        return lens_of(facts, info), to_lidar, doubts

    def facts(self) -> DriveFacts:
        """See the base class; with a note on images that no frame takes."""
        facts = super().facts()
        notes = []
        for name in facts.calibration.cameras:
            recorded, kept = len(self._index.images[self._topics[name]]), len(self._images[name])
            if kept < recorded:
                notes.append(
                    f"{name}: {recorded - kept} of {recorded} images in the bag are left out: a scan takes "
                    "the one nearest to it, within half the time from scan to scan"
                )
        return replace(facts, notes=(*facts.notes, *notes))

    def calibration(self) -> Calibration:
        """Camera infos and fixed transforms. The pose frame is the LiDAR's."""
        return self._mounted[0]

    def image_seconds(self, camera: str) -> dict[int, float]:
        """Stamps of a camera's images."""
        return {frame: one.stamp_s for frame, one in self._images.get(camera, {}).items()}

    def camera_place(self, camera: str) -> Path | None:
        """The bag."""
        return self.scene.root if camera in self._topics else None

    def scan_name(self, frame: int) -> str:
        """For messages."""
        return f"number {frame} of {self._lidar_topic}"

    def image_name(self, camera: str, frame: int) -> str:
        """For messages."""
        return f"of {self._topics.get(camera, camera)} near scan {frame}"

    def find_scan(self, frame: int) -> Recorded | None:
        """The bytes of a point cloud's message."""
        messages = _distinct(self._scans)
        if not 0 <= frame < len(messages):
            return None
        return self._recorded(str(self._lidar_topic), messages[frame])

    def find_image(self, camera: str, frame: int, width: int, height: int) -> Recorded | None:
        """The bytes of an image's message."""
        found = self._images.get(camera, {}).get(frame)
        return None if found is None else self._recorded(self._topics[camera], found)

    def _recorded(self, topic: str, message: Stamped) -> Recorded:
        with open_bag(self.scene.root) as reader:
            connections = [one for one in reader.connections if one.topic == topic]
            found, least_s = None, np.inf
            try:
                # By a simulated clock that ticks more slowly than a sensor, several are kept at once.
                for _, _, raw in reader.messages(
                    connections=connections, start=message.kept_ns, stop=message.kept_ns + 1
                ):
                    apart_s = abs(header_of(raw, is_ros2=reader.is2)[0] - message.stamp_s)
                    if apart_s < least_s:
                        found, least_s = bytes(raw), apart_s
                    if apart_s == 0.0:
                        break
            except Exception as error:  # the library's errors on damaged bags have no common base
                damaged = f"{topic} at {message.stamp_s:.6f} s cannot be read ({error!s:.200})"
                raise read_fault(self.scene.root, error, damaged) from error
        if found is None:
            raise DataError(
                f"{self.scene.root}: {topic} at {message.stamp_s:.6f} s is gone; copy the bag again"
            )
        name = f"{topic.strip('/')}@{message.stamp_s:.6f}"
        return Recorded(self.scene.root / name, found)

    def _message(self, found: Recorded, kinds: tuple[str, ...]) -> Any:
        topic = str(found.path.relative_to(self.scene.root)).rpartition("@")[0]
        with open_bag(self.scene.root) as reader:
            kind = next(
                one.msgtype for one in reader.connections
                if str(PurePosixPath(one.topic.strip("/"))) == topic and one.msgtype in kinds
            )  # fmt: skip
            try:
                return reader.deserialize(found.data, kind)
            except Exception as error:  # as above
                raise DataError(f"{found.path}: damaged message ({error!s:.200})") from error

    def _decoded(self, found: Recorded) -> Scan:
        """The scan with times after its stamp."""
        message = self._message(found, (POINT_CLOUD,))
        columns = cloud_columns(message, str(found.path))
        return scan_of_columns(found.path, columns, self._brightest, stamp_s(message))

    @cached_property
    def _brightest(self) -> float:
        """The largest intensity that the LiDAR can give, from some scans."""
        most = 0.0
        for frame in list(self.frames)[:: max(1, len(self.frames) // _LOOKED_AT)]:
            try:
                found = self.find_scan(frame)
                if found is None:
                    continue
                shine = cloud_columns(self._message(found, (POINT_CLOUD,)), "").get("intensity")
            except DataError:
                continue  # named where the frame itself is read
            if shine is not None and len(shine):
                most = max(most, float(np.percentile(shine.astype(np.float64), 99.9)))
        return next((one for one in _BRIGHTEST if most <= one), most)

    def parse_image(self, camera: str, found: Recorded, width: int, height: int) -> np.ndarray:
        """Decode an image and take out the distortion that the flow has no model of."""
        message = self._message(found, IMAGES)

        def decode(data: bytes) -> np.ndarray:
            return decode_picture(found.path, data, width, height)

        rgb = image_rgb(message, str(found.path), decode)
        if rgb.shape != (height, width, 3):
            raise DataError(
                f"{found.path}: wrong size, expected {width} x {height} as the camera info says, found "
                f"{rgb.shape[1]} x {rgb.shape[0]}"
            )
        return self.rectified(camera, rgb)

    def rectified(self, camera: str, rgb: np.ndarray) -> np.ndarray:
        """The image without the distortion that the flow has no model of."""
        return self._mounted[1][camera].rectified(rgb)


def camera_name(topic: str) -> str:
    """A camera's name from its topic: `/sensors/camera/front/image_raw` is `camera_front`."""
    parts = [part for part in topic.lower().split("/") if part and not _NOT_A_NAME.fullmatch(part)]
    name = re.sub(r"[^a-z0-9]+", "_", "_".join(parts)).strip("_")
    return name if name[:1].isalpha() else f"camera_{name}".rstrip("_")


def _distinct(messages: list[Stamped]) -> list[Stamped]:
    """Messages of ascending stamps; a repeated stamp is taken once."""
    return [one for k, one in enumerate(messages) if k == 0 or one.stamp_s > messages[k - 1].stamp_s]
