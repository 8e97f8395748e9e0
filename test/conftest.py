"""Switched on for every test: array shapes checked at run time, one torch thread, reproducible Hypothesis draws."""

import ast
import fcntl
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import hypothesis
import pytest
from jaxtyping import _import_hook, install_import_hook

# Before anything imports graspd_core, or its functions would stay unchecked.
install_import_hook("graspd_core", "beartype.beartype")
_reading = threading.RLock()


def _one_at_a_time(read: Callable[..., Any]) -> Callable[..., Any]:
    def locked(*arguments: Any, **named: Any) -> Any:
        with _reading:
            return read(*arguments, **named)

    return locked


# Python 3.11 counts the depth of syntax trees for all threads together (python/cpython#106905): a module that the hook
# reads, or a header that np.load reads, while another thread reads one would end in a SystemError.
_import_hook._JaxtypingLoader.source_to_code = _one_at_a_time(_import_hook._JaxtypingLoader.source_to_code)
ast.parse = _one_at_a_time(ast.parse)

import torch  # noqa: E402

torch.set_num_threads(1)

# A busy machine is no fault of a test: neither examples nor the drawing of them may take too long.
hypothesis.settings.register_profile(
    "dev", deadline=None, max_examples=25, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.register_profile("ci", hypothesis.settings.get_profile("dev"), derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "dev")


# Files whose tests share a node, which takes seconds to start: they go to one worker. It waits for nodes while the
# other computes; as one of the largest scopes it begins early.
SHARED_NODE = {
    f"test/ros/{name}.py"
    for name in (
        "inputs/test_situations",
        "outputs/test_messages",
        "test_action_server",
        "test_hostile",
        "test_node",
        "test_node_process",
        "test_scenarios",
    )
}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With several workers: a file's tests go to one, for what they share, and so do all of one shared node."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "shared node" if file in SHARED_NODE else file

    return ByFile(config, log)


@pytest.fixture(scope="module", autouse=True)
def no_child_is_left() -> Iterator[None]:
    """Ends the child process that a file's tests started: it has none of what the next file puts in modules."""
    from graspd_core.runtime import worker_process

    yield
    if worker_process._child is not None:
        worker_process._child.close()
        worker_process._child = None


@pytest.fixture(scope="session")
def claim_domain() -> Iterator[Callable[[], int]]:
    """Gives DDS domains that nobody else has: no other worker, and no other run of the tests beside this one."""
    claimed: list[IO[str]] = []

    def claim_domain() -> int:
        for number in range(100):
            domain = 1 + (os.getpid() + number) % 100
            try:
                claimed.append((Path(tempfile.gettempdir()) / f"graspd-test-domain-{domain}").open("w"))
                # Until this process ends, however it ends.
                fcntl.flock(claimed[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)
                return domain
            except OSError:
                continue
        pytest.fail("no DDS domain is free")

    yield claim_domain
    for file in claimed:
        file.close()


@pytest.fixture(scope="session")
def domain(claim_domain: Callable[[], int]) -> int:
    """The DDS domain of this process's tests."""
    return claim_domain()


@pytest.fixture(scope="session")
def bytecodes() -> Callable[[Callable[[], Any]], int]:
    """Counts the bytecodes that a call runs, the second time: Python's own work, however busy the machine is."""

    def bytecodes(call: Callable[[], Any]) -> int:
        ran = 0

        def trace(frame: Any, event: str, _: Any) -> Any:
            nonlocal ran
            frame.f_trace_opcodes = True
            ran += event == "opcode"
            return trace

        call()
        before = sys.gettrace()
        sys.settrace(trace)
        try:
            call()
        finally:
            sys.settrace(before)
        return ran

    return bytecodes


@pytest.fixture
def refusal_of(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command in this process, which has to end as one with bad input does, and gives its line of stderr."""

    def refusal_of(*words: object) -> str:
        from graspd_core.cli import main
        from graspd_core.cli.running import EXIT_BAD_INPUT

        capsys.readouterr()
        assert main([str(word) for word in words]) == EXIT_BAD_INPUT
        out, line = capsys.readouterr()
        assert (out, line.count("\n"), line.startswith("graspd: ")) == ("", 1, True), out + line
        return line

    return refusal_of


@pytest.fixture(scope="session")
def hand() -> Any:
    """The hand of the tests that name none."""
    from graspd_core import load_hand

    return load_hand("allegro_right")
