"""The transforms of a bag: a tree of frames, some of whose links move."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from nvsf_core.drives.kitti360.text import FARTHEST_M
from nvsf_core.drives.posed import PosePath
from nvsf_core.errors import DataError

_LONGEST_CHAIN = 100
_TRANSFORMS = "/tf"
"""Topic of links that move, and of fixed ones that are repeated."""
_STILL = 1e-6
"""Largest change, in metres and of a rotation's entries, of a link that is fixed."""
_WORLDS = ("earth", "map", "odom", "utm", "world")
"""Usual names of frames that cars move in."""


def plain_name(frame: str) -> str:
    """A frame's name without the slash that ROS 1 may begin it with."""
    return frame.lstrip("/")


def pose_of(translation: Any, rotation: Any) -> np.ndarray:
    """(4, 4) of a message's translation and quaternion.

    Raises:
        DataError: The quaternion has no length, a number is not finite, or the place is impossibly far.
    """
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w], np.float64)
    pose = np.eye(4)
    pose[:3, 3] = translation.x, translation.y, translation.z
    is_near = bool((np.abs(pose[:3, 3]) <= FARTHEST_M).all())
    if not is_near or not abs(float(np.linalg.norm(quaternion)) - 1.0) < 0.01:
        found = [*pose[:3, 3].tolist(), *quaternion.tolist()]
        raise DataError(f"expected a place within {FARTHEST_M:g} m and a rotation, found {found}")
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    return pose


class _Way(NamedTuple):
    """How a frame moves, as one topic says."""

    parent: str
    topic: str
    poses: dict[float, np.ndarray]

    def rank(self) -> tuple[bool, int, str, str]:
        """The least of several is taken."""
        return self.topic != _TRANSFORMS, -len(self.poses), self.topic, self.parent

    @property
    def words(self) -> str:
        """For notes."""
        return f"{self.topic} says, in {self.parent} ({len(self.poses)} poses)"


