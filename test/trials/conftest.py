"""A two-finger gripper about boxes: grasps whose fate can be told beforehand."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_meshes import box_of

from graspd_core import Grasp, HandModel, Posture, load_hand
from graspd_core.perception.scene import ObjectModel, build_scene
from graspd_core.verify.world import World, build_world

FINGER = """
  <joint name="{name}_slide" type="prismatic"><parent link="palm"/><child link="{name}"/>
    <origin xyz="0 {y} 0.04"/><axis xyz="0 {sign} 0"/><limit lower="0" upper="0.04" effort="20" velocity="1"/></joint>
  <link name="{name}">
    <inertial><mass value="0.05"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.03 0.01 0.06"/></geometry></collision></link>"""

GRIPPER = f"""<robot name="gripper">
  <link name="palm">
    <collision><origin xyz="0 0 -0.01"/><geometry><box size="0.04 0.16 0.02"/></geometry></collision>
  </link>
  {FINGER.format(name="left", y=0.05, sign=-1)}{FINGER.format(name="right", y=-0.05, sign=1)}
</robot>"""


@pytest.fixture(scope="session")
def gripper(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    """Two fingers that slide along y; at 25 mm their inner faces touch a cube of 40 mm in the middle."""
    path: Path = tmp_path_factory.mktemp("gripper") / "gripper.urdf"
    path.write_text(GRIPPER)
    return load_hand(path, candidates=8)


@pytest.fixture(scope="session")
def cube() -> ObjectModel:
    """A cube of 40 mm and 100 g."""
    return build_scene(box_of(0.02), source="cube", mass=0.1, resolution=8).object


@pytest.fixture(scope="module")
def world(request: pytest.FixtureRequest, gripper: HandModel, cube: ObjectModel) -> World:
    """The gripper about the cube, with the protocol `STANDARD` of the file that asks."""
    return build_world(gripper, cube, (cube.mesh,), request.module.STANDARD)


@pytest.fixture(scope="session")
def closing() -> Callable[..., Grasp]:
    """The gripper about the origin: fingers at `pre`, at `touch`, and told to go to `squeeze` (left, right) [m]."""

    def build(pre: float, touch: float, squeeze: tuple[float, float], height: float = -0.045) -> Grasp:
        def posture(left: float, right: float) -> Posture:
            return Posture(np.array([0.0, 0.0, height]), np.array([1.0, 0, 0, 0]), np.array([left, right]))

        return Grasp(posture(pre, pre), posture(touch, touch), posture(*squeeze), (), 0.0)

    return build
