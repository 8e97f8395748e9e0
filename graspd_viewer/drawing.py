"""Make the meshes that the browser (`scene_nodes`) and the pictures of the docs (`benchmarks/pictures.py`) show.

This module also computes the disturbance that a grasp resists least, and the hand's postures along a grasp's path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from graspd_core.hands.kinematics import forward, link_poses, make_kinematics, primitive_mesh, retreat_posture
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.perception.scene import ObjectModel, Scene, sample_confidence
from graspd_core.se3 import SE3, perpendicular, quaternion_from_rotation, rotation_from_quaternion
from graspd_core.types import Contact, Grasp, Plane, Posture, Snapshot, TriangleMesh, Verdict, joined
from graspd_core.verify.hold_trial import straight_path
from graspd_core.verify.prepared_grasp import MetricsContext, PreparedGrasp

Colour = tuple[float, float, float]
OBJECT, GUESSED, HAND = (0.85, 0.55, 0.25), (0.80, 0.45, 0.65), (0.40, 0.50, 0.68)
SEEN = (0.12, 0.43, 0.24)
SUPPORT, NEIGHBOUR = (0.70, 0.72, 0.75), (0.55, 0.58, 0.50)
NORMAL, FORCE, WEAKEST, TURN = (0.15, 0.45, 0.95), (0.90, 0.20, 0.25), (0.75, 0.15, 0.80), (0.95, 0.70, 0.10)
VERDICTS = {
    Verdict.VERIFIED: (0.15, 0.65, 0.30),
    Verdict.UNVERIFIED: (0.60, 0.62, 0.66),
    Verdict.FAILED: (0.85, 0.20, 0.20),
}
# Arrow lengths: contact normal [m], force [m/N], and disturbance (offset and factor, in radii of the object).
NORMAL_LENGTH, FORCE_LENGTH, PUSH_LENGTH = 0.02, 0.004, (1.1, 0.7)
_SHAFT, _SLICE = 0.0012, 96


def css(colour: Colour) -> str:
    """Return a colour as CSS."""
    return f"rgb({', '.join(str(round(255 * channel)) for channel in colour)})"


@dataclass(frozen=True)
class Part:
    """Mesh of one colour (RGB, 0 to 1) in its own frame [m]."""

    name: str
    mesh: TriangleMesh
    colour: Colour
    opacity: float = 1.0


def hand_parts(hand: HandModel) -> dict[int, Part]:
    """Return the mesh of each link with collision shapes, by link index, in the link's frame [m]."""
    parts = {}
    for link, primitives in enumerate(hand.primitives_of):
        if primitives:
            mesh = joined(*(primitive_mesh(primitive) for primitive in primitives))
            parts[link] = Part(f"hand/{link}", mesh, HAND)
    return parts


def scene_parts(scene: Scene) -> list[Part]:
    """Return meshes of object, support and obstacles. An object from clouds has two meshes: seen, guessed."""
    mesh, parts = scene.object.mesh, []
    if scene.confidence is None:
        parts.append(Part("object/known", mesh, OBJECT))
    else:
        middles = torch.as_tensor(mesh.vertices[mesh.faces].mean(1)).to(scene.sdf.field)
        seen = sample_confidence(scene.confidence, scene.sdf, middles[None])[0].numpy() >= 0.5
        parts.append(Part("object/seen", TriangleMesh(mesh.vertices, mesh.faces[seen]), OBJECT))
        parts.append(Part("object/guessed", TriangleMesh(mesh.vertices, mesh.faces[~seen]), GUESSED))
    if scene.support is not None:
        parts.append(Part("around/support", _square(scene.support, mesh), SUPPORT, 0.6))
    parts += [Part(f"around/neighbour{i}", o.mesh, NEIGHBOUR, 0.8) for i, o in enumerate(scene.obstacles)]
    return [part for part in parts if len(part.mesh.faces)]


def contact_parts(contacts: Sequence[Contact]) -> list[Part]:
    """Return a mesh of arrows: at each contact, one along the object's outward normal. Empty without contacts."""
    if not contacts:
        return []
    starts = np.array([contact.position for contact in contacts])
    ends = starts + NORMAL_LENGTH * np.array([contact.normal for contact in contacts])
    return [Part("contacts", arrows(starts, ends), NORMAL)]


def squeeze_parts(contacts: Sequence[Contact]) -> list[Part]:
    """Return a mesh of arrows: at each contact with a planned force, this force on the object. Empty without forces."""
    known = [(contact.position, contact.force) for contact in contacts if contact.force is not None]
    return force_parts(*np.array(known).swapaxes(0, 1)) if known else []


def force_parts(positions: Float[np.ndarray, "n 3"], forces: Float[np.ndarray, "n 3"]) -> list[Part]:
    """Return a mesh of arrows: each force on the object above 0.02 N. An arrow ends at the force's position [m]."""
    strong = np.linalg.norm(forces, axis=1) > 0.02
    if not strong.any():
        return []
    tips = positions[strong]
    return [Part("forces", arrows(tips - FORCE_LENGTH * forces[strong], tips), FORCE)]


def weakest_parts(push: Float[np.ndarray, "6"], target: ObjectModel) -> list[Part]:
    """Return arrows for force and torque of the unit disturbance `push`. No arrow if its norm is at most 0.05."""
    center, parts = target.center_of_mass, []
    for name, part, colour in (("weakest/force", push[:3], WEAKEST), ("weakest/turn", push[3:], TURN)):
        share = float(np.linalg.norm(part))
        if share > 0.05:
            length = target.radius * (PUSH_LENGTH[0] + PUSH_LENGTH[1] * share)
            parts.append(Part(name, arrows(center[None], (center + length * part / share)[None], 1.5 * _SHAFT), colour))
    return parts


