"""`graspd completion`: print a shell script that completes graspd's commands, options, hands and presets.

    source <(graspd completion bash)          # in ~/.bashrc
    graspd completion zsh > ~/.zfunc/_graspd  # a folder of zsh's fpath

The script lists the hands and presets that are installed when it is printed. Completion then runs without Python.
"""

from __future__ import annotations

import argparse
from typing import Any

from graspd_core.cli.running import EXIT_OK
from graspd_core.errors import ConfigError


def add_command(commands: Any) -> None:
    """Add the command `completion` to the parsers in `commands`."""
    parser = commands.add_parser("completion")
    parser.set_defaults(run=run, json=False)
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"))


def run(options: argparse.Namespace) -> int:
    """Print the completion script. Raises ConfigError: shtab is not installed."""
    try:
        import shtab
    except ImportError:
        raise ConfigError("completion: shtab is not installed; run: pip install shtab") from None
    from graspd_core.cli import build_parser, runnable
    from graspd_core.hands.library import hand_names
    from graspd_core.optimize.plan_config import method_names, preset_names

    names = {"hand": hand_names, "hands": hand_names, "preset": preset_names, "presets": preset_names}
    parser, names = build_parser(), {**names, "method": method_names}
    for action in (action for below in runnable(parser) for action in below._actions):
        if action.dest in names:
            action.choices = names[action.dest]()
        elif action.nargs != 0 and action.choices is None and action.type not in (int, float):
            # shtab reads this attribute of an action.
            vars(action)["complete"] = shtab.FILE
    print(shtab.complete(parser, shell=options.shell))
    return EXIT_OK
