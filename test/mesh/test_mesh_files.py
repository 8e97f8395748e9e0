"""Meshes: authored, read, refused, cut off, cleaned and measured."""

import dataclasses
import os
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from expected import refused
from hypothesis import given
from hypothesis import strategies as st
from made_meshes import box_of
from shape_volumes import shape_volume

from graspd_core import TriangleMesh, load_mesh, load_scene, save_mesh
from graspd_core.errors import MeshError
from graspd_core.mesh.collada import read_dae
from graspd_core.mesh.mesh_files import (
    check_mesh,
    content_hash,
    mass_properties,
    read_mesh,
    simplify,
    surface_samples,
    unit_advice,
)
from graspd_core.mesh.shapes import BOX_HALF, SHAPES, make_shape, object_hash
from graspd_core.mesh.topology import is_closed, is_oriented
from graspd_core.types import joined


def scaled(mesh, factor):
    return dataclasses.replace(mesh, vertices=mesh.vertices * factor)


@pytest.mark.parametrize("ending", ["obj", "stl", "ply", "glb", "off"])
def test_files_come_back_whole(tmp_path, ending):
    box = make_shape("box")
    save_mesh(tmp_path / f"box.{ending}", box)
    mesh, warnings = check_mesh(load_mesh(tmp_path / f"box.{ending}", scale=2.0), "box")
    assert warnings == ()
    assert len(mesh.faces) == len(box.faces)
    # Binary formats hold float32.
    assert mass_properties(mesh)[0] == pytest.approx(8 * shape_volume("box"), rel=1e-5)


def write(path, text):
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda d: d / "none.obj", "no such mesh file"),
        (lambda d: d, "is a directory"),
        (lambda d: write(d / "a.xyz", "0 0 0"), "unknown mesh ending '.xyz'; valid endings: dae, glb, obj"),
        (lambda d: write(d / "a.stl", "no mesh at all"), "a.stl"),
        (lambda d: write(d / "a.glb", "no mesh at all"), "not a readable glb"),
        (lambda d: write(d / "a.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "1 of 3 vertices are NaN"),
        (lambda d: write(d / "a.obj", "v inf 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "1 of 3 vertices are NaN"),
    ],
)
def test_bad_files_are_named(tmp_path, make, complaint):
    with refused(MeshError, complaint):
        load_mesh(make(tmp_path))


@pytest.mark.parametrize(
    ("factor", "complaint"),
    [
        (1000.0, r"90 m across.*scale 0.001 \(from mm\) makes it 90 mm$"),
        (100.0, r"9 m across.*scale 0.01 \(from cm\) makes it 90 mm, scale 0.0254 \(from inches\) makes it 229 mm"),
        (
            1 / 0.0254,
            r"3.543 m across.*scale 0.0254 \(from inches\) makes it 90 mm.*scale 0.01 \(from cm\) makes it 35.4 mm",
        ),
        (1e-3, "9e-05 m across.*scale 1000 makes it 90 mm"),
        (1e6, r"9e\+04 m across.*scale 1e-06 makes it 90 mm$"),
        (0.0, "0 m across.*all lie in one point"),
    ],
)
def test_wrong_units_are_guessed_and_not_applied(factor, complaint):
    with pytest.raises(MeshError, match=complaint):
        check_mesh(scaled(make_shape("box"), factor), "box.obj")


@pytest.mark.parametrize(
    ("size", "doubt"),
    [
        (0.005, "small for a hand; if the file is not in metres, scale 10 makes it 50 mm"),
        (
            0.9,
            "large for a hand; if the file is not in metres, scale 0.1 makes it 90 mm, "
            "scale 0.0254 (from inches) makes it 22.9 mm",
        ),
        (0.09, None),
        (0.45, None),
        (0.01, None),
    ],
)
def test_small_and_large_things_are_allowed_and_doubted(size, doubt):
    mesh, warnings = check_mesh(scaled(make_shape("box"), size / 0.09), "box")
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(size)
    assert [w.partition("across, ")[2] for w in warnings] == ([doubt] if doubt else [])


@pytest.mark.parametrize(
    ("scale", "size", "advice"),
    [
        (0.01, 0.9, "in another unit, scale 0.001 (from mm) makes it 90 mm"),
        (
            1e-3,
            0.005,
            "in another unit, scale 0.0254 (from inches) makes it 127 mm, scale 0.01 (from cm) makes it 50 mm, "
            "scale 0.1 makes it 500 mm",
        ),
        (10.0, 0.9, "in another unit, scale 1 makes it 90 mm"),
    ],
)
def test_advice_is_on_what_to_pass_in_place_of_what_was_passed(scale, size, advice):
    _, (doubt,) = check_mesh(scaled(make_shape("box"), size / 0.09), "box", scale=scale)
    assert doubt.partition("if the file is ")[2] == advice


@pytest.mark.parametrize(("size", "scale"), [(float("inf"), 1.0), (1e300, 1e-300), (5e-324, 1e10), (1e-9, 1e300)])
def test_advice_on_absurd_numbers_is_a_number_still(size, scale):
    assert re.fullmatch(r"scale 1e[+-]\d+ makes it [\d.]+ mm", unit_advice(size, scale))


def test_a_mesh_of_many_faces_is_made_smaller_first():
    mesh, warnings = check_mesh(make_shape("sphere"), "ball", 1000)
    assert len(mesh.faces) <= 1020
    assert warnings == ("ball: simplified from 5120 to 1000 faces",)
    assert is_closed(mesh)
    coarse = simplify(make_shape("sphere"), 600)
    assert len(coarse.faces) <= 620
    assert mass_properties(coarse)[0] == pytest.approx(shape_volume("sphere"), rel=0.03)


def test_faces_without_area_alone_or_beyond_the_vertices_are_refused():
    line = TriangleMesh(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.05, 0, 0]]), np.array([[0, 1, 2]]))
    with pytest.raises(MeshError, match="no face has an area"):
        check_mesh(line, "line")
    with pytest.raises(MeshError, match="outside 0 to 2"):
        check_mesh(TriangleMesh(np.eye(3), np.array([[0, 1, 3]])), "mesh")


