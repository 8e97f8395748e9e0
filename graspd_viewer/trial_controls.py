"""Record a grasp's trial, and play the recording up to the trial's end or failure.

A recording contains the poses of hand and object in MuJoCo, and the contact forces. Recording changes neither the
trial's steps nor its result.
"""

from __future__ import annotations

import html
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import ConfigError, GraspdError, short_repr
from graspd_core.types import Grasp, TrialResult
from graspd_core.verify.hold_trial import axis_name
from graspd_core.verify.lift_trial import LiftSettings
from graspd_core.verify.trial_registry import TRIALS, TrialContext
from graspd_core.verify.verification import trial_context
from graspd_core.verify.world import PROTOCOLS, Protocol, World
from graspd_viewer.drawing import force_parts
from graspd_viewer.grasp_list import BLOCK
from graspd_viewer.scene_nodes import SceneNodes
from graspd_viewer.server import LatestJobs
from graspd_viewer.session import Session

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false


# Simulation steps per frame, which give 50 frames per simulated second.
FRAME_STEPS = 5


@dataclass(frozen=True)
class Frame:
    """State of a trial at one time, in the object's coordinate frame before the trial. In a lift, hand and object rise.

    Attributes:
        stage: name of the current stage.
        positions, quaternions: poses of all links of the hand, in order, then of the object [m], wxyz.
        contacts: contact points between hand and object [m].
        forces: forces of the hand on the object at the contact points [N].
    """

    stage: str
    positions: Float[np.ndarray, "bodies 3"]
    quaternions: Float[np.ndarray, "bodies 4"]
    contacts: Float[np.ndarray, "contacts 3"]
    forces: Float[np.ndarray, "contacts 3"]


@dataclass(frozen=True)
class Recording:
    """Recorded trial. The frames are `seconds` of simulated time apart. The last frame shows the end of the trial."""

    result: TrialResult
    frames: tuple[Frame, ...]
    seconds: float


def record_trial(context: TrialContext, grasp: Grasp, name: str) -> Recording:
    """Run and record one trial of a grasp. Raises ConfigError: the trial is unknown or does not apply to the scene."""
    names = [row.name for row in TRIALS.values() if row.applies(context)]
    if name not in names:
        raise ConfigError(f"trial {short_repr(name)}; valid for this scene: {', '.join(names)}")
    recorder = _Recorder(context, name)
    # Use separate simulation data, because a parallel run may use the shared spare data.
    worlds = {
        which: world and replace(world, watch=recorder, spare=deque())
        for which, world in (("alone", context.alone), ("around", context.around))
    }
    result = TRIALS[name].run(replace(context, **worlds), grasp, lambda: False)
    return Recording(result, recorder.frames(), FRAME_STEPS * context.protocol.timestep)


class _Recorder:
    """Function that a trial calls after every step. It stores every fifth step and the last step."""

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
        # Any step may be the last step, so the newest frame is always kept.
        self._last = None if self._steps % FRAME_STEPS == 0 else self._frame(data)
        if self._last is None:
            self._frames.append(self._frame(data))

    def frames(self) -> tuple[Frame, ...]:
        return tuple(self._frames) if self._last is None else (*self._frames, self._last)

    def _frame(self, data: Any) -> Frame:
        # In a lift trial the surroundings sink (lift_trial.py). The page shows hand and object rising instead.
        origin = -data.mocap_pos[1] if len(data.mocap_pos) > 1 else np.zeros(3)
        contacts, forces = _contact_forces(self._world, data)
        return Frame(
            _lift_stage(data, self._protocol) if self._lifts else _hold_stage(self._world, data, self._protocol),
            data.xpos[self._bodies] + origin,
            data.xquat[self._bodies].copy(),
            contacts + origin,
            forces,
        )


def _contact_forces(world: World, data: Any) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the points where the hand touches the object [m], and the hand's force at each point [N], world frame."""
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
        # `wrench` is the force on the second body in the contact's axes. They are the rows of the contact's frame.
        forces.append((1.0 if on_second else -1.0) * wrench[:3] @ contact.frame.reshape(3, 3))
        places.append(contact.pos.copy())
    return np.array(places).reshape(-1, 3), np.array(forces).reshape(-1, 3)


def _hold_stage(world: World, data: Any, protocol: Protocol) -> str:
    pull = data.xfrc_applied[world.object_body, :3]
    if pull.any():
        return f"a pull along {axis_name(pull / np.linalg.norm(pull))}"
    return "closing" if data.time <= protocol.stage_time + 1e-9 else "squeezing"


def _lift_stage(data: Any, protocol: Protocol) -> str:
    ends = np.cumsum([LiftSettings.approach_time, protocol.stage_time, protocol.stage_time, LiftSettings.lift_time])
    names = ("coming", "closing", "squeezing", "lifting", "holding up")
    return names[int(np.searchsorted(ends + 1e-9, data.time))]


