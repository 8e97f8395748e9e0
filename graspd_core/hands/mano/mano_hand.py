"""Convert a MANO model to a `HandModel`: sixteen rigid bodies, forty-five hinges, a convex hull for every body.

Methods, metrics and trials see an ordinary hand. `ManoHand.skinned_mesh` returns MANO's own surface at the same joint
values. The hulls approximate the skin at rest, without the blend shapes of the pose. At a strongly bent joint the skin
differs from the hulls by a few millimetres. Contact candidates lie on the skin at rest.

The base frame has the model's axes and its origin in the wrist joint. The palm belongs to the wrist body.

Each of MANO's fifteen ball joints becomes three hinges. A body turns relative to its parent by `R = B Rx(flexion)
Ry(abduction) Rz(twist) Bᵀ`. B is the anatomical frame at rest: z along the bone, x the flexion axis, y = z × x. The
order of the hinges follows the ISB (Wu et al. 2005, after Grood and Suntay 1983).

The anatomical frames come from the joint positions of the shape. The palm normal is normal to the plane through wrist,
index knuckle and little knuckle. The normal points to the side to which the fingers bend in the mean pose. A finger
flexes towards the palm normal. The thumb flexes towards a point in front of the palm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from graspd_core.errors import HandError
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.mano.mano_file import BODIES, FINGERS, PARENTS, ManoData, read_mano
from graspd_core.hands.mano.mano_skin import close_wrist, closed_faces, rest, skin_vertices
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.readers.build_model import JointSpec, LinkSpec, assemble
from graspd_core.hands.self_collision import adjacent_links
from graspd_core.hands.surface_points import with_candidates
from graspd_core.mesh.convex_parts import limited_hull
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Posture, TriangleMesh

HINGES = ("flexion", "abduction", "twist")
# The thumb flexes towards a point at this distance in front of the palm [m].
_OPPOSITION = 0.05
# Limits of flexion, abduction and twist of three joints [deg] from the flat hand. A finger's joints flex by 90, 110 and
# 90, and a knuckle abducts by ±15 (Lin, Wu and Huang 2000). A knuckle also bends 20 backwards (Norkin and White: 45
# passively). The thumb's knuckle and tip flex by 50 and 80 (American Academy of Orthopaedic Surgeons 1965). Its saddle
# joint has total ranges of 53, 42 and 17 (Cooney et al. 1981), and MANO's rest pose lies near their middle. Axes that
# the literature does not count as degrees of freedom get a small range, because human joints have some play.
_FINGER_LIMITS = (
    ((-20.0, 90.0), (-15.0, 15.0), (-5.0, 5.0)),
    ((-5.0, 110.0), (-3.0, 3.0), (-3.0, 3.0)),
    ((-5.0, 90.0), (-3.0, 3.0), (-3.0, 3.0)),
)
_THUMB_LIMITS = (
    ((-20.0, 33.0), (-21.0, 21.0), (-8.5, 8.5)),
    ((-10.0, 50.0), (-8.0, 8.0), (-5.0, 5.0)),
    ((-15.0, 80.0), (-3.0, 3.0), (-3.0, 3.0)),
)
# Flexion of the open and of the closed hand [deg], for the three joints of a finger and of the thumb.
_OPEN, _CLOSED = ((10.0, 20.0, 10.0), (10.0, 0.0, 0.0)), ((45.0, 40.0, 20.0), (15.0, 10.0, 10.0))
# Greatest force of a fingertip [N]: half of an adult's tip pinch (Mathiowetz et al. 1985: 50 N women, 80 N men).
_TIP_FORCE = 30.0
# Least lever arm of every axis [m]. Twist has this lever arm.
_LEAST_LEVER = 0.02


def _all_fingers(finger: tuple, thumb: tuple) -> Float[np.ndarray, "15 *values"]:
    """Return values for all bodies except the wrist [rad], from those of one finger and of the thumb [deg]."""
    return np.deg2rad([*finger * (len(FINGERS) - 1), *thumb])


def _posture(finger: tuple[float, ...], thumb: tuple[float, ...]) -> Float[np.ndarray, "45"]:
    return np.column_stack([_all_fingers(finger, thumb), np.zeros((15, 2))]).ravel()


def efforts(joints: Float[np.ndarray, "16 3"], tips: Float[np.ndarray, "5 3"]) -> Float[np.ndarray, "15 3"]:
    """Return the joint torque limits [N·m] at which the tip of a straight finger presses with `_TIP_FORCE`."""
    reach = np.linalg.norm(np.repeat(tips, 3, axis=0) - joints[1:], axis=1)
    return _TIP_FORCE * np.maximum(np.column_stack([reach, reach, np.zeros(15)]), _LEAST_LEVER)


def palm_normal(data: ManoData, joints: Float[np.ndarray, "16 3"]) -> Float[np.ndarray, "3"]:
    """Return the unit direction out of the palm at rest, model frame. In the mean pose, fingers bend to this side."""
    normal = _unit(np.cross(joints[1] - joints[0], joints[7] - joints[0]))
    shape, mean, knuckles = data.joint_regressor @ data.template, data.mean.reshape(15, 3), np.array([1, 4, 7, 10])
    first, second = (shape[knuckles + n] - shape[knuckles + n - 1] for n in (1, 2))
    turn, further = (Rotation.from_rotvec(mean[knuckles + n]) for n in (-1, 0))
    bend = turn.apply(first + further.apply(second)) - (first + second)
    # If the mean pose is flat, it does not show the palm's side. Then a right hand is assumed.
    return -normal if float((bend @ normal).mean()) < -1e-4 else normal


def anatomical_frames(
    joints: Float[np.ndarray, "16 3"], tips: Float[np.ndarray, "5 3"], normal: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "16 3 3"]:
    """Return the anatomical frame B of every body at rest, with axes as columns. The wrist has the model's axes."""
    target = joints[[0, 1, 4, 7, 10]].mean(0) + _OPPOSITION * normal
    frames = np.tile(np.eye(3), (len(BODIES), 1, 1))
    for body in range(1, len(BODIES)):
        end = tips[(body - 1) // 3] if body % 3 == 0 else joints[body + 1]
        bone = _unit(end - joints[body])
        towards = target - joints[body] if BODIES[body].startswith("thumb") else normal
        flexion = _unit(np.cross(bone, towards))
        frames[body] = np.column_stack([flexion, np.cross(bone, flexion), bone])
    return frames


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


# Mean density of muscle and bone [kg/m³].
_DENSITY = 1100.0


@dataclass(frozen=True, eq=False)
class ManoHand:
    """A MANO model of one shape, as a hand model and as a skin.

    Attributes:
        model: hand model for planning.
        data: content of the file.
        vertices: vertices at rest, base frame [m].
    """

    model: HandModel
    data: ManoData
    vertices: Float[np.ndarray, "vertices 3"]

    def skinned_mesh(self, posture: Posture) -> TriangleMesh:
        """Return MANO's own surface at a posture [m], closed at the wrist, in the frame of the posture's position."""
        bodies = [self.model.link_index[name] for name in BODIES]
        frames, joints = (part[bodies] for part in link_poses(self.model, np.zeros(45)))
        turned, places = (part[bodies] for part in link_poses(self.model, posture.joint_positions))
        vertices = skin_vertices(self.data, self.vertices, joints, turned @ frames.transpose(0, 2, 1), places)
        turn = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
        return TriangleMesh(close_wrist(self.data, vertices) @ turn.T + posture.position, closed_faces(self.data))


def load_mano(path: str | Path, betas: Sequence[float] = (), *, candidates: int = 600) -> ManoHand:
    """Load the hand of a MANO file (.pkl) with shape coefficients `betas`. Missing betas are zero (mean shape).

    Raises HandError: the file cannot be used, or has fewer shape coefficients than `betas`.
    """
    data = read_mano(Path(path))
    shape = np.zeros(data.shape_directions.shape[-1])
    if len(betas) > len(shape) or not np.isfinite(list(betas)).all():
        raise HandError(f"{path}: betas has {len(betas)} numbers; valid: at most {len(shape)} finite numbers")
    shape[: len(betas)] = betas
    vertices, joints = rest(data, shape)
    closed_faces(data)  # Called only to raise, before any planning, if the mesh cannot be closed.
    hand = _bare_hand(data, vertices, joints)
    hand = replace(hand, adjacent=adjacent_links(hand))
    return ManoHand(with_candidates(hand, candidates), data, vertices - joints[0])


def _fingertips(
    vertices: Float[np.ndarray, "vertices 3"], joints: Float[np.ndarray, "16 3"], owner: Int[np.ndarray, "vertices"]
) -> Float[np.ndarray, "5 3"]:
    tips = []
    for body in range(3, len(BODIES), 3):
        own = vertices[owner == body]
        tips.append(own[np.linalg.norm(own - joints[body], axis=1).argmax()])
    return np.array(tips)


def _bare_hand(
    data: ManoData, vertices: Float[np.ndarray, "vertices 3"], joints: Float[np.ndarray, "16 3"]
) -> HandModel:
    """Return the hand of a shape at rest [m], without candidates and adjacent pairs.

    Two massless links lie between each body and its parent. A body's skin has all faces with a vertex of the body.
    """
    owner, normal = data.weights.argmax(1), palm_normal(data, joints)
    tips = _fingertips(vertices, joints, owner)
    frames = anatomical_frames(joints, tips, normal)
    torques, limits = efforts(joints, tips), _all_fingers(_FINGER_LIMITS, _THUMB_LIMITS)
    links, hinges, hulls, skins = list[LinkSpec](), list[JointSpec](), list[Primitive](), dict[str, TriangleMesh]()
    for body, name in enumerate(BODIES):
        points = (vertices - joints[body]) @ frames[body]
        skins[name] = TriangleMesh(points, data.faces[(owner[data.faces] == body).any(1)])
        hulls.append(_hull(data, name, points[owner == body]))
        links.append(LinkSpec(name, *_inertial(hulls[body]), (hulls[body],)))
        if body == 0:
            continue
        above, into = BODIES[PARENTS[body]], frames[PARENTS[body]].T
        pose = into @ frames[body], into @ (joints[body] - joints[PARENTS[body]])
        links += [LinkSpec(f"{name}_{hinge}") for hinge in HINGES[:2]]
        for axis, (hinge, child) in enumerate(zip(HINGES, (links[-2].name, links[-1].name, name), strict=True)):
            (lower, upper), effort = limits[body - 1, axis], torques[body - 1, axis]
            hinges.append(
                JointSpec(f"{name}_{hinge}", above, child, "revolute", *pose, np.eye(3)[axis], lower, upper, effort)
            )
            above, pose = child, (np.eye(3), np.zeros(3))
    hand = assemble(data.path, data.path.stem, links, hinges, {})
    return replace(
        hand,
        open_posture=_posture(*_OPEN),
        closed_posture=_posture(*_CLOSED),
        palm_center=_palm_center(hulls[0], joints, normal),
        palm_normal=normal,
        approach=normal,
        skins=tuple((hand.link_index[name], skin) for name, skin in skins.items() if len(skin.faces)),
    )


def _hull(data: ManoData, name: str, points: Float[np.ndarray, "points 3"]) -> Primitive:
    if len(points) < 4 or np.linalg.matrix_rank(points - points.mean(0)) < 3:
        raise HandError(f"{data.path}: weights: the vertices of {name} span no solid")
    hull = limited_hull(points, len(points))
    return Primitive(0, "hull", np.eye(3), np.zeros(3), (), hull.vertices, hull.faces)


def _inertial(hull: Primitive) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    import trimesh

    solid = trimesh.Trimesh(hull.vertices, hull.faces, process=False)
    solid.density = _DENSITY
    return float(solid.mass), np.asarray(solid.center_mass), np.asarray(solid.moment_inertia)


def _palm_center(
    palm: Primitive, joints: Float[np.ndarray, "16 3"], normal: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Follow the palm normal from the middle of the palm's bones to the hull. Return the end point, base frame [m]."""
    middle = joints[[1, 4, 7, 10]].mean(0) * 0.7 + joints[0] * 0.3 - joints[0]
    a, b, c = (palm.vertices[palm.faces[:, i]] for i in range(3))
    outward = np.cross(b - a, c - a)
    slope, room = outward @ normal, ((a - middle) * outward).sum(1)
    ahead = slope > 1e-9 * np.abs(slope).max()
    return middle + max(0.0, float((room[ahead] / slope[ahead]).min())) * normal