@pytest.mark.parametrize("stray", [(3.0, 0, 0), (1e30, 0, 0), (np.nan,) * 3, (0, np.inf, 0)])
@pytest.mark.parametrize("use", ["", "f 515 515 515\n", "f 1 1 515\n"], ids=["unused", "point", "line"])
def test_a_stray_vertex_is_dropped_aloud_and_counts_nowhere(tmp_path, stray, use):
    box = make_shape("box")
    save_mesh(tmp_path / "box.obj", box)
    text = (tmp_path / "box.obj").read_text() + "v {} {} {}\n".format(*stray) + use
    from_file = load_scene(write(tmp_path / "box.obj", text), mass=0.1, resolution=16)
    faces = [[514, 514, 514]] if use.startswith("f 5") else [[0, 0, 514]] if use else np.zeros((0, 3), int)
    spoilt = TriangleMesh(np.vstack([box.vertices, stray]), np.vstack([box.faces, faces]))
    from_value = load_scene(spoilt, mass=0.1, resolution=16)
    for thing in (from_file.object, from_value.object):
        assert np.ptp(thing.mesh.vertices, axis=0) == pytest.approx(2 * np.array(BOX_HALF), abs=1e-7)
        assert thing.volume == pytest.approx(shape_volume("box"), rel=1e-6)
        told = ["dropped 1 stray vertices that no face uses", *["dropped 1 faces without area"] * bool(use)]
        assert [warning.partition(": ")[2] for warning in thing.warnings] == told


def test_doubled_and_degenerate_faces_go():
    box = make_shape("box")
    extra = np.vstack([box.faces, box.faces[:, ::-1], [[0, 0, 1]]])
    mesh, warnings = check_mesh(TriangleMesh(box.vertices, extra), "box")
    assert len(mesh.faces) == len(box.faces)
    assert any("without area" in w for w in warnings)
    assert any(f"{len(box.faces)} repeated" in w for w in warnings)


