"""Define the hand model: a tree of links with joints, masses, collision primitives and contact candidates.

Link frames are the frames of the URDF. The base frame is the frame of `base_link`. Units are m, rad, kg, N, N·m.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.types import TriangleMesh

PrimitiveKind = Literal["box", "sphere", "capsule", "cylinder", "hull"]
JointKind = Literal["revolute", "prismatic", "fixed"]

# Pose of the base link if the file gives none.
AT_ORIGIN = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
# Travel of a prismatic joint that counts as one radian [m]. One radian moves a fingertip at 50 mm by this length.
METRES_PER_RADIAN = 0.05


@dataclass(frozen=True, eq=False)
class Primitive:
    """A convex collision shape, fixed to a link.

    Attributes:
        link: index of the link.
        kind: kind of the shape.
        rotation: `R_link_primitive`. Capsules and cylinders lie along the primitive's z axis.
        translation: origin of the primitive in the link frame [m].
        size: three half extents (box), radius (sphere), radius and half length (capsule, cylinder), () (hull) [m].
        vertices: corners of a hull in the primitive's frame [m]. Empty for other kinds.
        faces: triangles of a hull, counter-clockwise seen from outside.
    """

    link: int
    kind: PrimitiveKind
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    size: tuple[float, ...]
    vertices: Float[np.ndarray, "vertices 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    faces: Int[np.ndarray, "faces 3"] = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))


@dataclass(frozen=True)
class Mimic:
    """A joint coupled to an actuated joint. Its value is `multiplier · q[joint] + offset`.

    Attributes:
        name: name of the coupled joint.
        link: link that the coupled joint moves.
        joint: index of the actuated joint, also if the coupling leads through other coupled joints.
        multiplier: travel of the coupled joint per radian or metre of the actuated joint.
        offset: value of the coupled joint when the actuated joint is at zero [rad] or [m].
    """

    name: str
    link: int
    joint: int
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Mount:
    """The pose of a hand's base link on an arm: `T_parent_base`.

    Attributes:
        parent: link of the arm to which the hand is fixed, e.g. its flange or tool frame.
        position: position of the base link in the parent's frame [m].
        quaternion_wxyz: orientation of the base link in the parent's frame, a unit quaternion.
    """

    parent: str
    position: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class HandModel:
    """A loaded hand. Links and joints are in depth-first order. Link 0 is `base_link`.

    Joint arrays contain the actuated joints. Coupled joints follow from the actuated joints (`mimics`). Only output
    files and ROS messages also list the coupled joints (`all_joint_names`).

    Attributes:
        name: name of the hand.
        urdf: path of the loaded URDF or other hand file.
        link_names: names of all links, also of links behind fixed joints.
        joint_names: names of the actuated joints.
        lower, upper: joint limits [rad] or [m].
        effort: greatest joint torque [N·m] or force [N].
        velocity: greatest joint speed [rad/s] or [m/s]. Infinite if the file gives none.
        open_posture, closed_posture: joint values of the open hand and of the hand closed around an object.
        palm_center: centre of the palm's surface, base frame [m].
        palm_normal: unit direction out of the palm, base frame.
        approach: unit direction in which the hand moves towards an object, base frame.
        link_parent: parent of each link, -1 for the base.
        link_joint: actuated joint that moves the link relative to its parent, directly or by coupling. -1 for none.
        link_offset_rotation, link_offset_translation: `T_parent_link` at joint value zero [m].
        joint_axis: unit axis of the joint between link and parent, link frame. Zero for a fixed joint.
        joint_kind: kind of the joint between link and parent.
        link_group: rigid group of each link, numbered by its first link. Fixed joints connect the links of a group.
        link_mass: mass of each link [kg]. Zero if the file gives none.
        link_com: centre of mass, link frame [m].
        link_inertia: inertia about the centre of mass, in link axes [kg·m²].
        primitives: convex collision shapes.
        adjacent: True for pairs of links that are never checked for collision. Symmetric, True on the diagonal.
        candidate_points: contact candidates, in the frames of their links [m].
        candidate_normals: outward unit normals at the candidates, in the frames of their links.
        candidate_link: link of each candidate.
        warnings: guesses and doubtful values, found while loading.
        base_place: pose of the base link in the frame of the hand's file: position [m] and quaternion wxyz.
        mimics: coupled joints, in the order of their links.
        mount: pose of the base link on an arm. None if it is unknown.
        skins: index and surface mesh, link frame [m], of each link whose contact candidates lie on a mesh.
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
    candidate_points: Float[np.ndarray, "candidates 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    candidate_normals: Float[np.ndarray, "candidates 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    candidate_link: Int[np.ndarray, "candidates"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    warnings: tuple[str, ...] = ()
    base_place: tuple[tuple[float, float, float], tuple[float, float, float, float]] = AT_ORIGIN
    mimics: tuple[Mimic, ...] = ()
    mount: Mount | None = None
    skins: tuple[tuple[int, TriangleMesh], ...] = ()

    @property
    def base_link(self) -> str:
        """Name of the root link. Its frame is the base frame."""
        return self.link_names[0]

    @property
    def named_warnings(self) -> tuple[str, ...]:
        """The warnings, each with the hand's name."""
        return tuple(f"hand {self.name}: {warning}" for warning in self.warnings)

    @property
    def num_joints(self) -> int:
        """Number of actuated joints."""
        return len(self.joint_names)

    @property
    def num_links(self) -> int:
        """Number of links, including links behind fixed joints."""
        return len(self.link_names)

    @cached_property
    def link_index(self) -> dict[str, int]:
        """The index of each link by name."""
        return {name: i for i, name in enumerate(self.link_names)}

    @cached_property
    def primitives_of(self) -> tuple[tuple[Primitive, ...], ...]:
        """The primitives of each link, by link index."""
        return tuple(tuple(p for p in self.primitives if p.link == i) for i in range(self.num_links))

    @cached_property
    def fingertip_groups(self) -> Int[np.ndarray, "tips"]:
        """The rigid groups without a child group. They are at the ends of the fingers."""
        groups = np.unique(self.link_group)
        return np.setdiff1d(groups, self.link_group[self.link_parent[groups[1:]]])

    @cached_property
    def link_joint_names(self) -> tuple[str, ...]:
        """Name of the actuated or coupled joint between each link and its parent. Empty for a fixed joint."""
        names = [self.joint_names[joint] if joint >= 0 else "" for joint in self.link_joint.tolist()]
        for mimic in self.mimics:
            names[mimic.link] = mimic.name
        return tuple(names)

    @cached_property
    def link_multiplier(self) -> Float[np.ndarray, "links"]:
        """Motion of the joint above each link per unit motion of `link_joint`. 1 if the joint above is not coupled."""
        multiplier = np.ones(self.num_links)
        for mimic in self.mimics:
            multiplier[mimic.link] = mimic.multiplier
        return multiplier

    @cached_property
    def link_shift(self) -> Float[np.ndarray, "links"]:
        """Value of the joint above each link when `link_joint` is at zero [rad] or [m]. 0 if not coupled."""
        shift = np.zeros(self.num_links)
        for mimic in self.mimics:
            shift[mimic.link] = mimic.offset
        return shift

    @cached_property
    def slides(self) -> Bool[np.ndarray, "joints"]:
        """True for each actuated joint that is prismatic."""
        slides, own = np.zeros(self.num_joints, dtype=bool), self.link_joint >= 0
        own[[mimic.link for mimic in self.mimics]] = False
        slides[self.link_joint[own]] = np.array(self.joint_kind)[own] == "prismatic"
        return slides

    @cached_property
    def joint_scale(self) -> Float[np.ndarray, "joints"]:
        """The travel of each joint that counts as one radian: 1 rad if revolute, a length [m] if prismatic."""
        return np.where(self.slides, METRES_PER_RADIAN, 1.0)

    def joint_speeds(self, turning: float, sliding: float) -> Float[np.ndarray, "joints"]:
        """Return the greatest speed of each actuated joint [rad/s] or [m/s], within the joints' own limits.

        Revolute joints keep below `turning` [rad/s], prismatic joints below `sliding` [m/s], coupled joints included.
        """
        speeds, moved = self.velocity.copy(), self.link_joint >= 0
        own = np.where(np.array(self.joint_kind) == "prismatic", sliding, turning)
        own = own / np.maximum(np.abs(self.link_multiplier), 1e-9)
        np.minimum.at(speeds, self.link_joint[moved], own[moved])
        return speeds


def all_joint_names(hand: HandModel) -> tuple[str, ...]:
    """Return the names of all actuated and coupled joints, depth-first, as in output files and ROS messages."""
    return tuple(name for name in hand.link_joint_names if name)


def all_joint_positions(hand: HandModel, q: Float[np.ndarray, "joints"]) -> Float[np.ndarray, "movable"]:
    """Return the values of `all_joint_names` for the actuated joint values q [rad] or [m]."""
    moved = hand.link_joint >= 0
    return hand.link_multiplier[moved] * q[hand.link_joint[moved]] + hand.link_shift[moved]
