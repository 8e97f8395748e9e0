"""A result for RViz: the hand at its grasp, where it touches, the axes of its base link, and what it is worth.

Namespaces are the names of `PARTS`, so that each can be switched off in RViz; ids start at `IDS_OF_A_GRASP` times the
rank. Markers stay until the next result deletes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from graspd_core import HandModel
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import Primitive
from graspd_core.types import Contact, Grasp, Posture, Verdict
from graspd_ros.convert import Matrix, matrix_of_posture, point_of, pose_of_matrix, vector_of

IDS_OF_A_GRASP = 1000
GEOMETRIES = ("visual", "collision")
# What can be shown. Of the best grasps: the hand at the grasp, before it and where its squeeze aims at (faint), its
# contacts, the axes of its base link, its figures. Of those that failed a trial: where they are, and why they failed.
PARTS = ("hand", "pregrasp", "squeeze", "contacts", "axes", "text", "rejected")
USUAL_PARTS = ("hand", "contacts", "axes", "text")
_FAINT = 0.25
COLOURS = {
    Verdict.VERIFIED: (0.20, 0.70, 0.30),
    Verdict.UNVERIFIED: (0.95, 0.70, 0.15),
    Verdict.FAILED: (0.85, 0.20, 0.20),
}
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_AXIS_LENGTH = 0.05
_ARROW_LENGTH = 0.03
_TEXT_HEIGHT = 0.015
_TEXT_ABOVE = 0.12


def result_markers(
    grasps: Sequence[Grasp],
    hand: HandModel,
    frame: str,
    stamp: Time,
    *,
    shown: int = 1,
    parts: Sequence[str] = USUAL_PARTS,
    solids: Sequence[Primitive] | None = None,
) -> MarkerArray:
    """Parts of the best `shown` grasps; the first marker deletes what was shown before: none leave an empty scene.

    `solids` are what the hand is drawn with; None: its collision solids.
    """
    header = Header(frame_id=frame, stamp=stamp)
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    for rank, grasp in enumerate(grasps):
        made = _parts_of(grasp, rank, hand, hand.primitives if solids is None else solids) if rank < shown else {}
        if grasp.verdict is Verdict.FAILED:
            made["rejected"] = lambda grasp=grasp, rank=rank: _rejected(grasp, rank)
        for namespace in parts:
            for number, marker in enumerate(made[namespace]() if namespace in made else ()):
                marker.header, marker.action, marker.ns = header, Marker.ADD, namespace
                marker.id = rank * IDS_OF_A_GRASP + number
                markers.append(marker)
    return MarkerArray(markers=markers)


def _parts_of(
    grasp: Grasp, rank: int, hand: HandModel, solids: Sequence[Primitive]
) -> dict[str, Callable[[], Iterable[Marker]]]:
    T_frame_base, colour = matrix_of_posture(grasp.grasp), COLOURS[grasp.verdict]
    return {
        "hand": lambda: _hand(hand, solids, grasp.grasp, colour),
        "pregrasp": lambda: _faint(_hand(hand, solids, grasp.pregrasp, colour)),
        "squeeze": lambda: _faint(_hand(hand, solids, grasp.squeeze, colour)),
        "contacts": lambda: map(_contact, grasp.contacts),
        "axes": lambda: _axes(T_frame_base),
        "text": lambda: [_text(grasp, rank, T_frame_base)],
    }


def _faint(markers: Iterable[Marker]) -> Iterator[Marker]:
    for marker in markers:
        marker.color.a = _FAINT
        yield marker


def _rejected(grasp: Grasp, rank: int) -> Iterator[Marker]:
    """The way that the hand would have come, in red, and what the trial said."""
    start, end = grasp.pregrasp.position, grasp.grasp.position
    yield _arrow(np.asarray(start), np.asarray(end), COLOURS[Verdict.FAILED])
    text = _text(grasp, rank, matrix_of_posture(grasp.grasp))
    text.color = _colour(COLOURS[Verdict.FAILED], 1.0)
    yield text


def _hand(
    hand: HandModel, solids: Sequence[Primitive], posture: Posture, colour: tuple[float, float, float]
) -> Iterator[Marker]:
    """The solids; a capsule is a cylinder and two balls."""
    T_frame_base = matrix_of_posture(posture)
    rotations, translations = link_poses(hand, posture.joint_positions)
    for solid in solids:
        T_base_link = _matrix(rotations[solid.link], translations[solid.link])
        T = T_frame_base @ T_base_link @ _matrix(solid.rotation, solid.translation)
        pose, size = pose_of_matrix(T), solid.size
        if solid.kind == "hull":
            marker = Marker(type=Marker.TRIANGLE_LIST, pose=pose, scale=vector_of((1, 1, 1)), color=_colour(colour))
            marker.points = _corners(solid)
            yield marker
        elif solid.kind == "box":
            yield _solid(Marker.CUBE, pose, 2 * np.array(size), colour)
        elif solid.kind == "sphere":
            yield _solid(Marker.SPHERE, pose, np.full(3, 2 * size[0]), colour)
        else:
            yield _solid(Marker.CYLINDER, pose, np.array([2 * size[0], 2 * size[0], 2 * size[1]]), colour)
            if solid.kind == "capsule":
                for end in (-size[1], size[1]):
                    ball = pose_of_matrix(T @ _matrix(np.eye(3), np.array([0.0, 0.0, end])))
                    yield _solid(Marker.SPHERE, ball, np.full(3, 2 * size[0]), colour)


# Thousands of points take tens of milliseconds to make; nobody changes them.
@lru_cache(maxsize=256)
def _corners(mesh: Primitive) -> list[Point]:
    """The corners of its triangles, in its own frame."""
    return [point_of(corner) for corner in mesh.vertices[mesh.faces.reshape(-1)]]


def _contact(contact: Contact) -> Marker:
    """An arrow that ends where the link touches and goes the way it presses: against the object's normal."""
    tip = np.array(contact.position)
    tail = tip + _ARROW_LENGTH * np.array(contact.normal)
    return _arrow(tail, tip, (0.1, 0.3, 0.9))


