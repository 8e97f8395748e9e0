"""COLLADA surfaces against the coordinates that they were written with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import MeshError
from graspd_core.mesh.collada import read_dae
from graspd_core.mesh.mesh_files import load_mesh

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


def _write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "part.dae"
    path.write_text(text)
    return path


def test_nodes_units_and_polygons(tmp_path: Path) -> None:
    mesh = read_dae(_write(tmp_path, FILE))
    expected = np.array([[1, 0, 0], [1, 2, 0], [-1, 2, 0], [-1, 0, 0], [1, 0, -6]]) * 0.01
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-15)
    # Three triangles, turned over because the scale mirrors.
    assert sorted(map(tuple, mesh.faces.tolist())) == [(2, 1, 0), (3, 2, 0), (4, 1, 0)]
    np.testing.assert_allclose(load_mesh(tmp_path / "part.dae").vertices, mesh.vertices)


def test_all_kinds_of_faces_say_the_same(tmp_path: Path) -> None:
    start, end = FILE.index("<vcount>"), FILE.index("</polylist>")
    polygons = FILE[:start] + "<p>0 9 1 9 2 9 3 9</p><p>0 9 1 9 4 9</p>" + FILE[end:]
    triangles = FILE[:start] + "<p>0 9 1 9 2 9 0 9 2 9 3 9 0 9 1 9 4 9</p>" + FILE[end:]
    strips = FILE[:start] + "<p>1 9 2 9 0 9 3 9</p><p>0 9 1 9 4 9</p>" + FILE[end:]
    for tag, text in (("polygons", polygons), ("trifans", polygons), ("triangles", triangles), ("tristrips", strips)):
        mesh = read_dae(_write(tmp_path, text.replace("polylist", tag)))
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
    whole = read_dae(_write(tmp_path, FILE))
    mesh = read_dae(_write(tmp_path, FILE.replace(before, beside + before, 1)))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], whole.vertices[whole.faces])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</COLLADA>", "", "not well-formed XML"),
        ("<COLLADA", "<!DOCTYPE x><COLLADA", "document type declaration"),
        ("#v", "#w", "refers to '#w', which is not in the file"),
        ("0 9 1 9 4 9", "0 9 1 9 7 9", "names vertices that are not there"),
        ("<vcount>4 3", "<vcount>4 30", "names vertices that are not there"),
        ("<vcount>4 3", "<vcount>1 2", "holds no triangles"),
        ('semantic="VERTEX"', 'semantic="COLOR"', "has no VERTEX input"),
        ("<node><translate>", '<node id="n"><instance_node url="#n"/><translate>', "nodes in a circle"),
    ],
)
def test_a_broken_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in FILE
    path = _write(tmp_path, FILE.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        read_dae(path)
    with pytest.raises(MeshError, match=r"part.dae: not a readable dae mesh"):
        load_mesh(path)
