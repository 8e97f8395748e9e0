"""Web page that shows a running simulation: moving parts, camera points and lines of text."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from graspd_viewer.drawing import Part
from graspd_viewer.grasp_list import BLOCK
from graspd_viewer.scene_nodes import SceneNodes
from graspd_viewer.server import HOST, PORT, Page

Pose = Float[np.ndarray, "4 4"]


class MovingParts(Page):
    """Web page that shows moving parts. A thread draws the newest state. So the methods that draw return at once.

    Args:
        parts: moving parts, each in its own frame.
        eye, middle: position of the visitor's camera, and the point at which it looks [m].
        host, port: see `Page`.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        *,
        eye: Float[np.ndarray, "3"],
        middle: Float[np.ndarray, "3"],
        host: str = HOST,
        port: int = PORT,
    ) -> None:
        super().__init__(host, port)
        self._nodes = SceneNodes(self._server)
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._text = gui.add_html("")
        self._nodes.draw("moving", parts)
        self._nodes.aim(eye, middle, np.array([0.0, 0.0, 1.0]))

    def place(self, poses: Sequence[Pose]) -> None:
        """Set the poses of all moving parts, in the order of `parts` [m]."""
        self._jobs.submit("place", lambda: self._nodes.place("moving", poses))

    def draw(self, group: str, parts: Sequence[Part]) -> None:
        """Replace the parts of a group by `parts`, which do not move."""
        self._jobs.submit(group, lambda: self._nodes.draw(group, parts))

    def draw_points(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Replace the drawn camera points [m]."""
        self._jobs.submit("points", lambda: self._nodes.draw_points(points))

    def write(self, *lines: str) -> None:
        """Replace the shown text by `lines`."""
        text = "<br>".join(map(html.escape, lines))
        self._jobs.submit("text", lambda: setattr(self._text, "content", f"{BLOCK}{text}</div>"))
