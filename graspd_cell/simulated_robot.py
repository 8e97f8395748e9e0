"""Robot in a simulated cell. Simulated time passes only in waits and motions, as fast as the CPU allows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from graspd_bench.rendering.depth_noise import DEFAULT, DepthNoise, add_noise
from graspd_bench.rendering.render import render_depth
from graspd_bench.rendering.tabletop import moved
from graspd_cell.controller import JointLimits, MotionState, Tolerances, TrajectoryController
from graspd_cell.layout import Box
from graspd_cell.referee import Referee, Report, body_pose
from graspd_cell.robot import DepthView, JointMotion, JointReading, MotionAborted, never
from graspd_cell.world import DAMPING_TIME, CellWorld, Pose, put_robot
from graspd_core.hands.kinematics import primitive_mesh
from graspd_core.hands.model import HandModel
from graspd_core.types import TriangleMesh, joined

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

# Tolerances of the arm's controller [rad], [s]. The hand's controller has none.
ARM_TOLERANCES = Tolerances(path=0.1, goal=0.02, goal_time=1.0)
# Time in which dropped objects come to rest [s].
SETTLING = 2.0
# Steps between two checks of tolerances and forces. Time for the arm to brake, and period of the camera [s].
_LOOK_EVERY, _BRAKING, CAMERA_PERIOD = 2, 0.3, 0.1


class SimulatedRobot:
    """Implementation of `Robot` in simulated time.

    Args:
        world: the cell.
        noise: noise model of the depth camera.
        seed: seed of the noise. Every image has different noise.
    """

    def __init__(self, world: CellWorld, *, noise: DepthNoise = DEFAULT, seed: int = 0) -> None:
        import mujoco

        self.world = world
        self._data = mujoco.MjData(world.model)
        self._noise, self._seed, self._images = noise, seed, 0
        put_robot(world, self._data, world.start)
        mujoco.mj_forward(world.model, self._data)
        count = len(world.arm.joint_names)
        self.arm = TrajectoryController(self._limits(slice(0, count)), ARM_TOLERANCES, world.start[:count])
        self.hand = TrajectoryController(self._limits(slice(count, None)), Tolerances(), world.start[count:])
        self._referee = Referee(world)
        self._solids = _visible_solids(world)
        # Films and pages add callbacks here. They run after every step that the referee observes.
        self.watchers: list[Callable[[SimulatedRobot], None]] = []

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self._data.time)

    def joints(self) -> JointReading:
        """Return the current positions and efforts of all joints."""
        world, data = self.world, self._data
        efforts = data.qfrc_actuator[world.joint_dof].copy()
        return JointReading(self.time, world.joint_names, data.qpos[world.joint_qpos].copy(), efforts)

    def look(self) -> DepthView:
        """Return the next image of the camera."""
        self.wait(CAMERA_PERIOD)
        return self.view_of(self.meshes(), self.time)

    def view_of(self, meshes: Sequence[tuple[str, TriangleMesh]], time: float) -> DepthView:
        """Return a noisy image of `meshes`, base frame [m], with the stamp `time` [s]."""
        camera, pose = self.world.layout.camera, self.world.layout.T_base_camera
        self._images += 1
        true = render_depth(joined(*(mesh for _, mesh in meshes)), camera, pose)
        depth = add_noise(true, camera, self._noise, 100_000 * self._seed + self._images)
        matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        return DepthView(time, depth.astype(np.float32), matrix, pose)

    def meshes(self) -> list[tuple[str, TriangleMesh]]:
        """Return name and current surface of every part and object, base frame [m]."""
        return [(name, moved(mesh, pose)) for (name, mesh), pose in zip(self.solids(), self.solid_poses(), strict=True)]

    def solids(self) -> list[tuple[str, TriangleMesh]]:
        """Return name and surface of every part and object, each in its body's frame [m]."""
        own = [(name, mesh) for name, _, mesh in self._solids]
        return own + [(thing.name, thing.seen) for thing in self.world.things]

    def solid_poses(self) -> list[Pose]:
        """Return the current poses of `solids` in the base frame [m]."""
        own = [body_pose(self._data, body) if body >= 0 else np.eye(4) for _, body, _ in self._solids]
        return own + self.thing_poses()

    def follow(self, motion: JointMotion, timeout: float, stop: Callable[[], bool] = never) -> JointReading:
        """Execute a motion. See `Robot.follow`."""
        parts = self.parts_of(motion)
        end, reason = self.time + timeout, ""
        for controller, part in parts:
            controller.begin(part, self.time)
        while not reason:
            self.step(_LOOK_EVERY)
            states = [self.state_of(controller) for controller, _ in parts]
            if all(state is MotionState.REACHED for state, _ in states):
                return self.joints()
            reason = next((reason for _, reason in states if reason), "")
            if not reason and stop():
                reason = "the motion was stopped"
            elif not reason and self.time >= end:
                reason = f"the motion took longer than its timeout of {timeout:g} s"
        for controller, _ in parts:
            self.hold(controller)
        self.wait(_BRAKING)
        raise MotionAborted(reason)

    def wait(self, seconds: float) -> None:
        """Simulate `seconds`. Joints hold their targets."""
        steps = round(seconds / self.world.model.opt.timestep)
        for done in range(0, steps, _LOOK_EVERY):
            self.step(min(_LOOK_EVERY, steps - done))

    def parts_of(self, motion: JointMotion) -> list[tuple[TrajectoryController, JointMotion]]:
        """Return each controller with its motion. Unknown joints go to the arm controller, which rejects them."""
        hand = tuple(name for name in motion.names if name in self.hand.limits.names)
        arm = tuple(name for name in motion.names if name not in hand)
        if not hand or not arm:
            return [(self.hand if hand else self.arm, motion)]
        return [(self.arm, motion.part(arm)), (self.hand, motion.part(hand))]

    def state_of(self, controller: TrajectoryController) -> tuple[MotionState, str]:
        """Return the state of a controller's motion, and the reason if the motion failed."""
        return controller.state(self.time, self._positions(controller))

    def hold(self, controller: TrajectoryController) -> None:
        """Make the joints of a controller hold their current positions."""
        controller.hold(self._positions(controller))

    def step(self, steps: int = 1) -> None:
        """Simulate `steps` steps. The referee and the `watchers` see the state after the last step."""
        import mujoco

        world, data = self.world, self._data
        timestep, count = world.model.opt.timestep, len(self.arm.limits.names)
        for _ in range(steps):
            targets, speeds = self.arm.advance(data.time + timestep, timestep)
            # The speed term cancels the motors' damping. Otherwise the arm would lag behind its targets.
            data.ctrl[world.actuators[:count]] = targets + DAMPING_TIME * speeds
            data.ctrl[world.actuators[count:]] = self.hand.advance(data.time + timestep, timestep)[0]
            mujoco.mj_step(world.model, data)
        self._referee.watch(data)
        for watcher in self.watchers:
            watcher(self)

    def referee(self) -> Report:
        """Return the ground truth. Pickers must not use it."""
        return self._referee.report(self._data)

    def clear_forces(self) -> None:
        """Reset the referee's peak forces."""
        self._referee.clear()

    def thing_poses(self) -> list[Pose]:
        """Return the true poses of the objects in the base frame [m]."""
        return [body_pose(self._data, int(body)) for body in self.world.thing_bodies]

    def link_poses(self) -> dict[str, Pose]:
        """Return the poses of the links of arm and hand in the base frame [m]. The hand's keys begin with `hand/`."""
        world, found = self.world, dict[str, Pose]()
        for prefix, robot, bodies in (
            ("", world.arm.chain, world.arm_bodies),
            ("hand/", world.hand, world.hand_bodies),
        ):
            for name, body in zip(robot.link_names, bodies, strict=True):
                found[f"{prefix}{name}"] = body_pose(self._data, int(body))
        return found

    def _positions(self, controller: TrajectoryController) -> np.ndarray:
        return self.joints().of(controller.limits.names).positions

    def _limits(self, part: slice) -> JointLimits:
        world = self.world
        return JointLimits(world.joint_names[part], world.lower[part], world.upper[part], world.velocity[part])


def _visible_solids(world: CellWorld) -> list[tuple[str, int, TriangleMesh]]:
    """Return name, body id (-1 if fixed) and surface [m] in the body's frame of each link, table and bin wall."""
    fixed = [(solid.name, -1, box_mesh(solid)) for solid in world.layout.solids]
    robot: Sequence[tuple[str, HandModel, Any]] = (
        ("arm", world.arm.chain, world.arm_bodies),
        ("hand", world.hand, world.hand_bodies),
    )
    return fixed + [
        (name, int(bodies[link]), joined(*map(primitive_mesh, primitives)))
        for name, model, bodies in robot
        for link, primitives in enumerate(model.primitives_of)
        if primitives
    ]


def box_mesh(solid: Box) -> TriangleMesh:
    """Return the surface of a box in the base frame [m]."""
    import trimesh

    box = trimesh.creation.box(extents=2 * np.array(solid.half))
    return TriangleMesh(np.array(box.vertices) + solid.center, np.array(box.faces, dtype=np.int64))
