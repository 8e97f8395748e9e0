"""Memory that was freed, back to the system: for processes that serve for days."""

from __future__ import annotations

import ctypes


def give_memory_back() -> None:
    """Let the C library return what was freed (glibc keeps it, scattered, for later); others do so by themselves."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):  # no glibc
        return
    trim(ctypes.c_size_t(0))
