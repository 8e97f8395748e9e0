"""The tab where visitors plan: an object, a hand, a preset; Plan, Stop and Save. One run at a time, seen by all."""

from __future__ import annotations

import html
import json
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any

from graspd_core.errors import ConfigError, GraspdError, shown
from graspd_core.formats.grasps_json import result_document
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.mesh.shapes import SHAPES
from graspd_core.methods.plan_config import load_preset, preset_names
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import StopHook, Verdict
from graspd_core.viewer.grasp_list import BLOCK
from graspd_core.viewer.live_view import LiveView
from graspd_core.viewer.plan_request import (
    APPROACHES,
    ENDINGS,
    MOST_GRASPS,
    UNITS,
    PlanRequest,
    Upload,
    check,
    load_object,
)
from graspd_core.viewer.session import Session, make_session

_FILE = "the file sent"


class PlanTab:
    """Widgets of the tab, and the thread that plans.

    Args:
        server: of the page.
        live: shows the run.
        show: shows a session, from any thread.
        say: shows a line and how far the run is, from any thread.
    """

    def __init__(self, server: Any, live: LiveView, show: Callable[[Session], None], say: Callable[..., None]) -> None:
        self._live, self._show, self._say = live, show, say
        self._upload: Upload | None = None
        self._saved: bytes | None = None
        self._stop = threading.Event()
        self._busy = threading.Lock()
        self._thread: threading.Thread | None = None
        self._build(server.gui)

    def _build(self, gui: Any) -> None:
        self._object = gui.add_dropdown("Object", tuple(SHAPES), initial_value="mug")
        self._file = gui.add_upload_button("Send a mesh or a cloud", hint=", ".join(ENDINGS))
        self._units = gui.add_dropdown("Its unit", tuple(UNITS), hint="of the file's coordinates")
        self._alone = gui.add_checkbox("A cloud shows the object alone", False)
        self._hand = gui.add_dropdown("Hand", hand_names(), initial_value="allegro_right")
        self._preset = gui.add_dropdown("Preset", preset_names(), initial_value="fast")
        self._friction = gui.add_slider("Friction", 0.1, 1.5, 0.05, 0.6, hint="of the object against the hand")
        self._approach = gui.add_dropdown("The hand comes from", tuple(APPROACHES), hint="in the object's frame")
        self._angle = gui.add_slider("Within [°]", 5, 180, 5, 30, hint="of that direction")
        self._count = gui.add_slider("Grasps", 1, MOST_GRASPS, 1, 8, hint="verified grasps wanted")
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

    def tell(self, line: str, share: float) -> None:
        """Show how far a run is. From the drawing thread."""
        self._status.content, self._bar.value = f"{BLOCK}{html.escape(line)}</div>", 100.0 * min(max(share, 0.0), 1.0)

    def plan(self) -> None:
        """Begin what the widgets ask for, unless a run is under way."""
        self.begin(lambda _: self._plan_and_show(self._request()))

    def begin(self, work: Callable[[StopHook], None]) -> None:
        """Do something else in the thread that plans, which says when to stop, unless a run is under way."""
        if not self._busy.acquire(blocking=False):
            return
        self._stop.clear()
        self._plan.disabled, self._halt.disabled, self._save.disabled = True, False, True
        self._thread = threading.Thread(target=self._run, args=(work,), name="graspd-viewer-plan", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the run that is under way, if any."""
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
        """What the widgets say, checked. Raises ConfigError."""
        sent = self._upload if self._object.value == _FILE else None
        try:
            friction, count, angle = float(self._friction.value), int(self._count.value), float(self._angle.value)
        except (TypeError, ValueError, OverflowError):
            given = shown((self._friction.value, self._count.value, self._angle.value))
            raise ConfigError(f"friction, count or angle: {given}") from None
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
            self._refuse(f"a fault of graspd: {type(error).__name__}: {error}")
        finally:
            self._live.end()
            self._plan.disabled, self._halt.disabled, self._save.disabled = False, True, self._saved is None
            self._busy.release()

    def _plan_and_show(self, request: PlanRequest) -> None:
        self._say("loading")
        config = load_preset(request.preset)
        scene, seen = load_object(request)
        hand = load_hand(request.hand, candidates=config.problem.fine_candidates)
        title = request.upload.name if request.upload else request.shape
        session = make_session(title, hand, (), scene, config, seen, scene.object.warnings)
        self._show(session)
        self._live.begin(session)
        result = plan_grasps(
            scene, hand, count=request.count, seed=request.seed, preset=config,
            restrictions=request.restrictions,
            progress=self._live.progress, watch=self._live.watch, stop=self._stop.is_set,
        )  # fmt: skip
        self._live.end()
        self._saved = (json.dumps(result_document(result, scene.object, hand, config), indent=1) + "\n").encode()
        self._show(make_session(title, hand, result.grasps, scene, config, seen, result.warnings))
        good = sum(grasp.verdict is Verdict.VERIFIED for grasp in result.grasps)
        ending = result.message or result.outcome.value
        self._say(f"{good} of {request.count} grasps in {result.timing.total:.1f} s: {ending}", 1.0)
