"""Requests for objects that a library knows: what answers them, what is planned for them, and what is refused."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from expected import refused
from geometry_msgs.msg import Point, Pose, Vector3
from graspd_msgs.msg import GraspArray, GraspRequest
from scipy.spatial.transform import Rotation
from shape_msgs.msg import Plane
from std_msgs.msg import Header

from graspd_core import GraspLibrary, GraspResult, HandModel, Outcome, TriangleMesh, hand_mesh, load_scene, make_shape
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.library.known_grasps import known_or_planned
from graspd_core.mesh.mesh_files import save_mesh
from graspd_ros import known_objects
from graspd_ros.inputs import request_builder
from graspd_ros.inputs.request_builder import RequestBuilder
from graspd_ros.inputs.solids import SceneObject
from graspd_ros.parameters import Settings
from graspd_ros.request_planner import Planned, Planner


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, hand: HandModel) -> Path:
    """A folder with a mesh and a library that knows it."""
    folder = tmp_path_factory.mktemp("known")
    save_mesh(folder / "ball.obj", make_shape("sphere"))
    library = GraspLibrary(folder / "known.grasps")
    library.create()
    known_or_planned(library, load_scene(folder / "ball.obj", mass=0.1), hand, count=3, preset="fast")
    return folder


@pytest.fixture
def folder(built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, in which the node runs; its mesh stands where the library says."""
    shutil.copytree(built, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Node:
    """What the node does with a message, without ROS around it."""

    def __init__(self, hand: HandModel, things: Mapping[str, SceneObject] | None = None, **settings: object) -> None:
        self._things = things or {}
        usual = {"preset": "fast", "num_grasps": 2, "grasp_library": "known.grasps", "mesh_roots": ["."]}
        self.settings = Settings(**{**usual, **settings})
        self._builder = RequestBuilder(hand.name, lambda: Time(sec=1), lambda *_: np.eye(4))
        self._planner = Planner(hand, lambda *_: np.eye(4))

    def answer(self, **fields: object) -> Planned:
        fields.setdefault("id", "r")
        request = self._builder.from_message(str(fields["id"]), self.settings, GraspRequest(**fields))
        return self._planner.plan(replace(request, collision_objects=self._things), lambda: False, lambda _: None)

    def answer_path(self, path: str) -> Planned:
        request = self._builder.from_mesh("r", self.settings, path)
        return self._planner.plan(request, lambda: False, lambda _: None)


def known(**fields: object) -> dict[str, object]:
    return {"source": GraspRequest.KNOWN, "known_object": "ball", **fields}


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    """No mesh is read."""

    def read(*_: object, **__: object) -> None:
        raise AssertionError("a mesh was read")

    for module in (known_objects, request_builder):
        monkeypatch.setattr(module, "run_isolated", read)


@pytest.mark.parametrize(
    "fields",
    [
        known(),
        {"source": GraspRequest.KNOWN, "mesh_uri": "ball.obj"},
        {"source": GraspRequest.MESH, "mesh_uri": "ball.obj"},
    ],
)
def test_a_known_object_is_answered_where_it_stands_without_its_mesh_being_read(folder, hand, unread, fields):
    there = Pose(position=Point(x=5.0))
    # Of a mesh, only the request can tell the mass.
    mass = 0.1 if "mesh_uri" in fields else 0.0
    planned = Node(hand, mass=mass).answer(**fields, header=Header(frame_id="world"), object_pose=there)
    assert planned.result.outcome is Outcome.SUCCEEDED
    assert len(planned.result.grasps) == 2
    assert all(abs(grasp.grasp.position[0] - 5.0) < 0.3 for grasp in planned.result.grasps)
    assert "2 grasps from the library known.grasps" in planned.result.message
    assert (planned.mass, planned.mass_assumed) == (0.1, False)


def test_a_mesh_named_by_its_path_alone_is_known_too(folder: Path, hand: HandModel, unread: None):
    assert "2 grasps from the library known.grasps" in Node(hand, mass=0.1).answer_path("ball.obj").result.message


def test_a_friction_below_the_library_s_is_told(folder: Path, hand: HandModel):
    assert Node(hand, friction=0.6).answer(**known()).result.warnings == ()
    (told,) = Node(hand, friction=0.3).answer(**known()).result.warnings
    assert told == "ball: grasps were tried at the library's friction of 0.6; the parameter's is 0.3"


def test_grasps_that_were_lost_are_left_out(folder: Path, hand: HandModel, unread: None):
    node = Node(hand, num_grasps=1)
    first = node.answer(**known(id="a")).result.grasps[0]
    second = node.answer(**known(id="b", exclude=["a/0"])).result.grasps[0]
    assert np.abs(first.grasp.position - second.grasp.position).max() > 1e-3


def test_a_known_object_s_grasps_are_given_for_a_hand_that_closes_late(folder: Path, hand: HandModel):
    for count in (2, 4):  # from the library alone, and with planned ones, which are added
        planned = Node(hand, num_grasps=count).answer(**known(closes_late=True))
        assert (planned.result.outcome, len(planned.result.grasps)) == (Outcome.SUCCEEDED, count)
        assert all(grasp.arrival is not None for grasp in planned.result.grasps)
    assert "3 grasps from the library known.grasps, and 1 newly planned" in planned.result.message
    assert [count for _, count in GraspLibrary(folder / "known.grasps").entries()] == [4]


def test_a_mesh_that_is_new_is_planned_for_once(folder: Path, hand: HandModel, monkeypatch: pytest.MonkeyPatch):
    node, new = Node(hand), {"source": GraspRequest.MESH, "mesh_uri": "new.obj"}
    save_mesh(folder / "new.obj", make_shape("capsule"))
    assert "0 grasps from the library known.grasps, and 2 newly planned" in node.answer(**new).result.message
    monkeypatch.setattr(known_objects, "known_or_planned", None)
    for again in (new, known(known_object="new")):
        planned = node.answer(**again)
        assert "2 grasps from the library known.grasps" in planned.result.message
        assert planned.mass_assumed


def test_a_mesh_of_unknown_mass_gets_no_grasp_of_a_light_one(folder: Path, hand: HandModel):
    planned = Node(hand).answer(source=GraspRequest.MESH, mesh_uri="ball.obj")
    assert "0 grasps from the library known.grasps, and 2 newly planned" in planned.result.message
    assert planned.mass_assumed
    assert planned.mass > 0.5
    with pytest.raises(ConfigError, match="does not have it with unknown mass"):
        Node(hand, verify="hard").answer(source=GraspRequest.KNOWN, mesh_uri="ball.obj")


def test_a_direction_and_a_surface_are_kept(folder: Path, hand: HandModel):
    node, lowest = Node(hand), float(make_shape("sphere").vertices[:, 2].min())
    turned = {"approach_direction": Vector3(z=-1.0), "approach_angle": 0.6}
    surface = Plane(coef=[0.0, 0.0, 1.0, -(1.0 + lowest)])
    found = node.answer(**known(object_pose=Pose(position=Point(z=1.0)), surface=surface, **turned)).result
    assert found.outcome is Outcome.SUCCEEDED
    for grasp in found.grasps:
        w, x, y, z = grasp.grasp.quaternion_wxyz
        a = hand.approach
        # The third row of the rotation.
        down = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]) @ a
        assert down <= -np.cos(0.6) + 1e-6
        assert grasp.grasp.position[2] > 1.0 + lowest


