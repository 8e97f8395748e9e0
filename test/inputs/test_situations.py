"""Every situation of the table, by every way in that takes it: the scene that it shows, or a refusal by name."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from expected import refused
from situations import CLOUDS, DRIVERS, FILE_ONLY, MESHES, MESSAGES, SITUATIONS, Situation, camera_place, recorded

from graspd_core import GraspdError, Target, load_scene
from graspd_core.cli import main
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_OK, EXIT_TOO_FEW

FILES = {name: row for name, row in SITUATIONS.items() if name not in MESSAGES}
RECORDED = {name: row for name, row in SITUATIONS.items() if name not in FILE_ONLY | MESHES.keys()}
REFUSED = {name: row for name, row in FILES.items() if isinstance(row.expect, str)}
ANSWERED = {name: row for name, row in FILES.items() if name not in REFUSED}
FEW = ["-n", "1", "--preset", "fast", "--verify", "none"]


def arguments(row: Situation) -> dict[str, Any]:
    """The library's arguments that stand for the options of the command line."""
    target = row.options.get("target")
    return {**row.options, "target": None if target is None else Target(point=np.array(target))}


def words(row: Situation) -> list[str]:
    """The command line's options."""
    said = []
    for name, value in row.options.items():
        values = [] if value is True else list(value) if isinstance(value, tuple) else [value]
        said += [f"--{name}", *map(str, values)]
    return said


def test_the_table_says_where_most_situations_came_up():
    assert len(SITUATIONS) == sum(map(len, (CLOUDS, MESHES, DRIVERS, MESSAGES))) >= 63
    assert FILES.keys() > FILE_ONLY
    threads = [row.thread for row in SITUATIONS.values() if row.thread]
    assert len(threads) >= 50
    assert all(re.fullmatch(r"[\w.-]+/[\w.-]+#\d+", thread) for thread in threads)


@pytest.mark.parametrize("row", REFUSED.values(), ids=REFUSED)
def test_the_library_and_the_command_line_refuse_it_in_the_same_words(row: Situation, tmp_path: Path, refusal_of):
    path = row.make(tmp_path)
    with refused(GraspdError, match=str(row.expect)):
        load_scene(path, resolution=16, **arguments(row))
    assert re.search(str(row.expect), refusal_of("synthesize", path, *words(row)))


@pytest.mark.parametrize("row", ANSWERED.values(), ids=ANSWERED)
def test_the_library_makes_the_object_that_it_shows(row: Situation, tmp_path: Path):
    thing = load_scene(row.make(tmp_path), resolution=16, **arguments(row)).object
    assert thing.volume == pytest.approx(float(row.expect), rel=row.near)
    assert any(re.search(row.warns, warning) for warning in (*thing.warnings, "")), thing.warnings


@pytest.mark.slow
@pytest.mark.parametrize("row", ANSWERED.values(), ids=ANSWERED)
def test_the_command_line_answers_it_and_says_the_same(row: Situation, tmp_path: Path, capsys):
    assert main(["synthesize", str(row.make(tmp_path)), *FEW, *words(row)]) == EXIT_OK
    assert re.search(row.warns, capsys.readouterr().err)


@pytest.mark.parametrize("row", RECORDED.values(), ids=RECORDED)
def test_replay_of_a_recording_answers_the_same(row: Situation, tmp_path: Path, capsys):
    path = row.make(tmp_path)
    recording, place = recorded(path), camera_place(path)
    at = ["--view-point", *map(str, place)] if any(place) else []
    status = main(["replay", str(recording), *FEW, *words(row), *at])
    told = capsys.readouterr()
    if isinstance(row.expect, str):
        assert status in (EXIT_BAD_INPUT, EXIT_TOO_FEW)
        assert re.search(f"refused: .*(?:{row.expect})", told.out)
        return
    assert status == EXIT_OK
    (volume,) = re.findall(r"plausible mass for (\d+) cm³", told.err)
    assert 1e-6 * int(volume) == pytest.approx(row.expect, rel=row.near)
    assert re.search(row.warns, told.err)
