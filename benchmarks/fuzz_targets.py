"""Fuzzing targets: functions that call graspd's own parsers on a file.

A target returns a value or raises a documented error. Anything else is a finding: another exception, a warning, an
error of several lines, or a number that is not finite. benchmarks/fuzz.py calls the targets with mutated bytes, and
test/fuzz calls them with the inputs of earlier findings.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fuzz_seeds as seeds
import numpy as np

# Greatest length of an error message [characters]. In a longer message a user would not find the fault.
LONGEST = 2000


@dataclass(frozen=True)
class Target:
    """One parser to fuzz.

    Attributes:
        name: name of the target.
        run: reads the file with the input. Returns the value, or raises one of `refusals`.
        ending: ending of the file's name.
        seeds: returns valid inputs to begin with.
        refusals: errors that the parser's documentation names.
        words: words that the fuzzer inserts into inputs.
        most: length of the longest input [bytes].
    """

    name: str
    run: Callable[[Path], Any]
    ending: str
    seeds: Callable[[], list[bytes]]
    refusals: tuple[type[Exception], ...]
    words: tuple[str, ...] = ()
    most: int = 8192


def try_input(target: Target, data: bytes, folder: Path) -> str | None:
    """Return why the target refused the input, or None if it returned a value. Raise the error if it is a finding."""
    path = folder / f"input.{target.ending}"
    path.write_bytes(data)
    return outcome(lambda: target.run(path), *target.refusals)[1]


def outcome(run: Callable[[], Any], *refusals: type[Exception]) -> tuple[Any, str | None]:
    """Return (value, None) of a call, or (None, message) if the call raises one of `refusals`. Pass on other errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return run(), None
        except refusals as error:
            told = str(error)
            if "\n" in told or not told or len(told) > LONGEST:
                raise AssertionError(f"an error of {len(told)} letters: {told[:200]!r}") from error
            return None, told


def scratch() -> Any:
    """Return a temporary folder for inputs, in memory if the machine has /dev/shm."""
    return tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None)


def finite(*arrays: Any) -> None:
    """Raise AssertionError if a number is not finite."""
    for array in arrays:
        if not np.isfinite(np.asarray(array, dtype=float)).all():
            raise AssertionError(f"not finite: {array!r}"[:300])


def _hand(path: Path) -> Any:
    from graspd_core.hands.library import read_hand_file

    hand = read_hand_file(path)
    finite(hand.lower, hand.upper, hand.link_offset_rotation, hand.link_offset_translation, hand.joint_axis)
    finite(hand.link_mass, hand.link_com, hand.link_inertia, hand.link_multiplier, hand.link_shift)
    for part in hand.primitives:
        finite(part.rotation, part.translation, part.size)
    assert (hand.lower < hand.upper).all(), "limits the wrong way round"
    assert (hand.effort > 0).all(), "an effort of zero"
    return hand


@cache
def _gripper() -> Any:
    from graspd_core.hands.library import read_hand_file

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gripper.urdf"
        path.write_text(seeds.GRIPPER)
        return read_hand_file(path)


def _description(path: Path) -> Any:
    from graspd_core.hands.readers.description import apply_description, read_description

    hand = apply_description(_gripper(), read_description(path))
    finite(hand.palm_center, hand.palm_normal, hand.approach, hand.open_posture, hand.closed_posture)
    return hand


def _preset(path: Path) -> Any:
    from graspd_core.optimize.plan_config import load_preset

    return load_preset(str(path))


def _document(path: Path) -> Any:
    from graspd_core.io.grasps_json import grasps_of, load_document

    grasps = grasps_of(load_document(path))
    for grasp in grasps:
        for posture in (grasp.pregrasp, grasp.grasp, grasp.squeeze):
            assert posture.position.shape == (3,), posture
            assert posture.quaternion_wxyz.shape == (4,), posture
            finite(posture.position, posture.quaternion_wxyz, posture.joint_positions)
        finite(grasp.score, *(c.position for c in grasp.contacts), *(c.normal for c in grasp.contacts))
    return grasps


def _mano(path: Path) -> Any:
    from graspd_core.hands.mano.mano_file import read_mano

    return read_mano(path)


def _dae(path: Path) -> Any:
    from graspd_core.mesh.collada import read_dae

    mesh = read_dae(path)
    assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices), "faces name vertices that are not there"
    return mesh


def _cloud(path: Path) -> Any:
    from graspd_core.perception.cloud.cloud_files import is_cloud_file, load_views

    data = path.read_bytes()
    ending = next((e for mark, e in ((b"PK", "npz"), (b"ply", "ply"), (b"#", "pcd")) if data.startswith(mark)), "npy")
    named = path.rename(path.with_suffix(f".{ending}"))
    if not is_cloud_file(named):
        return None
    views = load_views(named)
    for view in views:
        finite(view.viewpoint, *(() if view.forward is None else (view.forward,)))
        assert view.points.ndim == 2, view.points.shape
    return views


