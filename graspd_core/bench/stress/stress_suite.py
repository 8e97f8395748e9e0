"""Stress cases in processes of their own, each ending kept on disk as soon as it is there."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import IO

from graspd_core.bench.benchmark_workers import ENVIRONMENT
from graspd_core.bench.result_store import kept_record
from graspd_core.bench.stress.run_stress_case import StressEnding
from graspd_core.bench.stress.stress_case import Case
from graspd_core.bench.stress.stress_cases import CASES
from graspd_core.errors import ConfigError
from graspd_core.formats.grasps_json import save_text
from graspd_core.methods.plan_config import load_preset, to_mapping

# Beyond loading and planning, before a process is called hung, and how often processes are looked at [s].
_PATIENCE, _POLL = 60.0, 0.05


def cases_of(names: Sequence[str]) -> tuple[Case, ...]:
    """Cases by their names or families, all of them for no name. Raises ConfigError: there is no such case."""
    families = sorted({case.family for case in CASES.values()})
    if unknown := [name for name in names if name not in CASES and name not in families]:
        raise ConfigError(f"unknown case {unknown[0]!r}; valid: {', '.join(families)}, {', '.join(sorted(CASES))}")
    return tuple(case for case in CASES.values() if not names or case.name in names or case.family in names)


@dataclass(frozen=True)
class EndingStore:
    """Where endings are kept, and what they must have come from to count.

    Attributes:
        folder: of the files.
        preset: that the cases are planned with.
        code: version of the code.
        any_code: endings of other versions count, too.
    """

    folder: Path
    preset: str
    code: str
    any_code: bool = False

    @cached_property
    def _key(self) -> str:
        """Hash of what the preset says."""
        said = json.dumps(to_mapping(load_preset(self.preset)), sort_keys=True)
        return hashlib.sha256(said.encode()).hexdigest()

    def path(self, case: Case) -> Path:
        """The file of one case."""
        return self.folder / f"stress-{Path(self.preset).stem}-{case.name}.json"

    def write(self, ending: StressEnding, case: Case) -> None:
        """Keep an ending; its file appears whole or not at all."""
        record = {"key": self._key, "code": self.code, "ending": asdict(ending)}
        save_text(self.path(case), json.dumps(record, indent=1) + "\n")

    def read(self, case: Case) -> tuple[StressEnding, str] | None:
        """The ending of a case and the code that it came of; None where there is none that counts."""
        record = kept_record(self.path(case), self._key, None if self.any_code else self.code)
        try:
            return None if record is None else (StressEnding(**record["ending"]), str(record["code"]))
        # Other code may have said other things of an ending.
        except (TypeError, KeyError):
            return None


def run_cases(
    cases: Sequence[Case], store: EndingStore, processes: int, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Case, StressEnding]]:
    """Run cases, `processes` at a time, and yield each as it ends; its ending is on disk by then.

    Ends early, its processes killed, once `stop` is true. A process that dies or hangs is an ending like any other.
    """
    waiting = deque(cases)
    running: list[_Running] = []
    try:
        while (waiting or running) and not stop():
            while waiting and len(running) < processes:
                running.append(_Running(waiting.popleft(), store.preset))
            ended = [one for one in running if one.over()]
            running = [one for one in running if one not in ended]
            for one in ended:
                ending = one.ending()
                store.write(ending, one.case)
                yield one.case, ending
            time.sleep(0.0 if ended else _POLL)
    finally:
        for one in running:
            one.kill()


class _Running:
    """One case in its process."""

    def __init__(self, case: Case, preset: str) -> None:
        self.case = case
        # It is loaded twice: for the second trial, too.
        self._patience = 2 * case.loading + case.deadline + _PATIENCE
        self._end = time.perf_counter() + self._patience
        command = [sys.executable, "-m", "graspd_core.bench.stress.run_stress_case", case.name, "--preset", preset]
        self._streams = out, err = _scratch(), _scratch()
        # A group of its own: a Ctrl-C is the parent's, who decides what it means.
        environment = {**os.environ, **ENVIRONMENT}
        self._process = subprocess.Popen(command, stdout=out, stderr=err, env=environment, process_group=0)

    def over(self) -> bool:
        return self._process.poll() is not None or time.perf_counter() > self._end

    def kill(self) -> None:
        """End it, and let go of what it wrote."""
        self._process.kill()
        self._process.wait()
        for stream in self._streams:
            stream.close()

    def ending(self) -> StressEnding:
        """What it came to; it is over afterwards."""
        ended = self._process.poll() is not None
        out, err = (_lines(stream) for stream in self._streams)
        self.kill()
        if not ended:
            return StressEnding(self.case.name, "hang", f"no end after {self._patience:.0f} s", planning=self._patience)
        try:
            return StressEnding(**json.loads(out[-1]))
        except (IndexError, ValueError, TypeError):
            # Both: the last words of what a signal ended are of something else.
            told = "; ".join([f"exit status {self._process.returncode}", *err[-1:]])
            return StressEnding(self.case.name, "crash", told)


def _scratch() -> IO[str]:
    """A file without a name, gone with its last reader."""
    return tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")


def _lines(stream: IO[str]) -> list[str]:
    stream.seek(0)
    return stream.read().strip().splitlines()
