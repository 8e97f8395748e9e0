"""Page of the viewer: tabs, help, and the drawing thread. It runs until it is closed, for any number of visitors."""

from __future__ import annotations

import html
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

from graspd_core.types import StopHook
from graspd_core.verify.metrics import METRICS
from graspd_viewer.grasp_list import BLOCK
from graspd_viewer.grasp_tab import GraspTab
from graspd_viewer.live_view import LiveView
from graspd_viewer.plan_tab import PlanTab
from graspd_viewer.scene_nodes import SceneNodes
from graspd_viewer.server import LatestJobs, quiet, start_server
from graspd_viewer.session import Session

_KEYS = """
**Keys.** N next grasp, P previous grasp, R run and play the trial. Drag turns the scene, the right button moves it, the
wheel zooms.

**Colours.** The object is orange; where a camera did not see it and its shape was guessed, mauve. Blue arrows are the
object's normals at the contacts. Red arrows are forces on the object, 4 mm for a newton: as planned for the squeeze,
and as MuJoCo measured them while a trial plays. Purple is the push that the grasp resists least, yellow the axis of the
turn that goes with it. In a slice of the signed distance blue is inside.

**Verdicts.** A grasp is *verified* when it passed every physics trial, *failed* when it did not: press R to see when
and why. One that is *less sure* holds on the likeliest shape of an object that cameras saw, and fails under too
much else that may be true; the share beside it is how probably it holds. *Unverified* grasps were not tried.

**Trials.** In the hold trial the hand closes on the free object, which is then pulled along six axes. In the lift trial
it comes from a retreat, closes on the object on its support, and lifts it.

**While planning.** Every line figure is a hand: blue while it is searched for, grey while it waits for its trial, then
green or red; one that is less sure stays grey.

**Slow?** A browser that draws without a graphics card does so twice as fast with
[a quarter of the pixels](/?fixedDpr=0.5).

**Figures.**
"""


def _help() -> str:
    figures = "\n".join(f"* *{row.title}*: {row.description}" for row in METRICS.values())
    return f"{_KEYS}\n{figures}\n\nMore in docs/viewer.md, docs/metrics.md and docs/method.md of graspd."


HELP = _help()


HOST, PORT = "127.0.0.1", 8080


class Viewer:
    """Web page that shows sessions to all visitors.

    Args:
        host, port: address to listen on. By default only this machine can connect. A used port is replaced by the next.
        plan: if True, visitors may plan.

    Raises:
        ConfigError: the address cannot be listened on, or viser is not installed.
    """

    def __init__(self, *, host: str = HOST, port: int = PORT, plan: bool = True) -> None:
        self._server = start_server(host, port)
        self._host = host
        self._jobs = LatestJobs(_report)
        self._nodes = SceneNodes(self._server)
        gui = self._server.gui
        self._theme(False)
        # Dock the panel beside the scene. An overlay would hide part of the scene, which is rendered anyway.
        gui.main_panel.dock_right()
        tabs = gui.add_tab_group()
        with tabs.add_tab("Grasps"):
            self._status = gui.add_html("", visible=False)
            self._grasps = GraspTab(self._server, self._jobs, self._nodes)
        self._planner: PlanTab | None = None
        self.live = LiveView(self._jobs, self._nodes, self.show_progress)
        if plan:
            with tabs.add_tab("Plan"):
                self._planner = PlanTab(self._server, self.live, self.show, self.say)
        with tabs.add_tab("Help"):
            dark = gui.add_checkbox("Dark", False)
            gui.add_markdown(HELP)

        @dark.on_update
        def _(_event: Any) -> None:
            self._theme(bool(dark.value))

    @property
    def url(self) -> str:
        """Address of the page."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{self.port}"

    @property
    def port(self) -> int:
        """Port of the page."""
        return self._server.get_port()

    def show(self, session: Session) -> None:
        """Replace the shown session. Thread-safe."""
        self._jobs.submit("session", lambda: self._grasps.show(session))

    def wait_for_visitor(self, patience: float) -> None:
        """Wait until a visitor opens the page, or `patience` seconds have passed."""
        end = time.monotonic() + patience
        while not self._server.get_clients() and time.monotonic() < end:
            time.sleep(0.05)

    def do(self, kind: str, work: Callable[[], None]) -> None:
        """Submit a job to the drawing thread, which runs the newest job of each kind."""
        self._jobs.submit(kind, work)

    def run(self, work: Callable[[StopHook], None]) -> None:
        """Stop the present run and call `work` in the planning thread. Do nothing if visitors may not plan."""
        if self._planner is not None:
            self._planner.close()
            self._planner.begin(work)

    def say(self, line: str, share: float = 0.0) -> None:
        """Show a line and the progress (0 to 1) of a run. Thread-safe."""
        self._jobs.submit("progress", lambda: self.show_progress(line, share))

    def show_progress(self, line: str, share: float) -> None:
        """Show a line and the progress (0 to 1) of a run. Call it in the drawing thread."""
        self._status.content, self._status.visible = f"{BLOCK}{html.escape(line)}</div>", share < 1.0
        if self._planner is not None:
            self._planner.show_progress(line, share)

    def close(self) -> None:
        """End runs, threads and the server."""
        if self._planner is not None:
            self._planner.close()
        self._jobs.close()
        with quiet():
            self._server.stop()

    def _theme(self, dark: bool) -> None:
        self._server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)


def _report(error: Exception) -> None:
    traceback.print_exception(error, file=sys.stderr)
