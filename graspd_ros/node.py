"""Process of the node: start, wait for a signal, clean shutdown. Other ROS commands use `run_command`.

This module handles Ctrl-C and SIGTERM itself, before the slow imports, so that no signal causes a traceback. While the
node runs, the main thread only waits, because Python runs signal handlers only in the main thread.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from graspd_core.errors import ConfigError, GraspdError, Parser

if TYPE_CHECKING:
    from rclpy.executors import Executor

    from graspd_ros.grasp_node import GraspNode

# Packages of different Python or ROS releases do not work together, so these must come from one installation.
ROS_PACKAGES = (
    "rclpy",
    "rcl_interfaces",
    "builtin_interfaces",
    "std_msgs",
    "geometry_msgs",
    "sensor_msgs",
    "graspd_msgs",
)
EXIT_STOPPED, EXIT_FAILED, EXIT_BAD_INPUT = 0, 1, 2
STOP_TIMEOUT = 2.0  # seconds that a busy worker has to stop
# Python's thread switch interval [s] (default 0.005). Each message needs several switches to the executor's thread.
SWITCH_INTERVAL = 0.001


def run_command(
    name: str,
    args: list[str] | None,
    parse: Callable[[list[str]], argparse.Namespace],
    work: Callable[[argparse.Namespace, threading.Event], None],
) -> int:
    """Run `work` with rclpy initialised. A signal sets the event passed to `work`. Return 0, or 2 for bad input.

    `args` exclude the program name. None means this process's arguments. `parse` gets `args` without ROS arguments.
    """
    if conflict := foreign_ros():
        sys.stderr.write(f"{name}: {conflict}\n")
        return EXIT_BAD_INPUT
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # the ROS wheels do not set this variable

    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args, try_shutdown

    stop = threading.Event()
    _on_signal(stop.set)
    arguments = sys.argv if args is None else [name, *args]
    try:
        with _ros_arguments():
            options = parse(remove_ros_args(arguments)[1:])
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        work(options, stop)
    except GraspdError as error:
        sys.stderr.write(f"{name}: {error}\n")
        return EXIT_BAD_INPUT
    finally:
        try_shutdown()
    return EXIT_STOPPED


def foreign_ros() -> str:
    """Return a message if Python would import ROS from outside this environment, otherwise ""."""
    for package in ROS_PACKAGES:
        own = next((Path(sys.prefix) / "lib").glob(f"python3*/site-packages/{package}/__init__.py"), None)
        # Find the package without importing it, because importing a package of another Python fails.
        spec = importlib.util.find_spec(package)
        if own is None or spec is None or not spec.origin or Path(spec.origin).resolve() == own.resolve():
            continue
        where = Path(spec.origin).parents[1]
        return f"{package} comes from {where}, not from this environment; unset PYTHONPATH, or source no other ROS"
    return ""


def probe() -> str:
    """Create and destroy a node. Return the middleware's name. `graspd doctor` calls this in a separate process.

    Raises ImportError if two ROS installations are mixed, and rclpy's exceptions if ROS does not work.
    """
    if conflict := foreign_ros():
        raise ImportError(conflict)
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from graspd_msgs.msg import GraspRequest
    from rclpy.utilities import get_rmw_implementation_identifier
    from sensor_msgs.msg import PointCloud2

    rclpy.init()
    node = rclpy.create_node("graspd_doctor")
    for kind in (PoseStamped, PointCloud2, GraspRequest):
        node.create_publisher(kind, f"~/probe_{kind.__name__}", 1)
    node.destroy_node()
    rclpy.shutdown()
    return f"{get_rmw_implementation_identifier()}, makes a node"


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal. Return 0 when stopped, 1 after a failure, 2 for a bad argument or parameter."""
    try:
        _refuse_arguments(sys.argv[1:] if args is None else args)
        if conflict := foreign_ros():
            raise ConfigError(conflict)
    except ConfigError as error:
        sys.stderr.write(f"graspd_node: {error}\n")
        return EXIT_BAD_INPUT
    # A signal ends the process at once, because no request is pending and imports cannot be interrupted.
    _on_signal(lambda: os._exit(EXIT_STOPPED))
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # the ROS wheels do not set this variable

    from graspd_core.runtime.worker_process import limit_malloc_arenas, start_planning_worker

    # Start the child first, so that its imports (2 s) run in parallel with this process's imports.
    start_planning_worker()
    from rclpy.executors import SingleThreadedExecutor

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
    spinner = start_thread(executor.spin, wake, fail)
    wake.wait()
    ended = node.close(STOP_TIMEOUT)
    ended = stop_spinning(executor, spinner) and ended
    node.destroy_node()
    status = EXIT_FAILED if failed.is_set() else EXIT_STOPPED
    if not ended:
        exit_at_once(status)
    return status


