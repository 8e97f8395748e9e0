"""A function in a process of its own."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from graspd_core.geometry.own_process import OwnProcess


@pytest.fixture
def who() -> Iterator[OwnProcess]:
    """Says in which process it was called."""
    process = OwnProcess(os.getpid)
    yield process
    process.close()


def test_the_work_is_done_elsewhere(who: OwnProcess):
    assert who() == who() != os.getpid()


def test_values_and_errors_come_back_and_the_child_lives_on():
    root = OwnProcess(math.sqrt)
    assert root(2.25) == 1.5
    with pytest.raises(ValueError, match="math domain"):
        root(-1.0)
    assert root(4.0) == 2.0
    root.close()


def test_when_the_child_is_killed_nothing_is_lost(who: OwnProcess):
    child = who()
    os.kill(child, signal.SIGKILL)
    assert who() not in (child, os.getpid())


def test_work_that_kills_its_process_does_not_kill_this_one():
    deadly = OwnProcess(os._exit)
    with pytest.raises(MemoryError, match="_exit: the process that it is done in died twice"):
        deadly(1)
    deadly.close()


def test_ctrl_c_in_the_terminal_leaves_the_child_alone(who: OwnProcess):
    child = who()
    os.kill(child, signal.SIGINT)
    assert who() == child


def test_an_answer_that_was_not_waited_for_is_not_the_next_ones():
    def interrupt(*_):
        raise KeyboardInterrupt

    shell = OwnProcess(subprocess.getoutput)
    assert shell("echo ready") == "ready"
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        with pytest.raises(KeyboardInterrupt):
            shell("sleep 0.5; echo late")
    finally:
        signal.signal(signal.SIGALRM, before)
    assert shell("echo next") == "next"
    shell.close()


def test_the_child_ends_with_its_parent():
    program = (
        "import os, signal, math\n"
        "from graspd_core.geometry.own_process import OwnProcess\n"
        "if __name__ == '__main__':\n"
        "    aside = OwnProcess(math.sqrt)\n"
        "    assert aside(4.0) == 2.0\n"
        "    print(aside._process.pid, flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    child = int(done.stdout)
    end = time.monotonic() + 10
    while _alive(child) and time.monotonic() < end:
        time.sleep(0.02)
    assert not _alive(child)


def _alive(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().split()[2] != "Z"
    except FileNotFoundError:
        return False
