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
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_PIPE, process_began
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
        return super().add_parser(name, help=_summary(name), **settings)


# Module within graspd_core, or name of the other package, and a summary, so that `graspd --help` imports no command.
_COMMANDS = {
    "synthesize": ("cli.synthesize_command", "plan grasps on a mesh, a cloud or a built-in shape"),
    "replay": ("cli.replay_command", "plan grasps on the clouds or depth images of a rosbag2 recording"),
    "reconstruct": ("cli.reconstruct_command", "reconstruct a closed mesh from a point cloud"),
    "library": ("cli.library_command", "keep verified grasps of known objects in a file"),
    "hands": ("cli.hands_command", "list the built-in hands, or inspect one"),
    "methods": ("cli.names_command", "list the methods that find grasps"),
    "presets": ("cli.names_command", "list the built-in presets"),
    "metrics": ("cli.names_command", "list the metrics of a grasp"),
    "doctor": ("doctor", "check the installation"),
    "completion": (
        "cli.completion_command",
        "print a script that lets bash, zsh or tcsh complete commands and options",
    ),
    "view": ("graspd_viewer", "show hands, grasps and results in a browser"),
    "bench": ("graspd_bench", "measure presets and methods on objects, with tables and charts"),
    "dataset": ("graspd_dataset", "make or inspect a data set of grasps"),
    "import": ("graspd_dataset", "convert grasps of other tools to grasps.json"),
    "cell": ("graspd_cell", "let a simulated arm, hand and camera empty a bin"),
}


def _overview() -> argparse.ArgumentParser:
    """Build the parser for `--help` and `--version`. The parser knows only names and summaries of the commands."""
    parser = _parser()
    commands = parser.add_subparsers(metavar="COMMAND", dest="command")
    for name in _modules():
        commands.add_parser(name, help=_summary(name))
    return parser


def build_parser(command: str = "") -> argparse.ArgumentParser:
    """Build the parser of `command`, or of all commands if `command` is empty.

    Raises ConfigError: the command is unknown or its package is not installed.
    """
    parser, modules = _parser(), _modules(command)
    if command and command not in modules:
        if command in _COMMANDS:
            raise ConfigError(f"{command}: {_COMMANDS[command][0]} is not installed; run: pip install graspd")
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


def _modules(command: str = "") -> dict[str, str]:
    """Return the module of each command. For a command of graspd_core, leave out the slow search for other packages."""
    own = {name: f"graspd_core.{module}" for name, (module, _) in _COMMANDS.items() if not module.startswith("graspd_")}
    return own if command in own else own | {point.name: point.value for point in entry_points(group="graspd.commands")}


def _summary(name: str) -> str:
    return _COMMANDS[name][1] if name in _COMMANDS else ""
