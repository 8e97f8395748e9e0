"""A viser server with limits, and the drawing thread.

By default viser listens on every network interface, lets any web page connect and accepts files of any size. It also
opens a public tunnel if a visitor asks. graspd's server does none of this. The drawing thread runs only the newest job
of each kind. So a moved slider does not leave a queue of drawings.
"""

from __future__ import annotations

import contextlib
import io
import json
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from graspd_core.errors import ConfigError, Extra

Work = Callable[[], object]


class LatestJobs:
    """Thread that runs jobs. Of each kind, only the newest waiting job runs.

    Args:
        failed: called with the exception of a failed job.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._waiting: dict[str, tuple[float, Work]] = {}
        self._change = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="graspd-viewer", daemon=True)
        self._thread.start()

    def submit(self, kind: str, work: Work, after: float = 0.0) -> None:
        """Submit a job to run after `after` seconds. The job replaces a waiting job of the same kind."""
        with self._change:
            self._waiting[kind] = time.monotonic() + after, work
            self._change.notify()

    def drop(self, kind: str) -> None:
        """Remove the waiting job of a kind, if there is one."""
        with self._change:
            self._waiting.pop(kind, None)

    def close(self) -> None:
        """End the thread after its current job."""
        with self._change:
            self._closed = True
            self._change.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(10.0)

    def _next(self) -> Work | None:
        with self._change:
            while not self._closed:
                kind = min(self._waiting, key=lambda kind: self._waiting[kind][0], default=None)
                left = None if kind is None else self._waiting[kind][0] - time.monotonic()
                if kind is not None and left is not None and left <= 0:
                    return self._waiting.pop(kind)[1]
                self._change.wait(left)
        return None

    def _run(self) -> None:
        while (work := self._next()) is not None:
            try:
                work()
            except Exception as error:
                self._failed(error)


HOST, PORT = "127.0.0.1", 8080


class Page:
    """Server of one page, and its drawing thread.

    Args:
        host, port: address to listen on. By default only this machine can connect. A used port is replaced by the next.

    Raises:
        ConfigError: the address cannot be listened on, or viser is not installed.
    """

    def __init__(self, host: str, port: int) -> None:
        self._server = start_server(host, port)
        self._host = host
        self._jobs = LatestJobs(lambda error: traceback.print_exception(error, file=sys.stderr))

    @property
    def port(self) -> int:
        """Return the port of the page."""
        return self._server.get_port()

    @property
    def url(self) -> str:
        """Return the address of the page."""
        return f"http://{f'[{self._host}]' if ':' in self._host else self._host}:{self.port}"

    def wait_for_visitor(self, patience: float, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait until a visitor opens the page, `patience` seconds have passed, or `stop` returns True."""
        end = time.monotonic() + patience
        while not self._server.get_clients() and time.monotonic() < end and not stop():
            time.sleep(0.05)

    def close(self) -> None:
        """End the thread and the server."""
        self._jobs.close()
        with quiet():
            self._server.stop()


# Largest file that a visitor may upload [bytes], and greatest number of uploads of a visitor at a time.
LARGEST_UPLOAD = 64 * 2**20
_UPLOADS_AT_ONCE = 2
LOCAL = ("localhost", "127.0.0.1", "::1")


def start_server(host: str, port: int) -> Any:
    """Start a `viser.ViserServer` on `host`, at `port` or the next free port.

    Raises ConfigError: viser is not installed, the port is invalid, or this machine does not have the address.
    """
    with Extra("view"):
        import viser
    if not 0 <= port < 65536:
        raise ConfigError(f"port: {port}; valid: 0 to 65535 (0: any free port)")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise ConfigError(f"host: {host!r}: {error.strerror or error}; use 127.0.0.1 for this machine only") from None
    # Without a free port, viser's thread would end with an error, and its constructor would wait for ever.
    if not any(_is_free(family, host, free) for free in range(port, 65536)):
        raise ConfigError(f"port: {port}; no port from {port} to 65535 is free; valid: a lower port, or 0")
    with quiet():
        server = viser.ViserServer(host=host, port=port, label="graspd", verbose=False)
    _refuse_strangers(server, host)
    _refuse_tunnels(server)
    _limit_uploads(server)
    return server


def _is_free(family: int, host: str, port: int) -> bool:
    with contextlib.suppress(OSError), socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((host, port))
        return True
    return False


def name_tab(server: Any, title: str) -> None:
    """Set the title of every visitor's browser tab. viser has no public API for this."""
    from viser._messages import RunJavascriptMessage

    script = RunJavascriptMessage(source=f"document.title = {json.dumps(title)}")
    server.gui._websock_interface.queue_message(script)


def quiet() -> contextlib.AbstractContextManager[Any]:
    """Return a context in which viser prints nothing."""
    return contextlib.redirect_stdout(io.StringIO())


def may_connect(origin: str | None, named: str | None, host: str) -> bool:
    """Return True if a client may connect. `origin` and `named` are its Origin and Host headers.

    Refuse pages of another site. If `host` is local, refuse clients that address the server by another name. Clients
    that are not web pages send no Origin, and may connect.
    """
    name = urlsplit(f"//{named or ''}")
    if host in LOCAL and name.hostname not in LOCAL:
        return False
    return origin is None or urlsplit(origin).netloc == name.netloc


def _refuse_strangers(server: Any, host: str) -> None:
    websockets = server._websock_server

    async def look(connection: Any) -> None:
        raw = websockets._live_connections.get(connection.client_id)
        headers = raw.request.headers if raw is not None else {}
        if raw is not None and not may_connect(headers.get("Origin"), headers.get("Host"), host):
            await raw.close(1008, "graspd: pages of other sites are refused")

    websockets.on_client_connect(look)


def _refuse_tunnels(server: Any) -> None:
    from viser import _messages

    for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(kind)


def _limit_uploads(server: Any) -> None:
    """Refuse files over 64 MB, and a visitor's third simultaneous upload. End uploads that exceed the stated size."""
    from viser import _messages

    gui = server.gui
    interface, transfers = gui._websock_interface, gui._current_file_upload_states

    def start(client: int, message: Any) -> None:
        busy = sum(state["client_id"] == client for state in transfers.values())
        if 0 <= message.size_bytes <= LARGEST_UPLOAD and busy < _UPLOADS_AT_ONCE and message.part_count < 10_000:
            gui._handle_file_transfer_start(client, message)
            return
        visitor = server.get_clients().get(client)
        if visitor is not None:
            limit = f"the limit is {LARGEST_UPLOAD // 2**20} MB, and {_UPLOADS_AT_ONCE} files at a time"
            visitor.add_notification("Refused", f"{message.filename[:80]}: {limit}", color="red")

    def part(client: int, message: Any) -> None:
        state = transfers.get(message.transfer_uuid)
        if state is None or state["client_id"] != client:
            return
        if state["transferred_bytes"] + len(message.content) > state["total_bytes"]:
            transfers.pop(message.transfer_uuid, None)
            return
        gui._handle_file_transfer_part(client, message)

    for kind, handle in ((_messages.FileTransferStartUpload, start), (_messages.FileTransferPart, part)):
        interface.unregister_handler(kind)
        interface.register_handler(kind, handle)