def sdf_slice(
    scene: Scene, axis: int, share: float
) -> tuple[UInt8[np.ndarray, "rows columns 3"], Float[np.ndarray, "3"]]:
    """Return an image of the SDF on a plane normal to `axis`, and the plane's centre [m].

    `share` is the plane's position along `axis`, from 0 to 1 over the grid. Blue is inside, red outside, white at the
    surface. `slice_axes` has the axes of the row index and the column index.
    """
    sdf = scene.sdf
    low = sdf.origin.double().cpu().numpy()
    size = 2 * sdf.half.double().cpu().numpy()
    down, right = slice_axes(axis)
    grid = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, _SLICE)] * 2, indexing="ij"), -1)
    at = np.empty((_SLICE, _SLICE, 3))
    at[..., axis] = low[axis] + share * size[axis]
    at[..., down] = low[down] + grid[..., 0] * size[down]
    at[..., right] = low[right] + grid[..., 1] * size[right]
    points = torch.as_tensor(at.reshape(-1, 3)).to(sdf.field)
    distance = sample_sdf(sdf, points)[0].reshape(_SLICE, _SLICE).cpu().numpy()
    fade = (np.abs(distance) / max(float(np.abs(distance).max()), 1e-9))[..., None] ** 0.5
    far = np.where(distance[..., None] < 0, (0.15, 0.35, 0.85), (0.85, 0.30, 0.20))
    return (255 * (1 - fade * (1 - far))).astype(np.uint8), low + size * np.where(np.arange(3) == axis, share, 0.5)


def slice_axes(axis: int) -> tuple[int, int]:
    """Return the axes of the row index and the column index in a slice normal to `axis`."""
    return (axis + 2) % 3, (axis + 1) % 3


def arrows(starts: Float[np.ndarray, "n 3"], ends: Float[np.ndarray, "n 3"], radius: float = _SHAFT) -> TriangleMesh:
    """Return one mesh of all arrows [m]. An arrow's head has three times the radius of its shaft."""
    import trimesh

    bodies = []
    for start, end in zip(starts, ends, strict=True):
        length = float(np.linalg.norm(end - start))
        head = min(5 * radius, 0.6 * length)
        shaft = trimesh.creation.cylinder(radius=radius, height=length - head, sections=6)
        cone = trimesh.creation.cone(radius=3 * radius, height=head, sections=8)
        along = (end - start) / max(length, 1e-12)
        side = perpendicular(along)
        turn = np.column_stack([side, np.cross(along, side), along])
        for body, offset in ((shaft, 0.5 * (length - head)), (cone, length - head)):
            local = np.asarray(body.vertices) + np.array([0.0, 0.0, offset])
            bodies.append(TriangleMesh(local @ turn.T + start, np.asarray(body.faces, dtype=np.int64)))
    return joined(*bodies)


def _square(support: Plane, mesh: TriangleMesh) -> TriangleMesh:
    """Return a square piece of the support below the object. Its side is three times the object's longest side."""
    middle = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    middle = middle + (support.offset - support.normal @ middle) * support.normal
    side = perpendicular(support.normal)
    other = np.cross(support.normal, side)
    half = 1.5 * float(np.ptp(mesh.vertices, axis=0).max())
    corners = middle + half * np.array([-side - other, side - other, side + other, other - side])
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def weakest_push(context: MetricsContext, grasp: Grasp) -> Float[np.ndarray, "6"] | None:
    """Return the unit disturbance that the contacts resist least: a force, and a torque over the object's radius.

    Return None without force closure. Then the contacts do not resist some disturbances at all.
    """
    return PreparedGrasp(context, grasp.grasp).wrench_hull.weakest_push


STAGES = ("retreat", "pregrasp", "grasp", "squeeze")


def posture_at(hand: HandModel, grasp: Grasp, at: float) -> Posture:
    """Return the hand's posture at `at` on its path: 0 retreat, 1 pregrasp, 2 grasp, 3 squeeze, or between."""
    stages = (retreat_posture(hand, grasp.pregrasp), grasp.pregrasp, grasp.grasp, grasp.squeeze)
    first = min(max(int(at), 0), len(stages) - 2)
    share = min(max(at - first, 0.0), 1.0)
    return straight_path(stages[first], stages[first + 1], np.array([share]))[0]


def placed_links(
    hand: HandModel, posture: Posture
) -> tuple[Float[np.ndarray, "links 3"], Float[np.ndarray, "links 4"]]:
    """Return the position [m] and the quaternion (wxyz) of each link in the object's frame."""
    rotations, translations = link_poses(hand, posture.joint_positions)
    base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz).double()).numpy()
    quaternions = quaternion_from_rotation(torch.as_tensor(base @ rotations)).numpy()
    return translations @ base.T + posture.position, quaternions


def skeletons(hand: HandModel, seen: Snapshot) -> Float[np.ndarray, "hands bones 2 3"]:
    """Return each hand as line segments from the origin of a link's parent to the link's origin, object frame [m]."""
    joints = torch.as_tensor(seen.joint_positions).float()
    links = forward(make_kinematics(hand), joints).translation
    quaternions = torch.as_tensor(seen.quaternions_wxyz).float()
    base = SE3(rotation_from_quaternion(quaternions), torch.as_tensor(seen.positions).float())
    origins = base.apply(links).numpy()
    ends = np.flatnonzero(hand.link_parent >= 0)
    return np.stack([origins[:, hand.link_parent[ends]], origins[:, ends]], 2)
