"""A hand as a frozen tree of links with joints, masses, collision primitives and contact candidates.

Link frames are the URDF's. The base frame is the frame of `base_link`. Metres, radians, kilograms, newton metres.
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

# Where the base link stands in a file that says nothing of it.
AT_ORIGIN = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
# Travel of a sliding joint that counts as much as a turn of one radian [m]: what a finger of 50 mm makes of it.
METRES_PER_RADIAN = 0.05


@dataclass(frozen=True, eq=False)
class Primitive:
    """One convex collision solid, fixed in its link.

    Attributes:
        link: index of the link it belongs to.
        kind: what solid it is.
        rotation: `R_link_primitive`, capsules and cylinders lie along the primitive's z axis.
        translation: the primitive's origin in the link frame [m].
        size: [m] three half extents (box), radius (sphere), radius and half length (capsule, cylinder), none (hull).
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


@dataclass(frozen=True)
class Mimic:
    """A joint coupled to an actuated one: its value is `multiplier · q[joint] + offset`.

    Attributes:
        name: of the coupled joint.
        link: the link that it moves.
        joint: the actuated joint that it follows, chains of coupled joints resolved.
        multiplier: its travel for one radian or metre of that joint.
        offset: its value where that joint is at zero [rad] or [m].
    """

    name: str
    link: int
    joint: int
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Mount:
    """Where a hand's base link sits on the arm that carries it: `T_parent_base`.

    Attributes:
        parent: the arm's link, its flange or tool frame.
        position: of the base link in that frame [m].
        quaternion_wxyz: of the base link in that frame, unit.
    """

    parent: str
    position: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class HandModel:
    """A hand as loaded. Links and joints are in depth-first order. Link 0 is `base_link`.

    Joints are the actuated ones throughout: coupled joints follow from them (`mimics`), and only what leaves graspd
    lists them too (`all_joint_names`).

    Attributes:
        name: the hand's name.
        urdf: path of the description, as loaded.
        link_names: every link, those behind fixed joints included.
        joint_names: actuated joints, depth-first.
        lower, upper: joint limits [rad] or [m].
        effort: greatest joint torque [N·m] or force [N].
        velocity: greatest joint speed, infinite where unset [rad/s] or [m/s].
        open_posture, closed_posture: joint values of an open hand and of a fist around something.
        palm_center: the point of the palm's surface that grasps centre on, base frame [m].
        palm_normal: unit direction out of the palm, base frame.
        approach: unit direction in which the hand moves towards an object, base frame.
        link_parent: each link's parent, -1 for the base.
        link_joint: the actuated joint that moves the link against its parent, directly or coupled, -1 for none.
        link_offset_rotation, link_offset_translation: `T_parent_link` at joint value zero [m].
        joint_axis: unit axis of the link's own joint in the link frame, zero where fixed.
        joint_kind: kind of the joint between link and parent.
        link_group: links welded to each other by fixed joints share a number.
        link_mass: [kg], zero if the description gives none.
        link_com: centre of mass, link frame [m].
        link_inertia: about the centre of mass, in link axes [kg·m²].
        primitives: collision solids.
        adjacent: pairs of links that are never checked against each other, symmetric, true on the diagonal.
        candidate_points: contact candidates, frame of their link [m].
        candidate_normals: outward unit normals there.
        candidate_link: the link of each candidate.
        warnings: what had to be guessed while loading.
        base_place: where the base link stands in the frame of its file, position [m] and quaternion wxyz.
        mimics: the coupled joints, in the order of their links.
        mount: where the base link sits on an arm, None where nobody said.
        skins: links, and the surfaces that their contact candidates lie on where it is not that of their solids [m].
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
    base_place: tuple[tuple[float, float, float], tuple[float, float, float, float]] = AT_ORIGIN
    mimics: tuple[Mimic, ...] = ()
    mount: Mount | None = None
    skins: tuple[tuple[int, TriangleMesh], ...] = ()

    @property
    def base_link(self) -> str:
        """Name of the root link, whose frame is the base frame."""
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

    @cached_property
    def fingertip_groups(self) -> Int[np.ndarray, "tips"]:
        """Groups of rigidly joined links at the ends of the fingers: those that move no further group."""
        groups, parents = self.link_group, self.link_parent
        inner = {int(groups[p]) for link, p in enumerate(parents) if p >= 0 and groups[link] != groups[p]}
        return np.array(sorted(set(groups.tolist()) - inner), dtype=int)

    @cached_property
    def link_joint_names(self) -> tuple[str, ...]:
        """Name of the joint that moves each link against its parent, coupled ones too, empty for none."""
        names = [self.joint_names[joint] if joint >= 0 else "" for joint in self.link_joint.tolist()]
        for mimic in self.mimics:
            names[mimic.link] = mimic.name
        return tuple(names)

    @cached_property
    def link_multiplier(self) -> Float[np.ndarray, "links"]:
        """Travel of each link's own joint for one radian or metre of `link_joint`: one where it is that joint."""
        multiplier = np.ones(self.num_links)
        for mimic in self.mimics:
            multiplier[mimic.link] = mimic.multiplier
        return multiplier

    @cached_property
    def link_shift(self) -> Float[np.ndarray, "links"]:
        """Value of each link's own joint where `link_joint` is at zero [rad] or [m]."""
        shift = np.zeros(self.num_links)
        for mimic in self.mimics:
            shift[mimic.link] = mimic.offset
        return shift

    @cached_property
    def slides(self) -> Bool[np.ndarray, "joints"]:
        """Which actuated joints are prismatic."""
        slides = np.zeros(self.num_joints, dtype=bool)
        coupled = {mimic.link for mimic in self.mimics}
        for link, joint in enumerate(self.link_joint):
            if joint >= 0 and link not in coupled:
                slides[joint] = self.joint_kind[link] == "prismatic"
        return slides

    @cached_property
    def joint_scale(self) -> Float[np.ndarray, "joints"]:
        """The travel of each joint that counts as much as one radian [rad] or [m]."""
        return np.where(self.slides, METRES_PER_RADIAN, 1.0)


def all_joint_names(hand: HandModel) -> tuple[str, ...]:
    """Return the names of all movable joints, coupled ones too, depth-first, as files and messages hold them."""
    return tuple(name for name in hand.link_joint_names if name)


def all_joint_positions(hand: HandModel, q: Float[np.ndarray, "joints"]) -> Float[np.ndarray, "movable"]:
    """Return the values of `all_joint_names` at actuated values q [rad] or [m]."""
    moved = hand.link_joint >= 0
    return hand.link_multiplier[moved] * q[hand.link_joint[moved]] + hand.link_shift[moved]