def test_soup_is_joined():
    box = make_shape("box")
    soup = TriangleMesh(box.vertices[box.faces].reshape(-1, 3), np.arange(3 * len(box.faces)).reshape(-1, 3))
    mesh, warnings = check_mesh(soup, "soup")
    assert len(mesh.vertices) == len(box.vertices)
    assert warnings == ()


@given(seed=st.integers(0, 1000))
def test_mixed_winding_is_made_consistent(seed):
    bowl = make_shape("bowl")
    flip = np.random.default_rng(seed).random(len(bowl.faces)) < 0.5
    mixed = np.where(flip[:, None], bowl.faces[:, ::-1], bowl.faces)
    mesh, warnings = check_mesh(TriangleMesh(bowl.vertices, mixed), "bowl")
    assert any("winding" in w for w in warnings)
    assert mass_properties(mesh)[0] == pytest.approx(mass_properties(bowl)[0], rel=1e-9)


@pytest.mark.parametrize("inside_out", [False, True])
def test_one_flipped_face_does_not_fill_a_cavity(inside_out):
    outer, inner = box_of(0.03), box_of(0.02)
    hollow = joined(outer, TriangleMesh(inner.vertices, inner.faces[:, ::-1]))
    faces = hollow.faces.copy()
    faces[0] = faces[0, ::-1]
    mesh, warnings = check_mesh(TriangleMesh(hollow.vertices, faces[:, ::-1] if inside_out else faces), "hollow")
    assert any("winding" in w for w in warnings)
    # The volume comes from sample points, with errors of about 1 %.
    assert mass_properties(mesh)[0] == pytest.approx(0.06**3 - 0.04**3, rel=0.02)


def test_mass_properties_of_a_box_are_the_closed_form():
    volume, center, inertia = mass_properties(make_shape("box"))
    squares = (2 * np.array(BOX_HALF)) ** 2
    assert volume == pytest.approx(shape_volume("box"))
    assert center == pytest.approx(np.zeros(3), abs=1e-12)
    # Box: I_x = m (b² + c²) / 12, and so on.
    assert inertia == pytest.approx(np.diag(volume * (squares.sum() - squares) / 12), abs=1e-12)


@pytest.mark.parametrize("change", ["invert", "open"])
def test_mass_properties_of_broken_boxes(change):
    box = make_shape("box")
    # A face of the 1024 missing: the winding number hardly notices.
    faces = box.faces[:, ::-1] if change == "invert" else box.faces[1:]
    volume, center, inertia = mass_properties(TriangleMesh(box.vertices, faces))
    exact = mass_properties(box)
    assert volume == pytest.approx(exact[0], rel=0.02)
    assert center == pytest.approx(exact[1], abs=1e-3)
    assert inertia == pytest.approx(exact[2], abs=0.05 * exact[2].max())


# The second has other diagonals below than above: its surface is closed, but encloses nothing.
@pytest.mark.parametrize("faces", [[[0, 1, 2], [0, 2, 3]], [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]])
def test_a_sheet_has_the_mass_properties_of_a_thin_box(faces):
    square = np.array([[0, 0, 0], [0.05, 0, 0], [0.05, 0.05, 0], [0, 0.05, 0]])
    volume, center, inertia = mass_properties(TriangleMesh(square, np.array(faces)))
    assert volume == pytest.approx(0.05 * 0.05 * 1e-3)
    assert center == pytest.approx([0.025, 0.025, 0], abs=1e-6)
    assert (np.linalg.eigvalsh(inertia) > 0).all()


def test_hash_tells_content_apart():
    box = make_shape("box")
    assert content_hash(box) == content_hash(make_shape("box"))
    assert content_hash(box) != content_hash(scaled(box, 1.0001))
    assert content_hash(box) != content_hash(TriangleMesh(box.vertices, box.faces[:, ::-1]))


