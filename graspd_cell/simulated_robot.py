"""A robot in a simulated cell. Time passes only while somebody waits for it, as fast as the processor goes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from graspd_bench.rendering.depth_noise import DEFAULT, DepthNoise, add_noise
from graspd_bench.rendering.render import render_depth
from graspd_bench.rendering.tabletop import moved
from graspd_cell.controller import JointLimits, MotionState, Tolerances, TrajectoryController
from graspd_cell.layout import Box
from graspd_cell.referee import Referee, Report, body_pose, thing_poses
from graspd_cell.robot import DepthView, JointMotion, JointReading, MotionAborted, never
from graspd_cell.world import DAMPING_TIME, CellWorld, Pose, put_robot
from graspd_core.hands.kinematics import primitive_mesh
from graspd_core.hands.model import HandModel
from graspd_core.types import TriangleMesh, joined

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

# Of the arm's controller [rad], [s]; the hand's has none.
ARM_TOLERANCES = Tolerances(path=0.1, goal=0.02, goal_time=1.0)
# What was dropped into a bin comes to rest within this [s].
SETTLING = 2.0
# Steps between two looks at tolerances and forces. So long an arm brakes, and a camera takes for an image [s].
_LOOK_EVERY, _BRAKING, CAMERA_PERIOD = 2, 0.3, 0.1


class SimulatedRobot:
    """Implements `Robot` in simulated time.

    Args:
        world: the cell.
        noise: of the depth camera.
        seed: of the noise; each image has noise of its own.
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
        # Called after every step that the referee looks at: pictures, pages.
        self.watchers: list[Callable[[SimulatedRobot], None]] = []

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self._data.time)

    def joints(self) -> JointReading:
        """Return positions and efforts of all joints now."""
        world, data = self.world, self._data
        efforts = data.qfrc_actuator[world.joint_dof].copy()
        return JointReading(self.time, world.joint_names, data.qpos[world.joint_qpos].copy(), efforts)

    def look(self) -> DepthView:
        """Return the next image of the camera."""
        self.wait(CAMERA_PERIOD)
        return self.view_now()

    def view_now(self) -> DepthView:
        """Return an image of this moment, with noise. No time passes."""
        return self.view_of(self.meshes(), self.time)

    def view_of(self, meshes: Sequence[tuple[str, TriangleMesh]], time: float) -> DepthView:
        """Return the image of surfaces as they were at some time, with noise."""
        camera = self.world.layout.camera
        self._images += 1
        depth = add_noise(self._depth(meshes), camera, self._noise, 100_000 * self._seed + self._images)
        matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        return DepthView(time, depth.astype(np.float32), matrix, self.world.layout.T_base_camera)

    def true_depth(self) -> Float32[np.ndarray, "height width"]:
        """Return the depth image of this moment without noise [m], zero where nothing is."""
        return self._depth(self.meshes()).astype(np.float32)

    def meshes(self) -> list[tuple[str, TriangleMesh]]:
        """Return the surfaces of everything as it is now, base frame [m], with the names of their parts or things."""
        return [(name, moved(mesh, pose)) for (name, mesh), pose in zip(self.solids(), self.solid_poses(), strict=True)]

    def solids(self) -> list[tuple[str, TriangleMesh]]:
        """Return the same surfaces, each in a frame of its own."""
        own = [(name, mesh) for name, _, mesh in self._solids]
        return own + [(thing.name, thing.seen) for thing in self.world.things]

    def solid_poses(self) -> list[Pose]:
        """Return the poses of the frames of `solids` [m]."""
        own = [body_pose(self._data, body) if body >= 0 else np.eye(4) for _, body, _ in self._solids]
        return own + self.thing_poses()

    def follow(self, motion: JointMotion, timeout: float, stop: Callable[[], bool] = never) -> JointReading:
        """Run a motion to its end; see `Robot.follow`."""
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
                reason = f"the motion took more than its {timeout:g} s"
        for controller, _ in parts:
            self.hold(controller)
        self.wait(_BRAKING)
        raise MotionAborted(reason)

    def wait(self, seconds: float) -> None:
        """Simulate so long; joints hold their targets."""
        steps = round(seconds / self.world.model.opt.timestep)
        for done in range(0, steps, _LOOK_EVERY):
            self.step(min(_LOOK_EVERY, steps - done))

    def parts_of(self, motion: JointMotion) -> list[tuple[TrajectoryController, JointMotion]]:
        """Return the controllers that a motion is for, each with its part. Joints of neither stay with the first."""
        hand = tuple(name for name in motion.names if name in self.hand.limits.names)
        arm = tuple(name for name in motion.names if name not in hand)
        if not hand or not arm:
            return [(self.hand if hand else self.arm, motion)]
        return [(self.arm, motion.part(arm)), (self.hand, motion.part(hand))]

    def state_of(self, controller: TrajectoryController) -> tuple[MotionState, str]:
        """Return how a controller's motion is getting on now, and of an abort why."""
        return controller.state(self.time, self._positions(controller))

    def hold(self, controller: TrajectoryController) -> None:
        """Make the joints of a controller stay where they are."""
        controller.hold(self._positions(controller))

    def step(self, steps: int = 1) -> None:
        """Simulate some steps. The referee looks at the last of them."""
        import mujoco

        world, data = self.world, self._data
        timestep, count = world.model.opt.timestep, len(self.arm.limits.names)
        for _ in range(steps):
            targets, speeds = self.arm.advance(data.time + timestep, timestep)
            # A motor's damping would make the arm lag behind its targets.
            data.ctrl[world.actuators[:count]] = targets + DAMPING_TIME * speeds
            data.ctrl[world.actuators[count:]] = self.hand.advance(data.time + timestep, timestep)[0]
            mujoco.mj_step(world.model, data)
        self._referee.watch(data)
        for watcher in self.watchers:
            watcher(self)

    def referee(self) -> Report:
        """Return what is true now. No picker may ask."""
        return self._referee.report(self._data)

    def clear_forces(self) -> None:
        """Make the referee forget the forces up to now."""
        self._referee.clear()

    def thing_poses(self) -> list[Pose]:
        """Return the true poses of the things [m]."""
        return thing_poses(self.world, self._data)

    def link_poses(self) -> dict[str, Pose]:
        """Return the poses of the links of arm and hand [m]; the hand's are named `hand/…`."""
        world, found = self.world, dict[str, Pose]()
        for prefix, robot, bodies in (
            ("", world.arm.chain, world.arm_bodies),
            ("hand/", world.hand, world.hand_bodies),
        ):
            for name, body in zip(robot.link_names, bodies, strict=True):
                found[f"{prefix}{name}"] = body_pose(self._data, int(body))
        return found

    def _depth(self, meshes: Sequence[tuple[str, TriangleMesh]]) -> Float[np.ndarray, "height width"]:
        layout = self.world.layout
        return render_depth(joined(*(mesh for _, mesh in meshes)), layout.camera, layout.T_base_camera)

    def _positions(self, controller: TrajectoryController) -> np.ndarray:
        return self.joints().of(controller.limits.names).positions

    def _limits(self, part: slice) -> JointLimits:
        world = self.world
        return JointLimits(world.joint_names[part], world.lower[part], world.upper[part], world.velocity[part])


def _visible_solids(world: CellWorld) -> list[tuple[str, int, TriangleMesh]]:
    """What the camera sees beside the things: name, body (-1 for what is fixed) and surface in the body's frame [m]."""
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
    """Return the surface of a box [m]."""
    import trimesh

    box = trimesh.creation.box(extents=2 * np.array(solid.half))
    return TriangleMesh(np.array(box.vertices) + solid.center, np.array(box.faces, dtype=np.int64))
