"""The published starts of Grasp'D: palm towards a random surface point along the normal, random roll, fingers open."""

from __future__ import annotations

import math

import torch

from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.methods.poses import Poses
from graspd_core.methods.problem import Problem, hand_forward
from graspd_core.scene.scene import Scene
from graspd_core.se3 import aligning_rotation, quaternion_from_rotation, rotation_from_axis_angle

# Places drawn for each start kept: those where the hand would touch are drawn again, as the released code does.
_POOL = 4


@torch.no_grad()
def published_starts(problem: Problem, scene: Scene, hand: HandModel, count: int, seed: int, standoff: float) -> Poses:
    """`count` seeded starts with the palm `standoff` [m] off the surface; those that touch only where all do."""
    generator = torch.Generator().manual_seed(seed)
    # Samples come in the order of the mesh's faces: unshuffled, the first that are clear would all lie on one side.
    order = torch.randperm(_POOL * count, generator=generator)
    points, normals = (torch.as_tensor(x)[order] for x in surface_samples(scene.object.mesh, _POOL * count, seed))
    roll = math.pi * (2 * torch.rand(len(points), generator=generator, dtype=torch.float64) - 1)
    rotation = aligning_rotation(torch.as_tensor(hand.palm_normal), -normals)
    rotation = rotation_from_axis_angle(normals, roll) @ rotation
    palm = points + standoff * normals
    translation = palm - (rotation @ torch.as_tensor(hand.palm_center)[:, None]).squeeze(-1)
    joints = torch.as_tensor(hand.open_posture).expand(len(points), -1)
    drawn = Poses(*(x.to(problem.hand.lower) for x in (translation, quaternion_from_rotation(rotation), joints)))
    placed = hand_forward(problem, problem.hand.coarse, drawn.translation, drawn.quaternion, drawn.joints)
    touching = sample_sdf(problem.object.sdf, placed.points)[0].amin(-1) <= 0
    return drawn[touching.int().argsort(stable=True)[:count]]
