"""`--deadline`: it counts from the start of the process, and ends a load that knows nothing of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from expected import some

from graspd_core.cli.running import EXIT_TOO_FEW, Deadline, DeadlinePassed, process_began

LATE = "0 of 2 grasps (verified, 0 tried): the deadline passed"


def graspd(*arguments: str, before: str = "pass") -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, and what that does beforehand."""
    program = f"import sys; {before}; from graspd_core.cli import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=100, check=False
    )


def test_a_load_that_does_not_end_is_ended(tmp_path: Path):
    """A pipe that nobody writes to can be read for ever."""
    os.mkfifo(tmp_path / "mug.obj")
    out = tmp_path / "grasps.json"
    done = graspd("synthesize", str(tmp_path / "mug.obj"), "-n", "2", "--deadline", "1", "--out", str(out))
    assert (done.returncode, done.stderr) == (EXIT_TOO_FEW, "")
    assert LATE in done.stdout
    assert not out.exists()


def test_what_went_before_counts():
    done = graspd("synthesize", "shape:box", "-n", "2", "--deadline", "0.5", before="import time; time.sleep(0.6)")
    assert (done.returncode, done.stderr) == (EXIT_TOO_FEW, "")
    assert LATE in done.stdout


def test_work_is_cut_short_whatever_it_catches_and_the_timer_set_before_goes_on():
    handler, timer = signal.getsignal(signal.SIGALRM), signal.getitimer(signal.ITIMER_REAL)
    caught: list[Exception] = []

    def stubborn() -> None:
        try:
            time.sleep(60)
        except Exception as error:
            caught.append(error)
        time.sleep(60)

    with pytest.raises(DeadlinePassed), Deadline(0.05, time.perf_counter()).cuts_short():
        stubborn()
    assert not caught
    assert signal.getsignal(signal.SIGALRM) is handler
    # pytest-timeout's own.
    assert (signal.getitimer(signal.ITIMER_REAL)[0] > 0) == (timer[0] > 0)


def test_who_catches_everything_is_interrupted_again_and_other_errors_count_as_late():
    caught: list[BaseException] = []

    def deaf() -> None:
        try:
            time.sleep(60)
        except BaseException as error:  # as some libraries do around their imports
            caught.append(error)
        try:
            time.sleep(60)
        except BaseException as error:
            raise ImportError("initialization failed") from error

    with pytest.raises(DeadlinePassed), Deadline(0.05, time.perf_counter()).cuts_short():
        deaf()
    assert [type(error) for error in caught] == [DeadlinePassed]


def test_an_error_in_time_is_that_error():
    with pytest.raises(ValueError, match="broken"), Deadline(60.0, time.perf_counter()).cuts_short():
        raise ValueError("broken")


def test_work_in_time_and_work_without_a_deadline_are_left_alone():
    for seconds in (60.0, None):
        deadline = Deadline(seconds, time.perf_counter())
        with deadline.cuts_short():
            done = sum(range(1000))
        assert done == 499500
        assert (deadline.left() is None) == (seconds is None)
    left = some(Deadline(1.0, time.perf_counter() - 5.0).left())
    assert left > 0


def test_in_another_thread_the_work_ends_first():
    ended: list[str] = []

    def work() -> None:
        try:
            with Deadline(0.01, time.perf_counter()).cuts_short():
                time.sleep(0.05)
                ended.append("work")
        except DeadlinePassed:
            ended.append("late")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert ended == ["work", "late"]


def test_a_process_knows_when_it_began():
    age = "import time; from graspd_core.cli.running import process_began; print(time.perf_counter() - process_began())"
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", f"import time; time.sleep(1); {age}"], capture_output=True, text=True, check=True
    )
    # The system counts in hundredths.
    assert 0.98 < float(done.stdout) < time.perf_counter() - begun + 0.02
    assert process_began() < begun
