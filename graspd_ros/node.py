"""The process, which starts the node, waits for a signal and ends cleanly, and code that the commands share with it.

Ctrl-C and SIGTERM are handled here instead of by rclpy, from before the slow imports on, so that neither leaves a
traceback at any time. Once the node runs, the main thread only waits, since Python runs signal handlers nowhere else.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from graspd_core.errors import ConfigError, GraspdError

if TYPE_CHECKING:
    from rclpy.executors import Executor

    from graspd_ros.grasp_node import GraspNode

# Of these all have to be of one ROS: what another Python or release compiled cannot be loaded, or not beside them.
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
STOP_TIMEOUT = 2.0  # seconds that a busy worker has to notice that it must stop
# Seconds that a thread may keep Python from others (5 ms by itself): the executor asks for it several times a message.
SWITCH_INTERVAL = 0.001


class Parser(argparse.ArgumentParser):
    """An argument parser that raises ConfigError for an option that is not valid."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see {self.prog} --help)")


def run_command(
    name: str,
    args: list[str] | None,
    parse: Callable[[list[str]], argparse.Namespace],
    work: Callable[[argparse.Namespace, threading.Event], None],
) -> int:
    """Run `work` with rclpy initialised until it is done or a signal sets the event. Return 0 then, or 2 for bad input.

    `args` are without the name (None: those of this process). `parse` takes those that are not for ROS.
    """
    if told := foreign_ros():
        sys.stderr.write(f"{name}: {told}\n")
        return EXIT_BAD_INPUT
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # the wheels leave it unset

    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args, try_shutdown

    stop = threading.Event()
    _on_signal(stop.set)
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
    return EXIT_STOPPED


def foreign_ros() -> str:
    """Return one line about a ROS that comes before the environment's own, empty where there is only one ROS."""
    for package in ROS_PACKAGES:
        own = next((Path(sys.prefix) / "lib").glob(f"python3*/site-packages/{package}/__init__.py"), None)
        # Found without being imported: what another Python compiled would only raise.
        spec = importlib.util.find_spec(package)
        if own is None or spec is None or not spec.origin or Path(spec.origin).resolve() == own.resolve():
            continue
        where = Path(spec.origin).parents[1]
        return f"{package} is that of {where}, not this environment's: unset PYTHONPATH, or do not source another ROS"
    return ""


def probe() -> str:
    """Make and destroy a node and return the middleware's name, for `graspd doctor`, in a process of its own.

    Raises what rclpy raises where ROS does not work.
    """
    if told := foreign_ros():
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


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal. Return 0 when stopped, 1 when it cannot go on, 2 for a bad argument or parameter."""
    try:
        _refuse_arguments(sys.argv[1:] if args is None else args)
        if told := foreign_ros():
            raise ConfigError(told)
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
        # A worker deep in a library call would abort the interpreter's teardown. There is nothing left to save.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def _refuse_arguments(args: list[str]) -> None:
    told = "Grasps of objects that are asked for over ROS 2; its parameters are in config/graspd.yaml."
    parser = Parser(prog="graspd_node", usage="graspd_node [--ros-args -p NAME:=VALUE ...]", description=told)
    parser.parse_args(args[: args.index("--ros-args")] if "--ros-args" in args else args)


def _spinning(executor: Executor, wake: threading.Event, fail: Callable[[], None]) -> threading.Thread:
    """Return a thread that runs the executor until `wake` is set. If the executor ends earlier, `fail` is called."""

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
    """Return the node, or None where an argument or a parameter is bad, which is written to standard error."""
    import rclpy

    if told := log_directory():
        sys.stderr.write(f"graspd_node: {told}\n")
    from rclpy.exceptions import ParameterException
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import try_shutdown

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
    """Set a writable directory for logs where the usual one is not. Return the line that says so."""
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
