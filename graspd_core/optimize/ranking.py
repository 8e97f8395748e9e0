"""Score candidates by their predicted chance to pass the hold trial, before the trial runs.

The score comes from a neural network with two small hidden layers. `benchmarks/ranking.py` fits it to trials and writes
`ranking.npz`. docs/method.md describes the data and the accuracy.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.optimize.grasp_postures import ContactSet, Squeeze
from graspd_core.optimize.loop import Poses, Values
from graspd_core.optimize.problem import Problem
from graspd_core.se3 import rotation_from_quaternion

# The network's inputs are clamped at this many standard deviations from their mean.
FARTHEST = 4.0
# Cost of a hand without any contact force. The network was fitted without such candidates.
_IDLE_COST = 20.0
# Cost of a self-collision deeper than `_DEEP` [m]. The trial refuses such a candidate, so it is tried last.
_SELF_COST, _DEEP = 100.0, 0.0018


class Staged(NamedTuple):
    """A batch of candidates before their trial.

    Attributes:
        poses: hand poses of the grasp.
        opened: hand poses of the pregrasp.
        clearance: fraction of the wanted clearance that the path from pregrasp to grasp keeps.
        contact_set: contacts of the grasp.
        pressed: squeeze of the grasp.
        overlap: greatest self-collision depth at pregrasp and grasp [m].
    """

    poses: Poses
    opened: Poses
    clearance: Values
    contact_set: ContactSet
    pressed: Squeeze
    overlap: Values


def score(problem: Problem, staged: Staged) -> Values:
    """Return the log-odds of passing the hold trial, minus costs for faults of the candidate.

    Faults are penetration of the object beyond 2 mm, self-collision beyond 1 mm, and a hand without contact force.
    Self-collision beyond 1.8 mm costs most, because the trial would refuse the candidate.
    """
    odds = log_odds(_fitted(), ranking_figures(problem, staged)).to(staged.clearance)
    idle = (staged.pressed.forces == 0.0).all(-1).all(-1)
    odds = odds - torch.where(idle, _IDLE_COST, 0.0) - torch.where(staged.overlap > _DEEP, _SELF_COST, 0.0)
    return odds - (_depth(staged) - 2.0).clamp_min(0.0) - 10.0 * (staged.overlap / 0.001 - 1.0).clamp_min(0.0)


def log_odds(network: Mapping[str, Tensor], figures: Float[Tensor, "batch figures"]) -> Values:
    """Return the log-odds of passing the hold trial, from a neural network that `benchmarks/ranking.py` fitted."""
    x = ((figures - network["mean"]) / network["deviation"]).clamp(-FARTHEST, FARTHEST)
    for layer in range(2):
        x = torch.nn.functional.silu(x @ network[f"weight{layer}"] + network[f"bias{layer}"])
    return (x @ network["weight2"] + network["bias2"])[:, 0]


@torch.no_grad()
def ranking_figures(problem: Problem, staged: Staged) -> Float[Tensor, "batch figures"]:
    """Return the inputs of the neural network (on the CPU), scaled by object size, joint range or a fixed unit."""
    poses, opened, pressed = staged.poses, staged.opened, staged.pressed
    hand, length = problem.hand, problem.object.length
    normal_forces = pressed.forces.norm(dim=-1)
    shares = normal_forces / normal_forces.sum(-1, keepdim=True).clamp_min(1e-9)
    active = staged.contact_set.active.to(shares)
    count = active.sum(-1).clamp_min(1.0)
    arms = (staged.contact_set.position - problem.object.center) / length
    middle = (active[..., None] * arms).sum(1) / count[:, None]
    normals = active[..., None] * staged.contact_set.normal
    margins = torch.minimum(poses.joints - hand.lower, hand.upper - poses.joints) / (hand.upper - hand.lower)
    palm = torch.as_tensor(np.stack([hand.model.palm_center, hand.model.palm_normal])).to(poses.translation)
    rotation = rotation_from_quaternion(poses.quaternion)
    to_center = (problem.object.center - poses.translation - rotation @ palm[0]) / length
    pressing = (pressed.joints - poses.joints).abs() / hand.joint_scale
    opening = (opened.joints - poses.joints).abs() / hand.joint_scale
    shift = (opened.translation - poses.translation).norm(dim=-1)
    columns = [
        (shares.amax(-1) + 0.01).log(),
        (pressed.imbalance + 1e-3).log10(),
        _depth(staged).clamp_max(10.0),
        (0.8 - staged.clearance).clamp_min(0.0),
        (staged.overlap / 0.001).clamp_max(5.0),
        _links_touching(staged.contact_set),
        count,
        shares.sum(-1) ** 2 / (shares**2).sum(-1).clamp_min(1e-9),  # Effective number of loaded contacts, 0 if none.
        (shares[..., None] * arms).sum(1).norm(dim=-1),
        normals.sum(1).norm(dim=-1) / count,
        *_spread(normals, count).unbind(0),
        *_spread(active[..., None] * (arms - middle[:, None]), count).sqrt().unbind(0),
        margins.amin(-1),
        (margins < 0.02).to(shares).sum(-1),
        pressing.amax(-1),
        pressing.mean(-1),
        normal_forces.sum(-1).clamp_min(1e-3).log(),
        opening.amax(-1),
        opening.mean(-1),
        shift / 0.01,
        to_center.norm(dim=-1),
        (to_center * (rotation @ palm[1])).sum(-1),
        *(torch.full_like(shift, float(np.log(value))) for value in (length, problem.object.mass)),
    ]
    return torch.nan_to_num(torch.stack(columns, -1).double().cpu())


def _depth(staged: Staged) -> Values:
    return (-staged.contact_set.distance.amin(-1)).clamp_min(0.0) / 0.001


def _links_touching(contact_set: ContactSet) -> Values:
    members = contact_set.link[None] == torch.unique(contact_set.link)[:, None]
    return (contact_set.active[:, None] & members).any(-1).sum(-1).to(contact_set.distance)


def _spread(rows: Float[Tensor, "batch slots 3"], count: Values) -> Float[Tensor, "3 batch"]:
    squares = torch.linalg.eigvalsh(rows.transpose(1, 2) @ rows / count[:, None, None])
    return squares.clamp_min(0.0).T


@lru_cache(maxsize=1)
def _fitted() -> dict[str, Tensor]:
    with files("graspd_core.optimize").joinpath("ranking.npz").open("rb") as file, np.load(file) as arrays:
        return {name: torch.as_tensor(arrays[name]).double() for name in arrays.files}
