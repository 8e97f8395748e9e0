"""Files that hold no mesh, or half of one, are called what they are."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest

from graspd_core.errors import MeshError
from graspd_core.mesh.mesh_files import load_mesh, read_mesh, save_mesh
from graspd_core.mesh.shapes import make_shape

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
PICTURES = {
    "a PNG picture": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + zlib.compress(bytes(64)),
    "a JPEG picture": b"\xff\xd8\xff\xe0\0\x10JFIF\0" + bytes(200),
    "a ZIP archive": b"PK\x03\x04" + bytes(300),
    "a page of HTML": b"\n<!DOCTYPE html><html><body>404</body></html>",
}


def refusal(path: Path, data: bytes) -> str:
    path.write_bytes(data)
    with pytest.raises(MeshError) as caught:
        load_mesh(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def saved(path: Path) -> bytes:
    save_mesh(make_shape("box"), path)
    return path.read_bytes()


@pytest.mark.parametrize("ending", ["obj", "stl", "ply", "off", "glb", "dae"])
def test_pointers_pictures_and_empty_files_are_called_that(tmp_path: Path, ending: str):
    path = tmp_path / f"mug.{ending}"
    assert "a git-LFS pointer to the mesh, not the mesh; `git lfs pull`" in refusal(path, POINTER)
    for what, data in PICTURES.items():
        assert f"{what}, not a mesh" in refusal(path, data)
    assert "an empty file" in refusal(path, b"")


@pytest.mark.parametrize(
    ("length", "told"),
    [(60, "60 bytes, less than the header of an STL"), (84, "0 of 1024 triangles"), (-1, "1023 of 1024 triangles")],
)
def test_a_binary_stl_that_was_cut_off(tmp_path: Path, length: int, told: str):
    path = tmp_path / "box.stl"
    assert f"cut off: {told}" in refusal(path, saved(path)[:length])


def test_a_text_stl_that_was_cut_off(tmp_path: Path):
    path = tmp_path / "box.stl"
    facets = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n" * 100
    whole = f"solid box\n{facets}endsolid box\n".encode()
    path.write_bytes(whole)
    assert len(load_mesh(path).faces) == 100
    assert "cut off: it has no endsolid" in refusal(path, whole[:5000])


@pytest.mark.parametrize("ending", ["ply", "glb"])
def test_other_binary_files_that_were_cut_off(tmp_path: Path, ending: str):
    path = tmp_path / f"box.{ending}"
    assert "cut off" in refusal(path, saved(path)[:-100])


@pytest.mark.parametrize(
    ("last", "told"),
    [
        ("v 0.1 0.", "cut off: it ends in the middle of a line, 'v 0.1 0.'"),
        ("v 0 0 -", "cut off: it ends in the middle of a line, 'v 0 0 -'"),
        ("f 1 2", "cut off: it ends in the middle of a line, 'f 1 2'"),
        ("f 1 2 9\n", "a face names a vertex that the file does not hold"),
        ("", "3 vertices and no face: cut off before them, or no mesh"),
    ],
)
def test_an_obj_that_was_cut_off(tmp_path: Path, last: str, told: str):
    assert told in refusal(tmp_path / "a.obj", f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{last}".encode())


def test_an_obj_cut_off_within_a_number_is_doubted_and_one_without_its_last_newline_is_not(tmp_path: Path):
    path = tmp_path / "box.obj"
    whole = saved(path).rstrip()
    path.write_bytes(whole)
    assert read_mesh(path)[1] == ()
    path.write_bytes(whole[: whole.rindex(b"f ", 0, -200)] + b"f 1 2 3")
    *_, warning = read_mesh(path)[1]
    assert "the last line has no end and the surface is not closed: the file may be cut off" in warning