@dataclass(slots=True)
class TransformTree:
    """Links from frames to their parents."""

    place: Path
    """The bag, for messages."""
    fixed: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    """(child, parent) to child's frame in the parent's, (4, 4)."""
    moving: dict[tuple[str, str], dict[float, np.ndarray]] = field(default_factory=dict)
    """(child, parent) to seconds and pose, of one topic; of each child there is one."""
    _choices: dict[str, str] = field(default_factory=dict)
    """Frame that moves in several ways to the words for which is taken, and which are not."""
    _by_topic: dict[tuple[str, str], dict[str, dict[float, np.ndarray]]] = field(default_factory=dict)

    def add(self, child: str, parent: str, pose: np.ndarray, time_s: float | None, topic: str = "") -> None:
        """Add a link.

        Args:
            child: Name of the frame.
            parent: Name of the frame that it lies in.
            pose: (4, 4) child's frame in the parent's, metres.
            time_s: When; None = it never moves.
            topic: Where it was read.
        """
        link = (plain_name(child), plain_name(parent))
        if time_s is None:
            self.fixed[link] = pose
        else:
            self._by_topic.setdefault(link, {}).setdefault(topic, {})[time_s] = pose

    def settle(self) -> None:
        """Choose what moves, once all messages are added.

        A frame that moves as several topics say, or in several parents, as two odometries have it, moves in
        one way alone: they drift apart. Transforms come before odometries, then the way with the most poses.
        What a node for fixed transforms repeats on `/tf` is fixed, and so is a world that never moves in
        another, as `odom` in `map`; a car that stands all the time is not.
        """
        ways: dict[str, list[_Way]] = {}
        for link, topics in self._by_topic.items():
            repeated = list(topics.get(_TRANSFORMS, {}).values())
            is_car = link[1] in _WORLDS and link[0] not in _WORLDS
            if repeated and not is_car and np.abs(np.stack(repeated) - repeated[0]).max() < _STILL:
                self.fixed.setdefault(link, repeated[0])
            else:
                ways.setdefault(link[0], []).extend(_Way(link[1], *one) for one in topics.items())
        for child, found in ways.items():
            taken, *others = sorted(found, key=_Way.rank)
            self.moving[child, taken.parent] = taken.poses
            if others:
                self._choices[child] = (
                    f"{child} moves as {taken.words}; not used: {', '.join(one.words for one in others)}"
                )
        self._by_topic.clear()

    def chain(self, frame: str) -> list[tuple[str, str]]:
        """Links from a frame up to its root."""
        # A moving link outdoes a fixed one of the same child.
        parents, links, at = dict((*self.fixed, *self.moving)), list[tuple[str, str]](), plain_name(frame)
        while at in parents and len(links) < _LONGEST_CHAIN:
            links.append((at, parents[at]))
            at = parents[at]
        return links

    def path(self, frame: str) -> PosePath | None:
        """Poses of a frame in its root; None if no link above it moves.

        Raises:
            DataError: There is no moment at which all links above it are known.
        """
        links = self.chain(frame)
        moving = {link: self._path_of(link) for link in links if link in self.moving}
        if not moving:
            return None
        finest = max(moving.values(), key=lambda one: len(one.time_s))
        times_s, poses = [], []
        for time_s in finest.time_s.tolist():
            pose: np.ndarray | None = np.eye(4)
            for link in links:
                step = moving[link].at(time_s) if link in moving else self.fixed[link]
                pose = None if step is None or pose is None else step @ pose
            if pose is not None:
                times_s.append(time_s)
                poses.append(pose)
        if not poses:
            found = "; ".join(f"{child} in {parent}: {_rate(one)}" for (child, parent), one in moving.items())
            raise DataError(
                f"{self.place}: expected moments at which all that moves above {frame!r} is known, found "
                f"none: {found}; leave a topic out, or give poses at a higher rate"
            )
        return PosePath(np.array(times_s), np.stack(poses), self.place)

    def notes_on(self, frame: str) -> list[str]:
        """Which of several ways to move is taken, and which are not, of a frame and those above it."""
        mounts, notes = dict(self.fixed.keys()), []
        for child, parent in self.chain(frame):
            notes += [self._choices[child]] if child in self._choices else []
            is_mounted = (child, parent) in self.moving and child in mounts
            if is_mounted and any(link in self.moving for link in self.chain(mounts[child])):
                notes.append(
                    f"{child} moves in {parent}, and is mounted on {mounts[child]}, which moves, too: the "
                    f"path is that in {parent}"
                )
        return notes

    def between(self, frame: str, other: str) -> np.ndarray | None:
        """(4, 4) from a frame to another, of links that do not move; None if there is no such way."""
        up, down = self._fixed_way(frame), self._fixed_way(other)
        common = next((name for name in up if name in down), None)
        return None if common is None else np.linalg.inv(down[common]) @ up[common]

    def _fixed_way(self, frame: str) -> dict[str, np.ndarray]:
        """Frames above a frame by fixed links alone, and the frame's pose in each.

        A frame may move, too, as a LiDAR whose odometry names it: it stays mounted where `/tf_static` says.
        """
        parents, at, pose = dict(self.fixed.keys()), plain_name(frame), np.eye(4)
        found = {at: pose}
        while at in parents and parents[at] not in found:
            pose = self.fixed[at, parents[at]] @ pose
            at = parents[at]
            found[at] = pose
        return found

    def _path_of(self, link: tuple[str, str]) -> PosePath:
        times_s = np.array(sorted(self.moving[link]))
        return PosePath(times_s, np.stack([self.moving[link][one] for one in times_s.tolist()]), self.place)


def _rate(path: PosePath) -> str:
    """How many poses there are, when, and how far apart, in words."""
    step = f", {np.median(np.diff(path.time_s)):.3g} s apart in the median" if len(path.time_s) > 1 else ""
    return f"{len(path.time_s)} poses from {path.time_s[0]:.3f} to {path.time_s[-1]:.3f} s{step}"
