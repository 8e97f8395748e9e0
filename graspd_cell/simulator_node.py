"""`graspd_cell_simulator`: the simulated cell in real time, with the ROS interfaces of a real cell's drivers.

It publishes /joint_states, /tf, /tf_static, /robot_description, /camera/depth/image_raw and camera_info. Like
ros2_control, it serves FollowJointTrajectory for arm and hand. Only /cell/referee carries the ground truth.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from typing import Any

import numpy as np

from graspd_cell.controller import MotionState, TrajectoryController
from graspd_cell.robot import JointMotion
from graspd_cell.robot_description import CAMERA_FRAME, frames_of, robot_description
from graspd_cell.simulated_robot import CAMERA_PERIOD, SimulatedRobot
from graspd_core.errors import ConfigError, GraspdError, Parser
from graspd_core.types import TriangleMesh
from graspd_ros.node import (
    EXIT_FAILED,
    EXIT_STOPPED,
    STOP_TIMEOUT,
    exit_at_once,
    run_command,
    start_thread,
    stop_spinning,
)

# Periods of joint states, transforms, referee reports and action feedback [s].
_JOINTS, _FRAMES, _REFEREE, _FEEDBACK = 0.01, 0.02, 0.2, 0.05
# Greatest delay behind real time that the simulation catches up, in simulated time [s].
_LATE = 0.2


def main(args: list[str] | None = None) -> int:
    """Run the cell until a signal. Return 0 when stopped, 1 after a failure, 2 for bad input."""
    return run_command("graspd_cell_simulator", args, _parse, _serve)


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = Parser(
        prog="graspd_cell_simulator", description="A simulated arm, hand and camera over a bin, in real time."
    )
    parser.add_argument("--arm", default="ur5e_like", metavar="NAME|PATH", help="default: ur5e_like")
    parser.add_argument("--hand", default="allegro_right", metavar="NAME|PATH", help="default: allegro_right")
    things = {"nargs": "+", "metavar": "THING", "default": ["family:pear", "family:jar", "family:banana"]}
    parser.add_argument("--things", **things, help="objects in the bin (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the fall and the camera noise (default 0)")
    parser.add_argument("--clock", action="store_true", help="publish /clock, and stamp with simulated time")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="multiple of real time (default 1)")
    options = parser.parse_args(arguments)
    if not 0 < options.speed < float("inf"):
        raise ConfigError(f"speed: {options.speed}; valid: a positive number")
    if not 0 <= options.seed < 2**31:
        raise ConfigError(f"seed: {options.seed}; valid: 0 to 2^31 - 1")
    return options


def _serve(options: argparse.Namespace, stop: threading.Event) -> None:
    import rclpy
    from rclpy.executors import MultiThreadedExecutor

    from graspd_cell.things import find_sources
    from graspd_cell.world import pile_cell
    from graspd_core.arms.arm import load_arm
    from graspd_core.hands.library import load_hand

    world = pile_cell(load_arm(options.arm), load_hand(options.hand), find_sources(options.things), options.seed)
    node = rclpy.create_node("graspd_cell_simulator")
    cell = SimulatorNode(node, SimulatedRobot(world, seed=options.seed), stop, clock=options.clock, speed=options.speed)
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)

    failed = threading.Event()

    def fail() -> None:
        failed.set()
        stop.set()

    spinner = start_thread(executor.spin, stop, fail)
    threads = [start_thread(work, stop, fail) for work in (cell.simulate, cell.film)]
    stop.wait()
    for thread in threads:
        thread.join(STOP_TIMEOUT)
    ended = stop_spinning(executor, spinner) and not any(thread.is_alive() for thread in threads)
    if failed.is_set() or not ended:
        exit_at_once(EXIT_FAILED if failed.is_set() else EXIT_STOPPED)
    node.destroy_node()


class SimulatorNode:
    """Publishers and action servers of a simulated robot. `simulate` and `film` run in separate threads.

    Args:
        node: rclpy node.
        robot: the simulated robot.
        stop: event that ends both threads.
        clock: if True, publish /clock and stamp messages with simulated time.
        speed: simulated seconds per second of wall clock.
    """

    def __init__(
        self, node: Any, robot: SimulatedRobot, stop: threading.Event, *, clock: bool = False, speed: float = 1.0
    ) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import CameraInfo, Image, JointState
        from std_msgs.msg import String
        from tf2_msgs.msg import TFMessage

        self.node, self.robot, self._stop, self._speed = node, robot, stop, speed
        self._lock = threading.Lock()
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._joints = node.create_publisher(JointState, "/joint_states", 50)
        self._tf = node.create_publisher(TFMessage, "/tf", 50)
        self._static = node.create_publisher(TFMessage, "/tf_static", latched)
        self._description = node.create_publisher(String, "/robot_description", latched)
        self._image = node.create_publisher(Image, "/camera/depth/image_raw", 5)
        self._info = node.create_publisher(CameraInfo, "/camera/depth/camera_info", 5)
        self._told = node.create_publisher(String, "/cell/referee", latched)
        self._clock = node.create_publisher(Clock, "/clock", 50) if clock else None
        self._description.publish(String(data=robot_description(robot.world.arm, robot.world.hand)))
        layout = robot.world.layout
        base = robot.world.arm.chain.base_link
        self._static.publish(self._transforms([(base, CAMERA_FRAME, layout.T_base_camera)], self._now()))
        self._servers = [
            MotionServer(self, "/arm_controller/follow_joint_trajectory", robot.arm),
            MotionServer(self, "/hand_controller/follow_joint_trajectory", robot.hand),
        ]

    def simulate(self) -> None:
        """Step the simulation in real time and publish the robot's state."""
        begun, offset, due = time.monotonic(), self.robot.time, {"joints": 0.0, "frames": 0.0, "referee": 0.0}
        while not self._stop.is_set():
            behind = offset + (time.monotonic() - begun) * self._speed - self.robot.time
            if behind > _LATE:
                # Let the simulation fall behind real time, but step it: it must not stand still on a busy machine.
                begun, offset, behind = time.monotonic(), self.robot.time + _LATE, _LATE
            with self._lock:
                while behind > 0:
                    self.robot.step(2)
                    behind -= 2 * float(self.robot.world.model.opt.timestep)
            self._publish(due)
            self._stop.wait(_JOINTS / 2)

    def _publish(self, due: dict[str, float]) -> None:
        from std_msgs.msg import String

        now, stamp = time.monotonic(), self._now()
        if self._clock is not None:
            from rosgraph_msgs.msg import Clock

            self._clock.publish(Clock(clock=stamp))
        if now >= due["joints"]:
            due["joints"] = max(due["joints"] + _JOINTS, now - _JOINTS)
            self._joints.publish(self._joint_state(stamp))
        if now >= due["frames"]:
            due["frames"] = max(due["frames"] + _FRAMES, now - _FRAMES)
            with self._lock:
                frames = frames_of(self.robot.world, self.robot.link_poses())
            self._tf.publish(self._transforms(frames, stamp))
        if now >= due["referee"]:
            due["referee"] = now + _REFEREE
            with self._lock:
                report = self.robot.referee()
            self._told.publish(String(data=json.dumps(vars(report) | {"hard": report.hard(report.in_hand)})))

    def film(self) -> None:
        """Publish images at the camera's rate, or as fast as rendering allows."""
        while not self._stop.is_set():
            begun = time.monotonic()
            with self._lock:
                meshes, now, stamp = self.robot.meshes(), self.robot.time, self._now()
            self._publish_view(meshes, now, stamp)
            self._stop.wait(max(0.0, CAMERA_PERIOD - (time.monotonic() - begun)))

    def _publish_view(self, meshes: list[tuple[str, TriangleMesh]], now: float, stamp: Any) -> None:
        import array

        from sensor_msgs.msg import CameraInfo, Image

        view = self.robot.view_of(meshes, now)
        height, width = view.depth.shape
        image = Image(height=height, width=width, encoding="32FC1", step=4 * width)
        image.header.stamp, image.header.frame_id = stamp, CAMERA_FRAME
        image.data = array.array("B", np.ascontiguousarray(view.depth, dtype="<f4").tobytes())
        info = CameraInfo(height=height, width=width, distortion_model="plumb_bob", d=[0.0] * 5)
        info.header, info.k = image.header, view.intrinsics.ravel().tolist()
        info.r = np.eye(3).ravel().tolist()
        info.p = np.hstack([view.intrinsics, np.zeros((3, 1))]).ravel().tolist()
        self._info.publish(info)
        self._image.publish(image)

    def _now(self) -> Any:
        """Return the stamp of messages: simulated time if /clock is published, otherwise the node's time."""
        from builtin_interfaces.msg import Time

        if self._clock is None:
            return self.node.get_clock().now().to_msg()
        nanoseconds = round(self.robot.time * 1e9)
        return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)

    def _joint_state(self, stamp: Any) -> Any:
        from sensor_msgs.msg import JointState

        with self._lock:
            reading = self.robot.joints()
        state = JointState(name=list(reading.names), position=reading.positions.tolist())
        state.header.stamp, state.effort = stamp, reading.efforts.tolist()
        return state

    def _transforms(self, frames: list[tuple[str, str, np.ndarray]], stamp: Any) -> Any:
        from geometry_msgs.msg import Transform, TransformStamped
        from tf2_msgs.msg import TFMessage

        from graspd_ros.convert import pose_of_matrix, vector_of

        transforms = []
        for parent, child, matrix in frames:
            pose = pose_of_matrix(matrix)
            moved = Transform(translation=vector_of(matrix[:3, 3]), rotation=pose.orientation)
            transform = TransformStamped(child_frame_id=child, transform=moved)
            transform.header.stamp, transform.header.frame_id = stamp, parent
            transforms.append(transform)
        return TFMessage(transforms=transforms)

    def begin(self, controller: TrajectoryController, motion: JointMotion) -> None:
        """Start a motion. Raises ConfigError: the motion has other joints or exceeds a limit."""
        with self._lock:
            controller.begin(motion, self.robot.time)

    def hold(self, controller: TrajectoryController) -> None:
        """Make the joints of a controller hold their current positions."""
        with self._lock:
            self.robot.hold(controller)

    def progress(self, controller: TrajectoryController) -> tuple[MotionState, str, np.ndarray, np.ndarray]:
        """Return state, reason of a failure, joint targets and joint positions of a controller's motion."""
        with self._lock:
            state, reason = self.robot.state_of(controller)
            positions = self.robot.joints().of(controller.limits.names).positions
            return state, reason, controller.targets.copy(), positions

    @property
    def stopped(self) -> bool:
        """True if the node must end."""
        return self._stop.is_set()


