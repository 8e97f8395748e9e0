"""What the documents show is true.

Pages build, their Python runs, their commands parse, their links lead somewhere, and the examples do what they say.
"""

import importlib
import json
import math
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import graspd_core
from graspd_core.cli import build_parser
from graspd_core.optimize import plan_config
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.optimize.graspd2022.graspd2022_config import Graspd2022Config
from graspd_core.optimize.plan_config import load_preset
from graspd_core.verify.early_stop import CREEPING

ROOT = Path(__file__).parents[1]


def test_the_pages_build_without_a_warning(tmp_path: Path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "api.html").read_text()
    assert "Plan grasps and try them in rank order" in page
    # Nothing is loaded from elsewhere when a page is shown.
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=\"https?:", page)


def test_the_reference_lists_every_public_name_once():
    listed = re.findall(r"^::: graspd_core\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert sorted({*listed} - {"errors"}) == graspd_core.__all__
    assert len(listed) == len({*listed})


README = (ROOT / "README.md").read_text()
USAGE = (ROOT / "docs" / "usage.md").read_text()
PAGES = sorted(str(page.relative_to(ROOT)) for page in ROOT.glob("docs/**/*.md"))
DOCUMENTS = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", *PAGES]


@pytest.mark.parametrize("page", [README, USAGE], ids=["README", "usage"])
def test_the_python_runs(page: str, capsys: pytest.CaptureFixture[str]):
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "page", "exec"), {})
    assert capsys.readouterr().out.count("verified") == 2


@pytest.mark.parametrize(("page", "least"), [("usage", 12), ("hands", 2)])
def test_the_commands_of_the_pages_parse(page: str, least: int):
    text = (ROOT / "docs" / f"{page}.md").read_text()
    lines = [line.split("#")[0].strip() for line in text.splitlines() if line.startswith("    graspd ")]
    assert len(lines) >= least
    for line in lines:
        build_parser().parse_args(shlex.split(line)[1:])


@pytest.mark.parametrize("name", DOCUMENTS)
def test_links_lead_to_files(name: str):
    document = ROOT / name
    targets = re.findall(r"\]\(((?!https?:)[^)#]+)", document.read_text())
    missing = [target for target in targets if not (document.parent / target).exists()]
    assert not missing


def test_the_numbers_of_the_pages_are_those_of_the_code():
    method, metrics = ((ROOT / "docs" / f"{page}.md").read_text() for page in ("method", "metrics"))
    settings, published = ClosedFormConfig(), Graspd2022Config()
    names = {"task": "wrench_resistance", "self-collision": "self_collision"}
    for title in ("task", "distance", "penetration", "self-collision", "posture", "obstacle"):
        name = names.get(title, title)
        weights = (f"{getattr(part, name):g}" for part in (settings.weights, settings.polish_weights))
        assert re.search(rf"^\| {title} \|.*\| {', '.join(weights)} \|$", method, re.MULTILINE), title
    task, limit, weights = published.constraints.task_bound, published.constraints.limit_bound, published.weights
    assert f"L_task < C_task = {task:g},  L_limit < C_limit = {limit:g} rad" in method
    assert f"min {weights.physics:g} L_phys + {weights.range:g} L_range + L_inter " in method
    rest = f"{CREEPING.speed * 1e3:g} mm/s, {math.degrees(CREEPING.spin):.1f}°/s"
    assert f"| at rest below | not asked | {rest} |" in metrics


def test_presets_named_in_the_documents_exist(tmp_path: Path):
    named = re.search(r"preset \(([a-z, ]+), or", USAGE).group(1).split(", ")  # pyright: ignore[reportOptionalMemberAccess]
    table = README.split("<!-- bench:begin -->")[1].split("<!-- bench:end -->")[0]
    for name in [*named, *re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)]:
        load_preset(name)
    (own,) = re.findall(r"```yaml\n(.*?)```", USAGE, re.DOTALL)
    (tmp_path / "own.yaml").write_text(own)
    assert load_preset(str(tmp_path / "own.yaml")) != load_preset("balanced")


EXAMPLES = Path(__file__).parents[1] / "examples"

# Runs `main` of an example with arguments, in a directory of its own.
Run = Callable[..., int]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return lambda name, *arguments, **named: importlib.import_module(name).main(arguments, **named)


