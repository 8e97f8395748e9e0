"""What a grasp does to its object: the forces of its squeeze, and the push that it resists least."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.methods.poses import Poses
from graspd_core.methods.problem import build_problem
from graspd_core.methods.stages.contact_set import find_contacts
from graspd_core.methods.stages.squeeze import squeeze
from graspd_core.metrics.metrics_context import make_metrics_context
from graspd_core.metrics.prepared_grasp import prepare_grasp
from graspd_core.types import Grasp
from graspd_core.viewer.session import Session


@dataclass(frozen=True)
class SqueezeForces:
    """Where a squeeze presses on the object [m], and with what force [N], as it was planned."""

    positions: Float[np.ndarray, "contacts 3"]
    forces: Float[np.ndarray, "contacts 3"]


class Mechanics:
    """Answers for the grasps of a session, which has a scene; what they share is prepared once."""

    def __init__(self, session: Session) -> None:
        assert session.scene is not None
        self._hand, self._config = session.hand, session.config
        self._problem = build_problem(session.scene, session.hand, session.config.problem, seed=0)
        self._metrics = make_metrics_context(session.scene.object, session.hand)

    def squeeze_forces(self, grasp: Grasp) -> SqueezeForces:
        """The balanced contact forces that the squeeze was made from."""
        posture = grasp.grasp
        rows = (posture.position, posture.quaternion_wxyz, posture.joint_positions)
        poses = Poses(*(torch.as_tensor(row)[None].to(self._problem.hand.lower) for row in rows))
        contacts = find_contacts(self._problem, poses, self._config.grasp_stages.touch_reach)
        effort = torch.as_tensor(self._hand.effort).to(self._problem.hand.lower)
        forces = squeeze(self._problem, poses, contacts, effort, self._config.grasp_stages).forces[0]
        pressing = contacts.active[0] & (forces.norm(dim=-1) > 0)
        return SqueezeForces(contacts.position[0][pressing].double().numpy(), forces[pressing].double().numpy())

    def weakest_push(self, grasp: Grasp) -> Float[np.ndarray, "6"] | None:
        """The unit disturbance (force, torque over the object's radius) that the contacts resist least.

        None where the contacts do not close around the object: there is a push that they do not resist at all.
        """
        return prepare_grasp(self._metrics, grasp.grasp).weakest_push
