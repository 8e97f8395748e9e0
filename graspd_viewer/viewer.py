"""The viewer's page: tabs, help, and the drawing thread. Any number of visitors see the page until `close`."""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import Any

from graspd_core.types import StopHook
from graspd_core.verify.metrics import METRICS
from graspd_viewer.grasp_list import BLOCK
from graspd_viewer.grasp_tab import GraspTab
from graspd_viewer.live_view import LiveView
from graspd_viewer.plan_tab import PlanTab
from graspd_viewer.scene_nodes import SceneNodes
from graspd_viewer.server import HOST, PORT, Page
from graspd_viewer.session import Session

_KEYS = """
**Keys.** N selects the next grasp, P the previous grasp. R runs and plays the trial. Drag to turn the scene, drag with
the right button to move the scene, and use the wheel to zoom.

**Colours.** The object is orange. Parts that no camera saw have a guessed shape and are mauve. Blue arrows are the
object's normals at the contacts. Red arrows are forces on the object, 4 mm for a newton. They are the planned forces of
the squeeze, or while a trial plays, MuJoCo's forces. The push that the grasp resists least is purple, and the axis of
its turn is yellow. In a slice of the signed distance, blue is inside.

**Verdicts.** A *verified* grasp passed every physics trial. A *failed* grasp did not: press R to see when and why. A
*less sure* grasp holds on the likeliest shape of an object that cameras saw, but fails too many robustness checks. The
number beside a grasp is the probability that it holds. *Unverified* grasps were not tried.

**Trials.** In the hold trial, the hand closes on the free object. Then the object is pulled along six axes. In the lift
trial, the hand approaches, closes on the object on its support, and lifts the object.

**While planning.** Every line figure is a hand. Hands of the search are blue, and hands that wait for their trial are
grey. Verified hands turn green, failed hands turn red, and less sure hands stay grey.

**Slow?** A browser without a graphics card draws twice as fast with [a quarter of the pixels](/?fixedDpr=0.5).

**Figures.**
"""


_FIGURES = "\n".join(f"* *{row.title}*: {row.description}" for row in METRICS.values())
HELP = f"{_KEYS}\n{_FIGURES}\n\nMore in docs/viewer.md, docs/metrics.md and docs/method.md of graspd."


class Viewer(Page):
    """Web page that shows all visitors the same session: grasps, their hand and the object.

    Args:
        host, port: see `Page`.
        plan: if True, the page has a tab where visitors plan.
    """

    def __init__(self, *, host: str = HOST, port: int = PORT, plan: bool = True) -> None:
        super().__init__(host, port)
        self._nodes = SceneNodes(self._server)
        gui = self._server.gui
        self._theme(False)
        # Dock the panel beside the scene. An overlay would hide a part of the scene that is rendered anyway.
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

    def show(self, session: Session) -> None:
        """Replace the shown session. Thread-safe."""
        self._jobs.submit("session", lambda: self._grasps.show(session))

    def do(self, kind: str, work: Callable[[], None]) -> None:
        """Submit a job to the drawing thread. The job replaces a waiting job of the same kind."""
        self._jobs.submit(kind, work)

    def run(self, work: Callable[[StopHook], None]) -> None:
        """Stop the run in progress. Then call `work` in a thread. Do nothing if the page has no tab Plan."""
        if self._planner is not None:
            self._planner.replace(work)

    def say(self, line: str, share: float = 0.0) -> None:
        """Show a line of text and the progress of a run, 0 to 1. Thread-safe."""
        self._jobs.submit("progress", lambda: self.show_progress(line, share))

    def show_progress(self, line: str, share: float) -> None:
        """Show a line of text and the progress of a run, 0 to 1. Call this in the drawing thread."""
        self._status.content, self._status.visible = f"{BLOCK}{html.escape(line)}</div>", share < 1.0
        if self._planner is not None:
            self._planner.show_progress(line, share)

    def close(self) -> None:
        """Stop the run in progress, the threads and the server."""
        if self._planner is not None:
            self._planner.close()
        super().close()

    def _theme(self, dark: bool) -> None:
        self._server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