def _layout(path: Path) -> Any:
    """Read points from a file with a `LAYOUT_HEAD` and the data of a PointCloud2."""
    from graspd_core.io.messages import points_from_message

    data = path.read_bytes().ljust(seeds.LAYOUT_HEAD.size, b"\0")
    width, height, point, row, big, *places = seeds.LAYOUT_HEAD.unpack_from(data)
    fields = [
        SimpleNamespace(name=name, offset=places[2 * i], datatype=places[2 * i + 1]) for i, name in enumerate("xyz")
    ]
    sizes = {"width": width, "height": height, "point_step": point, "row_step": row, "is_bigendian": bool(big & 1)}
    points = points_from_message(SimpleNamespace(data=data[seeds.LAYOUT_HEAD.size :], fields=fields, **sizes))
    assert 0 < len(points) <= width * height, f"{len(points)} points"
    finite(points)
    return points


def _bag(path: Path) -> Any:
    from graspd_core.errors import BagError, CloudError, TransformError
    from graspd_core.io.bags import bag_topics, read_frames, read_transforms

    named = path.rename(path.with_suffix(".db3" if path.read_bytes().startswith(b"SQLite") else ".mcap"))
    made: list[Any] = []
    for topic in [topic.name for topic in bag_topics(named)][:4]:
        try:
            for frame in read_frames(named, topic=topic, limit=4):
                made.append(frame.view())
        except (BagError, CloudError, TransformError) as error:
            made.append(error)
    made.append(read_transforms(named))
    return made


def _message(path: Path) -> Any:
    """Read a message in CDR. The first byte of the file selects one of four types."""
    from bag_writer import camera_info_message

    from graspd_core.errors import FormatError
    from graspd_core.io.bags import CLOUD, IMAGE, INFO, TRANSFORMS, jazzy_types
    from graspd_core.io.messages import ORIGIN, add_transforms, cloud_from_depth_message, no_lookup, stamp_of
    from graspd_core.perception.cloud.camera import PinholeCamera
    from graspd_core.transforms import TransformBuffer

    data = path.read_bytes() or b"\0"
    kind = (CLOUD, IMAGE, INFO, TRANSFORMS)[data[0] % 4]
    try:
        message = jazzy_types().deserialize_cdr(data[1:], kind)
    except Exception as error:  # rosbags rejects broken CDR, which is no fault of graspd
        raise FormatError("not a message") from error
    if kind == CLOUD:
        return ORIGIN.cloud(message, no_lookup)
    if kind == TRANSFORMS:
        return add_transforms(TransformBuffer(), message, static=False)
    stamp_of(message)
    camera = PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0)
    if kind == IMAGE:
        return cloud_from_depth_message(message, camera_info_message(camera, "c", 0))
    from bag_writer import depth_message

    image = depth_message(np.full((3, 4), 0.5), "c", 0)
    return cloud_from_depth_message(image, message), cloud_from_depth_message(image, message, rectified=True)


def _errors(*names: str) -> tuple[type[Exception], ...]:
    from graspd_core import errors

    return tuple(getattr(errors, name) for name in names)


_NUMBERS = ("nan", "inf", "-inf", "1e400", "1e308", "-1e308", "1e-320", "0", "-1", "99999999999999999999", "0x10")
_YAML = ("&a", "*a", "<<:", "!!binary", "!!set", "2001-99-99", "? ", "[[", "{")

TARGETS: dict[str, Target] = {
    target.name: target
    for target in (
        Target(
            "urdf", _hand, "urdf", lambda: seeds.URDFS, _errors("HandError"),
            (*_NUMBERS, "<mimic joint=", "<limit lower=", "continuous", "prismatic", "floating", "<mesh filename="),
        ),
        Target(
            "mjcf", _hand, "xml", lambda: seeds.MJCFS, _errors("HandError"),
            (*_NUMBERS, "polycoef=", "eulerseq=", "childclass=", "<freejoint/>", "quat=", "xyaxes=", "fromto="),
        ),
        Target(
            "description", _description, "yaml", lambda: seeds.DESCRIPTIONS, _errors("HandError"),
            (*_NUMBERS, *_YAML, "palm:", "!!timestamp", ".nan"),
        ),
        Target(
            "preset", _preset, "yaml", lambda: seeds.PRESETS, _errors("ConfigError"),
            (*_NUMBERS, *_YAML, "closed_form:", ".inf", "null"),
        ),
        Target(
            "document", _document, "json", lambda: seeds.DOCUMENTS, _errors("FormatError"),
            (*_NUMBERS, '"grasps"', '"hand"', "null", "true", "[[", '"mimic"', "NaN", '"verified"', '{"hold":'),
        ),
        Target(
            "mano", _mano, "pkl", seeds.pickles, _errors("HandError"),
            ("cnumpy\nndarray\n", "cnumpy\ndtype\n", "cchumpy.ch\nCh\n", "(", "tR", "}", "\x8a\xff", "\x8d", "2"),
            16384,
        ),
        Target(
            "dae", _dae, "dae", lambda: seeds.DAES, (ValueError,),
            (*_NUMBERS, "offset=", "stride=", "<vcount>", "<p>", "<instance_node url=", "<matrix>", "<rotate>"),
        ),
        Target(
            "cloud", _cloud, "npy", seeds.clouds, _errors("CloudError"),
            (*_NUMBERS, "POINTS ", "WIDTH ", "VIEWPOINT ", "DATA ascii", "element vertex ", "element face 1"),
        ),
        Target("layout", _layout, "bin", seeds.layouts, _errors("CloudError")),
        Target("message", _message, "bin", seeds.messages, _errors("CloudError", "TransformError", "FormatError")),
        Target("bag", _bag, "mcap", seeds.bags, _errors("BagError", "CloudError", "TransformError"), (), 65536),
    )
}  # fmt: skip