def test_a_mesh(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    graspd_core.save_mesh(tmp_path / "box.obj", graspd_core.make_shape("box"))
    assert run("grasp_a_mesh", "box.obj", "box.json") == 0
    assert "links touch" in capsys.readouterr().out
    assert graspd_core.load_grasps(tmp_path / "box.json")[0].verdict == "verified"


def test_a_cloud(run: Run, capsys: pytest.CaptureFixture[str]):
    assert run("grasp_a_cloud") == 0
    assert "held ['hold', 'lift', 'hypotheses']" in capsys.readouterr().out


def test_your_own_hand(run: Run, capsys: pytest.CaptureFixture[str]):
    assert run("your_own_hand") == 0
    assert "claw: 6 joints" in capsys.readouterr().out


def test_loss_weights(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "mine.yaml").write_text("closed_form: {weights: {distance: 2.0}}\n")
    assert run("loss_weights", "shape:box", "mine.yaml") == 0
    out = capsys.readouterr().out
    assert "unknown key 'speed'" in out
    assert [line.split()[0] for line in out.splitlines()[-3:]] == ["fast", "gentle", "yours"]


def test_your_own_metric(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # The row that the example adds is for this test only.
    monkeypatch.setitem(graspd_core.METRICS, "contact_offset", None)
    assert run("your_own_metric", "shape:box") == 0
    best = json.loads((tmp_path / "grasps.json").read_text())["grasps"][0]
    assert 0 < best["metrics"]["contact_offset_mm"] < 100


def test_your_own_metric_is_a_plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    plugin = str(EXAMPLES / "your_own_metric.py")
    done = graspd(tmp_path, "synthesize", "shape:box", "--plugin", plugin, "-n", "1", "--out", "g.json")
    assert done.returncode == 0, done.stderr
    assert "contact_offset_mm" in json.loads((tmp_path / "g.json").read_text())["grasps"][0]["metrics"]
    monkeypatch.setenv("GRASPD_PLUGINS", plugin)
    assert "contact_offset " in graspd(tmp_path, "metrics").stdout


PLUGIN = ("--plugin", str(EXAMPLES / "your_own_method.py"))


def graspd(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "graspd_core.cli", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


def test_your_own_method_plans(tmp_path: Path):
    done = graspd(tmp_path, "synthesize", "shape:box", *PLUGIN, "--method", "draws", "-n", "1", "--out", "g.json")
    assert done.returncode == 0, done.stderr
    document = json.loads((tmp_path / "g.json").read_text())
    assert (document["method"], document["grasps"][0]["verdict"]) == ("draws", "verified")


def test_your_own_method_is_measured_in_the_processes_of_the_benchmark(tmp_path: Path):
    (tmp_path / "mine.yaml").write_text("method: draws\ndraws: {per_grasp: 8}\n")
    options = ["--objects", "shape:box", "--trials", "standard", "--count", "1", "--out", "results"]
    done = graspd(tmp_path, "bench", *PLUGIN, "--presets", "mine.yaml", *options)
    assert done.returncode == 0, done.stderr
    assert "| `mine` | " in done.stdout


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("nothing.py", None, "plugin: nothing.py is not a Python file; valid: the path of a .py file"),
        ("broken_plugin.py", "1 / 0", "plugin broken_plugin.py: ZeroDivisionError: division by zero"),
        ("json.py", "", "plugin json.py: a module called json exists; give the file another name"),
    ],
)
def test_a_plugin_that_cannot_be_run_is_one_line(tmp_path: Path, name: str, text: str | None, told: str):
    if text is not None:
        (tmp_path / name).write_text(text)
    # With -P Python does not look for its own modules in the folder.
    command = [sys.executable, "-P", "-m", "graspd_core.cli", "synthesize", "shape:box", "--plugin", name]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (2, f"graspd: {told}\n")


def test_a_bad_list_of_plugins_is_no_fault_of_the_preset(monkeypatch: pytest.MonkeyPatch, refusal_of):
    monkeypatch.setenv("GRASPD_PLUGINS", "nothing.py")
    plan_config.run_plugins.cache_clear()
    told = "GRASPD_PLUGINS: nothing.py is not a Python file; valid: paths of .py files, separated by ':'"
    assert refusal_of("synthesize", "shape:box") == f"graspd: {told}\n"


def test_many_objects(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "meshes").mkdir()
    graspd_core.save_mesh(tmp_path / "meshes" / "ball.stl", graspd_core.make_shape("sphere"))
    for ending in ("succeeded", "done before"):
        assert run("many_objects", "out", "meshes", "nothing.obj", processes=1) == 1
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].endswith(f"verified  meshes/ball.stl: {ending}")
        assert lines[1].endswith("nothing.obj: no such mesh file")
    assert (tmp_path / "out" / "objects.csv").read_text().startswith("object,verified,ending\nmeshes/ball.stl,4,")


def test_somebody_elses_grasp(run: Run, capsys: pytest.CaptureFixture[str]):
    assert run("try_your_grasp") == 1
    verdicts = [line.split(": ")[1].split(";")[0] for line in capsys.readouterr().out.splitlines()]
    assert verdicts == ["verified", "verified", "verified", "failed"]
