"""What fuzzing found once, as small as it gets: each is refused in one line now, or read as it should be."""

import io
import json
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import fuzz_targets as fuzz
import numpy as np
import pytest

from graspd_core.errors import BagError, short_repr
from graspd_core.io.bags import CLOUD, read_frames
from graspd_core.perception.cloud.cloud_files import load_views


def npy(header: str, data: bytes = b"") -> bytes:
    """An array file with any header."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header.encode() + b"\n" + data


def array(kind: str, shape: str, data: bytes = b"") -> bytes:
    return npy(f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}", data)


def archive(**changed: int) -> bytes:
    """An archive of points of which both headers are changed: `flags`, `method`."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        # A date of its own: the time of now would give each process of a test run another parameter.
        file.writestr(zipfile.ZipInfo("points.npy"), array("'<f4'", "(1, 3)", bytes(12)))
    data = bytearray(out.getvalue())
    for mark, first in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.index(mark) + first
        for offset, key in enumerate(("flags", "method")):
            struct.pack_into("<H", data, at + 2 * offset, changed.get(key, 0))
    return bytes(data)


def seed(name: str, old: str, new: str) -> bytes:
    """The target's first seed with a part of it replaced."""
    text = fuzz.TARGETS[name].seeds()[0].decode()
    assert old in text
    return text.replace(old, new, 1).encode()


def refusal(name: str, data: bytes, folder: Path) -> str:
    """Why a target refuses an input; fails where it does not, or not as it should."""
    told = fuzz.try_input(fuzz.TARGETS[name], data, folder)
    assert told is not None, "it was taken"
    return told


def ply(kind: str, z: str, data: bytes) -> bytes:
    """A cloud of two points by its header."""
    head = f"ply\nformat {kind} 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty {z} z\nend_header\n"
    return head.encode() + data


def pcd(points: int, kind: str, data: bytes = b"", *, size: str = "4", form: str = "F", count: str = "1") -> bytes:
    """A cloud of so many points by its header, with other entries for z."""
    head = f"# .PCD\nFIELDS x y z\nSIZE 4 4 {size}\nTYPE F F {form}\nCOUNT 1 1 {count}\n"
    return f"{head}WIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA {kind}\n".encode() + data


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (npy("{[]: 1}"), "not readable as numbers"),
        (npy("(" * 900), "not readable as numbers"),
        (array("[('a', '<f4')]", "(1,)", bytes(4)), "'points' is not readable as numbers: it holds"),
        (array("'<c16'", "(1, 3)", bytes(48)), "'points' is not readable as numbers: it holds complex128"),
        (array("'<f4'", "(1000000000000, 3)"), "not readable as numbers"),
        (archive(flags=1), "is encrypted"),
        (archive(method=99), "compression method is not supported"),
        (ply("ascii", "float", b"0 0 1\n0 0"), "cut short: 1 of 2 points"),
        (ply("binary_little_endian", "float", bytes(13)), "cut short: 1 of 2 points"),
        (ply("ascii", "list uchar float", b"0 0 1\n0 0 1\n"), "'vertex' has a list"),
        (ply("ascii", "string", b"0 0 1\n0 0 1\n"), "'property string z' is not understood"),
        (pcd(2, "ascii", b"0 0 1\n"), "cut short: 1 of 2 points"),
        (pcd(10**9, "ascii", b"0 0 1\n"), "cut short: 1 of 1000000000 points"),
        (pcd(10**9, "binary", bytes(24)), "cut short: 2 of 1000000000 points"),
        (pcd(10**9, "binary_compressed", bytes(24)), "declares 12000000000 bytes of points, but its data declares 0"),
        (pcd(1, "binary_compressed", count="100000000"), "declares 400000008 bytes of points, but its data declares 0"),
        (pcd(1, "binary", bytes(24), size="5"), "not a readable pcd cloud"),
        (pcd(1, "binary", bytes(12), form=5000 * "1"), "is unknown; valid: F, I, U"),
        (pcd(1, "binary_compressed", struct.pack("<II", 8, 24) + bytes(8)), "but its data declares 24 bytes, packed"),
        (pcd(1, "packed", bytes(12)), "its DATA 'packed' is unknown; valid: ascii, binary"),
        (b"# 7\nFIELDS x y z\n", "its header has no SIZE"),
    ],
    ids=str,
)
def test_cloud_files(tmp_path: Path, data: bytes, message: str) -> None:
    assert message in refusal("cloud", data, tmp_path)


