"""Web page that shows a running simulation: moving parts, camera points and lines of text."""

from __future__ import annotations

import html
import sys
import time
import traceback
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from graspd_viewer.drawing import Part
from graspd_viewer.grasp_list import BLOCK
from graspd_viewer.scene_nodes import SceneNodes
from graspd_viewer.server import LatestJobs, quiet, start_server
from graspd_viewer.viewer import HOST, PORT

Pose = Float[np.ndarray, "4 4"]


class MovingParts:
    """Web page that shows moving parts. A thread draws the newest state. So the methods that draw return at once.

    Args:
        parts: moving parts, each in its own frame.
        eye, middle: position of the visitor's camera, and the point at which it looks [m].
        host, port: address to listen on. By default only this machine can connect. A used port is replaced by the next.

    Raises:
        ConfigError: the address cannot be listened on, or viser is not installed.
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
        self._server = start_server(host, port)
        self._host = host
        self._jobs = LatestJobs(lambda error: traceback.print_exception(error, file=sys.stderr))
        self._nodes = SceneNodes(self._server)
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._text = gui.add_html("")
        self._nodes.draw("moving", parts)
        self._nodes.aim(eye, middle, np.array([0.0, 0.0, 1.0]))

    @property
    def url(self) -> str:
        """Return the address of the page."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{self._server.get_port()}"

    def wait_for_visitor(self, patience: float, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait until a visitor opens the page, `patience` seconds have passed, or `stop` returns True."""
        end = time.monotonic() + patience
        while not self._server.get_clients() and time.monotonic() < end and not stop():
            time.sleep(0.05)

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

    def close(self) -> None:
        """End the thread and the server."""
        self._jobs.close()
        with quiet():
            self._server.stop()
