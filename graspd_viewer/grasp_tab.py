"""The tab Grasps: the list of grasps, a slider for the hand's path, choices of what is drawn, and a grasp's trial."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.types import Grasp
from graspd_core.verify.prepared_grasp import MetricsContext, make_metrics_context
from graspd_viewer.drawing import STAGES, contact_parts, posture_at, squeeze_parts, weakest_parts, weakest_push
from graspd_viewer.grasp_list import ALL, FILTERS, ORDERS, figures_html, label, legend_html, listed, table_html
from graspd_viewer.scene_nodes import SceneNodes
from graspd_viewer.server import LatestJobs, name_tab
from graspd_viewer.session import Session
from graspd_viewer.trial_controls import TrialControls

_NONE = "no grasp"
# When the slider moves, the hand is drawn half-way at once, and at the slider's place after this delay [s]. The page
# sends at most 20 slider positions a second. The delay is half of this period, for a smoother motion.
_HALF_PERIOD = 0.025
_AXES = ("none", "x", "y", "z")
# Groups of nodes that a visitor may hide, and their labels.
_GROUPS = {
    "contacts": "Contacts and normals (blue)", "forces": "Squeeze forces (red)",
    "weakest": "Weakest push (purple) and turn (yellow)", "around": "Support and neighbours",
    "cloud": "Cloud, as seen", "object": "Object",
}  # fmt: skip


class GraspTab:
    """Widgets of the tab and their actions. The thread of `jobs` does all drawing."""

    def __init__(self, server: Any, jobs: LatestJobs, nodes: SceneNodes) -> None:
        self._server, self._jobs, self._nodes = server, jobs, nodes
        self._session: Session | None = None
        self._metrics: MetricsContext | None = None
        self._ranks: list[int] = []
        self._chosen: int | None = None
        self._at = 2.0
        self._build(server.gui)
        for name, key, step in (("Next grasp", "N", 1), ("Previous grasp", "P", -1)):
            command = server.gui.add_command(name, hotkey=key)
            command.on_trigger(lambda _, step=step: self.step(step))

    def _build(self, gui: Any) -> None:
        self._title = gui.add_markdown("")
        self._filter = gui.add_dropdown("Show", FILTERS, initial_value=ALL, hint="by the verdict of the trials")
        self._order = gui.add_dropdown("Sort by", ORDERS, initial_value="rank", hint="best first")
        self._choice = gui.add_dropdown("Grasp", (_NONE,))
        self._step = gui.add_button_group("Keys P, N", ("Previous", "Next"))
        marks = tuple((float(at), name) for at, name in enumerate(STAGES))
        self._stage = gui.add_slider("Way", 0.0, 3.0, 0.01, 2.0, marks=marks, hint="from the retreat to the squeeze")
        self.trial = TrialControls(gui, self._jobs, self._nodes)
        gui.add_html(legend_html())
        self._table = gui.add_html("")
        self._figures = gui.add_html("")
        with gui.add_folder("What is shown", expand_by_default=False):
            self._boxes = {group: gui.add_checkbox(name, True) for group, name in _GROUPS.items()}
            self._solid = gui.add_slider("Opacity", 0.1, 1.0, 0.05, 1.0)
            self._axis = gui.add_dropdown("Distance slice", _AXES, hint="blue inside, red outside, white the surface")
            self._share = gui.add_slider("Slice at", 0.0, 1.0, 0.01, 0.5)
        self._connect()

    def _connect(self) -> None:
        def by_visitor(handle: Any, kind: str, work: Any) -> None:
            @handle.on_update
            def _(event: Any) -> None:
                if event.client is not None:
                    self._jobs.submit(kind, work)

        by_visitor(self._filter, "list", self._list)
        by_visitor(self._order, "list", self._list)
        by_visitor(self._choice, "choose", self._read_choice)
        by_visitor(self._stage, "pose", self._follow)
        by_visitor(self._solid, "solid", lambda: self._nodes.fade_hand(float(self._solid.value)))
        by_visitor(self._axis, "slice", self._draw_slice)
        by_visitor(self._share, "slice", self._draw_slice)
        for group, box in self._boxes.items():
            by_visitor(
                box, f"box {group}", lambda group=group: self._nodes.set_visible(group, self._boxes[group].value)
            )

        @self._step.on_click
        def _(event: Any) -> None:
            self.step(-1 if self._step.value == "Previous" else 1)

    def show(self, session: Session) -> None:
        """Show another session and select the first grasp of the list. Call this in the drawing thread."""
        self._session = session
        # The first selected grasp creates the metrics context, because this takes as long as opening the file.
        self._metrics = None
        notes = "".join(f"\n\n*{_plain(note)}*" for note in session.notes[:6])
        self._title.content = f"**{_plain(session.title)}**, {_plain(session.hand.name)}{notes}"
        seen = session.title if session.scene is None else Path(session.scene.object.source).name or session.title
        name_tab(self._server, f"{seen}, {session.hand.name} - graspd")
        self._nodes.show(session)
        self._list()
        self._draw_slice()

    def step(self, by: int) -> None:
        """Select the grasp `by` places further in the list. Negative values go back. The start follows the end."""
        self._jobs.submit("choose", lambda: self._choose_place(by))

    def draw_pose(self, at: float | None = None) -> None:
        """Draw the hand at `at` on its path (`posture_at`), by default at the slider's value. Put the object back."""
        self._at = float(self._stage.value) if at is None else at
        grasp = self._grasp()
        if self.trial.stop():
            self._draw_contacts()
        self._nodes.show_hand(grasp is not None)
        if self._session is not None and grasp is not None:
            self._nodes.pose_hand(self._session.hand, posture_at(self._session.hand, grasp, self._at))
        self._nodes.pose_object(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def _follow(self) -> None:
        self.draw_pose(0.5 * (self._at + float(self._stage.value)))
        self._jobs.submit("pose", self.draw_pose, after=_HALF_PERIOD)

    def _grasp(self) -> Grasp | None:
        return None if self._session is None or self._chosen is None else self._session.grasps[self._chosen]

    def _list(self) -> None:
        if self._session is None:
            return
        grasps = self._session.grasps
        self._ranks = listed(grasps, self._filter.value, self._order.value)
        self._choice.options = [label(grasps[rank], rank) for rank in self._ranks] or [_NONE]
        self._choose(self._ranks[0] if self._ranks else None)

    def _read_choice(self) -> None:
        options = list(self._choice.options)
        place = options.index(self._choice.value) if self._choice.value in options else 0
        self._choose(self._ranks[place] if self._ranks else None)

    def _choose_place(self, by: int) -> None:
        if self._ranks:
            place = self._ranks.index(self._chosen) if self._chosen in self._ranks else 0
            self._choose(self._ranks[(place + by) % len(self._ranks)])

    def _choose(self, rank: int | None) -> None:
        self._chosen = rank
        grasp, session = self._grasp(), self._session
        if session is None:
            return
        if grasp is not None and rank is not None:
            self._choice.value = label(grasp, rank)
        self._table.content = table_html(session.grasps, self._ranks, rank)
        self._figures.content = figures_html(grasp, rank) if grasp is not None and rank is not None else ""
        self.draw_pose()
        self.trial.show(session, grasp)
        self._draw_contacts()

    def _draw_contacts(self) -> None:
        grasp = self._grasp()
        contacts = grasp.contacts if grasp else ()
        self._nodes.draw("contacts", contact_parts(contacts))
        self._nodes.draw("forces", squeeze_parts(contacts))
        # Draw the weakest push after the pose, because the visitor waits for the pose.
        self._nodes.draw("weakest", ())
        self._jobs.submit("weakest", self._draw_weakest, after=0.05)

    def _draw_weakest(self) -> None:
        grasp, session = self._grasp(), self._session
        if grasp is None or session is None or session.scene is None:
            return
        target = session.scene.object
        self._metrics = self._metrics or make_metrics_context(target, session.hand)
        push = weakest_push(self._metrics, grasp)
        self._nodes.draw("weakest", weakest_parts(push, target) if push is not None else ())

    def _draw_slice(self) -> None:
        axis = _AXES.index(self._axis.value) - 1 if self._axis.value in _AXES else -1
        if self._session is not None:
            share = min(max(float(self._share.value), 0.0), 1.0)
            self._nodes.draw_slice(self._session, None if axis < 0 else axis, share)


def _plain(text: str) -> str:
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+!|<>~&" else c for c in " ".join(text.split())[:300])
