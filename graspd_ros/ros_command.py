"""What the commands share: options, ROS arguments, signals, exit codes, and whether ROS works here."""

from __future__ import annotations

import argparse
import importlib.util
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
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


def foreign_rclpy(file: str) -> str:
    """One line about an rclpy that comes before the environment's own; empty where there is one rclpy only."""
    own = next((Path(sys.prefix) / "lib").glob("python3*/site-packages/rclpy/__init__.py"), None)
    if own is None or Path(file).resolve() == own.resolve():
        return ""
    where = Path(file).parents[1]
    return f"rclpy is that of {where}, not this environment's: unset PYTHONPATH, or do not source another ROS"


def probe() -> str:
    """Make and destroy a node; tell the middleware. Raises what rclpy raises where ROS does not work.

    `graspd doctor` asks for it in a process of its own.
    """
    spec = importlib.util.find_spec("rclpy")
    if spec is not None and spec.origin and (told := foreign_rclpy(spec.origin)):
        raise ImportError(told)
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from graspd_msgs.msg import GraspRequest
    from rclpy.utilities import get_rmw_implementation_identifier
    from sensor_msgs.msg import PointCloud2

    rclpy.init()
    node = rclpy.create_node("graspd_doctor")
    node.create_publisher(PoseStamped, "~/probe_pose", 1)
    node.create_publisher(PointCloud2, "~/probe_points", 1)
    node.create_publisher(GraspRequest, "~/probe_request", 1)
    node.destroy_node()
    rclpy.shutdown()
    return f"{get_rmw_implementation_identifier()}, makes a node"
