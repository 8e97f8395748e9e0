"""Objects and hands whose metrics can be worked out on paper."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import content_hash, mass_properties
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.scene import ObjectModel
from graspd_core.types import Posture, TriangleMesh

BLOCK = """<robot name="block">
  <link name="base"/>
  <joint name="slide" type="prismatic"><parent link="base"/><child link="block"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" effort="10" velocity="1"/></joint>
  <link name="block"><collision><geometry><box size="0.04 0.03 0.02"/></geometry></collision></link>
</robot>"""

FINGER = """
  <joint name="{name}_slide" type="prismatic"><parent link="palm"/><child link="{name}"/>
    <origin xyz="0 {y} 0.04"/><axis xyz="0 {sign} 0"/><limit lower="0" upper="0.06" effort="20" velocity="1"/></joint>
  <link name="{name}"><collision><geometry><box size="0.03 0.01 0.06"/></geometry></collision></link>"""

GRIPPER = f"""<robot name="gripper">
  <link name="palm">
    <collision><origin xyz="0 0 -0.01"/><geometry><box size="0.04 0.16 0.02"/></geometry></collision>
  </link>
  {FINGER.format(name="left", y=0.05, sign=-1)}{FINGER.format(name="right", y=-0.05, sign=1)}
</robot>"""


def load(text: str, folder: Path) -> HandModel:
    path = folder / "hand.urdf"
    path.write_text(text)
    return load_hand(path, candidates=8)


@pytest.fixture(scope="session")
def block(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    """One box of 40 x 30 x 20 mm, centred on the base frame at joint value 0."""
    return load(BLOCK, tmp_path_factory.mktemp("block"))


@pytest.fixture(scope="session")
def gripper(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    """Two fingers 10 mm thick that slide along y; their inner faces are 45 mm − q from the middle."""
    return load(GRIPPER, tmp_path_factory.mktemp("gripper"))


@pytest.fixture(scope="session")
def box() -> TriangleMesh:
    """60 x 60 x 90 mm, centred."""
    return make_shape("box")


@pytest.fixture(scope="session")
def as_object() -> Callable[[TriangleMesh], ObjectModel]:
    """A mesh as an object of 100 g and friction 0.6."""

    def build(mesh: TriangleMesh) -> ObjectModel:
        volume, center, inertia = mass_properties(mesh)
        radius = float(np.linalg.norm(mesh.vertices - center, axis=1).max())
        sha256 = content_hash(mesh)
        return ObjectModel("mesh", sha256, mesh, volume, 0.1, center, inertia * (0.1 / volume), 0.6, 1.0, radius, ())

    return build


@pytest.fixture(scope="session")
def at() -> Callable[..., Posture]:
    """A posture from a position [m] and joint values."""

    def build(position: tuple[float, float, float], joints: tuple[float, ...], wxyz=(1.0, 0.0, 0.0, 0.0)) -> Posture:
        return Posture(np.array(position, dtype=float), np.array(wxyz, dtype=float), np.array(joints, dtype=float))

    return build
