"""A benchmark's page and the commands as a user starts them, in a real browser."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

from graspd_bench.measurement import Cell, run_cell
from graspd_bench.result_store import write_results
from graspd_bench.run_studies import Job, run_job
from graspd_core.cli import main
from graspd_core.errors import ConfigError, FormatError
from graspd_core.optimize.plan_config import load_preset
from graspd_viewer.bench_page import bench_page, plan_again, serve_page
from graspd_viewer.session import Session


def a_record(name: str, seconds: float, *, held: bool = True, thing: str = "box") -> dict:
    grasp = {
        "standard": {"passed": held, "reason": "" if held else "the object moved 5.1 cm"},
        "sd": {"displacement_cm": 0.2},
        "metrics": {"penetration": 1e-3, "contact_area": 2e-3},
    }
    return {
        "kind": "raw", "key": f"{name}-{thing}", "settings": {}, "name": name,
        "method": "closed_form", "object": thing, "hand": "allegro_right", "seed": 3,
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
    page.text("failed: the object moved 5.1 cm")
    page.text("This command plans and shows as many grasps that hold:")
    page.text("graspd synthesize shape:box --hand allegro_right --preset fast --seed 3 -n 1 --view")
    page.tab.locator("#time").select_option("CPU seconds per verified grasp")
    assert page.tab.locator("circle").count() == 6  # two panels of three; nothing of `fast` held in the first
    page.tab.locator("circle").last.click()
    page.tab.locator("h2").filter(has_text="</script><b>x").wait_for()
    page.tab.reload()
    page.tab.locator("h2").filter(has_text="</script><b>x").wait_for()


def test_the_grasps_of_a_run_are_those_that_were_measured(tmp_path: Path, viewer, visit):
    config = load_preset("fast")
    cell = Cell("raw", "fast", config, "shape:box", "parallel_gripper", 3, 4, ("standard",))
    record = run_job(Job("main", cell, run_cell, "0.1.0+abc"))
    write_results(tmp_path / "results.json", [record])
    html, runs = bench_page(tmp_path, served=True)
    shown: list[Session] = []

    def show(session: Session) -> None:
        shown.append(session)
        viewer.show(session)

    def open_run(key: str) -> int | None:
        if key in runs:
            viewer.run(lambda stop: plan_again(runs[key], show, viewer.say, stop))
        return viewer.port if key in runs else None

    with serve_page(html, "127.0.0.1", 0, open_run) as url:
        page = visit(url)
        page.tab.locator("circle[data-name=fast]").first.click()
        page.tab.locator("summary").click()
        with page.tab.expect_popup() as popup:
            page.press("Show these grasps")
        popup.value.get_by_text("fast, box, seed 3").first.wait_for()
        popup.value.get_by_text(f"{record['held']} of 4 held; {record['held']} held in the benchmark").first.wait_for()
        popup.value.get_by_text("#0 ").first.wait_for()
        popup.value.close()
    for grasp, measured in zip(shown[-1].grasps, record["grasps"], strict=True):
        assert 100 * grasp.trials[0].displacement == pytest.approx(measured["standard"]["displacement_cm"])
        assert grasp.metrics is not None
        assert grasp.metrics["epsilon"] == pytest.approx(measured["metrics"]["epsilon"])


def test_the_page_is_served_and_nothing_else(folder):
    asked: list[str] = []
    page, _ = bench_page(folder, served=True)
    with serve_page(page, "127.0.0.1", 0, lambda key: asked.append(key)) as url:
        assert urlopen(url).read() == urlopen(f"{url}/../results.json").read() == page.encode()
        for origin, status in ((url, 404), ("http://elsewhere.example", 403), ("null", 403)):
            with pytest.raises(HTTPError) as refused:
                urlopen(Request(f"{url}/run/none", data=b"", headers={"Origin": origin}))
            refused.value.close()
            assert refused.value.code == status
    assert asked == ["none"]
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
    with pytest.raises(ConfigError, match=r"999\.0\.0\.1"), serve_page(page, "999.0.0.1", 0, lambda _: None):
        pass


@pytest.mark.parametrize("records", [[], [{"kind": "raw"}], [{"study": "rgbd", "error": ""}]])
def test_results_that_hold_nothing_are_refused(tmp_path: Path, records: list):
    write_results(tmp_path / "results.json", records)
    with pytest.raises(FormatError, match=str(tmp_path)):
        bench_page(tmp_path)


Start = Callable[..., tuple[Any, str]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `graspd` and gives its process and the address that it prints."""
    started: list[Any] = []

    def run(*arguments: str) -> tuple[Any, str]:
        command = [sys.executable, "-m", "graspd_core.cli", *arguments, "--port", "0"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )
        started.append(process)
        assert process.stdout is not None
        line = next(line for line in process.stdout if "http://" in line)
        return process, next(word for word in line.split() if word.startswith("http://"))

    yield run
    for process in started:
        process.kill()
        process.communicate()


def test_a_run_is_watched_and_its_grasps_looked_at(start, visit, tmp_path: Path):
    out = tmp_path / "grasps.json"
    arguments = ("shape:box", "--hand", "parallel_gripper", "--preset", "fast", "-n", "2", "--out", str(out), "--view")
    process, url = start("synthesize", *arguments)
    page = visit(url)
    page.text("#0 verified")
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=60)
    assert process.returncode == 0, rest
    assert "2 of 2 grasps" in rest
    assert f"written: {out}; show it: graspd view {out}" in rest
    assert "Traceback" not in rest
    assert out.is_file()
    page.errors.clear()  # of the connection that is gone


def test_a_file_is_looked_at_until_ctrl_c(start, visit, grasps_file):
    process, url = start("view", str(grasps_file))
    page = visit(url)
    page.text("#0 verified")
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=60)
    assert process.returncode == 0, rest
    assert "Traceback" not in rest
    page.errors.clear()