@pytest.mark.parametrize(
    ("fields", "settings", "error", "told"),
    [
        (known(), {"grasp_library": ""}, GraspdError, "KNOWN=4 needs a library; set the parameter grasp_library"),
        (known(), {"verify": "hard"}, ConfigError, "does not have it with unknown mass, friction 0.6, hard trials"),
        (known(mesh_uri="ball.obj"), {}, GraspdError, "known_object: 'ball' with mesh_uri too; valid: source KNOWN=4"),
        (
            {"source": GraspRequest.LATEST_CLOUD, "surface": Plane(coef=[0.0, 0.0, 1.0, 0.0])},
            {},
            GraspdError,
            "surface: source is 2, a cloud; valid sources: MESH=1, KNOWN=4",
        ),
        (known(mesh_scale=0.5), {}, GraspdError, "mesh_scale: 0.5 with known_object; .* valid: 0"),
        (known(surface=Plane(coef=[0.0, 0.0, 0.0, 1.0])), {}, GraspdError, "surface: .* is not a plane"),
    ],
)
def test_what_cannot_be_answered_is_named(folder: Path, hand: HandModel, fields, settings, error, told: str):
    with refused(error, match=told, code="BAD_REQUEST"):
        Node(hand, **settings).answer(**fields)


def test_a_library_that_was_torn_is_told(folder: Path, hand: HandModel):
    Path("known.grasps").write_bytes(b"no library" * 1000)
    with refused(GraspdError, match=r"known\.grasps: damaged or not a library", code="BAD_LIBRARY"):
        Node(hand).answer(**known())


@pytest.mark.timeout(300)
def test_a_node_answers_another_process_from_its_library(client, start_node, folder: Path):
    process = start_node(grasp_library="known.grasps", num_grasps=2)
    client.send_request(**known(id="first"))
    answer = client.answer("first")
    assert (answer.status, len(answer.grasps)) == (GraspArray.SUCCEEDED, 2), answer.message
    assert "2 grasps from the library known.grasps" in answer.message
    client.send_request(**known(id="none", known_object="bell"))
    refused = client.answer("none")
    assert (refused.status, refused.error_code) == (GraspArray.FAILED, "BAD_REQUEST")
    assert "it has ball" in refused.message
    assert process.alive()


def test_what_stands_about_a_known_object_is_kept_clear_of(folder: Path, hand: HandModel):
    """A wall beside the ball, and the ball as a planning scene has it."""
    box, ball = make_shape("box"), make_shape("sphere").vertices
    cube, low, high = (box.vertices - box.vertices.min(0)) / np.ptp(box.vertices, axis=0), ball.min(0), ball.max(0)
    wall = TriangleMesh(np.array([high[0] + 0.01, -0.5, -0.5]) + cube, box.faces)
    same = TriangleMesh(low + cube * (high - low), box.faces)
    things = {name: SceneObject("object", np.eye(4), (shape,)) for name, shape in (("wall", wall), ("ball", same))}
    free, walled = Node(hand).answer(**known()).result, Node(hand, things=things).answer(**known()).result

    def farthest(result: GraspResult) -> float:
        postures = [grasp.grasp for grasp in result.grasps if grasp.usable]
        turns = [Rotation.from_quat(np.roll(p.quaternion_wxyz, -1)) for p in postures]
        hands = [hand_mesh(hand, p.joint_positions).vertices for p in postures]
        return max(
            float(t.apply(v)[:, 0].max() + p.position[0]) for t, v, p in zip(turns, hands, postures, strict=True)
        )

    assert farthest(free) > high[0] + 0.02
    assert not any(grasp.usable for grasp in walled.grasps) or farthest(walled) < high[0] + 0.012
    assert ["'ball' fills the place of the object to grasp" in warning for warning in walled.warnings] == [True]
