"""Success over the object's size against the hand's span."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from graspd_core.bench.failure_maps.map_case import MapCase, MapCell, hand_for, plan, settings, try_grasps
from graspd_core.hands.fingers import find_fingers
from graspd_core.hands.kinematics import make_kinematics, points_in_base
from graspd_core.hands.model import HandModel
from graspd_core.mesh.shapes import make_shape
from graspd_core.scene.load_scene import load_scene
from graspd_core.trials.world import PROTOCOLS
from graspd_core.types import TriangleMesh

RATIOS = (0.025, 0.05, 0.1, 0.25, 0.4, 0.5)
THINGS = ("sphere", "box", "cylinder")
_POSTURES = 4096


def run(case: MapCase) -> tuple[MapCell, ...]:
    """Plan and try on the shape scaled so that its least width is that share of the hand's span; 0.1 kg throughout."""
    config = settings(case.preset)
    width = float(case.across) * _span(case.hand, config.problem.fine_candidates)
    scale = width / least_width(make_shape(case.thing))
    scene = load_scene(f"shape:{case.thing}", scale=scale, resolution=config.resolution)
    hand, grasps = plan(case, scene)
    return tuple(try_grasps(case, up, hand, scene.object, grasps, PROTOCOLS["standard"]) for up in case.up)


def least_width(mesh: TriangleMesh) -> float:
    """The least extent along the axes of a mesh [m]: of the authored shapes, what a hand has to span."""
    return float(np.ptp(mesh.vertices, axis=0).min())


def hand_span(hand: HandModel) -> float:
    """The greatest distance between two fingertips that joints within their limits allow [m].

    The greatest of a few thousand seeded postures: about a millimetre short of the true one.
    """
    fingers = find_fingers(hand)
    draw = torch.Generator().manual_seed(0)
    lower, upper = torch.as_tensor(hand.lower), torch.as_tensor(hand.upper)
    shares = torch.rand(_POSTURES, hand.num_joints, generator=draw, dtype=torch.float64)
    # The greatest distances are at limits: half of the postures have every joint at one of its ends.
    shares[::2] = shares[::2].round()
    kinematics = make_kinematics(hand, dtype=torch.float64)
    tips = points_in_base(
        kinematics, lower + shares * (upper - lower), torch.as_tensor(fingers.points), torch.as_tensor(fingers.links)
    )
    return float(torch.cdist(tips, tips).max())


@lru_cache(maxsize=4)
def _span(hand: str, candidates: int) -> float:
    return hand_span(hand_for(hand, candidates))