def test_points_are_read_in_every_order_and_beside_other_things(tmp_path: Path) -> None:
    points = np.array([[1.0, 2, 3], [4, np.nan, 6]])
    header = (
        "ply\r\nformat {} 1.0\r\ncomment made by hand\r\nelement camera 1\r\nproperty uchar id\r\nelement vertex 2\r\n"
        "property double y\r\nproperty uchar red\r\nproperty float x\r\nproperty float64 z\r\nelement face 0\r\n"
        "property list uchar int vertex_indices\r\nend_header\r\n"
    )
    text = "7\n" + "".join(f"{y} 255 {x} {z}\n" for x, y, z in points)
    (tmp_path / "a.ply").write_bytes(header.format("ascii").encode() + text.encode())
    for mark, kind in ((">", "binary_big_endian"), ("<", "binary_little_endian")):
        rows = b"\7" + b"".join(struct.pack(f"{mark}dBfd", y, 255, x, z) for x, y, z in points)
        (tmp_path / f"{kind}.ply").write_bytes(header.format(kind).encode() + rows)
    columns = "# .PCD\nFIELDS n y x z\nSIZE 4 8 4 8\nTYPE F F F F\nCOUNT 2 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA "
    text = "".join(f"0 0 {y} {x} {z}\n" for x, y, z in points)
    (tmp_path / "a.pcd").write_bytes(columns.encode() + b"ascii\n" + text.encode())
    rows = b"".join(struct.pack("<ffdfd", 0, 0, y, x, z) for x, y, z in points)
    (tmp_path / "b.pcd").write_bytes(columns.encode() + b"binary\n" + rows)
    for path in tmp_path.iterdir():
        np.testing.assert_array_equal(load_views(path)[0].points, points)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("-1.5", "1" + 400 * "0", "too large"),
        ("0.1, 0.2]", "0.1, 1e999]", "position: [0.0, 0.1, inf]; expected 3 finite"),
        ("0.1, 0.2]", "0.1]", "position: [0.0, 0.1]; expected 3 finite"),
        ("0.1, 0.2]", "0.1, null]", "position: [0.0, 0.1, None]; expected 3 finite"),
        ("[1.0, 0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0]", "expected a unit quaternion"),
        ("[1.0, 0.0, 0.0, 0.0]", "[1e308, 0.0, 0.0, 0.0]", "expected a unit quaternion"),
        ("-1.5", '"good"', "could not convert string to float"),
        ('"rotation": 0.25', '"rotation": "far"', "could not convert string to float"),
        ("{", "[" * 2000, "not JSON"),
    ],
    ids=lambda value: value[:20],
)
def test_grasp_documents(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert message in refusal("document", seed("document", old, new), tmp_path)


NEST = "&b0 [1, 1]"
for _level in range(1, 20):
    NEST = f"&b{_level} [{NEST}, *b{_level - 1}]"
DOUBLED = "k0: &k0 {a: 1}\n" + "".join(f"k{n}: &k{n} {{<<: [*k{n - 1}, *k{n - 1}]}}\n" for n in range(1, 40))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("resolution: 2001-99-99", "not valid YAML: line 1: ValueError"),
        ("resolution: 1" + 5000 * "0", "not valid YAML: line 1: ValueError"),
        ("resolution: 1" + 400 * "0", "is too large"),
        ("resolution: 0x" + 5000 * "f", "a huge int is too large"),
        ("problem: {friction: 1" + 400 * "0" + "}", "is too large"),
        ("problem: {friction: -1}", "-1.0 must be a finite number, zero or more"),
        ("[" * 1000, "not valid YAML: line 1: RecursionError"),
        ("resolution: " + NEST, "expected int, got [[[[...], [...]], [[...], [...]]], [["),
        ("resolution: !!timestamp x", "not valid YAML: line 1: AttributeError"),
        (DOUBLED, "a mapping of more than 10000 entries"),
    ],
    ids=lambda value: value[:24],
)
def test_presets(tmp_path: Path, text: str, message: str) -> None:
    assert message in refusal("preset", text.encode(), tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("effort: 1" + 400 * "0", "effort: expected positive numbers"),
        ("palm: {center: [1.0e+308, 0, 0], normal: [0, 0, 1]}", "palm.center: expected 3 numbers"),
        ("palm: {center: [0, 0, 0], normal: [1.0e+300, 1.0e+300, 0]}", "palm.normal: expected 3 numbers"),
        ("mount: {parent: a, position: [1" + 400 * "0" + ", 0, 0]}", "mount.position: expected 3 numbers"),
        ("mount: {parent: a, quaternion_wxyz: [1.0e+300, 0, 0, 0]}", "mount.quaternion_wxyz: expected 4 numbers"),
        ("effort: {? 0x" + 5000 * "f" + " : 1}", "no such joint"),
        ("open: " + NEST, "expected a mapping of keys to values, got [["),
        (DOUBLED, "a mapping of more than 10000 entries"),
    ],
    ids=lambda value: value[:24],
)
def test_hand_descriptions(tmp_path: Path, text: str, message: str) -> None:
    assert message in refusal("description", f"urdf: g.urdf\n{text}\n".encode(), tmp_path)


def test_an_effort_may_be_a_whole_number(tmp_path: Path) -> None:
    assert not fuzz.try_input(fuzz.TARGETS["description"], b"urdf: g.urdf\neffort: 1\n", tmp_path)