# Frames that the page shows per second. A trial is played in real time.
_RATE = 25.0


class TrialControls:
    """Widgets that run and play a trial. The thread of `jobs` does all drawing."""

    def __init__(self, gui: Any, jobs: LatestJobs, nodes: SceneNodes) -> None:
        self._jobs, self._nodes = jobs, nodes
        self._session: Session | None = None
        self._grasp: Grasp | None = None
        self._contexts: dict[str, TrialContext] = {}
        self._recording: Recording | None = None
        with gui.add_folder("Its trial, as MuJoCo ran it"):
            self._name = gui.add_dropdown("Trial", tuple(TRIALS), hint="lift: if there is a support or a neighbour")
            self._protocol = gui.add_dropdown("Protocol", tuple(PROTOCOLS))
            self._play = gui.add_button("Run and play", hint="key R")
            self._time = gui.add_slider("Moment", 0, 1, 1, 0, disabled=True)
            self._text = gui.add_html("")
        self._play.on_click(lambda _: self.play())
        gui.add_command("Play the trial", hotkey="R").on_trigger(lambda _: self.play())

        @self._time.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self._jobs.drop("play")
                self._jobs.submit("frame", lambda: self._draw(int(self._time.value)))

    def show(self, session: Session, grasp: Grasp | None) -> None:
        """Set the grasp whose trial can be played. Remove the recording. Select the failed trial, if any."""
        if session is not self._session:
            self._session, self._contexts = session, {}
        self._grasp = grasp
        failed = [trial.name for trial in (grasp.trials if grasp else ()) if not trial.passed and trial.name in TRIALS]
        if failed:
            self._name.value = failed[0]
        self.stop()
        self._text.content = ""

    def stop(self) -> bool:
        """Remove the recording. Return True if there was one. Call this in the drawing thread."""
        self._jobs.drop("play")
        recorded, self._recording, self._time.disabled = self._recording is not None, None, True
        self._nodes.draw("trial", ())
        return recorded

    def play(self) -> None:
        """Run the trial and play it from the start."""
        self._jobs.submit("trial", self._run)

    def _run(self) -> None:
        if self._session is None or self._grasp is None or self._session.scene is None:
            self._text.content = f"{BLOCK}a trial needs a grasp and its object</div>"
            return
        try:
            self._recording = record_trial(self._context(), self._grasp, self._name.value)
        except GraspdError as error:
            self._text.content = f"{BLOCK}{html.escape(str(error))}</div>"
            return
        self._time.max, self._time.disabled = max(len(self._recording.frames) - 1, 1), False
        self._play_from(0)

    def _context(self) -> TrialContext:
        assert self._session is not None
        assert self._session.scene is not None
        name = self._protocol.value if self._protocol.value in PROTOCOLS else "standard"
        if name not in self._contexts:
            scene = self._session.scene
            self._contexts[name] = trial_context(scene, self._session.hand, name)
        return self._contexts[name]

    def _play_from(self, index: int) -> None:
        if self._recording is None:
            return
        last = len(self._recording.frames) - 1
        self._time.value = index
        self._draw(index)
        if index < last:
            ahead = max(1, round(1 / _RATE / self._recording.seconds))
            self._jobs.submit("play", lambda: self._play_from(min(index + ahead, last)), after=1 / _RATE)

    def _draw(self, index: int) -> None:
        recording = self._recording
        if recording is None:
            return
        if not recording.frames:
            reason = html.escape(recording.result.reason)
            self._text.content = f"{BLOCK}failed before its first step: <b>{reason}</b></div>"
            return
        last = len(recording.frames) - 1
        index = min(max(index, 0), last)
        frame = recording.frames[index]
        self._nodes.pose_links(frame.positions[:-1], frame.quaternions[:-1])
        self._nodes.pose_object(frame.positions[-1], frame.quaternions[-1])
        for planned in ("contacts", "forces", "weakest"):
            self._nodes.draw(planned, ())
        parts = force_parts(frame.contacts, frame.forces)
        self._nodes.draw("trial", parts)
        self._text.content = _caption(recording, index, frame.stage)


def _caption(recording: Recording, index: int, stage: str) -> str:
    """Return HTML with the time and stage of a frame, and the trial's result."""
    result, seconds = recording.result, recording.seconds
    end = seconds * (len(recording.frames) - 1)
    line = f"{seconds * index:.2f} s of {end:.2f} s: {html.escape(stage)}"
    if result.passed:
        return f"{BLOCK}{line}<br><b style='color:rgb(40,165,75)'>passed</b></div>"
    failed = f"failed at {end:.2f} s: {html.escape(result.reason)}"
    return f"{BLOCK}{line}<br><b style='color:rgb(215,50,50)'>{failed}</b></div>"
