"""What tests of many folders expect, an error of one line, a value that is there, and a pickle that runs code."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import pytest

T = TypeVar("T")


@contextmanager
def refused(
    error: type[Exception], *told: str, start: str = "", match: str | None = None, code: str = ""
) -> Iterator[None]:
    """Expect an error of one line that has these texts, begins with one, and that a regular expression matches.

    `code` is the error code that the node gives with the error.
    """
    with pytest.raises(error, match=match) as caught:
        yield
    line = str(caught.value)
    assert "\n" not in line, line
    assert line.startswith(start), line
    assert [text for text in told if text not in line] == [], line
    if code:
        from graspd_ros.error_codes import code_of

        assert code_of(caught.value) == code


def some(value: T | None) -> T:
    """Return a value that is not None, for pyright too."""
    assert value is not None
    return value


class Evil:
    """Pickles as a call of a function of one's choice."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call