@given(seed=st.integers(0, 2**31))
def test_samples_lie_on_the_surface_and_are_spread_by_area(seed):
    points, normals = surface_samples(make_shape("box"), 2000, seed)
    past = np.abs(points) / np.array(BOX_HALF)
    assert past.max(1) == pytest.approx(np.ones(2000), abs=1e-9)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(2000))
    # The two square ends are 2·60·60 of 2·60·60 + 4·60·90 mm²: a quarter.
    assert (past.argmax(1) == 2).mean() == pytest.approx(0.25, abs=0.01)


def test_a_tear_made_by_simplifying_is_not_blamed_on_the_mesh():
    # Boxes that touch along whole sides share edges of four faces: closed, and torn by the simplifier.
    row = joined(*(box_of(0.02, (0.04 * i, 0.0, 0.0)) for i in range(4)))
    mesh, warnings = check_mesh(row, "row", 600)
    assert not is_closed(mesh)
    assert warnings == ("row: simplified from 4096 to 600 faces",)


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_has_the_volume_of_its_formula_and_needs_no_cleaning(name):
    mesh = make_shape(name)
    # Chords lie inside arcs: 64 segments lose 0.2 % a curved direction; overlapping bodies are summed over points.
    near = 0.015 if name in ("mug", "hammer") else 0.006
    assert mass_properties(mesh)[0] == pytest.approx(shape_volume(name), rel=near)
    assert is_closed(mesh)
    assert is_oriented(mesh.faces)
    clean, warnings = check_mesh(mesh, name)
    assert warnings == ()
    assert len(clean.faces) == len(mesh.faces)
    # Its size suits a hand.
    assert 0.05 < np.ptp(mesh.vertices, axis=0).max() < 0.2
    assert np.abs((mesh.vertices.min(0) + mesh.vertices.max(0)) / 2).max() < 0.03


def test_another_file_of_the_same_size_and_time_in_its_place_has_another_hash(tmp_path: Path):
    path, other = tmp_path / "a.obj", tmp_path / "b.obj"
    path.write_text("v 0 0 0")
    other.write_text("v 1 0 0")
    for file in (path, other):
        os.utime(file, (0, 0))
    before = object_hash(str(path))
    other.replace(path)
    assert object_hash(str(path)) != before


def test_unknown_shape_lists_the_valid_ones():
    with pytest.raises(MeshError, match=r"teapot.*bottle, bowl, box"):
        make_shape("teapot")


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
PICTURES = {
    "a PNG picture": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + zlib.compress(bytes(64)),
    "a JPEG picture": b"\xff\xd8\xff\xe0\0\x10JFIF\0" + bytes(200),
    "a ZIP archive": b"PK\x03\x04" + bytes(300),
    "a page of HTML": b"\n<!DOCTYPE html><html><body>404</body></html>",
}


def is_refused(path: Path, data: bytes, told: str) -> None:
    """Reading this file is refused by this reason."""
    path.write_bytes(data)
    with refused(MeshError, told, start=f"{path}: "):
        load_mesh(path)


def saved(path: Path) -> bytes:
    save_mesh(path, make_shape("box"))
    return path.read_bytes()


@pytest.mark.parametrize("ending", ["obj", "stl", "ply", "off", "glb", "dae"])
def test_pointers_pictures_and_empty_files_are_called_that(tmp_path: Path, ending: str):
    path = tmp_path / f"mug.{ending}"
    is_refused(path, POINTER, "a git-LFS pointer to the mesh, not the mesh; `git lfs pull`")
    for what, data in PICTURES.items():
        is_refused(path, data, f"{what}, not a mesh")
    is_refused(path, b"", "the file is empty")


@pytest.mark.parametrize(
    ("ending", "length", "told"),
    [
        ("stl", 60, "cut off: 60 bytes, less than the header of an STL"),
        ("stl", 84, "cut off: 0 of 1024 triangles"),
        ("stl", -1, "cut off: 1023 of 1024 triangles"),
        ("ply", -100, "cut off"),
        ("glb", -100, "cut off"),
    ],
)
def test_a_binary_file_that_was_cut_off(tmp_path: Path, ending: str, length: int, told: str):
    path = tmp_path / f"box.{ending}"
    is_refused(path, saved(path)[:length], told)


