"""What a hand is: a frozen tree of links with joints, masses, collision primitives and contact candidates.

Link frames are the URDF's. The base frame is the frame of `base_link`. Metres, radians, kilograms, newton metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

PrimitiveKind = Literal["box", "sphere", "capsule", "cylinder", "hull"]
JointKind = Literal["revolute", "prismatic", "fixed"]


@dataclass(frozen=True, eq=False)
class Primitive:
    """One convex collision solid, fixed in its link.

    Attributes:
        link: index of the link it belongs to.
        kind: what solid it is.
        rotation: `R_link_primitive`; capsules and cylinders lie along the primitive's z axis.
        translation: the primitive's origin in the link frame [m].
        size: box: three half extents; sphere: radius; capsule and cylinder: radius, half length; hull: empty [m].
        vertices: corners of a hull in the primitive's frame, empty for other kinds [m].
        faces: triangles of a hull, counter-clockwise seen from outside.
    """

    link: int
    kind: PrimitiveKind
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    size: tuple[float, ...]
    vertices: Float[np.ndarray, "vertices 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    faces: Int[np.ndarray, "faces 3"] = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))


@dataclass(frozen=True, eq=False)
class HandModel:
    """A hand as loaded. Links are in depth-first order, link 0 is `base_link`; joints in depth-first order too.

    Attributes:
        name: the hand's name.
        urdf: path of the description, as loaded.
        link_names: every link, those behind fixed joints included.
        joint_names: actuated joints, in pytorch-kinematics' order.
        lower, upper: joint limits [rad] or [m].
        effort: greatest joint torque [N·m] or force [N].
        velocity: greatest joint speed, infinite where unset [rad/s] or [m/s].
        open_posture, closed_posture: joint values of an open hand and of a fist around something.
        palm_center: the point of the palm's surface that grasps centre on, base frame [m].
        palm_normal: unit direction out of the palm, base frame.
        approach: unit direction in which the hand moves towards an object, base frame.
        link_parent: each link's parent, -1 for the base.
        link_joint: the actuated joint that moves the link against its parent, -1 where none does.
        link_offset_rotation, link_offset_translation: `T_parent_link` at joint value zero [m].
        joint_axis: unit axis of the link's own joint in the link frame, zero where fixed.
        joint_kind: kind of the joint between link and parent.
        link_group: links welded to each other by fixed joints share a number.
        link_mass: [kg]; zero where the description gives none.
        link_com: centre of mass, link frame [m].
        link_inertia: about the centre of mass, in link axes [kg·m²].
        primitives: collision solids.
        adjacent: pairs of links that are never checked against each other, symmetric, true on the diagonal.
        candidate_points: contact candidates, frame of their link [m].
        candidate_normals: outward unit normals there.
        candidate_link: the link of each candidate.
        warnings: what had to be guessed while loading.
    """

    name: str
    urdf: str
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    lower: Float[np.ndarray, "joints"]
    upper: Float[np.ndarray, "joints"]
    effort: Float[np.ndarray, "joints"]
    velocity: Float[np.ndarray, "joints"]
    open_posture: Float[np.ndarray, "joints"]
    closed_posture: Float[np.ndarray, "joints"]
    palm_center: Float[np.ndarray, "3"]
    palm_normal: Float[np.ndarray, "3"]
    approach: Float[np.ndarray, "3"]
    link_parent: Int[np.ndarray, "links"]
    link_joint: Int[np.ndarray, "links"]
    link_offset_rotation: Float[np.ndarray, "links 3 3"]
    link_offset_translation: Float[np.ndarray, "links 3"]
    joint_axis: Float[np.ndarray, "links 3"]
    joint_kind: tuple[JointKind, ...]
    link_group: Int[np.ndarray, "links"]
    link_mass: Float[np.ndarray, "links"]
    link_com: Float[np.ndarray, "links 3"]
    link_inertia: Float[np.ndarray, "links 3 3"]
    primitives: tuple[Primitive, ...]
    adjacent: Bool[np.ndarray, "links links"]
    candidate_points: Float[np.ndarray, "candidates 3"]
    candidate_normals: Float[np.ndarray, "candidates 3"]
    candidate_link: Int[np.ndarray, "candidates"]
    warnings: tuple[str, ...] = ()

    @property
    def base_link(self) -> str:
        """Name of the root link, whose frame is the base frame."""
        return self.link_names[0]

    @property
    def num_joints(self) -> int:
        """Number of actuated joints."""
        return len(self.joint_names)

    @property
    def num_links(self) -> int:
        """Number of links, fixed ones included."""
        return len(self.link_names)

    @cached_property
    def link_index(self) -> dict[str, int]:
        """Link name to link number."""
        return {name: i for i, name in enumerate(self.link_names)}

    @cached_property
    def primitives_of(self) -> tuple[tuple[Primitive, ...], ...]:
        """The primitives of each link, by link number."""
        return tuple(tuple(p for p in self.primitives if p.link == i) for i in range(self.num_links))
