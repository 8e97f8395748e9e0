"""A grasp's trial, run again and watched: forwards, step by step, up to the moment and the reason of its failure."""

from __future__ import annotations

import html
from typing import Any

from graspd_core.errors import GraspdError
from graspd_core.runtime.latest_jobs import LatestJobs
from graspd_core.scene.scene import object_parts
from graspd_core.trials.trial_recording import Recording, record_trial
from graspd_core.trials.trial_registry import TRIALS, TrialContext, build_worlds
from graspd_core.trials.world import PROTOCOLS, at_friction
from graspd_core.types import Grasp
from graspd_core.viewer.drawing import force_parts
from graspd_core.viewer.grasp_list import BLOCK
from graspd_core.viewer.scene_nodes import SceneNodes
from graspd_core.viewer.session import Session

# Frames of the page for each second, and of the recording for each of those: as fast as it happened.
_RATE = 25.0


class TrialControls:
    """Widgets of a trial; everything is drawn by `jobs`, in one thread."""

    def __init__(self, gui: Any, jobs: LatestJobs, nodes: SceneNodes) -> None:
        self._jobs, self._nodes = jobs, nodes
        self._session: Session | None = None
        self._grasp: Grasp | None = None
        self._contexts: dict[str, TrialContext] = {}
        self._recording: Recording | None = None
        with gui.add_folder("Its trial, as MuJoCo ran it"):
            self._name = gui.add_dropdown("Trial", tuple(TRIALS), hint="lift: where there is a support or a neighbour")
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
        """Another grasp, of which no trial is run yet; its own failed trial is offered first."""
        if session is not self._session:
            self._session, self._contexts = session, {}
        self._grasp = grasp
        failed = [trial.name for trial in (grasp.trials if grasp else ()) if not trial.passed and trial.name in TRIALS]
        if failed:
            self._name.value = failed[0]
        self.stop()
        self._text.content = ""

    def stop(self) -> bool:
        """Show no moment of a trial any more; whether one was shown. From the drawing thread."""
        self._jobs.drop("play")
        shown, self._recording, self._time.disabled = self._recording is not None, None, True
        self._nodes.draw("trial", ())
        return shown

    def play(self) -> None:
        """Run the trial and play it from its beginning."""
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
            protocol = at_friction(PROTOCOLS[name], scene.object.friction)
            self._contexts[name] = build_worlds(scene, self._session.hand, object_parts(scene.object), protocol)
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
        self._text.content = _told(recording, index, frame.stage)


def _told(recording: Recording, index: int, stage: str) -> str:
    """When and what, and how the trial ended."""
    result, seconds = recording.result, recording.seconds
    end = seconds * (len(recording.frames) - 1)
    line = f"{seconds * index:.2f} s of {end:.2f} s: {html.escape(stage)}"
    if result.passed:
        return f"{BLOCK}{line}<br><b style='color:rgb(40,165,75)'>passed</b></div>"
    failed = f"failed at {end:.2f} s: {html.escape(result.reason)}"
    return f"{BLOCK}{line}<br><b style='color:rgb(215,50,50)'>{failed}</b></div>"
