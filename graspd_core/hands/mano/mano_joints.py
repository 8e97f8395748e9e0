"""MANO's fifteen ball joints as forty-five hinges: axes, limits, efforts, and the conversion to axis-angle and back.

A body turns against its parent by `R = B Rx(flexion) Ry(abduction) Rz(twist) Bᵀ`, B being its anatomical frame at rest:
z along the bone, x the axis about which it flexes, y = z × x. The order is that of the ISB's recommendation for finger
joints (Wu et al. 2005, after Grood and Suntay 1983): flexion about the parent's axis, then abduction, then twist about
the bone itself. It is exact both ways as long as abduction stays under 90°, which every limit here does.

MANO has no such frames; they are made from the joints of the shape at hand. A finger flexes towards the palm's normal,
which is that of the plane through wrist, index and little knuckle; the thumb flexes towards a point in front of the
palm. Which side of that plane the palm is on shows in the mean pose, whose fingers are bent.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.hands.mano.mano_file import BODIES, ManoData
from graspd_core.hands.mano.mano_skin import make_skin, pose_from_components, rotation_from_vector, skin_vertices

HINGES = ("flexion", "abduction", "twist")
# How far in front of the palm the thumb's tip goes when the thumb is bent [m].
_OPPOSITION = 0.05
# Limits of flexion, abduction and twist [deg], from the flat hand. Fingers: Lin, Wu and Huang 2000 (flexion 0 to 90 at
# the knuckle, 0 to 110, 0 to 90; abduction ±15), knuckles also 20 backwards (Norkin and White: 45 passively). Thumb:
# flexion of knuckle and tip 50 and 80 (American Academy of Orthopaedic Surgeons 1965); saddle joint 53 of flexion, 42
# of abduction and 17 of twist in all (Cooney et al. 1981), about MANO's rest, which is in their middle. What is no
# degree of freedom in the literature keeps a little play, as living joints do.
_LIMITS_DEG = {
    "finger1": ((-20.0, 90.0), (-15.0, 15.0), (-5.0, 5.0)),
    "finger2": ((-5.0, 110.0), (-3.0, 3.0), (-3.0, 3.0)),
    "finger3": ((-5.0, 90.0), (-3.0, 3.0), (-3.0, 3.0)),
    "thumb1": ((-20.0, 33.0), (-21.0, 21.0), (-8.5, 8.5)),
    "thumb2": ((-10.0, 50.0), (-8.0, 8.0), (-5.0, 5.0)),
    "thumb3": ((-15.0, 80.0), (-3.0, 3.0), (-3.0, 3.0)),
}
# Flexion [deg] of the open and of the closed hand, joint by joint along a finger and along the thumb.
_OPEN_DEG = {"finger": (10.0, 20.0, 10.0), "thumb": (10.0, 0.0, 0.0)}
_CLOSED_DEG = {"finger": (45.0, 40.0, 20.0), "thumb": (15.0, 10.0, 10.0)}
# What a fingertip can press with [N]: half of an adult's tip pinch (Mathiowetz et al. 1985: 50 N women, 80 N men).
_TIP_FORCE = 30.0
# Lever of twist [m], half the breadth of a finger, and the least lever of anything.
_TWIST_LEVER, _LEAST_LEVER = 0.01, 0.02


def kind_of(body: int) -> str:
    """Row of `_LIMITS_DEG` of a body other than the wrist."""
    name = BODIES[body]
    return name if name.startswith("thumb") else f"finger{name[-1]}"


def limits() -> tuple[Float[np.ndarray, "45"], Float[np.ndarray, "45"]]:
    """Lower and upper limits of the hinges, body by body [rad]."""
    table = np.deg2rad([_LIMITS_DEG[kind_of(body)] for body in range(1, len(BODIES))])
    return table[..., 0].ravel(), table[..., 1].ravel()


def postures() -> tuple[Float[np.ndarray, "45"], Float[np.ndarray, "45"]]:
    """Open and closed joint values [rad]."""
    made = []
    for table in (_OPEN_DEG, _CLOSED_DEG):
        flexion = [table["thumb" if kind_of(b).startswith("thumb") else "finger"][(b - 1) % 3] for b in range(1, 16)]
        made.append(np.column_stack([np.deg2rad(flexion), np.zeros(15), np.zeros(15)]).ravel())
    return made[0], made[1]


def efforts(joints: Float[np.ndarray, "16 3"], tips: Float[np.ndarray, "5 3"]) -> Float[np.ndarray, "45"]:
    """Greatest torques [N·m]: those by which a stretched finger presses with `_TIP_FORCE` at its tip.

    The levers are those of this shape: a small hand is weaker.
    """
    reach = np.linalg.norm(np.repeat(tips, 3, axis=0) - joints[1:], axis=1)
    lever = np.maximum(np.column_stack([reach, reach, np.full(15, _TWIST_LEVER)]), _LEAST_LEVER)
    return (_TIP_FORCE * lever).ravel()


def palm_normal(data: ManoData, joints: Float[np.ndarray, "16 3"]) -> Float[np.ndarray, "3"]:
    """Unit direction out of the palm at rest, model frame: a right hand's or a left hand's, by the mean pose."""
    wrist, index, little = joints[0], joints[1], joints[7]
    normal = np.cross(index - wrist, little - wrist)
    normal /= np.linalg.norm(normal)
    skin = make_skin(data, dtype=torch.float64)
    zero = torch.zeros(1, data.shape_directions.shape[-1], dtype=torch.float64)
    mean = pose_from_components(data, zero.new_zeros(1, 0))
    turned = torch.cat([torch.eye(3).to(zero).expand(1, 1, 3, 3), rotation_from_vector(mean)], 1)
    flat = torch.eye(3).to(zero).expand(1, 16, 3, 3)
    bent, straight = (skin_vertices(skin, zero, r, zero.new_zeros(1, 3))[1][0].numpy() for r in (turned, flat))
    ends = [3, 6, 9, 12]
    # A mean pose that is flat says nothing: the file's usual content is a right hand.
    return -normal if float(((bent - straight)[ends] @ normal).mean()) < -1e-4 else normal


def anatomical_frames(
    joints: Float[np.ndarray, "16 3"], tips: Float[np.ndarray, "5 3"], normal: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "16 3 3"]:
    """The frames B: flexion, abduction and twist axes of every body at rest as columns; the wrist's is the model's."""
    target = joints[[0, 1, 4, 7, 10]].mean(0) + _OPPOSITION * normal
    frames = np.tile(np.eye(3), (len(BODIES), 1, 1))
    for body in range(1, len(BODIES)):
        end = tips[(body - 1) // 3] if body % 3 == 0 else joints[body + 1]
        bone = _unit(end - joints[body])
        towards = target - joints[body] if BODIES[body].startswith("thumb") else normal
        flexion = _unit(np.cross(bone, towards))
        frames[body] = np.column_stack([flexion, np.cross(bone, flexion), bone])
    return frames


def rotations_from_joints(
    frames: Float[Tensor, "16 3 3"], values: Float[Tensor, "batch 45"]
) -> Float[Tensor, "batch 16 3 3"]:
    """Rotation of every body against its parent in the model's axes; the wrist's is the identity."""
    sine, cosine = values.sin().unflatten(-1, (15, 3)), values.cos().unflatten(-1, (15, 3))
    (sx, sy, sz), (cx, cy, cz) = sine.unbind(-1), cosine.unbind(-1)
    # Rx Ry Rz, written out.
    local = torch.stack(
        [
            cy * cz, -cy * sz, sy,
            sx * sy * cz + cx * sz, cx * cz - sx * sy * sz, -sx * cy,
            sx * sz - cx * sy * cz, cx * sy * sz + sx * cz, cx * cy,
        ],
        -1,
    ).unflatten(-1, (3, 3))  # fmt: skip
    turned = frames[1:] @ local @ frames[1:].transpose(-1, -2)
    base = torch.eye(3, dtype=values.dtype, device=values.device).expand(len(values), 1, 3, 3)
    return torch.cat([base, turned], 1)


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
