"""A benchmark's page in a real browser: the points of the chart lead to their runs, and names do no harm."""

from __future__ import annotations

from pathlib import Path
from urllib.request import urlopen

import pytest

from graspd_core.bench.result_store import write_results
from graspd_core.cli import main
from graspd_core.errors import ConfigError, FormatError
from graspd_core.viewer.bench_page import save_bench_page, serve_page


def a_record(name: str, seconds: float, *, held: bool = True, thing: str = "box") -> dict:
    grasp = {
        "standard": {"passed": held, "reason": "" if held else "the object moved 5.1 cm"},
        "sd": {"displacement_cm": 0.2},
        "metrics": {"penetration": 1e-3, "contact_area": 2e-3},
    }
    return {
        "kind": "raw", "name": name, "method": "closed_form", "object": thing, "hand": "allegro_right", "seed": 3,
        "count": 1, "given": 1, "held": int(held), "error": "", "code": "0.1.0+abc", "machine": "2 cores",
        "cpu": {"scene": 1.0, "optimise": seconds, "standard": 0.1}, "peak_mb": 600.0, "grasps": [grasp],
    }  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    records = [
        a_record("fast", 1.0, held=False),
        a_record("balanced", 3.0),
        a_record("</script><b>x", 2.0, thing="a b"),
        {"study": "rgbd", "error": ""},  # of a study without raw grasps
    ]
    write_results(tmp_path / "results.json", records)
    return tmp_path


def test_a_point_leads_to_its_runs(folder, visit):
    page_file = folder / "page.html"
    assert main(["view", str(folder), "--html", str(page_file)]) == 0
    page = visit(page_file.as_uri())
    page.tab.locator("circle[data-name=fast]").first.click()
    page.text("box, seed 3: 0 of 1 held")
    page.tab.get_by_text("box, seed 3: 0 of 1 held").click()
    page.text("failed the object moved 5.1 cm")
    page.text("graspd synthesize shape:box --hand allegro_right --preset fast --seed 3 -n 1 --view")
    page.tab.locator("#time").select_option("CPU seconds per verified grasp")
    assert page.tab.locator("circle").count() == 6  # two panels of three; nothing of `fast` held in the first
    page.tab.locator("circle").last.click()
    page.tab.locator("h2").filter(has_text="</script><b>x").wait_for()
    page.tab.reload()
    page.tab.locator("h2").filter(has_text="</script><b>x").wait_for()


def test_the_page_is_served_and_nothing_else(folder):
    page_file = folder / "page.html"
    save_bench_page(folder, page_file)
    with serve_page(page_file, "127.0.0.1", 0) as url:
        whole = page_file.read_bytes()
        assert urlopen(url).read() == urlopen(f"{url}/../results.json").read() == whole
    assert b"http://" not in whole.replace(b"http://www.w3.org/2000/svg", b"")
    with pytest.raises(ConfigError, match=r"999\.0\.0\.1"), serve_page(page_file, "999.0.0.1", 0):
        pass


@pytest.mark.parametrize("records", [[], [{"kind": "raw"}], [{"study": "rgbd", "error": ""}]])
def test_results_that_hold_nothing_are_refused(tmp_path: Path, records: list):
    write_results(tmp_path / "results.json", records)
    with pytest.raises(FormatError, match=str(tmp_path)):
        save_bench_page(tmp_path, tmp_path / "page.html")