FOLLOWS = (
    '<joint name="f{n}" type="revolute"><parent link="{parent}"/><child link="f{n}"/><limit upper="1"/>{mimic}</joint>'
)


def test_a_chain_of_couplings_beyond_all_numbers(tmp_path: Path) -> None:
    text = ""
    for n, (parent, leader) in enumerate((("left", "one"), ("right", "f0"))):
        mimic = f'<mimic joint="{leader}" multiplier="1e200"/>'
        text += f'<link name="f{n}"/>' + FOLLOWS.format(n=n, parent=parent, mimic=mimic)
    told = refusal("urdf", seed("urdf", "</robot>", text + "</robot>"), tmp_path)
    assert "mimics 'one' with multiplier" in told


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("urdf", f"<robot>{'<a/>' * 20_001}</robot>", "more than 20000 elements"),
        ("urdf", "<robot " + " ".join(f'a{n}="1"' for n in range(201)) + "/>", "more than 200 attributes"),
        (
            "mjcf",
            f"<mujoco><default>{'<default/>' * 300}</default></mujoco>",
            "301 default classes; a hand has at most 300",
        ),
    ],
    ids=["elements", "attributes", "classes"],
)
def test_hand_files_that_would_take_gigabytes(tmp_path, name, text, message):
    assert message in refusal(name, text.encode(), tmp_path)


def test_limits_up_to_the_largest_float_are_none(tmp_path: Path) -> None:
    data = seed("urdf", 'lower="-0.5" upper="1"', 'lower="-1e308" upper="1e308"')
    assert not fuzz.try_input(fuzz.TARGETS["urdf"], data, tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<p>0 1 2<", "<p>0 1 99999999999999999999<", "too large"),
        ("4 3</vcount>", "-4 11</vcount>", "names vertices that the file does not hold"),
        ('1.0"?>', '1.0" encoding="no-such"?>', "unknown encoding"),
        (
            '<instance_geometry url="#g"/>',
            '<instance_geometry url="#g"/>' * 400,
            "more than 20000000 faces or vertices",
        ),
    ],
    ids=lambda value: value[:16],
)
def test_collada_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = seed("dae", old, new).decode()
    if "#g" in old:
        text = text.replace("0 0 3\n", "0 0 3\n" + "1 2 3 " * 60_000)
    assert message in refusal("dae", text.encode(), tmp_path)


def test_entities_are_refused_in_every_encoding(tmp_path: Path) -> None:
    text = seed("dae", '<?xml version="1.0"?>', '<!DOCTYPE x [<!ENTITY a "1">]>').decode()
    for encoding in ("utf-8", "utf-16"):
        assert "document type" in refusal("dae", text.encode(encoding), tmp_path)


def test_a_bag_that_gives_a_known_type_other_fields(tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.EMPTY)
    types.register(get_types_from_msg("int32 x", CLOUD))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/points", CLOUD, typestore=types)
        writer.write(connection, 5, bytes([0, 1, 0, 0, 9, 0, 0, 0]))
    with pytest.raises(BagError, match="a message on /points is broken"):
        list(read_frames(tmp_path / "bag"))


SIGNALLING = struct.pack("<I", 0x7FA00000)


@pytest.mark.parametrize("name", ["layout", "message", "cloud"])
def test_a_signalling_nan_is_a_nan_like_others(tmp_path: Path, name: str) -> None:
    data = fuzz.TARGETS[name].seeds()[0]
    at = data.index(struct.pack("<f", 0.01))
    assert not fuzz.try_input(fuzz.TARGETS[name], data[:at] + SIGNALLING + data[at + 4 :], tmp_path)


def test_a_rotation_with_a_signalling_nan_is_refused_like_others(tmp_path: Path) -> None:
    data = fuzz.TARGETS["message"].seeds()[3]
    at = data.index(struct.pack("<d", 1.0))
    spoilt = data[:at] + struct.pack("<Q", 0x7FF4000000000000) + data[at + 8 :]
    assert fuzz.try_input(fuzz.TARGETS["message"], spoilt, tmp_path) is None


def test_a_mano_file_tells_little_of_what_it_holds(tmp_path: Path) -> None:
    told = refusal("mano", b"F" * 10_000 + b"\n.", tmp_path)
    assert len(told) < 400
    whole: dict[str, Any] = pickle.loads(fuzz.TARGETS["mano"].seeds()[0])
    whole["weights"] = np.frombuffer(SIGNALLING * 256, np.float32).reshape(16, 16)
    assert "weights has entries that are not finite" in refusal("mano", pickle.dumps(whole, 2), tmp_path)


def test_what_is_shown_is_short() -> None:
    endless: list[object] = []
    endless.append(endless)
    values = (10**5000, "x" * 10**6, {n: [n] * 1000 for n in range(1000)}, endless, json.loads("[" * 500 + "]" * 500))
    assert max(len(short_repr(value)) for value in values) < 1000