class MotionServer:
    """FollowJointTrajectory server of one controller. A new goal replaces and aborts the running goal."""

    def __init__(self, cell: SimulatorNode, name: str, controller: TrajectoryController) -> None:
        from control_msgs.action import FollowJointTrajectory
        from rclpy.action.server import ActionServer, CancelResponse
        from rclpy.callback_groups import ReentrantCallbackGroup

        self._cell, self._controller, self._newest = cell, controller, 0
        self._lock = threading.Lock()
        self._result = FollowJointTrajectory.Result
        self._server = ActionServer(
            cell.node,
            FollowJointTrajectory,
            name,
            self._execute,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def _execute(self, handle: Any) -> Any:
        result = self._result
        try:
            motion = motion_of(handle.request, self._controller)
            with self._lock:
                self._cell.begin(self._controller, motion)
                self._newest += 1
                number, told = self._newest, 0.0
        except (GraspdError, ValueError) as error:
            handle.abort()
            known = set(handle.request.trajectory.joint_names) == set(self._controller.limits.names)
            code = result.INVALID_GOAL if known else result.INVALID_JOINTS
            return result(error_code=code, error_string=str(error))
        while not self._cell.stopped:
            if number != self._newest:
                handle.abort()
                return result(error_code=result.INVALID_GOAL, error_string="a newer goal took its place")
            if handle.is_cancel_requested:
                self._hold(number)
                handle.canceled()
                return result(error_string="cancelled")
            state, reason, targets, positions = self._cell.progress(self._controller)
            if state is MotionState.REACHED:
                handle.succeed()
                return result(error_code=result.SUCCESSFUL)
            if state is not MotionState.RUNNING:
                self._hold(number)
                handle.abort()
                left = state is MotionState.LEFT_PATH
                code = result.PATH_TOLERANCE_VIOLATED if left else result.GOAL_TOLERANCE_VIOLATED
                return result(error_code=code, error_string=reason)
            if time.monotonic() >= told:
                told = time.monotonic() + _FEEDBACK
                handle.publish_feedback(feedback_of(self._controller.limits.names, targets, positions))
            time.sleep(_JOINTS)
        handle.abort()
        return result(error_code=result.INVALID_GOAL, error_string="the simulator is shutting down")

    def _hold(self, number: int) -> None:
        """Hold the joints unless a goal newer than goal `number` has begun."""
        with self._lock:
            if number == self._newest:
                self._cell.hold(self._controller)


def feedback_of(names: tuple[str, ...], targets: np.ndarray, positions: np.ndarray) -> Any:
    """Return FollowJointTrajectory feedback: desired and actual joint positions, and their error."""
    from control_msgs.action import FollowJointTrajectory

    message = FollowJointTrajectory.Feedback(joint_names=list(names))
    message.desired.positions = targets.tolist()
    message.actual.positions = positions.tolist()
    message.error.positions = (targets - positions).tolist()
    return message


def motion_of(goal: Any, controller: TrajectoryController) -> JointMotion:
    """Return the motion of a FollowJointTrajectory goal. Raises ConfigError: a field is inconsistent or unsupported."""
    names, points = tuple(goal.trajectory.joint_names), goal.trajectory.points
    for kind in ("positions", "velocities"):
        for index, point in enumerate(points):
            count = len(getattr(point, kind))
            if count != len(names) and (kind == "positions" or count):
                raise ConfigError(f"point {index} has {count} {kind}; valid: {len(names)}, one per joint")
    if goal.multi_dof_trajectory.points:
        raise ConfigError("multi_dof_trajectory is not supported; valid: trajectory")
    seconds = [point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in points]
    velocities = [point.velocities for point in points if len(point.velocities)]
    if velocities and len(velocities) != len(points):
        raise ConfigError(f"{len(velocities)} of {len(points)} points have velocities; valid: all or none")
    late = goal.goal_time_tolerance.sec + 1e-9 * goal.goal_time_tolerance.nanosec
    return JointMotion(
        names,
        np.array(seconds, dtype=float),
        np.array([point.positions for point in points], dtype=float).reshape(len(points), len(names)),
        np.array(velocities, dtype=float) if velocities else None,
        _tolerances(goal.path_tolerance, names, controller.tolerances.path, "path_tolerance"),
        _tolerances(goal.goal_tolerance, names, controller.tolerances.goal, "goal_tolerance"),
        late or None,
    )


def _tolerances(given: Any, names: tuple[str, ...], usual: float, field: str) -> np.ndarray | None:
    """Return one tolerance per joint, or None if `given` is empty. 0 means the default, below 0 no limit."""
    if not given:
        return None
    allowed = np.full(len(names), usual)
    for tolerance in given:
        if tolerance.name not in names:
            raise ConfigError(f"{field}: no joint {tolerance.name!r} in the trajectory; valid: {', '.join(names)}")
        if tolerance.position:
            allowed[names.index(tolerance.name)] = tolerance.position if tolerance.position > 0 else np.inf
    return allowed


if __name__ == "__main__":
    sys.exit(main())
