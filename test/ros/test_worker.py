"""Every accepted request ends in exactly one report, whatever happens to it."""

import threading
import time
from collections import Counter
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_ros.error_codes import ErrorCode
from graspd_ros.worker import BusyPolicy, Report, Worker, WorkerEnding

TIMEOUT = 100.0  # seconds; what is waited for takes milliseconds


@dataclass(frozen=True)
class Job:
    id: str
    only_newest: bool = False
    error: BaseException | None = None


class Bench:
    """A worker whose jobs last until they are released or stopped; collects the reports."""

    def __init__(self, queue_size: int = 2) -> None:
        self.release = threading.Event()
        self.started = threading.Semaphore(0)
        self.reports: list[tuple[str, WorkerEnding]] = []
        self.errors: list[BaseException | None] = []
        self.values: list[str | None] = []
        self.worker: Worker[Job, str] = Worker(
            work=self._work, finish=self._finish, prepare=lambda: None, queue_size=queue_size
        )
        self.worker.start()

    def _work(self, job: Job, stop) -> str:
        self.started.release()
        while not (self.release.is_set() or stop()):
            time.sleep(0.001)
        if job.error:
            raise job.error
        return job.id

    def _finish(self, job: Job, report) -> None:
        self.errors.append(report.error)
        self.values.append(report.value)
        self.reports.append((job.id, report.ending))

    def run(self, *jobs: Job, policy: BusyPolicy = BusyPolicy.QUEUE) -> list[bool]:
        """Submit jobs one after another, the first with the worker idle."""
        taken = [self.worker.submit(jobs[0], policy).refusal is None]
        assert self.started.acquire(timeout=TIMEOUT)
        return taken + [self.worker.submit(job, policy).refusal is None for job in jobs[1:]]

    def wait(self, count: int) -> dict[str, WorkerEnding]:
        end = time.monotonic() + TIMEOUT
        while len(self.reports) < count:
            assert time.monotonic() < end, f"{len(self.reports)} of {count} reports"
            time.sleep(0.001)
        return dict(self.reports)


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.release.set()
    assert bench.worker.stop(TIMEOUT)


def jobs(count: int, **kind) -> list[Job]:
    return [Job(str(i), **kind) for i in range(count)]


def test_the_queue_holds_its_size_and_refuses_the_next(bench: Bench):
    assert bench.run(*jobs(3)) == [True, True, True]
    assert "queue is full" in bench.worker.submit(Job("3"), BusyPolicy.QUEUE).reason
    bench.release.set()
    assert bench.wait(3) == {str(i): WorkerEnding.DONE for i in range(3)}


def test_reject_takes_nothing_while_busy(bench: Bench):
    assert bench.run(*jobs(2), policy=BusyPolicy.REJECT) == [True, False]
    bench.release.set()
    assert bench.wait(1) == {"0": WorkerEnding.DONE}
    assert bench.worker.submit(Job("2"), BusyPolicy.REJECT).refusal is None


def test_replace_supersedes_what_runs_and_waits(bench: Bench):
    bench.run(*jobs(2))
    assert bench.worker.submit(Job("2"), BusyPolicy.REPLACE).refusal is None
    assert bench.wait(2) == {"0": WorkerEnding.SUPERSEDED, "1": WorkerEnding.SUPERSEDED}
    bench.release.set()
    assert bench.wait(3)["2"] is WorkerEnding.DONE


