"""Small valid inputs for the targets of fuzz_targets.py. Each input uses most features of its format."""

from __future__ import annotations

import io
import json
import pickle
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

_BOX = '<collision><origin xyz="0 0 .01" rpy="0 .1 0"/><geometry><box size="0.02 0.02 0.04"/></geometry></collision>'
_MASS = '<inertial><mass value=".1"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>'
_JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="0 .02 .03"/>'
    '<axis xyz="0 1 0"/><limit lower="-0.5" upper="1" effort="2" velocity="3"/>{extra}</joint>'
)


def _joint(name: str, kind: str, parent: str, child: str, extra: str = "") -> str:
    return _JOINT.format(name=name, kind=kind, parent=parent, child=child, extra=extra)


GRIPPER = (
    f'<robot name="gripper"><link name="palm">{_BOX}{_MASS}</link><link name="left">{_BOX}</link>'
    f'<link name="right">{_BOX}</link>{_joint("one", "revolute", "palm", "left")}'
    f"{_joint('two', 'prismatic', 'palm', 'right')}</robot>"
)
URDFS = [
    GRIPPER.encode(),
    (
        '<?xml version="1.0"?><robot name="h"><link name="world"/><link name="base"><visual><geometry>'
        '<sphere radius=".03"/></geometry></visual></link><link name="a"><collision><geometry><cylinder radius=".01" '
        f'length=".04"/></geometry></collision></link><link name="b">{_BOX}</link><link name="c"><visual><geometry>'
        '<capsule radius=".01" length=".02"/></geometry></visual></link>'
        f"{_joint('w', 'fixed', 'world', 'base')}{_joint('j', 'continuous', 'base', 'a')}"
        + _joint("k", "revolute", "a", "b", '<mimic joint="j" multiplier="2" offset="0.1"/>')
        + _joint("l", "revolute", "b", "c", '<mimic joint="k" multiplier="-1"/>')
        + "</robot>"
    ).encode(),
]
MJCFS = [
    b"""<mujoco model="t"><compiler angle="degree" eulerseq="zyx"/><default><geom type="capsule"/><default class="f">
<joint axis="0 1 0" range="-10 90"/><geom size=".01 .02"/></default></default><asset><mesh name="t" vertex="0 0 0 .02 0
 0 0 .02 0 0 0 .03" scale="1 -1 1"/></asset><worldbody><geom type="plane" size="1 1 .1"/><body name="palm" euler="1 2 3"
 childclass="f"><freejoint/><geom type="box" size=".04 .04 .01"/><body name="a" pos=".04 0 .01" quat="1 0 1 0"><joint
 name="j" pos="0 0 .01" ref="15"/><joint name="i" axis="1 0 1" range="-5 60"/><geom fromto="0 0 0 0 0 .05" size=".01"/>
<body name="tip" zaxis="1 0 1"><inertial pos="0 0 0" mass=".01" diaginertia="1e-5 1e-5 1e-5"/><geom type="ellipsoid"
 size=".01 .02 .01"/></body></body><body name="b" xyaxes="0 1 0 -1 0 0"><joint name="s" type="slide" range="0 .05"
 ref=".01"/><geom type="mesh" mesh="t"/></body></body></worldbody><equality><joint joint1="s" joint2="j"
 polycoef=".1 .5 0 0 0"/></equality><actuator><position joint="j" forcerange="-2 2"/><motor joint="s" ctrlrange="0 5"
 gear="3"/></actuator></mujoco>""",
]
DESCRIPTIONS = [
    b"name: g\nurdf: gripper.urdf\npalm: {link: palm, center: [0, 0, 0.02], normal: [0, 0, 1]}\napproach: [0, 0, 1]\n"
    b"effort: {one: 2.0, two: 3}\nopen: {one: 0, two: 0.1}\nclosed: {one: 1, two: -0.4}\n"
    b"mount: {parent: tool0, position: [0, 0, 0.1], quaternion_wxyz: [1, 0, 0, 0]}\n",
    b"urdf: gripper.urdf\neffort: 1\n",
]
PRESETS = [
    b"resolution: 48\nmethod: closed_form\nclosed_form: {explore_steps: 10}\nproblem: {friction: 0.4}",
    b"graspd2022: {steps: 10, initial: {kind: hull}}\ngrasp_stages: {open_steps: 3}\nmethod: graspd2022\n",
]
_GRASP: dict[str, Any] = {
    **{"rank": 0, "verdict": "verified", "reason": "", "score": -1.5, "position": [0.0, 0.1, 0.2]},
    **{"quaternion_wxyz": [1.0, 0.0, 0.0, 0.0], "joint_positions": [0.1, 0.2], "pregrasp_joint_positions": [0, 0]},
    **{"squeeze_joint_positions": [0.3, 0.4], "pregrasp_position": [0, 0, 1], "pregrasp_quaternion_wxyz": [0, 0, 1, 0]},
    "contacts": [{"link": "tip", "position": [0.0, 0.0, 0.1], "normal": [0.0, 0.0, 1.0]}],
    "metrics": {"epsilon": 0.1, "penetration_mm": None},
    "trials": [
        {"name": "hold", "passed": True, "displacement": 0.001, "rotation": 0.25, "reason": ""},
        {"name": "lift", "passed": True, "displacement": None, "rotation": 0.02, "reason": ""},
    ],
}
_TRIED = {"max_displacement_cm": None, "max_rotation_deg": 1.0, "reach_through_mm": 0.0}
_OLD_GRASP = {**_GRASP, "verdict": "failed", "metrics": {"epsilon": 0.1, "sd_cm": None, "hold": _TRIED, "lift": _TRIED}}
DOCUMENT: dict[str, Any] = {
    **{"format": "graspd/grasps", "version": 2, "units": "m, rad, N"},
    "hand": {"name": "g", "joint_names": ["one", "two"], "mimic": [{"joint": "two", "of": "one"}]},
    "grasps": [_GRASP, {**_GRASP, "verdict": "unverified", "trials": []}],
}
DOCUMENTS = [json.dumps(DOCUMENT).encode(), json.dumps({**DOCUMENT, "version": 1, "grasps": [_OLD_GRASP]}).encode()]
DAES = [
    b"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema"><asset><unit meter="0.01"/>
</asset><library_geometries><geometry id="g"><mesh><source id="p"><float_array count="15">0 0 0 2 0 0 2 2 0 0 2 0 0 0 3
</float_array><technique_common><accessor stride="3"/></technique_common></source><vertices id="v"><input
 semantic="POSITION" source="#p"/></vertices><polylist><input semantic="NORMAL" source="#p" offset="1"/><input
 semantic="VERTEX" source="#v" offset="0"/><vcount>4 3</vcount><p>0 9 1 9 2 9 3 9 0 9 1 9 4 9</p></polylist><triangles>
<input semantic="VERTEX" source="#v"/><p>0 1 2</p></triangles><polygons><input semantic="VERTEX" source="#v"/><p>0 1 2 3
</p></polygons></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">
<translate>1 0 0</translate><node><rotate>0 0 1 90</rotate><scale>1 1 -2</scale><instance_geometry url="#g"/></node>
<matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix></node></visual_scene></library_visual_scenes></COLLADA>""",
]
# Head of a layout file: width, height, step of a point and of a row, byte order, then offset and type of x, y and z.
LAYOUT_HEAD = struct.Struct("<IIIIBIBIBIB")
_POINTS = np.array([[0.0, 0.0, 0.5], [0.01, 0.0, 0.5], [0.0, 0.01, 0.5], [np.nan, 0.0, 0.5]], dtype=np.float32)


def pickles() -> list[bytes]:
    """Return a MANO file of 16 vertices in two pickle protocols, and a pickle of other types in three protocols."""
    from scipy.sparse import csc_matrix

    parents = (-1, *(0 if k % 3 == 0 else k for k in range(15)))
    count = 16
    whole = {
        "v_template": np.zeros((count, 3), np.float32),
        "shapedirs": np.zeros((count, 3, 1), np.float16),
        "posedirs": np.zeros((count, 3, 135), np.int8),
        "J_regressor": csc_matrix(np.eye(16, count)),
        "weights": np.eye(count, 16, dtype=np.int8),
        "f": np.array([[0, 1, 2]], dtype=np.uint32),
        "kintree_table": np.array([[2**32 - 1, *parents[1:]], range(16)], dtype=np.int64),
        "hands_components": np.zeros((1, 45), np.float16),
        "hands_mean": np.zeros(45, np.float16),
    }
    small = {"v_template": np.zeros((1, 3), ">f4"), "f": [1, 2], "x": {"y": (1.5, "text", None, True, {3}, b"b")}}
    return [
        pickle.dumps(value, protocol)
        for value, protocol in ((whole, 2), (whole, 4), (small, 0), (small, 2), (small, 4))
    ]


def clouds() -> list[bytes]:
    """Return cloud files: npy, npz with points and with depth images, and ply and pcd as text and binary."""

    def archive(**arrays: Any) -> bytes:
        out = io.BytesIO()
        np.savez_compressed(out, **arrays)
        return out.getvalue()

    array = io.BytesIO()
    np.save(array, _POINTS)
    depth = np.full((3, 4), 500, dtype=np.uint16)
    camera, pose = np.array([[4.0, 0, 1.5], [0, 4.0, 1.0], [0, 0, 1]]), np.eye(4)
    text = "\n".join(" ".join(map(str, p)) for p in _POINTS)
    ply = "ply\nformat {} 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    pcd = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA {}\n"
    )
    return [
        array.getvalue(),
        archive(points=_POINTS, viewpoint=np.zeros(3), forward=np.array([0.0, 0, 1])),
        archive(depth=depth, K=camera, distortion=np.zeros(5), T_world_camera=pose),
        archive(depths=np.full((1, 3, 4), 0.5, dtype=np.float32), K=camera, poses=pose[None]),
        (ply.format("ascii") + text + "\n").encode(),
        ply.format("binary_little_endian").encode() + _POINTS.tobytes(),
        (pcd.format("ascii") + text + "\n").encode(),
        pcd.format("binary").encode() + _POINTS.tobytes(),
    ]


def layouts() -> list[bytes]:
    """Return two files, one per byte order: a `LAYOUT_HEAD` and the data of four points."""
    places = (0, 7, 4, 7, 8, 7)
    plain, big = LAYOUT_HEAD.pack(4, 1, 12, 48, 0, *places), LAYOUT_HEAD.pack(2, 2, 12, 24, 1, *places)
    return [plain + _POINTS.tobytes(), big + _POINTS.astype(">f4").tobytes()]


def _messages() -> list[Any]:
    from bag_writer import camera_info_message, cloud_message, depth_message, transforms_message

    from graspd_core.perception.cloud.camera import PinholeCamera

    camera = PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0, (0.1, -0.2, 0.001, -0.001, 0.05))
    depth = np.full((3, 4), 0.5)
    return [
        cloud_message(_POINTS.astype(float), "camera_optical_frame", 5),
        depth_message(depth, "camera_optical_frame", 5),
        camera_info_message(camera, "camera_optical_frame", 5),
        transforms_message([("world", "camera_optical_frame", np.eye(4))], 5),
        depth_message(depth, "camera_optical_frame", 5, encoding="32FC1"),
    ]


def messages() -> list[bytes]:
    """Return messages of every type, with the number of the type as first byte."""
    from graspd_core.io.bags import jazzy_types

    numbers = (0, 1, 2, 3, 1)
    return [
        bytes([number]) + bytes(jazzy_types().serialize_cdr(message, message.__msgtype__))
        for number, message in zip(numbers, _messages(), strict=True)
    ]


def bags() -> list[bytes]:
    """Return a recording with every kind of message as mcap and as sqlite3."""
    from bag_writer import Record, write_bag

    topics = ("/points", "/depth/image_raw", "/depth/camera_info", "/tf", "/depth/image_rect")
    records = [
        Record(topic, 5 + i, message) for i, (topic, message) in enumerate(zip(topics, _messages(), strict=True))
    ]
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for storage in ("mcap", "sqlite3"):
            write_bag(Path(folder) / storage, records, storage=storage)
            found += [file.read_bytes() for file in (Path(folder) / storage).iterdir() if file.suffix != ".yaml"]
    return found
