"""What a library knows an object by: the content of mesh and hand, and the physics that its grasps were tried with."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

from graspd_core.errors import MeshError
from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import content_hash
from graspd_core.mesh.shapes import make_shape
from graspd_core.runtime.disk_cache import digest
from graspd_core.scene.load_scene import SHAPE_PREFIX
from graspd_core.scene.scene import ObjectModel

# How much a verification asks: what held under more is good where less is asked.
STRICTNESS = {"none": 0, "standard": 1, "full": 1, "hard": 2, "hard_full": 2}
# Not part of a hand's content: what it is called, where it is mounted, and points that are drawn anew for each plan.
_NO_CONTENT = {"name", "urdf", "link_names", "joint_names", "warnings", "mount", "mimics"}
_NO_CONTENT |= {"candidate_points", "candidate_normals", "candidate_link"}


@dataclass(frozen=True)
class LibraryEntry:
    """An object at one size, a hand, and physics.

    Attributes:
        name: what the object is called: of its file, with the scale where that is not 1.
        source: absolute path of its file, or shape:NAME; empty for a mesh that had no file.
        file_sha256: hash of the file's content; empty likewise.
        mesh_sha256: hash of the cleaned mesh in metres.
        scale: metres per unit of the file.
        mass: [kg].
        friction: Coulomb coefficient.
        verify: the trials that its grasps passed.
        hand: the hand's name.
        hand_content: hash of the hand's kinematics and solids.
    """

    name: str
    source: str
    file_sha256: str
    mesh_sha256: str
    scale: float
    mass: float
    friction: float
    verify: str
    hand: str
    hand_content: str

    @property
    def key(self) -> str:
        """By content: not what object and hand are called."""
        content = (self.mesh_sha256, self.hand_content, self.mass, self.friction, self.verify)
        return digest(content)[:32]


def entry_of(target: ObjectModel, hand: HandModel, verify: str, name: str = "") -> LibraryEntry:
    """The entry of an object as it was loaded."""
    file = target.source.startswith(SHAPE_PREFIX) or Path(target.source).is_file()
    source = absolute(target.source) if file else ""
    return LibraryEntry(
        name=name or entry_name(target.source, target.scale),
        source=source,
        file_sha256=source_hash(source) if source else "",
        mesh_sha256=target.sha256,
        scale=target.scale,
        mass=target.mass,
        friction=target.friction,
        verify=verify,
        hand=hand.name,
        hand_content=hand_hash(hand),
    )


def entry_name(source: str, scale: float) -> str:
    """What an object of a file or a shape is called: mug, or mug@0.5."""
    stem = source.removeprefix(SHAPE_PREFIX) if source.startswith(SHAPE_PREFIX) else Path(source).stem
    return stem if scale == 1.0 else f"{stem}@{scale:g}"


def absolute(source: str) -> str:
    """The source as it is found from anywhere."""
    return source if source.startswith(SHAPE_PREFIX) else str(Path(source).resolve())


def source_hash(source: str) -> str:
    """Hash of the content of a mesh file or a shape. Raises MeshError: it cannot be read."""
    if source.startswith(SHAPE_PREFIX):
        return content_hash(make_shape(source.removeprefix(SHAPE_PREFIX)))
    try:
        found = os.stat(source)
        return _file_hash(source, found.st_mtime_ns, found.st_size)
    except OSError as error:
        raise MeshError(f"{source}: {error.strerror or error}") from None


@lru_cache(maxsize=4096)
def _file_hash(path: str, changed: int, size: int) -> str:
    """Of a file that was last written then [ns] and is so long [bytes]: read again only after a change."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@lru_cache(maxsize=8)
def hand_hash(hand: HandModel) -> str:
    """Hash of all that a grasp and its trials depend on; a prefix of names does not count."""
    mimics = tuple((m.link, m.joint, m.multiplier, m.offset) for m in hand.mimics)
    content = (getattr(hand, item.name) for item in fields(hand) if item.name not in _NO_CONTENT)
    return digest((*content, mimics))
