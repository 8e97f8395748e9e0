"""Study `piles`: what is drawn and dropped, a thing that gets cleared, and the report of made records."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd_bench.studies.piles import (
    BLOCKED,
    CLEARED,
    DROPPED,
    NO_GRASP,
    PileCase,
    drawn_objects,
    dropped_pile,
    film_strip,
    pile_cases,
    pile_sections,
    run_pile,
    seen_pile,
)
from graspd_bench.study import Request
from graspd_core.errors import ConfigError

SHAPES = ("shape:box", "shape:cylinder", "shape:l_block")


def scene(size: int, *objects: str) -> PileCase:
    return PileCase(objects or SHAPES, size, "fast", "allegro_right", 0)


def test_a_scene_is_a_number_of_things():
    assert [case.size for case in pile_cases(Request())] == [3, 5, 8, 12]
    assert [(c.size, c.seed) for c in pile_cases(Request(cases=("4",), seeds=(0, 7)))] == [(4, 0), (4, 7)]
    with pytest.raises(ConfigError, match="cases: 'many'; valid: a number of objects from 1 to 24"):
        pile_cases(Request(cases=("many",)))


def test_things_repeat_only_where_there_are_too_few():
    assert sorted(drawn_objects(scene(3))) == sorted(SHAPES)
    assert sorted(drawn_objects(scene(6))) == sorted(2 * SHAPES)


def test_every_point_that_is_seen_knows_its_thing():
    case = scene(3)
    bodies = dropped_pile(case)
    (view,), truth = seen_pile(case, bodies, 0)
    assert len(view.points) == len(truth)
    for number, body in enumerate(bodies):
        centre = body.pose[:3, :3] @ body.model.center_of_mass + body.pose[:3, 3]
        away = np.linalg.norm(view.points[truth == number] - centre, axis=1)
        # Jittered pixels take their depth from a neighbour.
        assert len(away) > 100
        assert np.median(away) < body.model.radius


def test_a_thing_alone_on_the_table_gets_cleared():
    record = run_pile(scene(1, "shape:box"))
    assert (record["cleared"], record["left"]) == (1, [])
    assert record["attempts"][-1]["ended"] == CLEARED
    assert not record["attempts"][-1]["merged"]
    # As the pile fell, and a lift each.
    assert len(record["frames"]) == 1 + record["lifts"]


@pytest.fixture
def attempts() -> Callable[..., list[dict[str, Any]]]:
    """Attempts by their endings; of two things where they say so."""

    def made(*endings: str, merged: bool = False) -> list[dict[str, Any]]:
        reason = {DROPPED: "the object moved 11.2 cm while lifting", NO_GRASP: "fails under 5 of 6: 7; other: 1"}
        lift = {"lift": {"firm": True}, "moved": 1, "along": []}
        return [
            {
                "thing": 0,
                "ended": ended,
                "reason": reason.get(ended, ""),
                "merged": merged,
                "scene_s": 1.0,
                "plan_s": 2.0,
            }
            | (lift if ended in (CLEARED, DROPPED, BLOCKED) else {})
            for ended in endings
        ]

    return made


def made_record(size: int, attempts: list[dict[str, Any]], left: list[str]) -> dict[str, Any]:
    frame = {"poses": {"0": np.eye(4)[:3].tolist()}, "hand": None}
    return {
        "objects": ["shape:box"], "size": size, "preset": "fast", "hand": "allegro_right", "seed": 0, "views": 1,
        "cleared": size - len(left), "left": left, "attempts": attempts, "look_s": [0.5], "frames": [frame],
    }  # fmt: skip


def test_the_report_counts_what_came_of_attempts(attempts, tmp_path: Path):
    good = made_record(3, attempts(CLEARED, CLEARED, CLEARED), [])
    bad = made_record(5, [*attempts(DROPPED, CLEARED), *attempts(NO_GRASP, merged=True)], ["box"] * 4)
    _, table, told, _, causes = pile_sections([good, bad], tmp_path / "bench")["piles"]
    assert (tmp_path / "piles.png").is_file()
    rows = str(table).splitlines()[2:]
    assert rows[0].startswith("| 3 | 3 of 3 | 1 of 1 | 3 | 0 | 0 | 0 | 0 | 0 |")
    assert rows[1].startswith("| 5 | 1 of 5 | 0 of 1 | 3 | 0 | 1 | 0 | 1 | 1 |")
    assert rows[2].startswith("| all | 4 of 8 | 1 of 2 | 6 | 0 | 1 | 0 | 1 | 1 |")
    assert rows[1].endswith("| 1/2 | 3.5 s | 6.0 s |")
    assert "4 of 5 where the segment was of one thing, 0 of 0 where two" in str(told)
    assert "| dropped | the object moved … cm while lifting | 1 | 0 |" in str(causes)
    assert "| no verified grasp | fails under … of … | 1 | 1 |" in str(causes)


def test_a_film_strip_shows_every_frame(attempts):
    record = made_record(1, attempts(CLEARED), [])
    one = film_strip(record)
    two = film_strip(record | {"frames": 2 * record["frames"]})
    assert two.shape == (one.shape[0], 2 * one.shape[1], 3)
    # The box is there: not all is table and background.
    assert len(np.unique(one.reshape(-1, 3), axis=0)) > 3
