"""A trial watched: where hand and object were at every moment as MuJoCo ran it, and what pressed on the object.

Nothing here is run by planning; a trial that is recorded takes the same steps and ends with the same result.
"""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import ConfigError, shown
from graspd_core.trials.hold_trial import axis_name
from graspd_core.trials.lift_trial import LiftSettings
from graspd_core.trials.trial_registry import TRIALS, TrialContext
from graspd_core.trials.world import Protocol, World
from graspd_core.types import Grasp, TrialResult

# Steps from one frame to the next: 50 frames for each simulated second.
FRAME_STEPS = 5


@dataclass(frozen=True)
class Frame:
    """One moment of a trial; the object's frame as it was at the start, in which a lift moves hand and object up.

    Attributes:
        stage: what is being done.
        positions, quaternions: of every link of the hand, in its order, and of the object last [m], wxyz.
        contacts: where the hand touches the object [m].
        forces: of the hand on the object there [N].
    """

    stage: str
    positions: Float[np.ndarray, "bodies 3"]
    quaternions: Float[np.ndarray, "bodies 4"]
    contacts: Float[np.ndarray, "contacts 3"]
    forces: Float[np.ndarray, "contacts 3"]


@dataclass(frozen=True)
class Recording:
    """A trial from its first step to its end, `seconds` of simulated time apart; the last frame is its very end."""

    result: TrialResult
    frames: tuple[Frame, ...]
    seconds: float


def record_trial(context: TrialContext, grasp: Grasp, name: str) -> Recording:
    """Run one trial of a grasp and keep what happens.

    Raises:
        ConfigError: no such trial, or none that applies to this scene.
    """
    names = [row.name for row in TRIALS.values() if row.applies(context)]
    if name not in names:
        raise ConfigError(f"trial {shown(name)}: valid for this scene: {', '.join(names)}")
    recorder = _Recorder(context, name)
    # Data of its own: that of a trial which ended may be in use by a run beside.
    worlds = {
        which: world and replace(world, watch=recorder, spare=deque())
        for which, world in (("alone", context.alone), ("around", context.around))
    }
    result = TRIALS[name].run(replace(context, **worlds), grasp, lambda: False)
    return Recording(result, recorder.frames(), FRAME_STEPS * context.protocol.timestep)


class _Recorder:
    """Keeps every fifth step of a trial, and the last."""

    def __init__(self, context: TrialContext, name: str) -> None:
        world = context.around if name == "lift" else context.alone
        assert world is not None
        self._world, self._protocol, self._lifts = world, context.protocol, name == "lift"
        bodies = [int(world.model.body(f"link:{link}").id) for link in context.hand.link_names]
        self._bodies = np.array([*bodies, world.object_body])
        self._frames: list[Frame] = []
        self._last: Frame | None = None
        self._steps = 0

    def __call__(self, data: Any) -> None:
        self._steps += 1
        # The last frame is wanted wherever the trial ends, which nobody knows before.
        self._last = None if self._steps % FRAME_STEPS == 0 else self._frame(data)
        if self._last is None:
            self._frames.append(self._frame(data))

    def frames(self) -> tuple[Frame, ...]:
        return tuple(self._frames) if self._last is None else (*self._frames, self._last)

    def _frame(self, data: Any) -> Frame:
        # What is beside the hand sinks in a lift (lift_trial.py); seen from there, hand and object rise.
        origin = self._world.origin - (data.mocap_pos[1] if len(data.mocap_pos) > 1 else 0.0)
        contacts, forces = _contact_forces(self._world, data)
        return Frame(
            _lift_stage(data, self._protocol) if self._lifts else _hold_stage(self._world, data, self._protocol),
            data.xpos[self._bodies] + origin,
            data.xquat[self._bodies].copy(),
            contacts + origin,
            forces,
        )


def _contact_forces(world: World, data: Any) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Where the hand touches the object, and the force on the object there; world frame [m], [N]."""
    import mujoco

    places, forces, wrench = [], [], np.zeros(6)
    hand = set(world.hand_geoms)
    for index in range(data.ncon):
        contact = data.contact[index]
        first, second = int(contact.geom1), int(contact.geom2)
        on_second = first in hand and world.model.geom_bodyid[second] == world.object_body
        if not on_second and not (second in hand and world.model.geom_bodyid[first] == world.object_body):
            continue
        mujoco.mj_contactForce(world.model, data, index, wrench)
        # The force on the second body, in the contact's axes, which are the rows of its frame.
        forces.append((1.0 if on_second else -1.0) * wrench[:3] @ contact.frame.reshape(3, 3))
        places.append(contact.pos.copy())
    return np.array(places).reshape(-1, 3), np.array(forces).reshape(-1, 3)


def _hold_stage(world: World, data: Any, protocol: Protocol) -> str:
    """What a hold trial does, told by its clock, which every pull sets back, and by what pulls."""
    pull = data.xfrc_applied[world.object_body, :3]
    if pull.any():
        return f"a pull along {axis_name(pull / np.linalg.norm(pull))}"
    return "closing" if data.time <= protocol.stage_time + 1e-9 else "squeezing"


def _lift_stage(data: Any, protocol: Protocol) -> str:
    ends = np.cumsum([LiftSettings.approach_time, protocol.stage_time, protocol.stage_time, LiftSettings.lift_time])
    names = ("coming", "closing", "squeezing", "lifting", "holding up")
    return names[int(np.searchsorted(ends + 1e-9, data.time))]
