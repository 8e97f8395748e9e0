"""Keep time-stamped transforms (/tf and /tf_static) in a buffer, without a ROS node.

`T_a_b` maps coordinates in frame b to frame a. Stamps are integer nanoseconds. Between two samples the position is
interpolated linearly and the rotation spherically, as in tf2. A lookup before the first or after the last sample raises
an error that names the known time span.
"""

from __future__ import annotations

import bisect
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from graspd_core.errors import TransformError

SECOND = 1_000_000_000
HISTORY = 10 * SECOND

# Target of a lookup in the root above a frame. No frame has this name.
ROOT = "<root>"

_RIGID = 1e-3
# Greatest valid translation [m]. No two points on Earth are farther apart.
_FARTHEST = 1e8
# A camera rested if it moved and turned by less than this between two views [m], [rad].
_AT_REST, _AT_REST_TURN = 0.005, 0.01


@dataclass
class _Link:
    """Poses of one frame in its parent frame, by ascending stamp. A static frame has a single pose."""

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    poses: list[Float[np.ndarray, "4 4"]] = field(default_factory=list)


class TransformBuffer:
    """A thread-safe buffer that returns the transform between any two connected frames.

    Args:
        history: greatest age of a kept sample, relative to the frame's newest sample [ns]. None keeps all samples.
    """

    def __init__(self, history: int | None = HISTORY) -> None:
        self._history = history
        self._links: dict[str, _Link] = {}
        self._lock = threading.RLock()
        # The child and the fault of the last transform that was refused.
        self._refused = ("", "")

    def add(
        self, parent: str, child: str, T_parent_child: Float[np.ndarray, "4 4"], stamp: int = 0, static: bool = False
    ) -> None:
        """Add the pose of `child` in `parent` at `stamp` [ns]. A static transform is valid at all times.

        If a child gets a new parent, changes between static and moving, or its stamps jump back by more than the
        history, as when a recording restarts, the child's earlier poses are dropped.
        Raises TransformError: a frame has no valid name, the frames form a loop, or the transform is not rigid.
        """
        parent, child = _name(parent), _name(child)
        try:
            pose = _rigid(T_parent_child, parent, child)
        except TransformError as error:
            self._refused = (child, f"; refused: {error}")
            raise
        with self._lock:
            if child == self._refused[0]:
                self._refused = ("", "")
            above = self._chain(parent)
            if child in above:
                loop = " -> ".join([*reversed(above[: above.index(child) + 1]), child])
                raise TransformError(f"transform {parent} -> {child}: closes the loop {loop}")
            link = self._links.get(child)
            restarted = link and link.stamps and self._history is not None and stamp < link.stamps[-1] - self._history
            if link is None or link.parent != parent or static or link.static or restarted:
                link = self._links[child] = _Link(parent, static)
            self._insert(link, stamp, pose)

    def lookup(self, target: str, source: str, stamp: int | None = None) -> Float[np.ndarray, "4 4"]:
        """Return `T_target_source` at `stamp` [ns], by default at the newest time that all frames in between cover.

        The target `ROOT` is the root above `source`.
        Raises TransformError: a frame is unknown, the frames are not connected, or the time is outside the known span.
        """
        source = _name(source)
        with self._lock:
            target, known = self._chain(source)[-1] if target == ROOT else _name(target), self.frames()
            for name in (target, source):
                if name not in known:
                    heard = f"known: {', '.join(known)}" if known else "no transform was received on /tf or /tf_static"
                    raise TransformError(f"unknown frame {name!r}; {heard}{self.refused}")
            up_target, up_source = self._chain(target), self._chain(source)
            common = next((name for name in up_source if name in up_target), None)
            if common is None:
                raise TransformError(
                    f"transform {source} -> {target}: not connected; the root of {source} is {up_source[-1]}, "
                    f"that of {target} is {up_target[-1]}{self.refused}"
                )
            below_source = up_source[: up_source.index(common)]
            below_target = up_target[: up_target.index(common)]
            if stamp is None:
                moving = [link for name in (*below_source, *below_target) if not (link := self._links[name]).static]
                stamp = min((link.stamps[-1] for link in moving), default=0)
            what = f"transform {source} -> {target}"
            return _inverse(self._down(below_target, stamp, what)) @ self._down(below_source, stamp, what)

    @property
    def refused(self) -> str:
        """Text to append to an error about a missing frame: the last refused transform. Empty if none was refused."""
        return self._refused[1]

    def frames(self) -> tuple[str, ...]:
        """Return the names of all known frames, in alphabetical order."""
        with self._lock:
            return tuple(sorted({*self._links, *(link.parent for link in self._links.values())}))

    def clear(self) -> None:
        """Remove all moving transforms, for example after a jump back in time. Keep static transforms."""
        with self._lock:
            self._links = {child: link for child, link in self._links.items() if link.static}

    def _chain(self, name: str) -> list[str]:
        chain = [name]
        while chain[-1] in self._links:
            chain.append(self._links[chain[-1]].parent)
        return chain

    def _insert(self, link: _Link, stamp: int, pose: np.ndarray) -> None:
        place = bisect.bisect_left(link.stamps, stamp)
        if place < len(link.stamps) and link.stamps[place] == stamp:
            link.poses[place] = pose
            return
        link.stamps.insert(place, stamp)
        link.poses.insert(place, pose)
        if self._history is not None:
            old = bisect.bisect_left(link.stamps, link.stamps[-1] - self._history)
            del link.stamps[:old], link.poses[:old]

    def _down(self, names: list[str], stamp: int, what: str) -> Float[np.ndarray, "4 4"]:
        pose = np.eye(4)
        for name in names:
            pose = _pose_at(self._links[name], name, stamp, what) @ pose
        return pose


