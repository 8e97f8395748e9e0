"""Run the command line. Each command has its own module. Commands import heavy libraries only when they run.

graspd_core provides synthesize, replay, reconstruct, library, hands, methods, presets, metrics, doctor and completion.
Other packages add commands by entry points of the group `graspd.commands`: view, bench, dataset, import and cell.
"""

from __future__ import annotations

import argparse
import difflib
import gc
import importlib
import os
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.metadata import entry_points
from typing import Any, NoReturn

from graspd_core.cli.output import add_output_options, flush_output, output_of, print_error
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_PIPE, SIBLINGS, process_began
from graspd_core.errors import ConfigError, GraspdError, Parser, choices

# A garbage collection starts after this number of new objects. Python's default is 700. Collections during imports free
# nothing and take a tenth of the start-up time.
_YOUNG = 20_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Return 0 for enough grasps, 3 for fewer, 2 for bad input, 130 if interrupted.

    Return 141 if the reader of the output has ended.
    """
    # With `arguments`, the caller is a process that may have started long ago.
    own_process = arguments is None
    began = process_began() if own_process else time.perf_counter()
    if own_process:
        gc.set_threshold(_YOUNG)
    try:
        words = (sys.argv[1:] if arguments is None else list(arguments)) or ["--help"]
        options = (_overview() if words[0].startswith("-") else build_parser(words[0])).parse_args(words)
        options.began = began
        with output_of(options):
            status = int(options.run(options))
        if own_process and (error := flush_output()):
            raise error
        return status
    except BrokenPipeError:
        return EXIT_PIPE
    except (GraspdError, OSError) as error:
        print_error(error)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print_error("interrupted")
        return EXIT_INTERRUPTED
    finally:
        if own_process:
            flush_output()
            # Without `freeze`, the interpreter would collect garbage once more at exit.
            gc.freeze()


class _Parser(Parser):
    """Parser of `graspd` and its commands."""

    def error(self, message: str) -> NoReturn:
        # The top parser reports unknown options, so search the options of all its commands.
        if (words := message.removeprefix("unrecognized arguments: ")) != message and words.startswith("--"):
            known = [option for below in runnable(self) for option in below._option_string_actions]
            if near := difflib.get_close_matches(words.split()[0].split("=")[0], known, 1):
                message = f"{message}; did you mean {near[0]}?"
            if programs := [below.prog.replace(" ", "/") for below in runnable(self)]:
                self.prog = os.path.commonpath(programs).replace("/", " ")
        super().error(message)


class _Commands(argparse._SubParsersAction):
    """Subparsers with a summary for each command. Shell completion hides commands without a summary."""

    def add_parser(self, name: str, **settings: Any) -> argparse.ArgumentParser:
        return super().add_parser(name, help=_SUMMARIES.get(name, ""), **settings)


# The commands of graspd_core, in the order of `graspd --help`.
_COMMANDS = {
    "synthesize": "graspd_core.cli.synthesize_command",
    "replay": "graspd_core.cli.replay_command",
    "reconstruct": "graspd_core.cli.reconstruct_command",
    "library": "graspd_core.cli.library_command",
    "hands": "graspd_core.cli.hands_command",
    **dict.fromkeys(("methods", "presets", "metrics"), "graspd_core.cli.names_command"),
    "doctor": "graspd_core.doctor",
    "completion": "graspd_core.cli.completion_command",
}
# Summaries for `graspd --help`, which imports no command.
_SUMMARIES = {
    "synthesize": "plan grasps on a mesh, a cloud or a built-in shape",
    "replay": "plan grasps on the clouds or depth images of a rosbag2 recording",
    "reconstruct": "reconstruct a closed mesh from a point cloud",
    "library": "keep verified grasps of known objects in a file",
    "hands": "list the built-in hands, or inspect one",
    "methods": "list the methods that find grasps",
    "presets": "list the built-in presets",
    "metrics": "list the metrics of a grasp",
    "doctor": "check the installation",
    "completion": "print a script that lets bash, zsh or tcsh complete commands and options",
    "view": "show hands, grasps and results in a browser",
    "bench": "measure presets and methods on objects, with tables and charts",
    "dataset": "make or inspect a data set of grasps",
    "import": "convert grasps of other tools to grasps.json",
    "cell": "let a simulated arm, hand and camera empty a bin",
}


def _overview() -> argparse.ArgumentParser:
    """Build the parser for `--help` and `--version`. The parser knows only names and summaries of the commands."""
    parser = _parser()
    commands = parser.add_subparsers(metavar="COMMAND", dest="command")
    for name in _modules():
        commands.add_parser(name, help=_SUMMARIES.get(name, ""))
    return parser


def build_parser(command: str = "") -> argparse.ArgumentParser:
    """Build the parser of `command`, or of all commands if `command` is empty.

    Raises ConfigError: the command is unknown or its package is not installed.
    """
    parser, modules = _parser(), _COMMANDS if command in _COMMANDS else _modules()
    if command and command not in modules:
        if command in SIBLINGS:
            raise ConfigError(f"{command}: {SIBLINGS[command]} is not installed; run: pip install graspd")
        raise ConfigError(f"unknown command {command!r}; {choices(command, modules)}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command", action=_Commands)
    # One module may hold several commands.
    for module in dict.fromkeys([modules[command]] if command else modules.values()):
        importlib.import_module(module).add_command(commands)
    for runs in runnable(parser):
        add_output_options(runs)
    return parser


def runnable(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield the parser and its subparsers, but only those that run a command."""
    for action in parser._actions:
        for below in action.choices.values() if isinstance(action, argparse._SubParsersAction) else ():
            yield from runnable(below)
    if parser.get_default("run"):
        yield parser


def _parser() -> _Parser:
    return _Parser(prog="graspd", description="Verified grasps for multi-fingered hands.")


def _modules() -> dict[str, str]:
    return _COMMANDS | {point.name: point.value for point in entry_points(group="graspd.commands")}
