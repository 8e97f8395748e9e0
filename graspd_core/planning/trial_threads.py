"""Work on several threads whose results come in order, the same for any number of threads."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import TypeVar

from graspd_core.types import StopHook

Item = TypeVar("Item")
Result = TypeVar("Result")

# How often the stop hook is asked while waiting for a result [s].
_POLL = 0.02


def begin_in_thread(name: str, work: Callable[[], Result]) -> Future[Result]:
    """Begin work in a thread that only who asks for its result, and the process's end, waits for."""
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
    begun = pool.submit(work)
    pool.shutdown(wait=False)
    return begun


def results_in_order(
    over: StopHook,
    work: Callable[[Item, StopHook], Result],
    items: Sequence[Item],
    threads: int,
    needed: Callable[[], int] = lambda: 0,
    *,
    known_over: StopHook = lambda: False,
) -> Generator[Result]:
    """The result of each item, in their order, until it is over.

    Work that is begun ahead and not asked for any more ends by its stop hook when the iterator is closed.

    Args:
        over: ends it all; asked by the calling thread alone.
        work: done by the calling thread where there is one thread, else by so many others.
        items: what is worked on.
        threads: at least 1.
        needed: how many more results will be asked for at least, so that none of these is begun too early.
        known_over: ends work too; asked by all threads, also while nobody asks for a result.
    """
    if min(threads, len(items)) <= 1:
        for item in items:
            if over():
                return
            yield work(item, over)
        return
    closed = threading.Event()
    pool = ThreadPoolExecutor(max_workers=threads, thread_name_prefix="graspd-trials")
    waiting, left = deque[Future[Result]](), iter(items)
    try:
        while not over():
            # As many again as are worked on, and all that are needed: no thread waits for the first in line.
            for item in islice(left, max(2 * threads, needed()) - len(waiting)):
                waiting.append(pool.submit(work, item, lambda: closed.is_set() or known_over()))
            if not waiting:
                return
            while not wait([waiting[0]], timeout=_POLL).done:
                if over():
                    closed.set()
            yield waiting.popleft().result()
    finally:
        closed.set()
        pool.shutdown(cancel_futures=True)
