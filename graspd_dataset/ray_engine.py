"""Make blocks on Ray: on a private Ray of this machine, or on a cluster. Ray repeats the tasks of a lost worker."""

from __future__ import annotations

import os
import pickle
import secrets
import shutil
import signal
import socket
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graspd_core.errors import ConfigError, Extra, GraspdError
from graspd_core.optimize.plan_config import PlanConfig
from graspd_dataset.blocks import Block, DatasetObject
from graspd_dataset.dataset_store import DatasetStore
from graspd_dataset.guarded_calls import Job, Limits, Report, prepare_object, run_block

# Size of a private Ray's object store [bytes]. A prepared object takes about 2 MB, and few are stored at a time.
_OBJECT_STORE = 256 * 2**20
# Number of times that Ray repeats a task after its worker or node was lost.
_RETRIES = 4
# Address at which a private Ray listens. Ray would replace 127.0.0.1 by the machine's network address.
_LOOPBACK = "127.0.0.2"
# Timeout for the connection to a cluster [s].
_CONNECT = 10.0
# Secret of every private Ray of this process.
_TOKEN = secrets.token_hex(32)
# Prefix of the name of a private Ray's folder. The id of this process follows.
_FOLDER = "graspd-ray-"


@contextmanager
def ray_running(address: str | None, workers: int | None, folder: Path | None = None) -> Iterator[Any]:
    """Connect to the cluster at `address`. None: start a private Ray with `workers` CPUs. Yield the module `ray`.

    A private Ray ends with this context. It has no dashboard and reports no usage. It accepts only connections with a
    random token. Its files are in `folder`, or in a temporary folder if `folder` is None.

    Raises ConfigError: Ray is not installed, or there is no cluster at the address.
    """
    settings = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
    if address is None:
        settings |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": _TOKEN}
        _remove_abandoned(folder or Path(tempfile.gettempdir()))
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    # The name is short because the paths of sockets in the folder may have at most 107 characters.
    own = Path(tempfile.mkdtemp(prefix=f"{_FOLDER}{os.getpid()}-", dir=folder)) if address is None else None
    try:
        with Extra("dataset"):
            import ray
        _refuse_silent(address)
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
        if own is not None:
            options |= {"address": "local", "num_cpus": workers, "object_store_memory": _OBJECT_STORE}
            options |= {"include_dashboard": False, "_temp_dir": str(own), "_node_ip_address": _LOOPBACK}
        try:
            with _own_handler():
                ray.init(**{"address": address, **options})
        except (ConnectionError, ValueError, RuntimeError) as error:
            said = " ".join(str(error).split())[-200:]
            raise ConfigError(f"address: no connection to Ray at {address}; does the cluster run? ({said})") from None
        try:
            yield ray
        finally:
            ray.shutdown()
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
        if own is not None:
            shutil.rmtree(own, ignore_errors=True)


@contextmanager
def _own_handler() -> Iterator[None]:
    """Keep this process's handler of SIGTERM. Ray's handler ends the process without a run record."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        # Ray and this context can change handlers only in the main thread.
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


def _refuse_silent(address: str | None) -> None:
    """Raise ConfigError if nothing listens at `address`. Without this check, Ray waits minutes and ends the process."""
    host, _, port = (address or "").removeprefix("ray://").partition(":")
    if not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), _CONNECT).close()
    except OSError as error:
        raise ConfigError(f"address: {address}: {error.strerror or error}; start Ray with: ray start --head") from None


def _remove_abandoned(folder: Path) -> None:
    for path in folder.glob(f"{_FOLDER}*-*"):
        process = path.name.removeprefix(_FOLDER).partition("-")[0]
        if process.isdigit() and not Path(f"/proc/{process}").exists() and Path("/proc/self").exists():
            shutil.rmtree(path, ignore_errors=True)


def pickled_hand(block: Block) -> bytes:
    from graspd_core.hands.library import load_hand

    return pickle.dumps(load_hand(block.hand, candidates=block.config.problem.fine_candidates))


def object_job(source: DatasetObject, config: PlanConfig) -> Job:
    return Job(source.key, {"object": source.source, **source.inputs}, pickle.dumps((source, config)))


def block_job(block: Block) -> Job:
    inputs = {"object": block.object.source, "hand": block.hand, **block.inputs}
    return Job(block.key, inputs, pickle.dumps(block), block.hand_name)


class RayEngine:
    """Client that submits blocks and objects to Ray, and returns their reports.

    Args:
        ray: the connected module.
        store: the data set that files are written to.
        limits: limits for each block and each object.
        ship: whether tasks contain the mesh files. A cluster needs this, because its nodes may lack the files.
    """

    def __init__(self, ray: Any, store: DatasetStore, limits: Limits, *, ship: bool) -> None:
        self._ray, self._store, self._limits, self._ship = ray, store, limits, ship
        self._hands: dict[str, Any] = {}
        options = {"num_cpus": 1, "max_retries": _RETRIES, "retry_exceptions": False}
        self._prepare = ray.remote(**options, num_returns=2)(prepare_object)
        self._run = ray.remote(**options)(run_block)

    def slots(self) -> int:
        """Return the number of tasks that can run at the same time."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def submit_object(self, source: DatasetObject, config: PlanConfig) -> tuple[Any, Any]:
        """Submit an object to prepare. Return two Ray handles: of the report, and of `ReadyObject.shared`."""
        shape = source.source.startswith("shape:")
        content = Path(source.source).read_bytes() if self._ship and not shape else None
        return tuple(self._prepare.remote(object_job(source, config), content, self._store, self._limits))

    def submit_block(self, block: Block, shared: Any) -> Any:
        """Submit a block. Return the handle of its report. `shared` is the second result of `submit_object`."""
        if block.hand_content not in self._hands:
            self._hands[block.hand_content] = self._ray.put(pickled_hand(block))
        return self._run.remote(block_job(block), self._hands[block.hand_content], shared, self._store, self._limits)

    def wait(self, handles: Sequence[Any], seconds: float) -> list[Any]:
        """Wait up to `seconds` for a task to end. Return a list with its handle, or an empty list if none ended."""
        return self._ray.wait(list(handles), num_returns=1, timeout=seconds)[0]

    def report(self, handle: Any, key: str) -> Report:
        """Return the report of a handle. If Ray lost the worker at every attempt, the failure is `lost`.

        Raises StorageError: the file could not be written.
        """
        from ray.exceptions import RayError, RayTaskError

        try:
            return self._ray.get(handle)
        except RayTaskError as error:
            raise (error.cause if isinstance(error.cause, GraspdError) else error) from None
        except RayError as error:
            return Report(key, failed="lost", error=" ".join(str(error).split())[:300])
