"""Things with their masses: what names stand for, and what is refused of a folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd_bench.rendering.families import draw_object
from graspd_cell.things import SHAPE_DENSITY, family_sources, find_sources, load_thing
from graspd_core.errors import ConfigError
from graspd_core.mesh.mesh_files import save_mesh
from graspd_core.mesh.shapes import make_shape


def test_a_drawn_thing_weighs_what_it_was_drawn_with():
    (source,) = find_sources(["family:pear:3"])
    thing = load_thing(source)
    assert (source.name, thing.name) == ("pear 3", "pear 3")
    assert thing.model.mass == draw_object("pear", 3).mass
    assert len(thing.parts) >= 1
    assert len(thing.seen.faces) <= 2000
    assert [s.name for s in family_sources((1, 2), ("jar", "pan"))] == ["jar 1", "pan 1", "jar 2", "pan 2"]


def test_a_shape_has_a_density():
    thing = load_thing(find_sources(["shape:box"])[0])
    assert thing.model.mass == pytest.approx(SHAPE_DENSITY * thing.model.volume)


def test_a_folder_of_meshes_needs_a_csv_of_masses(tmp_path: Path):
    for name in ("one", "two"):
        save_mesh(tmp_path / f"{name}.obj", make_shape("sphere"))
    with pytest.raises(ConfigError, match=r"no mass of one\.obj; its csv files name none; columns: name, mass_kg"):
        find_sources([str(tmp_path)])
    (tmp_path / "masses.csv").write_text("name,mass_kg,colour\none,0.3,red\ntwo.obj,0.5,blue\n")
    things = [load_thing(source) for source in find_sources([str(tmp_path)])]
    assert {thing.name: thing.model.mass for thing in things} == {"one": 0.3, "two": 0.5}
    for mass, told in (("heavy", "'heavy'; valid: a number"), ("-1", "-1; valid: more"), ("nan", "nan; valid: more")):
        (tmp_path / "masses.csv").write_text(f"name,mass_kg\none,{mass}\n")
        with pytest.raises(ConfigError, match=f"the mass of 'one' is {told}"):
            find_sources([str(tmp_path)])
    # Spreadsheets write a byte order mark.
    (tmp_path / "masses.csv").write_text("name,mass_kg\none,0.3\ntwo,0.5\n", encoding="utf-8-sig")
    assert [source.mass for source in find_sources([str(tmp_path)])] == [0.3, 0.5]
    for broken in (b"name,mass_kg\ncaf\xe9,0.3\n", b"name,mass_kg\n" + b"a" * 200_000):
        (tmp_path / "masses.csv").write_bytes(broken)
        with pytest.raises(ConfigError, match=r"masses\.csv: cannot be read: .*; valid: text with columns name"):
            find_sources([str(tmp_path)])


@pytest.mark.parametrize(
    "name", ["shape:what", "family:unicorn", "family:pear:x", "family:pear:x1", "family:pear:-1", "nowhere"]
)
def test_an_unknown_thing_is_named(name: str):
    with pytest.raises(ConfigError, match=f"unknown thing '{name}'; valid: a folder of meshes, shape:NAME, or family"):
        find_sources([name])
