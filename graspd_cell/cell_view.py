"""Pictures of a simulated cell: a live view in a browser, and an image with eight frames of one pick."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from graspd_bench.rendering.render import look_at, render_shaded, save_png
from graspd_cell.grasp_source import Offer, cloud_of
from graspd_cell.robot import DepthView
from graspd_cell.simulated_robot import SimulatedRobot
from graspd_core.hands.model import HandModel
from graspd_core.types import TriangleMesh

if TYPE_CHECKING:
    from graspd_viewer.moving_parts import MovingParts

Colour = tuple[float, float, float]
ROBOT: dict[str, Colour] = {"arm": (0.78, 0.79, 0.82), "hand": (0.40, 0.50, 0.68)}
SOLIDS: dict[str, Colour] = {
    "table": (0.86, 0.83, 0.76),
    "pick bin": (0.45, 0.50, 0.46),
    "place bin": (0.38, 0.46, 0.56),
}
THINGS: tuple[Colour, ...] = (
    (0.84, 0.37, 0.30), (0.36, 0.58, 0.80), (0.95, 0.72, 0.28), (0.45, 0.70, 0.45), (0.62, 0.48, 0.72),
    (0.55, 0.44, 0.36), (0.88, 0.56, 0.70), (0.30, 0.65, 0.68), (0.70, 0.70, 0.32), (0.90, 0.52, 0.22),
)  # fmt: skip
# Simulated seconds between two updates of the page, and between two frames stored for the film.
_PICTURE, _FRAME = 1 / 15, 0.2
# Frames of a film, frames per row, width and height of a frame [pixels], and most frames stored of one attempt.
FRAMES, _ROW, _WIDTH, _HEIGHT, _KEPT = 8, 4, 320, 240, 200
_BORDER = 3


def colour_of(name: str, names: Sequence[str]) -> Colour:
    """Return the colour of a part of the cell or of one of the objects in `names`."""
    known = ROBOT | SOLIDS
    return known[name] if name in known else THINGS[list(names).index(name) % len(THINGS)]


def view_point(robot: SimulatedRobot) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's position and target, base frame [m]. The camera looks across the bins at the robot."""
    pick, place = (np.array([*bin_.center, 0.0]) for bin_ in (robot.world.layout.pick, robot.world.layout.place))
    middle = 0.4 * (pick + place)
    ahead = middle / np.linalg.norm(middle)
    side = (pick - place) / np.linalg.norm(pick - place)
    return middle + 1.35 * ahead + 0.9 * side + np.array([0.0, 0.0, 1.0]), middle + np.array([0.0, 0.0, 0.25])


def cell_picture(
    robot: SimulatedRobot, meshes: Sequence[tuple[str, TriangleMesh]]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Render an RGB image of the surfaces `meshes`, which come from `SimulatedRobot.meshes`."""
    names = [thing.name for thing in robot.world.things]
    coloured = [(mesh, colour_of(name, names)) for name, mesh in meshes]
    image = render_shaded(coloured, T_world_camera=look_at(*view_point(robot)), width=_WIDTH, height=_HEIGHT)
    image[:_BORDER], image[-_BORDER:], image[:, :_BORDER], image[:, -_BORDER:] = 255, 255, 255, 255
    return image


class Film:
    """Recorder that saves one attempt as eight frames. The robot calls the recorder as one of its `watchers`."""

    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot, self._due = robot, 0.0
        self._moments: deque[list[tuple[str, TriangleMesh]]] = deque(maxlen=_KEPT)
        robot.watchers.append(self._watch)

    def _watch(self, robot: SimulatedRobot) -> None:
        if robot.time >= self._due:
            self._due = robot.time + _FRAME
            self._moments.append(robot.meshes())

    def begin(self) -> None:
        """Delete the recorded frames."""
        self._moments.clear()

    def save(self, path: Path) -> None:
        """Stop recording, and write one image of eight frames, evenly spaced over the recording."""
        self._robot.watchers.remove(self._watch)
        places = np.linspace(0, len(self._moments) - 1, FRAMES).round().astype(int)
        frames = [cell_picture(self._robot, self._moments[k]) for k in places]
        rows = [np.concatenate(frames[k : k + _ROW], axis=1) for k in range(0, FRAMES, _ROW)]
        path.parent.mkdir(parents=True, exist_ok=True)
        save_png(path, np.concatenate(rows, axis=0))


class LiveCell:
    """Web page that shows a simulated cell while a picker empties its bin. The robot calls it as one of its `watchers`.

    Args:
        robot: the robot to show.
        host, port: address of the page.
        speed: simulated seconds per second of wall clock.
    """

    def __init__(self, robot: SimulatedRobot, *, host: str, port: int, speed: float = 1.0) -> None:
        from graspd_viewer.drawing import Part
        from graspd_viewer.moving_parts import MovingParts

        names = [thing.name for thing in robot.world.things]
        parts = [Part(f"{n}/{k}", mesh, colour_of(n, names)) for k, (n, mesh) in enumerate(robot.solids())]
        eye, middle = view_point(robot)
        self.page: MovingParts = MovingParts(parts, eye=eye, middle=middle, host=host, port=port)
        self._speed, self._due = speed, 0.0
        self._wall, self._simulated = time.monotonic(), robot.time
        self._watch(robot)
        robot.watchers.append(self._watch)

    def _watch(self, robot: SimulatedRobot) -> None:
        if robot.time < self._due:
            return
        self._due = robot.time + _PICTURE
        self.page.place(robot.solid_poses())
        # Simulated time stops while graspd plans. The page does not catch up on this time.
        wait = (robot.time - self._simulated) / self._speed - (time.monotonic() - self._wall)
        if not wait > -0.2:
            self._wall, self._simulated = time.monotonic(), robot.time
        elif wait > 0:
            time.sleep(wait)

    def show_offer(self, hand: HandModel, view: DepthView, offer: Offer) -> None:
        """Show the camera's points and the hand at the chosen grasp, coloured by verdict."""
        from graspd_viewer.drawing import VERDICTS, Part
        from graspd_viewer.grasp_page import placed_hand

        self.page.draw_points(cloud_of(view).points)
        parts = []
        if offer.grasp is not None:
            mesh = placed_hand(hand, offer.grasp.grasp)
            parts = [Part("chosen/hand", mesh, VERDICTS[offer.grasp.verdict], 0.4)]
        self.page.draw("chosen", parts)
