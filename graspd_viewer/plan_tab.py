"""The tab Plan: visitors choose object, hand and preset, and plan, stop or save. All visitors share one run.

This module checks every request, because a forged message may contain any value.
"""

from __future__ import annotations

import html
import json
import math
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from graspd_core.errors import ConfigError, GraspdError, short_repr
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.io.grasps_json import result_document
from graspd_core.mesh.mesh_files import MESH_ENDINGS
from graspd_core.mesh.shapes import SHAPES
from graspd_core.optimize.plan_config import load_preset, preset_names
from graspd_core.perception.cloud.cloud_files import CLOUD_ENDINGS
from graspd_core.perception.load_scene import SHAPE_PREFIX, load_scene
from graspd_core.perception.scene import Scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.planning.steering import Steering
from graspd_core.runtime.worker_process import run_isolated, start_planning_worker
from graspd_core.types import StopHook, Verdict
from graspd_viewer.grasp_list import BLOCK
from graspd_viewer.live_view import LiveView
from graspd_viewer.session import Session, make_session, seen_points

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
# Sides from which the hand may come, with the direction in which it then moves, in the object's frame.
APPROACHES = {
    "any side": None, "above": (0.0, 0.0, -1.0), "below": (0.0, 0.0, 1.0),
    "+x": (-1.0, 0.0, 0.0), "-x": (1.0, 0.0, 0.0), "+y": (0.0, -1.0, 0.0), "-y": (0.0, 1.0, 0.0),
}  # fmt: skip
ENDINGS = tuple(sorted({*MESH_ENDINGS, *CLOUD_ENDINGS}))
MOST_GRASPS = 64


@dataclass(frozen=True)
class Upload:
    """File that a visitor sent. The server shows its name, but never uses it as a path."""

    name: str
    content: bytes

    @property
    def ending(self) -> str:
        """Return the file ending in lower case without the dot. Empty if there is none."""
        return self.name.rpartition(".")[2].lower() if "." in self.name else ""


@dataclass(frozen=True)
class PlanRequest:
    """What a visitor asks for: the settings of one run.

    Attributes:
        shape: name of a built-in shape, used if there is no upload.
        upload: file of the object, or None.
        units: unit of the file's coordinates, a key of `UNITS`.
        alone: True if the cloud contains only the object.
        hand, preset: names of built-in hands and presets.
        friction: friction coefficient.
        approach: side from which the hand comes, a key of `APPROACHES`.
        approach_angle: greatest angle between the hand's approach and the direction in `APPROACHES` [degrees].
        count, seed: arguments of `plan_grasps`.
    """

    shape: str
    upload: Upload | None
    units: str
    alone: bool
    hand: str
    preset: str
    friction: float
    count: int
    approach: str = "any side"
    approach_angle: float = 30.0
    seed: int = 0

    @property
    def restrictions(self) -> tuple[Steering, ...]:
        """Return the approach as restrictions for `plan_grasps`. Raises ConfigError: the angle is out of range."""
        direction = APPROACHES[self.approach]
        return () if direction is None else (Steering(direction, math.radians(self.approach_angle)),)


def check(request: PlanRequest) -> None:
    """Check the fields of a request. Raises ConfigError: a value is not valid. The message names the valid values."""
    chosen = (
        ("shape", request.shape, tuple(SHAPES)),
        ("units", request.units, tuple(UNITS)),
        ("hand", request.hand, hand_names()),
        ("preset", request.preset, preset_names()),
        ("approach", request.approach, tuple(APPROACHES)),
    )
    for name, value, valid in chosen:
        if value not in valid:
            raise ConfigError(f"{name}: {short_repr(value)}; valid: {', '.join(valid)}")
    if request.upload is not None and request.upload.ending not in ENDINGS:
        raise ConfigError(f"{request.upload.name[:80]}: unknown ending; valid endings: {', '.join(ENDINGS)}")
    if not (math.isfinite(request.friction) and 0.01 <= request.friction <= 2.0):
        raise ConfigError(f"friction: {short_repr(request.friction)}; valid: 0.01 to 2")
    if not 1.0 <= request.approach_angle <= 180.0:
        raise ConfigError(f"approach angle: {short_repr(request.approach_angle)} degrees; valid: 1 to 180")
    if not 1 <= request.count <= MOST_GRASPS:
        raise ConfigError(f"count: {short_repr(request.count)} grasps; valid here: 1 to {MOST_GRASPS}")


