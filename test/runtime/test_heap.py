"""Freed memory goes back to the system."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

from graspd_core.runtime.worker_process import limit_malloc_arenas, trim_heap


def resident() -> float:
    """Of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_what_was_freed_between_things_that_stay_is_given_back():
    blocks = [bytearray(4096) for _ in range(25_000)]
    stay = blocks[::100]
    del blocks
    before = resident()
    trim_heap()
    # 100 MB were freed; other tests may have left holes that a part of them came from.
    assert before - resident() > 50
    assert len(stay) == 250


def no_library(name: None) -> object:
    raise OSError("no such library")


@pytest.mark.parametrize("library", [lambda name: object(), no_library])
def test_where_the_c_library_has_no_such_thing_nothing_is_raised(monkeypatch: pytest.MonkeyPatch, library):
    monkeypatch.setattr(ctypes, "CDLL", library)
    trim_heap()
    limit_malloc_arenas()


def test_threads_share_two_arenas_once_they_are_told_to():
    code = (
        "import threading, ctypes, sys\n"
        "from graspd_core.runtime.worker_process import limit_malloc_arenas\n"
        "if sys.argv[1] == 'shared': limit_malloc_arenas()\n"
        "wait = threading.Barrier(9)\n"
        "def work():\n"
        "    kept = ctypes.create_string_buffer(50_000)\n"
        "    wait.wait(); wait.wait()\n"
        "threads = [threading.Thread(target=work) for _ in range(8)]\n"
        "[t.start() for t in threads]; wait.wait()\n"
        "ctypes.CDLL(None).malloc_stats(); wait.wait()\n"
    )

    def arenas(kind: str) -> int:
        done = subprocess.run([sys.executable, "-c", code, kind], capture_output=True, text=True, check=True)
        return done.stderr.count("Arena ")

    assert arenas("shared") <= 2 < arenas("each its own")
