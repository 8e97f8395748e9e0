"""What a command says: its result on stdout, errors, notes and progress on stderr. `--quiet` and `--json` of them all.

Nothing here writes a colour. Bars are drawn on a terminal only.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass
from typing import Any, TypeVar, cast

from graspd_core.types import Progress, Stage

T = TypeVar("T")
_END = object()
# Seconds until a wait is shown, and then from one look of it to the next.
_PATIENCE = 1.0


@dataclass(frozen=True)
class _Asked:
    """What the running command was asked for: no notes, and where its JSON document goes, None for text."""

    quiet: bool = False
    document_to: Any = None


_asked = _Asked()


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add `--quiet`, and `--json` unless the default of the parser's `json` is False."""
    # No default: an action of a command would set back what was given before it.
    parser.add_argument("--quiet", action="store_true", default=argparse.SUPPRESS, help="errors and the result only")
    if parser.get_default("json") is None:
        told = "the result as one JSON document on stdout"
        parser.add_argument("--json", action="store_true", default=argparse.SUPPRESS, help=told)


@contextmanager
def output_of(options: argparse.Namespace) -> Iterator[None]:
    """Say what the options ask for. With `--json`, stdout gets the document alone, and stderr what is printed."""
    global _asked
    quiet, as_json = getattr(options, "quiet", False), getattr(options, "json", False)
    before, _asked = _asked, _Asked(quiet, sys.stdout if as_json else None)
    with contextlib.ExitStack() as stack:
        stack.callback(globals().update, _asked=before)
        if as_json:
            text = stack.enter_context(open(os.devnull, "w")) if quiet else sys.stderr
            stack.enter_context(contextlib.redirect_stdout(text))
        yield


def answer(document: Any) -> None:
    """Write the result of the command if it was asked for as JSON."""
    if _asked.document_to is not None:
        # NaN is not JSON.
        text = json.dumps(document, indent=1, allow_nan=False, default=_plain)
        print(text, file=_asked.document_to, flush=True)


def _plain(value: Any) -> Any:
    """Return the JSON-ready form of a dataclass, a mapping, an array or a set, and of another value its text."""
    if is_dataclass(value):
        return vars(value)
    if isinstance(value, Mapping):
        return dict(value)
    return value.tolist() if hasattr(value, "tolist") else sorted(value) if isinstance(value, set) else str(value)


def print_note(text: object) -> None:
    """Say on stderr what `--quiet` leaves out."""
    if not _asked.quiet:
        print_error(text)


def print_error(text: object) -> None:
    """Say on stderr what went wrong."""
    print(f"graspd: {text}", file=sys.stderr, flush=True)


def bar(what: str, total: int | None, done: int = 0, **settings: Any) -> Any:
    """Return a bar of tqdm on a terminal, None elsewhere and with `--quiet`."""
    if not _draws():
        return None
    from tqdm import tqdm

    return tqdm(total=total, initial=done, desc=what, file=sys.stderr, **settings)


def _draws() -> bool:
    return sys.stderr.isatty() and not _asked.quiet


@contextmanager
def busy(what: str) -> Iterator[None]:
    """Show on a terminal for how many seconds something has been going on, from the first second on."""
    began, ended = time.time(), threading.Event()
    if not _draws():
        yield
        return

    def show() -> None:
        if ended.wait(_PATIENCE):
            return
        shown = bar(what, None, leave=False, bar_format="{desc}: {elapsed}")
        shown.start_t = began
        while not ended.wait(_PATIENCE):
            shown.refresh()
        shown.close()

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def waiting(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
    """Yield the items. On a terminal, what is waited for is shown, and its number."""
    rest, of = iter(items), f"/{total}" if total else ""
    for number in itertools.count(1):
        with busy(f"{what} {number}{of}"):
            item = next(rest, _END)
        if item is _END:
            return
        yield cast(T, item)


class Reporter:
    """Progress of a run: a bar on a terminal, elsewhere plain lines, one a stage."""

    def __enter__(self) -> Reporter:
        self._bar: Any = None
        self._stage: Stage | None = None
        return self

    def __call__(self, progress: Progress) -> None:
        if progress.stage is not self._stage:
            self._close()
            self._stage = progress.stage
            if progress.stage is not Stage.DONE:
                self._bar = bar(str(progress.stage), progress.of, leave=False)
                if self._bar is None:
                    print_note(f"{progress.stage} ({progress.elapsed:.1f} s)")
        if self._bar is not None:
            self._bar.set_postfix_str(f"{progress.verified} verified" if progress.verified else f"{progress.best:.2f}")
            self._bar.update(progress.step - self._bar.n)

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
