"""Too little memory is a named failure, whichever library meets it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from graspd_core.errors import ResourceError

# What torch says where it finds no memory, on the processor and on CUDA; it raises a RuntimeError for both.
_TORCH_SAYS = ("can't allocate memory", "not enough memory", "out of memory")


@contextmanager
def enough_memory(asked: str) -> Iterator[None]:
    """Raise ResourceError for `asked` where the work inside runs out of memory."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or any(words in str(error) for words in _TORCH_SAYS):
            raise ResourceError(
                f"{asked}: not enough memory; ask for fewer grasps, or a preset of less effort"
            ) from None
        raise