def load_object(request: PlanRequest) -> tuple[Scene, Any]:
    """Return the scene of a checked request, and the points of its cloud [m]. A shape or a mesh has no such points.

    A child process reads the file. So a file that crashes or attacks a reader cannot harm this process.

    Raises:
        GraspdError: the object cannot be used. The message contains the visitor's file name.
    """
    if request.upload is None:
        source = f"{SHAPE_PREFIX}{request.shape}"
        return load_scene(source, friction=request.friction), seen_points(source)
    start_planning_worker()
    with tempfile.TemporaryDirectory(prefix="graspd-view-") as folder:
        # The path contains no text of the visitor, except an ending from a fixed list.
        path = Path(folder) / f"object.{request.upload.ending}"
        path.write_bytes(request.upload.content)
        scale = UNITS[request.units]
        try:
            scene = run_isolated(load_scene, str(path), friction=request.friction, scale=scale, alone=request.alone)
            seen = run_isolated(seen_points, str(path), scale)
        except GraspdError as error:
            raise type(error)(str(error).replace(str(path), request.upload.name[:80])) from None
    # The folder is gone. A saved grasps.json names the visitor's file, which `graspd view` finds beside it.
    return replace(scene, object=replace(scene.object, source=request.upload.name)), seen


_FILE = "the file sent"


