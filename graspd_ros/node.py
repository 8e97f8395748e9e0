"""The process: starts the node, waits for a signal, ends cleanly.

Ctrl-C and SIGTERM are handled here instead of by rclpy, from before the slow imports on, so that neither leaves a
traceback at any time. Once the node runs the main thread only waits, since Python runs signal handlers nowhere else.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from graspd_core.errors import ConfigError
from graspd_ros.ros_command import Parser, foreign_rclpy

if TYPE_CHECKING:
    from rclpy.executors import Executor

    from graspd_ros.grasp_node import GraspNode

STOP_TIMEOUT = 2.0  # seconds that a busy worker has to notice that it must stop
# Seconds that a thread may keep Python from others (5 ms by itself): the executor asks for it several times a message.
SWITCH_INTERVAL = 0.001

EXIT_STOPPED = 0
EXIT_FAILED = 1
EXIT_BAD_INPUT = 2


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal; 0 when stopped, 1 when it cannot go on, 2 for a bad argument or parameter."""
    try:
        _refuse_arguments(sys.argv[1:] if args is None else args)
    except ConfigError as error:
        sys.stderr.write(f"graspd_node: {error}\n")
        return EXIT_BAD_INPUT
    # Nothing has been promised to anybody yet, and neither an import nor reading a hand can be ended otherwise.
    _on_signal(lambda: os._exit(EXIT_STOPPED))
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # the wheels leave it unset

    from graspd_core.runtime.worker_process import limit_malloc_arenas, start_planning_worker

    # First, so that the child's imports, two seconds of them, go on beside this process's own.
    start_planning_worker()
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.utilities import try_shutdown

    limit_malloc_arenas()
    sys.setswitchinterval(SWITCH_INTERVAL)
    wake, failed = threading.Event(), threading.Event()

    def fail() -> None:
        failed.set()
        wake.set()

    node = _make_node(args, fail)
    if node is None:
        return EXIT_BAD_INPUT
    _on_signal(wake.set)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = _spinning(executor, wake, fail)
    wake.wait()
    ended = node.close(STOP_TIMEOUT)
    # In this order: shutting the executor down takes what it waits with from under it.
    try_shutdown()
    spinner.join(0.5)
    executor.shutdown(timeout_sec=0.5)
    node.destroy_node()
    status = EXIT_FAILED if failed.is_set() else EXIT_STOPPED
    if not ended:
        # A worker deep in a library call would abort the interpreter's teardown; there is nothing left to save.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def _refuse_arguments(args: list[str]) -> None:
    """Say what the node takes, where it is asked or is given what is not for ROS. Raises ConfigError."""
    told = "Grasps of objects that are asked for over ROS 2; its parameters are in config/graspd.yaml."
    parser = Parser(prog="graspd_node", usage="graspd_node [--ros-args -p NAME:=VALUE ...]", description=told)
    parser.parse_args(args[: args.index("--ros-args")] if "--ros-args" in args else args)


def _spinning(executor: Executor, wake: threading.Event, fail: Callable[[], None]) -> threading.Thread:
    """A thread that runs the executor until `wake` is set; before that, an end of it is a failure."""

    def spin() -> None:
        try:
            executor.spin()
        except Exception:
            if not wake.is_set():
                raise
            # The context was shut down, under a callback perhaps, to end this.
        finally:
            if not wake.is_set():
                fail()

    spinner = threading.Thread(target=spin, name="graspd_executor", daemon=True)
    spinner.start()
    return spinner


def _make_node(args: list[str] | None, on_failure: Callable[[], None]) -> GraspNode | None:
    """The node; None where an argument or a parameter is bad, which standard error then says."""
    import rclpy

    if told := foreign_rclpy(str(rclpy.__file__)):
        sys.stderr.write(f"graspd_node: {told}\n")
    if told := log_directory():
        sys.stderr.write(f"graspd_node: {told}\n")
    from rclpy.exceptions import ParameterException
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import try_shutdown

    from graspd_core.errors import GraspdError
    from graspd_ros.grasp_node import GraspNode

    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # what rcl says of arguments that it cannot read, over several lines
        sys.stderr.write(f"graspd_node: {' '.join(str(error).split())}\n")
        return None
    try:
        return GraspNode(on_failure=on_failure)
    except (GraspdError, ParameterException) as error:
        sys.stderr.write(f"graspd_node: {error}\n")
        try_shutdown()
        return None


def log_directory() -> str:
    """Set a directory that logs can be written to, where the usual one cannot; gives the line that says so."""
    if os.environ.get("ROS_LOG_DIR"):
        return ""
    usual = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "log"
    try:
        usual.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=usual):
            return ""
    except OSError as error:
        os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="graspd-log-")
        return f"{usual} cannot be written ({error.strerror}): ROS_LOG_DIR={os.environ['ROS_LOG_DIR']}"


def _on_signal(action: Callable[[], None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: action())


if __name__ == "__main__":
    sys.exit(main())