def _axes(T_frame_base: Matrix) -> Iterator[Marker]:
    """x red, y green, z blue."""
    origin = T_frame_base[:3, 3]
    for axis, colour in enumerate(AXES):
        yield _arrow(origin, origin + _AXIS_LENGTH * T_frame_base[:3, axis], colour)


def _text(grasp: Grasp, rank: int, T_frame_base: Matrix) -> Marker:
    lines = [f"#{rank} {grasp.verdict}"]
    epsilon = (grasp.metrics or {}).get("epsilon")
    if epsilon is not None:
        lines.append(f"ε {epsilon:.3f}")
    if grasp.reason:
        lines.append(grasp.reason)
    above = _matrix(np.eye(3), T_frame_base[:3, 3] + [0.0, 0.0, _TEXT_ABOVE])
    return Marker(
        type=Marker.TEXT_VIEW_FACING,
        pose=pose_of_matrix(above),
        scale=vector_of((0, 0, _TEXT_HEIGHT)),
        color=_colour((1.0, 1.0, 1.0), 1.0),
        text="\n".join(lines),
    )


def _solid(kind: int, pose: Pose, size: np.ndarray, colour: tuple[float, float, float]) -> Marker:
    return Marker(type=kind, pose=pose, scale=vector_of(size), color=_colour(colour))


def _arrow(tail: np.ndarray, tip: np.ndarray, colour: tuple[float, float, float]) -> Marker:
    # Points are in the header's frame; RViz wants the pose beside them to be a rotation all the same.
    marker = Marker(type=Marker.ARROW, scale=vector_of((0.004, 0.008, 0.01)), color=_colour(colour, 1.0))
    marker.pose.orientation.w = 1.0
    marker.points = [point_of(tail), point_of(tip)]
    return marker


def _matrix(rotation: np.ndarray, translation: np.ndarray) -> Matrix:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


def _colour(rgb: tuple[float, float, float], alpha: float = 0.8) -> ColorRGBA:
    r, g, b = rgb
    return ColorRGBA(r=r, g=g, b=b, a=alpha)
