"""The command line, one file a command. Each command imports heavy libraries when it runs.

graspd synthesize | replay | reconstruct | library | hands | doctor are graspd_core's own. Other packages add commands
by entry points of the group `graspd.commands`: view, bench, dataset, import and cell.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import sys
import time
from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import NoReturn

from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_INTERRUPTED, SIBLINGS, process_began
from graspd_core.errors import ConfigError, GraspdError

# New objects between two looks for garbage, by default 700. What libraries make when they are imported stays, and
# looking through it takes a tenth of the time.
_YOUNG = 20_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Return the exit status: 0 enough grasps, 3 fewer, 2 bad input, 130 interrupted."""
    # With arguments of its own this is a call within a process that began long ago.
    own_process = arguments is None
    began = process_began() if own_process else time.perf_counter()
    if own_process:
        gc.set_threshold(_YOUNG)
    try:
        words = sys.argv[1:] if arguments is None else list(arguments)
        options = build_parser(*words[:1]).parse_args(words)
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
    """A parser whose errors are a ConfigError like any other: one line, no usage text before it."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see {self.prog} --help)")


# The commands of graspd_core, in the order of `graspd --help`.
_COMMANDS = {
    "synthesize": "graspd_core.cli.synthesize_command",
    "replay": "graspd_core.cli.replay_command",
    "reconstruct": "graspd_core.cli.reconstruct_command",
    "library": "graspd_core.cli.library_command",
    "hands": "graspd_core.cli.hands_command",
    "doctor": "graspd_core.doctor",
}


def build_parser(command: str = "") -> argparse.ArgumentParser:
    """Build the parser of `command` alone, or of all commands if there is no such command.

    Raises ConfigError: the parser meets options that it does not know.
    """
    parser = _Parser(prog="graspd", description="Verified grasps for multi-fingered hands.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    modules = {command: _COMMANDS[command]} if command in _COMMANDS else _with_siblings(command)
    for module in modules.values():
        importlib.import_module(module).add_command(commands)
    return parser


def _with_siblings(command: str) -> dict[str, str]:
    registered = {point.name: point.value for point in entry_points(group="graspd.commands")}
    if command in SIBLINGS and command not in registered:
        raise ConfigError(f"{command}: {SIBLINGS[command]} is not installed; run: pip install graspd")
    return {command: registered[command]} if command in registered else _COMMANDS | registered
