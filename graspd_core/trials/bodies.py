"""The world of a trial in MuJoCo bodies and geoms: the hand's solids, the object, the support, the obstacles."""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.hands.model import HandModel, Primitive
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.scene.scene import ObjectModel, Obstacle
from graspd_core.se3 import quaternion_between, quaternion_from_rotation
from graspd_core.types import Plane, TriangleMesh

OBJECT = "graspd_object"
# What the hand meets of the support, and what the object rests on.
TABLE, _REST = "the support", "graspd_rest"
_GRAVITY = 9.81

# Sliding, torsional and rolling coefficients.
Friction = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class FreeBody:
    """A thing that lies somewhere, free to move.

    Attributes:
        model: the thing, in its own frame.
        parts: its convex parts, likewise [m].
        pose: of its frame in the world [m].
    """

    model: ObjectModel
    parts: tuple[TriangleMesh, ...]
    pose: Float[np.ndarray, "4 4"]


def add_primitive(spec: Any, body: Any, primitive: Primitive, name: str, friction: Friction) -> None:
    """A collision solid of the hand; `name` is its mesh's, where it needs one."""
    import mujoco

    geom = body.add_geom(
        pos=primitive.translation,
        quat=quaternion_from_rotation(torch.as_tensor(primitive.rotation, dtype=torch.float64)).numpy(),
        condim=4,
        friction=friction,
        # The hand's contact softness rules in every contact it takes part in.
        priority=1,
        solref=[0.005, 1.0],
        solimp=[0.5, 0.99, 1e-4, 0.5, 2.0],
    )
    if primitive.kind == "hull":
        geom.type = mujoco.mjtGeom.mjGEOM_MESH
        geom.meshname = name
        add_mesh(spec, name, primitive.vertices, primitive.faces)
    else:
        geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{primitive.kind.upper()}")
        geom.size = np.resize(np.append(primitive.size, [0.0, 0.0]), 3)


def add_object(
    spec: Any,
    target: ObjectModel,
    parts: Sequence[TriangleMesh],
    friction: Friction,
    *,
    name: str = OBJECT,
    pose: Float[np.ndarray, "4 4"] | None = None,
) -> None:
    import mujoco

    body = spec.worldbody.add_body(name=name)
    if pose is not None:
        body.pos = pose[:3, 3]
        body.quat = quaternion_from_rotation(torch.as_tensor(pose[:3, :3], dtype=torch.float64)).numpy()
    body.add_freejoint(name=name)
    body.explicitinertial = True
    body.mass = target.mass
    body.ipos = target.center_of_mass
    body.fullinertia = full_inertia(target.inertia, floor=1e-9)
    for index, part in enumerate(parts):
        mesh = f"part:{index}" if name == OBJECT else f"{name} part:{index}"
        add_mesh(spec, mesh, part.vertices, part.faces)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh,
            condim=4,
            friction=friction,
            contype=1,
            conaffinity=1,
        )


def add_others(
    spec: Any, others: Sequence[FreeBody], friction: Friction, origin: Float[np.ndarray, "3"]
) -> tuple[str, ...]:
    """Things that lie about, each free, in a world about `origin`; returns the names of their bodies."""
    names = tuple(f"other {index + 1}" for index in range(len(others)))
    for name, other in zip(names, others, strict=True):
        add_object(spec, other.model, other.parts, friction, name=name, pose=other.pose)
        spec.body(name).pos = other.pose[:3, 3] - origin
    return names


def add_support(spec: Any, hand: HandModel, parts: Sequence[TriangleMesh], friction: Friction, support: Plane) -> None:
    """What the hand meets, and below `parts` what they rest on; without parts, all meets the one plane."""
    spec.option.gravity = -_GRAVITY * support.normal
    add_plane(spec, TABLE, support, friction)
    for link in hand.link_names:
        # Real hands carry their own weight.
        spec.body(f"link:{link}").gravcomp = 1.0
    if not parts:
        return
    lowest = min(float((part.vertices @ support.normal).min()) for part in parts)
    add_plane(spec, _REST, Plane(support.normal, lowest), friction)
    spec.add_exclude(bodyname1=TABLE, bodyname2=OBJECT)
    for link in hand.link_names:
        spec.add_exclude(bodyname1=_REST, bodyname2=f"link:{link}")


def add_plane(spec: Any, name: str, plane: Plane, friction: Friction) -> None:
    import mujoco

    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 1.0],
        pos=plane.offset * plane.normal,
        quat=quaternion_between(np.eye(3)[2], plane.normal, around=np.eye(3)[0]),
        condim=4,
        friction=friction,
    )


def add_obstacle(spec: Any, name: str, neighbour: Obstacle, target: ObjectModel, friction: Friction) -> None:
    import mujoco

    body = spec.worldbody.add_body(name=name, mocap=True)
    add_mesh(spec, name, neighbour.mesh.vertices, neighbour.mesh.faces)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, condim=4, friction=friction)
    surface = torch.as_tensor(surface_samples(target.mesh, 1000, 0)[0]).to(neighbour.sdf.field)
    if bool((sample_sdf(neighbour.sdf, surface)[0] < 0).any()):
        # A grown hull that overlaps the object would throw it away.
        spec.add_exclude(bodyname1=name, bodyname2=OBJECT)


def add_mesh(spec: Any, name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    import mujoco

    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.asarray(vertices, dtype=float).ravel()
    mesh.userface = np.asarray(faces, dtype=np.int32).ravel()
    # Masses are given explicitly, so a part may be as thin as it likes.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def full_inertia(inertia: Float[np.ndarray, "3 3"], floor: float) -> list[float]:
    """MuJoCo's order xx yy zz xy xz yz, with principal moments raised to `floor` and the triangle inequality kept."""
    moments, axes = np.linalg.eigh(0.5 * (inertia + inertia.T))
    moments = np.maximum(moments, floor)
    moments[2] = min(moments[2], 0.999 * (moments[0] + moments[1]))
    m = axes @ np.diag(moments) @ axes.T
    return [m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]]