def test_only_the_newest_waits_and_jobs_go_first(bench: Bench):
    clouds = [Job(f"cloud{i}", only_newest=True) for i in range(3)]
    assert all(bench.run(Job("0"), *clouds, Job("1")))
    bench.release.set()
    bench.wait(5)
    assert bench.reports[:2] == [("cloud0", WorkerEnding.SUPERSEDED), ("cloud1", WorkerEnding.SUPERSEDED)]
    assert bench.reports[2:] == [(name, WorkerEnding.DONE) for name in ("0", "1", "cloud2")]


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("in the middle"), MemoryError(), SystemExit(1), KeyboardInterrupt(), BaseException()]
)
def test_an_error_ends_one_request_and_not_the_worker(bench: Bench, error: BaseException):
    bench.release.set()
    bench.worker.submit(Job("bad", error=error), BusyPolicy.QUEUE)
    assert bench.wait(1) == {"bad": WorkerEnding.FAILED}
    assert bench.errors == [error]
    bench.worker.submit(Job("good"), BusyPolicy.QUEUE)
    assert bench.wait(2)["good"] is WorkerEnding.DONE


def test_cancel_reaches_the_running_and_the_waiting(bench: Bench):
    bench.run(*jobs(3))
    assert bench.worker.cancel("1") == 1
    assert bench.worker.cancel("1") == 0
    assert bench.worker.cancel("") == 2
    assert bench.wait(3) == {str(i): WorkerEnding.CANCELLED for i in range(3)}


def test_what_was_done_before_a_cancel_is_not_lost(bench: Bench):
    bench.run(Job("0"))
    bench.worker.cancel("0")
    bench.wait(1)
    assert bench.values == ["0"]


@pytest.mark.parametrize("policy", list(BusyPolicy))
def test_an_id_is_taken_once_at_a_time(bench: Bench, policy: BusyPolicy):
    bench.run(Job("same"))
    again = bench.worker.submit(Job("same"), policy)
    assert (again.refusal, again.reason) == (ErrorCode.DUPLICATE_ID, "a request 'same' is already waiting or running")
    bench.release.set()
    assert bench.wait(1) == {"same": WorkerEnding.DONE}
    assert bench.worker.submit(Job("same"), BusyPolicy.REJECT).refusal is None
    bench.wait(2)


def test_those_who_waited_too_long_are_told_and_the_running_one_goes_on(bench: Bench):
    bench.run(*jobs(3), Job("cloud", only_newest=True))
    assert bench.worker.end_waiting(lambda job: job.id != "1", Report(WorkerEnding.DONE, value="too late")) == 2
    assert bench.wait(2) == {"2": WorkerEnding.DONE, "cloud": WorkerEnding.DONE}
    assert bench.values == ["too late", "too late"]
    assert bench.worker.state() == ("0", 1)
    bench.release.set()
    assert set(bench.wait(4)) == {"0", "1", "2", "cloud"}


def test_a_job_that_raises_on_being_cancelled_is_cancelled(bench: Bench):
    bench.run(Job("0", error=RuntimeError("torn down")))
    bench.worker.cancel("0")
    assert bench.wait(1) == {"0": WorkerEnding.CANCELLED}
    assert bench.errors == [None]


def test_after_stop_nothing_is_taken(bench: Bench):
    bench.run(*jobs(2))
    assert bench.worker.stop(TIMEOUT)
    assert bench.wait(2) == {"0": WorkerEnding.CANCELLED, "1": WorkerEnding.CANCELLED}
    refused = bench.worker.submit(Job("2"), BusyPolicy.QUEUE)
    assert (refused.refusal, refused.reason) == (ErrorCode.SHUTTING_DOWN, "the node is shutting down")


ACTIONS = st.lists(
    st.tuples(st.sampled_from(["submit", "newest", "fail", "cancel"]), st.sampled_from(list(BusyPolicy))), max_size=30
)


@given(ACTIONS)
def test_accepted_requests_and_reports_match_one_to_one(actions):
    bench = Bench()
    bench.release.set()
    accepted = []
    for number, (action, policy) in enumerate(actions):
        job = Job(str(number), only_newest=action == "newest", error=ValueError() if action == "fail" else None)
        if action == "cancel":
            bench.worker.cancel("")
        elif bench.worker.submit(job, policy).refusal is None:
            accepted.append(job.id)
    assert bench.worker.stop(TIMEOUT)
    assert Counter(name for name, _ in bench.reports) == Counter(accepted)