def test_a_text_stl_that_was_cut_off(tmp_path: Path):
    path = tmp_path / "box.stl"
    facets = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n" * 100
    whole = f"solid box\n{facets}endsolid box\n".encode()
    path.write_bytes(whole)
    assert len(load_mesh(path).faces) == 100
    is_refused(path, whole[:5000], "cut off: it has no endsolid")


_ROWS = "0 0 0\n.05 0 0\n0 .05 0\n0 0 .05\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3"
_TEXT_PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
_TEXT_PLY += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"


@pytest.mark.parametrize(("ending", "head"), [("ply", _TEXT_PLY), ("off", "OFF # a comment\n4 4 6\n\n")])
@pytest.mark.parametrize(("cut", "left"), [(2, 7), (7, 7), (9, 6), (17, 5)])
def test_text_files_that_state_more_rows_than_they_have(tmp_path: Path, ending: str, head: str, cut: int, left: int):
    path = tmp_path / f"a.{ending}"
    path.write_text(head + _ROWS)
    assert len(load_mesh(path).faces) == 4
    is_refused(path, (head + _ROWS)[:-cut].encode(), f"cut off: {left} of 8 rows are there")


def test_faces_with_many_corners_are_named(tmp_path: Path):
    off = f"OFF\n4 5 0\n{_ROWS}\n5 0 1 2 3 0\n"
    is_refused(tmp_path / "a.off", off.encode(), "faces with more than four corners; triangulate them")


