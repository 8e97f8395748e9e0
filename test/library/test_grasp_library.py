"""The file: what goes in comes out, from another process, after a kill, while somebody writes; and what is refused."""

from __future__ import annotations

import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd_core import GraspResult, HandModel, Scene, load_hand, load_preset, load_scene
from graspd_core.errors import FormatError
from graspd_core.library.grasp_library import GraspLibrary, LibraryEntry, entry_of, hand_hash
from graspd_core.types import Grasp, Verdict

# Adds records without end, and says the number of each once it is in.
WRITER = """
import sys
from dataclasses import replace
from pathlib import Path
from graspd_core import load_hand, load_preset, load_scene
from graspd_core.library.grasp_library import GraspLibrary

library = GraspLibrary(Path(sys.argv[1]))
((entry, _),) = library.entries()
hand, target, config = load_hand("allegro_right"), load_scene("shape:sphere").object, load_preset("fast")
grasps = library.grasps(entry, hand)
for number in range(10**9):
    other = replace(entry, name=f"record{number}", mesh_sha256=f"{number:064}")
    library.add(other, target, hand, config, grasps)
    print(number, flush=True)
"""


def stored(library: GraspLibrary, hand: HandModel) -> tuple[LibraryEntry, tuple[Grasp, ...]]:
    ((entry, count),) = library.entries()
    grasps = library.grasps(entry, hand)
    assert len(grasps) == count
    return entry, grasps


def same(a: Grasp, b: Grasp) -> bool:
    postures = [(getattr(a, stage), getattr(b, stage)) for stage in ("pregrasp", "grasp", "squeeze")]
    near = all(
        np.allclose(getattr(p, part), getattr(q, part))
        for p, q in postures
        for part in ("position", "quaternion_wxyz", "joint_positions")
    )
    return near and a.contacts == b.contacts and a.trials == b.trials


def test_grasps_come_back_as_they_were_put_in(library: GraspLibrary, planned: GraspResult, hand: HandModel):
    entry, grasps = stored(library, hand)
    assert (entry.name, entry.source, entry.hand, entry.verify) == ("sphere", "shape:sphere", hand.name, "standard")
    good = [grasp for grasp in planned.grasps if grasp.verdict is Verdict.VERIFIED]
    assert len(grasps) == len(good) == 4
    assert all(map(same, grasps, good))


def test_what_is_added_stands_behind_what_was_there(library: GraspLibrary, planned: GraspResult, scene, hand):
    entry, before = stored(library, hand)
    bad = replace(planned.grasps[0], trials=())
    assert library.add(entry, scene.object, hand, load_preset("fast"), [planned.grasps[1], bad]) == 5
    _, after = stored(library, hand)
    assert all(map(same, after, (*before, before[1])))


def test_a_key_is_the_content_of_object_hand_and_physics(scene: Scene, hand: HandModel):
    entry = entry_of(scene.object, hand, "standard")
    others = [
        entry_of(load_scene("shape:sphere", scale=1.1).object, hand, "standard"),
        entry_of(load_scene("shape:sphere", mass=0.2).object, hand, "standard"),
        entry_of(load_scene("shape:sphere", friction=0.5).object, hand, "standard"),
        entry_of(scene.object, hand, "hard"),
        entry_of(scene.object, replace(hand, effort=hand.effort * 2), "standard"),
        entry_of(load_scene("shape:box").object, hand, "standard"),
    ]
    assert len({entry.key, *(other.key for other in others)}) == 7
    assert replace(entry, name="ball", source="", hand="other").key == entry.key


def test_a_prefix_of_names_is_no_other_hand(library: GraspLibrary, hand: HandModel):
    prefixed = load_hand("allegro_right", prefix="left_", candidates=10)
    assert hand_hash(prefixed) == hand_hash(hand)
    _, grasps = stored(library, prefixed)
    assert {contact.link for grasp in grasps for contact in grasp.contacts} <= set(prefixed.link_names)


def test_a_changed_file_takes_the_place_of_what_it_was(library: GraspLibrary, scene, hand, planned, tmp_path: Path):
    entry = replace(entry_of(scene.object, hand, "standard"), source=str(tmp_path / "ball.obj"), file_sha256="old")
    config = load_preset("fast")
    for content in ("old", "new"):
        changed = replace(entry, file_sha256=content, mesh_sha256=content)
        library.add(changed, scene.object, hand, config, planned.grasps)
    assert [found.mesh_sha256 for found, _ in library.entries(source=entry.source)] == ["new"]