def _refuse_arguments(args: list[str]) -> None:
    description = "Plan grasps for objects that are requested over ROS 2. config/graspd.yaml lists the parameters."
    parser = Parser(prog="graspd_node", usage="graspd_node [--ros-args -p NAME:=VALUE ...]", description=description)
    parser.parse_args(args[: args.index("--ros-args")] if "--ros-args" in args else args)


def start_thread(work: Callable[[], None], wake: threading.Event, fail: Callable[[], None]) -> threading.Thread:
    """Start and return a thread that runs `work`. The thread calls `fail` if it ends before `wake` is set."""

    def run() -> None:
        try:
            work()
        except Exception:
            if not wake.is_set():
                raise
            # Ignore the error, because the shutdown may interrupt a callback.
        finally:
            if not wake.is_set():
                fail()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def stop_spinning(executor: Executor, spinner: threading.Thread) -> bool:
    """Shut down rclpy, then the executor. Return False if the executor's thread is still alive."""
    from rclpy.utilities import try_shutdown

    # Keep this order. Shutting down the executor destroys objects on which its thread waits.
    try_shutdown()
    spinner.join(STOP_TIMEOUT)
    executor.shutdown(timeout_sec=0.5)
    return not spinner.is_alive()


def exit_at_once(status: int) -> NoReturn:
    """End the process without the interpreter's shutdown, which crashes if a thread is inside a library call."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _make_node(args: list[str] | None, on_failure: Callable[[], None]) -> GraspNode | None:
    """Return the node. If an argument or parameter is invalid, print the error to stderr and return None."""
    import rclpy

    if problem := log_directory():
        sys.stderr.write(f"graspd_node: {problem}\n")
    from rclpy.exceptions import ParameterException
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import try_shutdown

    from graspd_ros.grasp_node import GraspNode

    try:
        with _ros_arguments():
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        return GraspNode(on_failure=on_failure)
    except (GraspdError, ParameterException) as error:
        sys.stderr.write(f"graspd_node: {error}\n")
        try_shutdown()
        return None


@contextmanager
def _ros_arguments() -> Iterator[None]:
    """Raise ConfigError if ROS refuses an argument."""
    try:
        yield
    except RuntimeError as error:
        told = " ".join(str(error).split())  # rcl reports invalid arguments on several lines
        if type(error).__name__ == "UnknownROSArgsError":  # its text is only the list of the arguments
            valid = "-p NAME:=VALUE, --params-file FILE.yaml, -r FROM:=TO, --log-level LEVEL"
            told = f"unknown ROS arguments: {told.strip('[]')}; valid: {valid}"
        raise ConfigError(told) from error


def log_directory() -> str:
    """Set ROS_LOG_DIR to a temporary directory if the default one is read-only. Return a message about this, or ""."""
    if os.environ.get("ROS_LOG_DIR"):
        return ""
    usual = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "log"
    try:
        usual.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=usual):
            return ""
    except OSError as error:
        os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="graspd-log-")
        return f"{usual} cannot be written ({error.strerror}); logs go to ROS_LOG_DIR={os.environ['ROS_LOG_DIR']}"


def _on_signal(action: Callable[[], None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: action())


if __name__ == "__main__":
    sys.exit(main())
