"""Work on several threads whose results come in order, the same for any number of threads."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import TypeVar

from graspd_core.planning.run_clock import Run
from graspd_core.types import StopHook

Item = TypeVar("Item")
Result = TypeVar("Result")

# How often the stop hook is asked while waiting for a result [s].
_POLL = 0.02


def results_in_order(
    run: Run,
    work: Callable[[Item, StopHook], Result],
    items: Sequence[Item],
    threads: int,
    needed: Callable[[], int] = lambda: 0,
) -> Generator[Result]:
    """The result of each item, in their order, until the run is over.

    Work that is begun ahead and not asked for any more ends by its stop hook when the iterator is closed.

    Args:
        run: the stop hook of `work` is true when it is over; its own hook is asked by the calling thread alone.
        work: done by the calling thread where there is one thread, else by so many others.
        items: what is worked on.
        threads: at least 1.
        needed: how many more results will be asked for at least, so that none of these is begun too early.
    """
    if min(threads, len(items)) <= 1:
        for item in items:
            if run.over():
                return
            yield work(item, run.over)
        return
    closed = threading.Event()
    pool = ThreadPoolExecutor(max_workers=threads, thread_name_prefix="graspd-trials")
    waiting, left = deque[Future[Result]](), iter(items)
    try:
        while not run.over():
            # As many again as are worked on, and all that are needed: no thread waits for the first in line.
            for item in islice(left, max(2 * threads, needed()) - len(waiting)):
                waiting.append(pool.submit(work, item, lambda: closed.is_set() or run.known_over()))
            if not waiting:
                return
            while not wait([waiting[0]], timeout=_POLL).done:
                run.over()
            yield waiting.popleft().result()
    finally:
        closed.set()
        pool.shutdown(cancel_futures=True)