@pytest.mark.timeout(300)
def test_a_kill_during_writes_loses_no_record_that_was_in(library: GraspLibrary, hand: HandModel):
    entry, grasps = stored(library, hand)
    for _ in range(3):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(library.path)], stdout=subprocess.PIPE, text=True)
        assert writer.stdout is not None
        said = [int(writer.stdout.readline()) for _ in range(5)]
        # While it writes, whoever reads sees whole records.
        whole = [other for other, _ in library.entries() if other.name != "sphere"]
        assert len(whole) >= 5
        assert same(library.grasps(whole[-1], hand)[0], grasps[0])
        writer.send_signal(signal.SIGKILL)
        said += [int(line) for line in writer.stdout.read().split()]
        writer.wait()
        writer.stdout.close()
        found = {other.name for other, _ in library.checked().entries()}
        assert {f"record{number}" for number in said} <= found
        # The next writer adds under other names; the first entry is the only one that it looks for.
        with sqlite3.connect(library.path) as base:
            base.execute("DELETE FROM records WHERE name != 'sphere'")
        base.close()
    assert same(library.grasps(entry, hand)[0], grasps[0])


def test_a_reader_does_not_wait_for_a_writer(library: GraspLibrary, hand: HandModel):
    base = sqlite3.connect(library.path, isolation_level=None)
    base.execute("BEGIN IMMEDIATE")
    base.execute("UPDATE records SET name = 'other'")
    began = time.thread_time()
    entry, grasps = stored(library, hand)
    assert entry.name == "sphere"
    assert len(grasps) == 4
    assert time.thread_time() - began < 5
    base.execute("COMMIT")
    base.close()
    assert library.names() == ["other"]


def test_a_library_that_nobody_may_write_is_read(library: GraspLibrary, hand, tmp_path: Path, monkeypatch):
    copy = tmp_path / "still" / "known.grasps"
    copy.parent.mkdir()
    copy.write_bytes(library.path.read_bytes())
    # As it is on a medium that cannot be written; the tests may run as one who may write anywhere.
    monkeypatch.setattr(os, "access", lambda *_: False)
    connected = []
    real = sqlite3.connect

    def connect(address: str, **named):
        connected.append(address)
        return real(address, **named)

    monkeypatch.setattr(sqlite3, "connect", connect)
    assert len(stored(GraspLibrary(copy), hand)[1]) == 4
    assert all(address.endswith("mode=ro&immutable=1") for address in connected)
    assert list(copy.parent.iterdir()) == [copy]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda path: path.unlink(), "no such file; `graspd library build --out"),
        (lambda path: path.write_bytes(b""), "no library of grasps"),
        (lambda path: path.write_text("grasps: none\n" * 500), "torn or no library"),
        (lambda path: os.truncate(path, path.stat().st_size // 2), "torn or no library"),
        (lambda path: _scribble(path), "torn or no library"),
        (lambda path: _sql(path, "PRAGMA user_version = 7"), "a library of version 7, this graspd reads version 1"),
        (lambda path: _sql(path, "PRAGMA application_id = 7"), "no library of grasps"),
    ],
)
def test_what_is_no_whole_library_of_this_version_is_told_in_one_line(library: GraspLibrary, spoil, told: str):
    spoil(library.path)
    with pytest.raises(FormatError, match=re.escape(told)) as error:
        library.checked()
    assert str(library.path) in str(error.value)
    assert "graspd library build" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_record_that_was_spoilt_is_named(library: GraspLibrary, hand: HandModel):
    entry, _ = stored(library, hand)
    _sql(library.path, "UPDATE records SET document = substr(document, 1, 100)")
    with pytest.raises(FormatError, match=r"known\.grasps: torn .*record sphere for allegro"):
        library.grasps(entry, hand)


def _sql(path: Path, command: str) -> None:
    with sqlite3.connect(path) as base:
        base.execute(command)
    base.close()


def _scribble(path: Path) -> None:
    """Other bytes where the tree of the records begins."""
    content = bytearray(path.read_bytes())
    content[4096 : 4096 + 200] = b"\xa5" * 200
    path.write_bytes(bytes(content))