class PlanTab:
    """Widgets of the tab, and the thread that plans.

    Args:
        server: server of the page.
        live: live view of the run.
        show: thread-safe function that shows a session.
        say: thread-safe function that shows a line of text and the progress, 0 to 1.
    """

    def __init__(self, server: Any, live: LiveView, show: Callable[[Session], None], say: Callable[..., None]) -> None:
        self._live, self._show, self._say = live, show, say
        self._upload: Upload | None = None
        self._saved: bytes | None = None
        self._stop = threading.Event()
        self._busy = threading.Lock()
        # Work that waits for the end of the run in progress, and the lock of this attribute.
        self._next: Callable[[StopHook], None] | None = None
        self._waiting = threading.Lock()
        self._thread: threading.Thread | None = None
        self._build(server.gui)

    def _build(self, gui: Any) -> None:
        self._object = gui.add_dropdown("Object", tuple(SHAPES), initial_value="mug")
        self._file = gui.add_upload_button("Send a mesh or a cloud", hint=", ".join(ENDINGS))
        self._units = gui.add_dropdown("Its unit", tuple(UNITS), hint="unit of the file's coordinates")
        self._alone = gui.add_checkbox("A cloud shows the object alone", False)
        self._hand = gui.add_dropdown("Hand", hand_names(), initial_value="allegro_right")
        self._preset = gui.add_dropdown("Preset", preset_names(), initial_value="fast")
        self._friction = gui.add_slider("Friction", 0.1, 1.5, 0.05, 0.6, hint="between object and hand")
        sides = tuple(APPROACHES)
        self._approach = gui.add_dropdown("The hand comes from", sides, hint="approach side, in the object's frame")
        self._angle = gui.add_slider("Within [°]", 5, 180, 5, 30, hint="greatest angle to this direction")
        self._count = gui.add_slider("Grasps", 1, MOST_GRASPS, 1, 8, hint="number of verified grasps")
        self._plan = gui.add_button("Plan")
        self._halt = gui.add_button("Stop", disabled=True)
        self._save = gui.add_button("Save grasps.json", disabled=True)
        self._bar = gui.add_progress_bar(0.0)
        self._status = gui.add_html(f"{BLOCK}nothing planned yet</div>")
        self._file.on_upload(self._take)
        self._plan.on_click(lambda _: self.plan())
        self._halt.on_click(lambda _: self._stop.set())

        @self._save.on_click
        def _(event: Any) -> None:
            if self._saved is not None and event.client is not None:
                event.client.send_file_download("grasps.json", self._saved, save_immediately=True)

    def show_progress(self, line: str, share: float) -> None:
        """Show a line of text and the progress of a run, 0 to 1. Call this in the drawing thread."""
        self._status.content, self._bar.value = f"{BLOCK}{html.escape(line)}</div>", 100.0 * min(max(share, 0.0), 1.0)

    def plan(self) -> None:
        """Start a run with the values of the widgets. Do nothing if a run is in progress."""
        if self._busy.acquire(blocking=False):
            self._start(lambda _: self._plan_and_show(self._request()))

    def replace(self, work: Callable[[StopHook], None]) -> None:
        """Stop the run in progress. After its end, call the newest waiting `work` in a thread."""
        with self._waiting:
            self._next = work
        self._stop.set()
        self._start_next()

    def _start_next(self) -> None:
        """Start the work that waits, if any. A run in progress calls this method at its end."""
        while self._next is not None and self._busy.acquire(blocking=False):
            with self._waiting:
                work, self._next = self._next, None
            if work is not None:
                # The work shows its own grasps, so the grasps of the last run cannot be saved any more.
                self._saved = None
                self._start(work)
                return
            self._busy.release()

    def _start(self, work: Callable[[StopHook], None]) -> None:
        self._stop.clear()
        if self._next is not None:
            self._stop.set()
        self._plan.disabled, self._halt.disabled, self._save.disabled = True, False, True
        self._thread = threading.Thread(target=self._run, args=(work,), name="graspd-viewer-plan", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the run in progress, if any. Wait at most 10 s for its end. Drop the waiting work."""
        with self._waiting:
            self._next = None
        self._stop.set()
        if self._thread is not None:
            self._thread.join(10.0)

    def _take(self, event: Any) -> None:
        sent = event.target.value
        upload = Upload(sent.name[-80:], sent.content)
        if upload.ending not in ENDINGS:
            self._refuse(f"{upload.name}: unknown ending; valid endings: {', '.join(ENDINGS)}")
            return
        self._upload = upload
        self._object.options = (_FILE, *SHAPES)
        self._object.value = _FILE
        self._say(f"{upload.name}: {len(upload.content) / 1e6:.1f} MB; press Plan")

    def _refuse(self, reason: str) -> None:
        self._say(f"refused: {reason}")

    def _request(self) -> PlanRequest:
        """Return the request in the widgets, checked. Raises ConfigError: a value is not valid."""
        sent = self._upload if self._object.value == _FILE else None
        try:
            friction, count, angle = float(self._friction.value), int(self._count.value), float(self._angle.value)
        except (TypeError, ValueError, OverflowError):
            given = short_repr((self._friction.value, self._count.value, self._angle.value))
            raise ConfigError(f"friction, count, angle: {given}; valid: three numbers") from None
        request = PlanRequest(
            shape=self._object.value if sent is None else next(iter(SHAPES)),
            upload=sent, units=self._units.value, alone=bool(self._alone.value), hand=self._hand.value,
            preset=self._preset.value, friction=friction, count=count,
            approach=self._approach.value, approach_angle=angle,
        )  # fmt: skip
        check(request)
        return request

    def _run(self, work: Callable[[StopHook], None]) -> None:
        try:
            work(self._stop.is_set)
        except GraspdError as error:
            self._refuse(str(error))
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            self._refuse(f"a bug in graspd: {type(error).__name__}: {error}")
        finally:
            self._live.end()
            self._plan.disabled, self._halt.disabled, self._save.disabled = False, True, self._saved is None
            self._busy.release()
            self._start_next()

    def _plan_and_show(self, request: PlanRequest) -> None:
        self._say("loading")
        config = load_preset(request.preset)
        scene, seen = load_object(request)
        hand = load_hand(request.hand, candidates=config.problem.fine_candidates)
        title = request.upload.name if request.upload else request.shape
        session = make_session(title, hand, (), scene, config, seen, scene.object.warnings)
        self._saved = None
        self._show(session)
        self._live.begin(session)
        result = plan_grasps(
            scene, hand, count=request.count, seed=request.seed, preset=config,
            restrictions=request.restrictions,
            progress=self._live.progress, watch=self._live.watch, stop=self._stop.is_set,
        )  # fmt: skip
        self._live.end()
        self._saved = (json.dumps(result_document(result, scene.object, hand, config), indent=1) + "\n").encode()
        about = scene, config, seen, result.warnings
        self._show(make_session(title, hand, result.tried, *about, mass=result.tried_mass))
        good = sum(grasp.verdict is Verdict.VERIFIED for grasp in result.tried)
        ending = result.message or result.outcome.value
        self._say(f"{good} of {request.count} grasps in {result.timing.total:.1f} s: {ending}", 1.0)
