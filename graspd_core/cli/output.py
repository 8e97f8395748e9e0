"""Print results on stdout, messages and progress on stderr. Define the options `--quiet` and `--json`.

Output has no colours. Progress bars appear only on a terminal.
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
# `busy` shows a progress bar after this time, and updates the bar at this interval [s].
_PATIENCE = 1.0


@dataclass(frozen=True)
class _OutputSettings:
    """Output settings of the running command: whether notes are hidden, and the stream for JSON (None for text)."""

    quiet: bool = False
    document_to: Any = None


_settings = _OutputSettings()


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add `--quiet`. If the parser has no default for `json`, also add `--json`."""
    # These options have no default. A default of a subcommand would overwrite an option given before the subcommand.
    parser.add_argument("--quiet", action="store_true", default=argparse.SUPPRESS, help="only errors and the result")
    if parser.get_default("json") is None:
        text = "print the result as one JSON document on stdout"
        parser.add_argument("--json", action="store_true", default=argparse.SUPPRESS, help=text)


@contextmanager
def output_of(options: argparse.Namespace) -> Iterator[None]:
    """Apply `--quiet` and `--json` inside the context. With `--json`, stdout gets only JSON. Text goes to stderr."""
    global _settings
    quiet, as_json = getattr(options, "quiet", False), getattr(options, "json", False)
    before, _settings = _settings, _OutputSettings(quiet, sys.stdout if as_json else None)
    with contextlib.ExitStack() as stack:
        stack.callback(globals().update, _settings=before)
        if as_json:
            text = stack.enter_context(open(os.devnull, "w")) if quiet else sys.stderr
            stack.enter_context(contextlib.redirect_stdout(text))
        yield


def answer(document: Any) -> None:
    """Print the command's result as JSON if `--json` was given."""
    if _settings.document_to is not None:
        # NaN is not valid JSON, so refuse to print NaN.
        text = json.dumps(document, indent=1, allow_nan=False, default=_plain)
        print(text, file=_settings.document_to, flush=True)


def _plain(value: Any) -> Any:
    """Return the JSON-ready form of a dataclass, mapping, array or set. Return any other value as text."""
    if is_dataclass(value):
        return vars(value)
    if isinstance(value, Mapping):
        return dict(value)
    return value.tolist() if hasattr(value, "tolist") else sorted(value) if isinstance(value, set) else str(value)


def flush_output() -> OSError | None:
    """Flush stdout. If this fails, discard the rest, because Python would fail again at its end. Return the error."""
    # Without a standard output, sys.stdout is None.
    if (stream := sys.stdout) is None:
        return None
    try:
        stream.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return error
    return None


def print_note(text: object) -> None:
    """Print a note on stderr, unless `--quiet` was given."""
    if not _settings.quiet:
        print_error(text)


def print_error(text: object) -> None:
    """Print an error on stderr."""
    print(f"graspd: {text}", file=sys.stderr, flush=True)


def bar(what: str, total: int | None, done: int = 0, **settings: Any) -> Any:
    """Return a tqdm progress bar. Return None with `--quiet` or without a terminal."""
    if not _draws():
        return None
    from tqdm import tqdm

    return tqdm(total=total, initial=done, desc=what, file=sys.stderr, **settings)


def _draws() -> bool:
    return sys.stderr.isatty() and not _settings.quiet


@contextmanager
def busy(what: str) -> Iterator[None]:
    """Show on a terminal how long the work inside the context has taken, if it takes more than 1 s."""
    began, ended = time.time(), threading.Event()
    if not _draws():
        yield
        return

    def show() -> None:
        if ended.wait(_PATIENCE):
            return
        progress_bar = bar(what, None, leave=False, bar_format="{desc}: {elapsed}")
        progress_bar.start_t = began
        while not ended.wait(_PATIENCE):
            progress_bar.refresh()
        progress_bar.close()

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def waiting(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
    """Yield the items. While the caller waits for an item, a terminal shows `what` and the item's number."""
    rest, of = iter(items), f"/{total}" if total else ""
    for number in itertools.count(1):
        with busy(f"{what} {number}{of}"):
            item = next(rest, _END)
        if item is _END:
            return
        yield cast(T, item)


class Reporter:
    """Progress display of a run: a bar on a terminal, otherwise one line per stage."""

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
