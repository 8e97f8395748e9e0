"""A picture of a hand by ray casting: open and closed, from the side and onto the palm, with what was found of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from graspd_core.hands.hand_mesh import hand_mesh
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel
from graspd_core.mesh.shapes import joined
from graspd_core.rendering.render import look_at, render_shaded
from graspd_core.se3 import perpendicular
from graspd_core.types import TriangleMesh

_HAND, _CANDIDATE, _PALM = (0.45, 0.55, 0.75), (0.85, 0.25, 0.15), (0.15, 0.6, 0.2)
_WIDTH, _HEIGHT = 560, 480
# Dots for candidates, and the arrow out of the palm, in shares of the hand's size.
_DOT, _ARROW, _SHAFT = 0.006, 0.35, 0.012


def hand_picture(hand: HandModel) -> UInt8[np.ndarray, "height width 3"]:
    """Four views: above from the side, below onto the palm; left open, right closed.

    Contact candidates are red dots; a green arrow stands on the palm's centre along its normal.
    """
    reach = hand_mesh(hand, hand.open_posture).vertices
    middle, size = 0.5 * (reach.min(0) + reach.max(0)), float(np.ptp(reach, axis=0).max())
    up = _up(hand, middle)
    side = np.cross(up, hand.palm_normal)
    eyes = (side + 0.5 * hand.palm_normal + 0.25 * up, hand.palm_normal + 0.15 * side + 0.1 * up)
    rows = []
    for eye in eyes:
        # The light comes from z: the world is turned so that the fingers point up.
        frame = np.column_stack([np.cross(hand.palm_normal, up), hand.palm_normal, up]).T
        pose = look_at(frame @ (2.1 * size * eye / np.linalg.norm(eye)), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        row = []
        for posture in (hand.open_posture, hand.closed_posture):
            meshes = [
                (TriangleMesh((mesh.vertices - middle) @ frame.T, mesh.faces), colour)
                for mesh, colour in _scene(hand, posture, size)
            ]
            row.append(render_shaded(meshes, T_world_camera=pose, width=_WIDTH, height=_HEIGHT))
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows, axis=0)


def _up(hand: HandModel, middle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The direction from the palm to the middle of the hand, square to the palm's normal, unit."""
    along = middle - hand.palm_center
    along = along - (along @ hand.palm_normal) * hand.palm_normal
    length = float(np.linalg.norm(along))
    return along / length if length > 1e-3 else perpendicular(hand.palm_normal)


def _scene(
    hand: HandModel, posture: Float[np.ndarray, "joints"], size: float
) -> list[tuple[TriangleMesh, tuple[float, float, float]]]:
    import trimesh

    rotations, translations = link_poses(hand, posture)
    links = hand.candidate_link
    placed = np.einsum("pij,pj->pi", rotations[links], hand.candidate_points) + translations[links]
    dot = trimesh.creation.icosphere(subdivisions=0, radius=_DOT * size)
    count = len(dot.vertices)
    dots = TriangleMesh(
        (placed[:, None] + np.asarray(dot.vertices)).reshape(-1, 3),
        (np.asarray(dot.faces) + count * np.arange(len(placed))[:, None, None]).reshape(-1, 3),
    )
    ends = np.stack([hand.palm_center, hand.palm_center + _ARROW * size * hand.palm_normal])
    shaft = trimesh.creation.cylinder(radius=_SHAFT * size, segment=ends, sections=12)
    knob = trimesh.creation.icosphere(subdivisions=1, radius=2 * _SHAFT * size)
    knob.apply_translation(ends[1])
    arrow = joined(*(TriangleMesh(np.asarray(body.vertices), np.asarray(body.faces)) for body in (shaft, knob)))
    return [(hand_mesh(hand, posture), _HAND), (dots, _CANDIDATE), (arrow, _PALM)]
