"""Freed memory goes back to the system."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import pytest

from graspd_core.geometry.memory import give_memory_back


def resident() -> float:
    """Of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_what_was_freed_between_things_that_stay_is_given_back():
    blocks = [bytearray(4096) for _ in range(25_000)]
    stay = blocks[::100]
    del blocks
    before = resident()
    give_memory_back()
    # 100 MB were freed; other tests may have left holes that a part of them came from.
    assert before - resident() > 50
    assert len(stay) == 250


def test_where_the_c_library_has_no_such_thing_nothing_happens(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    before = resident()
    give_memory_back()
    assert abs(resident() - before) < 50
