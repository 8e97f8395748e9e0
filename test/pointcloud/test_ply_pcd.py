"""Headers that writers in the field make, and that say less or more than the formats' papers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graspd_core.perception.cloud.cloud_files import load_views

POINTS = np.arange(6, dtype="<f4").reshape(2, 3)
_PLY = (
    "ply\nformat binary_little_endian 1.0\n{}element vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
)
_PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 2\nDATA binary\n"


def read(path: Path, head: str, body: bytes) -> list[list[float]]:
    path.write_bytes(head.encode() + body)
    (view,) = load_views(path)
    return view.points.tolist()


def test_a_comment_may_name_the_end_of_the_header(tmp_path):
    head = _PLY.format("comment up to end_header is text\n") + "end_header\n"
    assert read(tmp_path / "cloud.ply", head, POINTS.tobytes()) == POINTS.tolist()


def test_two_properties_may_have_one_name(tmp_path):
    head = _PLY.format("") + "property uchar quality\nproperty uchar quality\nend_header\n"
    body = b"".join(row.tobytes() + b"\0\1" for row in POINTS)
    assert read(tmp_path / "cloud.ply", head, body) == POINTS.tolist()


def test_width_and_height_say_how_many_points_there_are(tmp_path):
    assert read(tmp_path / "cloud.pcd", _PCD, POINTS.tobytes()) == POINTS.tolist()
