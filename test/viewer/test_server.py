"""Who may connect to the page, and what may be sent to it: forged messages included."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from graspd_core.errors import ConfigError, GraspdError
from graspd_core.hands.library import load_hand
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.planning.steering import angle_of_approach
from graspd_viewer import plan_tab
from graspd_viewer import server as viewer_server
from graspd_viewer.plan_tab import PlanRequest, Upload, check, load_object
from graspd_viewer.server import may_connect

viser = pytest.importorskip("viser", reason="viser is not installed: pip install 'graspd[view]'")
from viser import _messages  # noqa: E402

GOOD = PlanRequest("box", None, "m", False, "parallel_gripper", "fast", 0.6, 2)


def test_a_last_port_that_is_in_use_is_named():
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 65535))
        busy.listen()
        with pytest.raises(ConfigError, match="port: 65535; no port from 65535 to 65535 is free"):
            viewer_server.start_server("127.0.0.1", 65535)


@pytest.mark.parametrize(
    ("origin", "named", "host", "may"),
    [
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", True),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        (None, "localhost:8080", "127.0.0.1", True),
        ("https://evil.example", "localhost:8080", "127.0.0.1", False),
        ("http://localhost:9999", "localhost:8080", "127.0.0.1", False),
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.1", False),
        ("http://robot:8080", "robot:8080", "0.0.0.0", True),
        ("https://evil.example", "robot:8080", "0.0.0.0", False),
        (None, None, "127.0.0.1", False),
    ],
)
def test_only_its_own_page_may_connect(origin, named, host, may):
    assert may_connect(origin, named, host) is may


@pytest.mark.parametrize("origin", ["http://evil.example", None])
def test_a_page_of_another_site_is_sent_away(viewer, origin):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    address = viewer.url.replace("http", "ws")
    asked = {"origin": origin, "subprotocols": [f"viser-v{viser.__version__}"], "max_size": None}
    with connect(address, **asked) as socket:
        if origin is None:
            assert socket.recv(timeout=20)
            return
        with pytest.raises(ConnectionClosed):
            list(socket)
        assert socket.close_code == 1008


def transfer(viewer, size: int, parts: int = 1, name: str = "a") -> bool:
    """Begin to send a file as visitor 7; whether the server takes it."""
    gui = viewer._server.gui
    (start,) = gui._websock_interface._incoming_handlers[_messages.FileTransferStartUpload]
    before = len(gui._current_file_upload_states)
    button = viewer._planner._file._impl.uuid
    message = SimpleNamespace(
        source_component_uuid=button,
        transfer_uuid=name,
        filename="x.obj",
        mime_type="",
        part_count=parts,
        size_bytes=size,
    )
    start(7, message)
    return len(gui._current_file_upload_states) > before


def test_large_files_and_many_at_once_are_not_taken(viewer):
    assert not transfer(viewer, viewer_server.LARGEST_UPLOAD + 1)
    assert not transfer(viewer, -1)
    assert not transfer(viewer, 1000, parts=10**9)
    assert [transfer(viewer, 1000, name=name) for name in "abc"] == [True, True, False]


def test_a_transfer_that_sends_more_than_it_said_ends(viewer):
    gui = viewer._server.gui
    (part,) = gui._websock_interface._incoming_handlers[_messages.FileTransferPart]
    assert transfer(viewer, 1000, parts=3)
    stranger = SimpleNamespace(transfer_uuid="a", part_index=0, content=b"x" * 100, source_component_uuid=None)
    part(8, stranger)
    assert gui._current_file_upload_states["a"]["transferred_bytes"] == 0
    part(7, SimpleNamespace(transfer_uuid="a", part_index=0, content=b"x" * 1001, source_component_uuid=None))
    assert "a" not in gui._current_file_upload_states


def test_no_tunnel_is_opened(viewer):
    handlers = viewer._server._websock_server._incoming_handlers
    assert not handlers.get(_messages.ShareUrlRequest)


@pytest.mark.parametrize(
    ("change", "culprit"),
    [
        ({"shape": "../../etc/passwd"}, "shape: '../../etc/passwd'; valid: "),
        ({"hand": "/etc/hand.yaml"}, "hand: '/etc/hand.yaml'; valid: "),
        ({"preset": "/etc/preset.yaml"}, "preset: '/etc/preset.yaml'; valid: "),
        ({"units": "ft"}, "units: 'ft'; valid: "),
        ({"friction": float("nan")}, "friction: nan; valid: "),
        ({"approach": "within"}, "approach: 'within'; valid: any side, above"),
        ({"approach_angle": float("inf")}, "approach angle: inf degrees; valid: 1 to 180"),
        ({"count": 10**6}, "count: 1000000 grasps; valid here: 1 to "),
        ({"upload": Upload("a.obj/../../b.yaml", b"")}, "b.yaml: unknown ending"),
        ({"upload": Upload("obj", b"")}, "obj: unknown ending"),
    ],
)
def test_what_no_honest_visitor_asks_for_is_refused(change, culprit):
    check(GOOD)
    with pytest.raises(ConfigError) as caught:
        check(PlanRequest(**{**vars(GOOD), **change}))
    assert culprit in str(caught.value)


@pytest.mark.parametrize(("side", "way"), [("above", (0.0, 0.0, -1.0)), ("+y", (0.0, -1.0, 0.0))])
def test_the_hand_comes_from_the_side_that_was_chosen(side, way):
    hand = load_hand("parallel_gripper")
    asked = PlanRequest(**{**vars(GOOD), "approach": side, "approach_angle": 20.0})
    check(asked)
    result = plan_grasps(load_object(asked)[0], hand, count=2, preset="fast", restrictions=asked.restrictions)
    angles = [angle_of_approach(hand, grasp, np.array(way)) for grasp in result.grasps]
    assert len(angles) > 0
    assert np.degrees(max(angles)) < 20.01


def test_a_file_is_called_by_its_visitors_name_and_read_from_nowhere_else(monkeypatch):
    # Here, because the child of a test run would stay behind.
    monkeypatch.setattr("graspd_viewer.plan_tab.start_planning_worker", lambda: None)
    box = b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    sent = PlanRequest(**{**vars(GOOD), "upload": Upload("../../my thing.obj", box)})
    check(sent)
    loaded = load_object(sent)[0].object
    assert loaded.volume == pytest.approx(0.1**3 / 6, rel=0.01)
    # A saved grasps.json names the visitor's file.
    assert loaded.source == "../../my thing.obj"
    broken = PlanRequest(**{**vars(GOOD), "upload": Upload("mine.stl", b"solid")})
    with pytest.raises(GraspdError, match=r"mine\.stl") as caught:
        load_object(broken)
    assert "graspd-view-" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        (["view", "missing.json"], "missing.json"),
        (["view", "--host", "999.1.1.1"], "host: '999.1.1.1'"),
        (["view", "--port", "99999"], "port: 99999; valid: 0 to 65535"),
        (["view", "--object", "shape:box"], "no grasps.json is given"),
        (["view", "missing.json", "--html", "x.html"], "--html x.html"),
    ],
)
def test_bad_arguments_are_one_line(refusal_of, arguments, culprit):
    assert culprit in refusal_of(*arguments)


def test_a_run_that_is_slow_to_stop_is_followed_by_the_newest(viewer):
    slow, ran, release = threading.Event(), list[str](), threading.Event()

    def first(stop: Callable[[], bool]) -> None:
        slow.set()
        release.wait(30.0)
        ran.append(f"first, stopped: {stop()}")

    viewer.run(first)
    assert slow.wait(10.0)
    for name in ("second", "third"):
        viewer.run(lambda stop, name=name: ran.append(f"{name}, stopped: {stop()}"))
    release.set()
    end = time.monotonic() + 10.0
    while len(ran) < 2 and time.monotonic() < end:
        time.sleep(0.01)
    assert ran == ["first, stopped: True", "third, stopped: False"]


def test_only_the_grasps_that_are_shown_can_be_saved(viewer, monkeypatch):
    planner = viewer._planner
    request = PlanRequest("box", None, "m", True, "parallel_gripper", "fast", 0.6, 1)
    planner._plan_and_show(request)
    assert planner._saved is not None
    monkeypatch.setattr(plan_tab, "plan_grasps", raise_refused)
    with pytest.raises(ConfigError):
        planner._plan_and_show(request)
    assert planner._saved is None
    planner._saved, done = b"{}", threading.Event()
    viewer.run(lambda _: done.set())
    assert done.wait(10.0)
    assert planner._saved is None


def raise_refused(*_: object, **__: object) -> None:
    raise ConfigError("refused")