@pytest.mark.parametrize(
    ("last", "told"),
    [
        ("v 0.1 0.", "cut off: it ends in the middle of a line, 'v 0.1 0.'"),
        ("v 0 0 -", "cut off: it ends in the middle of a line, 'v 0 0 -'"),
        ("f 1 2", "cut off: it ends in the middle of a line, 'f 1 2'"),
        ("f 1 2 9\n", "a face names a vertex that the file does not hold"),
        ("", "3 vertices and no face: cut off before its faces, or not a mesh"),
    ],
)
def test_an_obj_that_was_cut_off(tmp_path: Path, last: str, told: str):
    is_refused(tmp_path / "a.obj", f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{last}".encode(), told)


def test_an_obj_cut_off_within_a_number_is_doubted_and_one_without_its_last_newline_is_not(tmp_path: Path):
    path = tmp_path / "box.obj"
    whole = saved(path).rstrip()
    path.write_bytes(whole)
    assert read_mesh(path)[1] == ()
    path.write_bytes(whole[: whole.rindex(b"f ", 0, -200)] + b"f 1 2 3")
    *_, warning = read_mesh(path)[1]
    assert "the last line has no line end and the surface is not closed: the file may be cut off" in warning


# A square of 2 x 2 and a triangle, in centimetres, in a node that is turned, moved and scaled within another.
FILE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="15">0 0 0 2 0 0 2 2 0 0 2 0 0 0 3</float_array>
<technique_common><accessor source="#a" count="5" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="2"><input semantic="NORMAL" source="#p" offset="1"/><input semantic="VERTEX" source="#v" offset="0"/>
<vcount>4 3</vcount><p>0 9 1 9 2 9 3 9 0 9 1 9 4 9</p></polylist>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><translate>1 0 0</translate><node>
<rotate>0 0 1 90</rotate><scale>1 1 -2</scale><instance_geometry url="#g"/></node></node></visual_scene>
</library_visual_scenes></COLLADA>"""


def test_nodes_units_and_polygons(tmp_path: Path) -> None:
    mesh = read_dae(write(tmp_path / "part.dae", FILE))
    expected = np.array([[1, 0, 0], [1, 2, 0], [-1, 2, 0], [-1, 0, 0], [1, 0, -6]]) * 0.01
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-15)
    # Three triangles, turned over because the scale mirrors.
    assert sorted(map(tuple, mesh.faces.tolist())) == [(2, 1, 0), (3, 2, 0), (4, 1, 0)]
    np.testing.assert_allclose(load_mesh(tmp_path / "part.dae").vertices, mesh.vertices)


def test_only_the_scene_that_is_shown_counts(tmp_path: Path) -> None:
    other = '<visual_scene id="t"><node><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>'
    text = FILE.replace("</library_visual_scenes>", other + '<scene><instance_visual_scene url="#t"/></scene>')
    vertices = read_dae(write(tmp_path / "part.dae", text)).vertices
    np.testing.assert_allclose(vertices.max(0), [0.02, 0.02, 0.03])
    assert len(vertices) == 5


def test_all_kinds_of_faces_say_the_same(tmp_path: Path) -> None:
    start, end = FILE.index("<vcount>"), FILE.index("</polylist>")
    polygons = FILE[:start] + "<p>0 9 1 9 2 9 3 9</p><p>0 9 1 9 4 9</p>" + FILE[end:]
    triangles = FILE[:start] + "<p>0 9 1 9 2 9 0 9 2 9 3 9 0 9 1 9 4 9</p>" + FILE[end:]
    strips = FILE[:start] + "<p>1 9 2 9 0 9 3 9</p><p>0 9 1 9 4 9</p>" + FILE[end:]
    for tag, text in (("polygons", polygons), ("trifans", polygons), ("triangles", triangles), ("tristrips", strips)):
        mesh = read_dae(write(tmp_path / "part.dae", text.replace("polylist", tag)))
        turned = [tuple(np.roll(face, 2 - int(np.argmin(face)))) for face in mesh.faces]
        assert sorted(turned) == [(2, 1, 0), (3, 2, 0), (4, 1, 0)]


@pytest.mark.parametrize(
    ("before", "beside"),
    [
        ("<library_geometries>", '<library_cameras><camera id="c"><optics/></camera></library_cameras>'),
        ("<library_geometries>", '<library_lights><light id="l"><technique_common/></light></library_lights>'),
        ("<library_geometries>", '<library_images><image id="i"/></library_images>'),
        ("<polylist", '<lines count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1</p></lines>'),
        ("<vcount>", '<input semantic="TEXCOORD" source="#gone" offset="1"/>'),
    ],
    ids=["camera", "light", "image", "lines", "texture"],
)
def test_what_is_no_surface_may_be_broken(tmp_path: Path, before: str, beside: str) -> None:
    """pycollada refuses each of these files, or drops the surface too where it is told to pass over what is broken."""
    whole = read_dae(write(tmp_path / "part.dae", FILE))
    mesh = read_dae(write(tmp_path / "part.dae", FILE.replace(before, beside + before, 1)))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], whole.vertices[whole.faces])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</COLLADA>", "", "not well-formed XML"),
        ("<COLLADA", "<!DOCTYPE x><COLLADA", "document type declaration"),
        ("#v", "#w", "refers to '#w', which is not in the file"),
        ("0 9 1 9 4 9", "0 9 1 9 7 9", "names vertices that the file does not hold"),
        ("<vcount>4 3", "<vcount>4 30", "names vertices that the file does not hold"),
        ("<vcount>4 3", "<vcount>1 2", "holds no triangles"),
        ('semantic="VERTEX"', 'semantic="COLOR"', "has no VERTEX input"),
        ("<node><translate>", '<node id="n"><instance_node url="#n"/><translate>', "a node contains itself"),
        ("</polylist>", "</polylist><polygons><ph><p>0</p><h>1</h></ph></polygons>", "a polygon with holes"),
        ("<visual_scene", "<visual_scene/><visual_scene", "the file has 2 visual scenes"),
        ("</COLLADA>", '<scene><instance_visual_scene url="#t"/></scene></COLLADA>', "refers to '#t'"),
    ],
)
def test_a_broken_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in FILE
    path = write(tmp_path / "part.dae", FILE.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        read_dae(path)
    with pytest.raises(MeshError, match=r"part.dae: not a readable dae mesh"):
        load_mesh(path)


def test_the_order_of_an_earlier_version_still_saves_with_a_warning(tmp_path: Path):
    with pytest.warns(DeprecationWarning, match="pass the path first"):
        save_mesh(make_shape("box"), tmp_path / "box.ply")
    assert len(load_mesh(tmp_path / "box.ply").faces) == len(make_shape("box").faces)