def refuse_motion(frame: str, poses: Sequence[Float[np.ndarray, "4 4"]]) -> None:
    """Raise TransformError if a camera frame moved between views. `poses` are its poses in a fixed frame [m]."""
    far = max((float(np.linalg.norm(pose[:3, 3] - poses[0][:3, 3])) for pose in poses), default=0.0)
    apart = max((float(np.linalg.norm(pose[:3, :3] - poses[0][:3, :3])) for pose in poses), default=0.0)
    # Two rotation matrices with the angle a in between differ by a matrix of the norm 2 √2 sin(a / 2).
    turn = 2 * math.asin(min(apart / math.sqrt(8), 1.0))
    if far > _AT_REST or turn > _AT_REST_TURN:
        told = f"frame {frame} moved by {1e3 * far:.0f} mm and {math.degrees(turn):.1f}° between views"
        most = f"{1e3 * _AT_REST:.0f} mm and {math.degrees(_AT_REST_TURN):.1f}°"
        raise TransformError(f"{told}; valid: at most {most}; set the parameter fixed_frame, or --frame")


def _pose_at(link: _Link, name: str, stamp: int, what: str) -> Float[np.ndarray, "4 4"]:
    if link.static:
        return link.poses[0]
    first, last = link.stamps[0], link.stamps[-1]
    if not first <= stamp <= last:
        raise TransformError(
            f"{what} at {_seconds(stamp)}: {name} in {link.parent} is known from {_seconds(first)} to {_seconds(last)}"
        )
    after = bisect.bisect_left(link.stamps, stamp)
    if link.stamps[after] == stamp:
        return link.poses[after]
    share = (stamp - link.stamps[after - 1]) / (link.stamps[after] - link.stamps[after - 1])
    return _between(link.poses[after - 1], link.poses[after], share)


def _between(a: np.ndarray, b: np.ndarray, share: float) -> Float[np.ndarray, "4 4"]:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    pose = np.eye(4)
    pose[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    pose[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return pose


def _inverse(T_a_b: np.ndarray) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3] = T_a_b[:3, :3].T
    pose[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return pose


def _rigid(pose: np.ndarray, parent: str, child: str) -> Float[np.ndarray, "4 4"]:
    turn = pose[:3, :3]
    # Check the size of the numbers first, because products of NaN, infinite or huge numbers cause NumPy warnings.
    fits = (np.abs(turn) < 2).all() and (np.abs(pose[:3, 3]) <= _FARTHEST).all()
    square = fits and np.abs(turn @ turn.T - np.eye(3)).max() < _RIGID and np.linalg.det(turn) > 0
    if not square:
        raise TransformError(f"transform {parent} -> {child}: not rigid; valid: a rotation and a finite position")
    return np.array(pose, dtype=float)


def _name(frame: str) -> str:
    # ROS 1 wrote a slash before frame names, and old drivers still write this slash.
    name = frame.removeprefix("/")
    if not name:
        raise TransformError("transform: a frame has no name")
    if not name.isprintable():
        raise TransformError(f"transform: the frame name {name[:80]!r} has a character that cannot be printed")
    return name


def _seconds(stamp: int) -> str:
    return f"{stamp // SECOND}.{stamp % SECOND:09d} s"
