"""The command line, one file a command; heavy imports wait for who needs them.

graspd synthesize | view | replay | reconstruct | bench | dataset | import | library | hands | doctor
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Sequence
from typing import NoReturn

from graspd_bench import bench_command as bench
from graspd_core.cli import hands_command as hands
from graspd_core.cli import library_command as library
from graspd_core.cli import reconstruct_command as reconstruct
from graspd_core.cli import replay_command as replay
from graspd_core.cli import synthesize_command as synthesize
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_INTERRUPTED, process_began
from graspd_core.errors import ConfigError, GraspdError
from graspd_dataset import dataset_command as dataset
from graspd_dataset import import_command as imports
from graspd_viewer import view_command as view

# New objects between two looks for garbage, by default 700. What libraries make when they are imported stays, and
# looking through it takes a tenth of the time.
_YOUNG = 20_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status: 0 enough grasps, 3 fewer, 2 bad input, 130 interrupted."""
    # With arguments of its own this is a call within a process that began long ago.
    own_process = arguments is None
    began = process_began() if own_process else time.perf_counter()
    if own_process:
        gc.set_threshold(_YOUNG)
    try:
        options = build_parser().parse_args(arguments)
        options.began = began
        return int(options.run(options))
    except (GraspdError, OSError) as error:
        print(f"graspd: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("graspd: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    finally:
        if own_process:
            # The interpreter's end would look through all of it once more.
            gc.freeze()


class _Parser(argparse.ArgumentParser):
    """Wrong options are errors like any other: one line, no usage text before it."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see {self.prog} --help)")


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; raises ConfigError for options that it does not know."""
    parser = _Parser(prog="graspd", description="Verified grasps for multi-fingered hands.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    synthesize.add_command(commands)
    view.add_command(commands)
    replay.add_command(commands)
    reconstruct.add_command(commands)
    bench.add_command(commands)
    dataset.add_command(commands)
    imports.add_command(commands)
    library.add_command(commands)
    hands.add_command(commands)
    doctor = commands.add_parser("doctor", help="check the installation")
    doctor.set_defaults(run=_doctor)
    return parser


def _doctor(options: argparse.Namespace) -> int:
    from graspd_core import doctor

    return doctor.main()
