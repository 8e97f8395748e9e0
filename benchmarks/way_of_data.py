"""List the files that a command of graspd passes through, in the order in which it enters them.

    python benchmarks/way_of_data.py synthesize shape:mug -n 1

A file counts if another file of graspd calls one of its functions. Code that runs while modules are imported does not
count. Caches are off, so that nothing is skipped. docs/architecture.md has the lists of a mesh and of a cloud.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PREFIX = str(ROOT / "graspd_")


def caller_of(frame: FrameType) -> FrameType | None:
    """Return the nearest stack frame in graspd's code that called `frame`, if there is one."""
    caller = frame.f_back
    while caller is not None and not caller.f_code.co_filename.startswith(PREFIX):
        caller = caller.f_back
    return caller


def files_of(arguments: list[str]) -> list[str]:
    """Run a command and return the files that it entered, relative to the checkout, in order."""
    from graspd_core.cli import main

    entered: dict[str, None] = {}

    def trace(frame: FrameType, event: str, argument: Any) -> None:
        path = frame.f_code.co_filename
        if event != "call" or frame.f_code.co_name == "<module>" or path in entered or not path.startswith(PREFIX):
            return
        caller = caller_of(frame)
        if caller is not None and caller.f_code.co_name != "<module>" and caller.f_code.co_filename != path:
            entered[path] = None

    threading.setprofile(trace)
    sys.setprofile(trace)
    try:
        main(arguments)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return [str(Path(path).relative_to(ROOT)) for path in entered]


if __name__ == "__main__":
    os.environ["GRASPD_CACHE"] = "off"
    files = files_of(sys.argv[1:])
    print("\n".join(files))
    print(f"{len(files)} files")
