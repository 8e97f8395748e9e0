"""What the commands beside the node share: options, ROS arguments, signals and what their process ends with."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import NoReturn

from graspd_core.errors import ConfigError, GraspdError

EXIT_DONE, EXIT_BAD_INPUT = 0, 2


class Parser(argparse.ArgumentParser):
    """Raises ConfigError for an option that is not valid."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see {self.prog} --help)")


def run_command(
    name: str,
    args: list[str] | None,
    parse: Callable[[list[str]], argparse.Namespace],
    work: Callable[[argparse.Namespace, threading.Event], None],
) -> int:
    """Work with rclpy initialised until it is done or a signal sets the event; 0 then, 2 for bad input.

    Args:
        name: of the command, for the line that says what is bad.
        args: without the name; None: of this process.
        parse: takes those that are not for ROS.
        work: what the command does.
    """
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # the wheels leave it unset

    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args, try_shutdown

    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    arguments = sys.argv if args is None else [name, *args]
    try:
        options = parse(remove_ros_args(arguments)[1:])
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        work(options, stop)
    except GraspdError as error:
        sys.stderr.write(f"{name}: {error}\n")
        return EXIT_BAD_INPUT
    finally:
        try_shutdown()
    return EXIT_DONE
