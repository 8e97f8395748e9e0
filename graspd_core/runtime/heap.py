"""Memory that was freed, back to the system: for processes that serve for days."""

from __future__ import annotations

import ctypes

# glibc's mallopt: how many arenas there may be.
_M_ARENA_MAX, _ARENAS = -8, 2


def trim_heap() -> None:
    """Let the C library return what was freed (glibc keeps it, scattered, for later); others do so by themselves."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):  # no glibc
        return
    trim(ctypes.c_size_t(0))


def limit_malloc_arenas() -> None:
    """Let all threads allocate from two arenas, from now on; glibc only.

    Else every thread that ever allocated holds freed memory of its own that no other thread can use, and a process with
    many threads grows for as long as they come upon their largest work by turns.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return
    mallopt(_M_ARENA_MAX, _ARENAS)
