"""The rules of docs/architecture.md, read off the sources: imports, sizes, names."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAX_LINES, MAX_FUNCTION_LINES, MAX_POSITIONAL, MAX_FILES = 350, 50, 7, 15
# Private metaphors of earlier code: none may be part of a name again, nor of a file's.
METAPHORS = set(
    [
        "allround",
        "atlas",
        "court",
        "dust",
        "elsewhere",
        "intake",
        "judge",
        "judged",
        "laps",
        "outlets",
        "perceive",
        "rival",
        "rivals",
        "rung",
        "rungs",
        "shelf",
        "sighting",
        "specks",
        "synthesise",
        "tally",
        "trust",
    ]
)
# Nor may prose use these; what else the words above mean in plain English is a writer's business.
PRIVATE_PHRASE = re.compile(
    r"\b(front door|rungs?|ladders|shel(f|ves)|tally|outlets|the house|the judge)\b", re.IGNORECASE
)

BASE = {"types", "errors", "se3", "config", "paths", "runtime"}
PERCEPTION = BASE | {"mesh", "pointcloud", "segmentation", "reconstruction", "scene"}
UP_TO_CONTACT = PERCEPTION | {"hands", "contact"}
BELOW_PLANNING = UP_TO_CONTACT | {"methods", "metrics", "trials", "formats", "transforms", "bags", "rendering"}
# What each folder or module of graspd_core may import; one that is not here may not exist.
MAY_IMPORT = {
    "types": {"errors"},
    "errors": set[str](),
    "se3": {"types", "errors"},
    "config": BASE,
    "paths": {"errors"},
    "runtime": {"errors"},
    "kernel": {"errors"},
    "transforms": {"types", "errors", "se3"},
    "mesh": BASE,
    "pointcloud": BASE | {"mesh"},
    "segmentation": BASE | {"mesh", "pointcloud"},
    "reconstruction": BASE | {"mesh", "pointcloud"},
    "scene": PERCEPTION,
    "bags": BASE | {"pointcloud", "transforms"},
    "hands": BASE | {"mesh"},
    "arms": BASE | {"mesh", "hands", "scene"},
    "rendering": BASE | {"mesh", "pointcloud", "hands"},
    "contact": UP_TO_CONTACT,
    "methods": UP_TO_CONTACT | {"kernel"},
    "metrics": UP_TO_CONTACT,
    "trials": UP_TO_CONTACT,
    "formats": BASE | {"mesh", "scene", "hands", "methods", "metrics"},
    "planning": BELOW_PLANNING | {"arms"},
    "library": BELOW_PLANNING | {"planning"},
    "__init__": BELOW_PLANNING | {"arms", "planning", "library"},
    "bench": BELOW_PLANNING | {"arms", "planning", "__init__"},
    "doctor": BELOW_PLANNING | {"planning", "__init__"},
    "viewer": BELOW_PLANNING | {"planning", "bench", "__init__"},
    "dataset": BELOW_PLANNING | {"planning", "bench", "__init__"},
    "cli": BELOW_PLANNING | {"arms", "planning", "bench", "dataset", "library", "doctor", "viewer", "__init__"},
}
# What the node sees: the public names, values, the viewer, and what only a process that serves needs.
NODE_SEES = {"__init__", "config", "types", "errors", "paths", "transforms", "bags", "viewer"}
NODE_SEES |= {"runtime", "hands", "arms", "pointcloud", "formats", "planning", "library"}

# library: where it may be imported, as a path prefix below the repository root
CONFINED = {
    "mujoco": ("graspd_core/trials/", "graspd_core/hands/readers/"),
    "pybullet": ("graspd_core/bench/bullet/",),
    "open3d": (
        "graspd_core/mesh/",
        "graspd_core/pointcloud/",
        "graspd_core/segmentation/",
        "graspd_core/reconstruction/",
    ),
    "matplotlib": ("graspd_core/bench/charts/",),
    "viser": ("graspd_core/viewer/",),
    "ray": ("graspd_core/dataset/",),
    "pyarrow": ("graspd_core/dataset/",),
}
HEAVY = {"open3d", "trimesh", "igl", "vhacdx", "mujoco", "matplotlib", "fast_simplification"}
HEAVY |= {"pybullet", "viser", "ray", "pyarrow"}
ROS = {"rclpy", "ament_index_python", "builtin_interfaces", "launch", "launch_ros", "graspd_ros"}


@dataclass(frozen=True)
class Import:
    """One imported module: its dotted name, its line, and whether importing the file runs it."""

    module: str
    line: int
    at_module_level: bool


def imports_of(source: str, package: str) -> list[Import]:
    """Every import of a file in `package`, those inside functions too; relative ones are resolved."""
    found: list[Import] = []

    def visit(node: ast.AST, at_module_level: bool) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            at_module_level = False
        if isinstance(node, ast.Import):
            found.extend(Import(alias.name, node.lineno, at_module_level) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")
            base = ".".join(parents[: len(parents) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            if module == "graspd_core":
                found.extend(Import(f"{module}.{a.name}", node.lineno, at_module_level) for a in node.names)
            else:
                found.append(Import(module, node.lineno, at_module_level))
        inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            visit(child, at_module_level and not inside)

    visit(ast.parse(source), True)
    return found


def folder_of(module: str) -> str:
    """The folder of a `graspd_core...` module; names that the package itself offers count as its `__init__`."""
    folder = module.removeprefix("graspd_core").strip(".").split(".")[0]
    return folder if folder in MAY_IMPORT else "__init__"


def breaches(path: str, source: str) -> list[str]:
    """What `source`, lying at `path` below the root, does against the rules; one line each."""
    parts = Path(path).with_suffix("").parts
    home = parts[1]
    wrong = []
    if source.count("\n") > MAX_LINES:
        wrong.append(f"{path}: {source.count(chr(10))} lines, more than {MAX_LINES}: split it")
    if parts[0] == "graspd_core" and home not in MAY_IMPORT:
        wrong.append(f"{path}: {home} is not in the table; give it a row in MAY_IMPORT and docs/architecture.md")
    for found in imports_of(source, ".".join(parts[:-1])):
        library = found.module.split(".")[0]
        where = f"{path}:{found.line}: imports {found.module}"
        if library == "graspd_core":
            allowed = NODE_SEES if parts[0] == "graspd_ros" else MAY_IMPORT.get(home, set())
            if folder_of(found.module) not in allowed | {home}:
                wrong.append(f"{where}, but {home} may import only {sorted(allowed)}")
        if parts[0] == "graspd_core" and (library in ROS or library.endswith("_msgs")):
            wrong.append(f"{where}, but graspd_core knows no ROS")
        if library in CONFINED and not path.startswith(CONFINED[library]):
            wrong.append(f"{where}, which only {' and '.join(CONFINED[library])} may")
        if library in HEAVY and found.at_module_level:
            wrong.append(f"{where} at module level: import it inside the function that needs it")
    return wrong


def large_functions(path: str, source: str) -> dict[str, str]:
    """Functions with too many lines or parameters: what is too much, by path and name."""
    found = {}
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        lines = (node.end_lineno or node.lineno) - node.lineno + 1
        positional = [a.arg for a in node.args.posonlyargs + node.args.args if a.arg not in ("self", "cls")]
        if lines > MAX_FUNCTION_LINES:
            found[f"{path}: {node.name}"] = f"{lines} lines, more than {MAX_FUNCTION_LINES}"
        elif len(positional) > MAX_POSITIONAL:
            found[f"{path}: {node.name}"] = f"{len(positional)} positional parameters, more than {MAX_POSITIONAL}"
    return found


def crowded_folders(paths: Iterable[str]) -> list[str]:
    """Folders with too many modules, and basenames that occur twice in a package; an `__init__` counts for neither."""
    modules = [Path(path) for path in paths if Path(path).stem not in ("__init__", "__main__")]
    folders = Counter(path.parent.as_posix() for path in modules)
    names = Counter((path.parts[0], path.name) for path in modules)
    wrong = [f"{folder}: {n} files, more than {MAX_FILES}" for folder, n in sorted(folders.items()) if n > MAX_FILES]
    return wrong + [f"{package}: {name} occurs {n} times" for (package, name), n in sorted(names.items()) if n > 1]


def metaphors(path: str, source: str) -> list[str]:
    """Names in a file, its own included, that hold a word which only this project would understand."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    names = {Path(path).stem} | {token.string for token in tokens if token.type == tokenize.NAME}
    split = {name: re.findall("[a-z]+", re.sub("([A-Z])", r"_\1", name).lower()) for name in names}
    return sorted(f"{path}: {name}" for name, words in split.items() if METAPHORS & set(words))


def private_phrases(path: str, text: str) -> list[str]:
    """Phrases in a text, code or prose, that only this project would understand."""
    lines = enumerate(text.splitlines(), 1)
    return [f"{path}:{number}: {found[0]}" for number, line in lines for found in PRIVATE_PHRASE.finditer(line)]


def sources() -> list[Path]:
    return sorted(path for package in ("graspd_core", "graspd_ros") for path in (ROOT / package).rglob("*.py"))


def test_the_sources_keep_the_rules():
    found = [line for path in sources() for line in breaches(str(path.relative_to(ROOT)), path.read_text())]
    assert not found, "\n".join(found)


def test_folders_stay_small_and_names_are_the_fields():
    paths = {str(path.relative_to(ROOT)): path.read_text() for path in sources()}
    assert crowded_folders(paths) == []
    assert [line for path, source in paths.items() for line in metaphors(path, source)] == []


def test_the_checker_sees_a_crowded_folder_and_a_name_that_occurs_twice():
    assert crowded_folders([f"graspd_core/mesh/m{i}.py" for i in range(16)]) == [
        "graspd_core/mesh: 16 files, more than 15"
    ]
    assert crowded_folders(["graspd_core/mesh/run.py", "graspd_core/bench/a/run.py"]) == [
        "graspd_core: run.py occurs 2 times"
    ]
    fine = [f"graspd_core/mesh/m{i}.py" for i in range(15)] + ["graspd_core/mesh/__init__.py", "graspd_ros/m1.py"]
    assert crowded_folders(fine) == []


def test_the_checker_sees_a_metaphor():
    assert metaphors("graspd_core/a.py", "def make_judge(): ...") == ["graspd_core/a.py: make_judge"]
    assert metaphors("graspd_core/a.py", "class ResultShelf: ...") == ["graspd_core/a.py: ResultShelf"]
    assert metaphors("graspd_core/atlas.py", "") == ["graspd_core/atlas.py: atlas"]
    assert metaphors("graspd_core/a.py", "def adjudge(trustee): ...  # a judge") == []


def test_the_prose_is_plain():
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *(ROOT / "benchmarks").glob("*.py"), *sources()]
    assert len(pages) > 200
    found = [line for page in pages for line in private_phrases(str(page.relative_to(ROOT)), page.read_text())]
    assert not found, "\n".join(found)


def test_the_checker_sees_a_private_phrase():
    assert private_phrases("a.py", "x = 1  # fine\n# The Front door") == ["a.py:2: Front door"]
    assert private_phrases("a.md", "The house holds 8 rungs.") == ["a.md:1: The house", "a.md:1: rungs"]
    assert private_phrases("a.md", "A warehouse holds `--suite ladder`.") == []


def test_functions_stay_small():
    large = {
        k: v for path in sources() for k, v in large_functions(str(path.relative_to(ROOT)), path.read_text()).items()
    }
    assert large == {}


@pytest.mark.parametrize(
    ("source", "culprit"),
    [
        ("def f():\n" + "    x = 1\n" * MAX_FUNCTION_LINES, "51 lines"),
        ("class A:\n    async def f(self):\n" + "        x = 1\n" * MAX_FUNCTION_LINES, "51 lines"),
        ("def f(a, b, c, d, /, e, f, g, h): ...", "8 positional"),
    ],
)
def test_the_checker_sees_a_large_function(source: str, culprit: str):
    ((name, what),) = large_functions("graspd_core/types.py", source).items()
    assert name == "graspd_core/types.py: f"
    assert what.startswith(culprit)


def test_the_checker_lets_small_functions_pass():
    short = "def f():\n" + "    x = 1\n" * (MAX_FUNCTION_LINES - 1)
    assert large_functions("a.py", short + "class A:\n    def f(self, a, b, c, d, e, f, g, *, h): ...") == {}


def test_no_file_outside_the_packages_is_too_long():
    others = [p for folder in ("test", "examples", "benchmarks", "scripts") for p in (ROOT / folder).rglob("*.py")]
    long = {str(p.relative_to(ROOT)) for p in others if p.read_text().count("\n") > MAX_LINES}
    assert not long


@pytest.mark.parametrize(
    ("path", "source", "culprit"),
    [
        ("graspd_core/mesh/sdf.py", "from graspd_core.hands.model import HandModel", "hands.model"),
        ("graspd_core/optimize/graspd2022/contact_dynamics.py", "from ..methods import losses", "methods"),
        (
            "graspd_core/verify/metrics.py",
            "def f():\n    from graspd_core.optimize.losses import g",
            "methods.losses",
        ),
        ("graspd_core/verify/hold_trial.py", "from graspd_core import methods", "methods"),
        ("graspd_core/hands/model.py", "from graspd_core.planning.plan_grasps import plan_grasps", "planning"),
        ("graspd_core/io/bags.py", "from graspd_core.planning.plan_grasps import plan_grasps", "planning"),
        (
            "graspd_core/transforms.py",
            "from graspd_core.perception.cloud.point_cloud import PointCloud",
            "pointcloud.point_cloud",
        ),
        ("graspd_core/io/grasps_json.py", "import rclpy", "rclpy"),
        ("graspd_core/io/grasps_json.py", "from sensor_msgs.msg import PointCloud2", "sensor_msgs.msg"),
        ("graspd_core/optimize/losses.py", "def f():\n    import mujoco", "mujoco"),
        ("graspd_core/hands/kinematics.py", "def f():\n    import open3d as o3d", "open3d"),
        ("graspd_core/verify/world.py", "import mujoco", "module level"),
        ("graspd_core/mesh/mesh_files.py", "if True:\n    import trimesh", "module level"),
        ("graspd_core/mesh/mesh_files.py", "def f():\n    import matplotlib.pyplot", "matplotlib"),
        ("graspd_bench/suites.py", "def f():\n    from matplotlib import pyplot", "matplotlib"),
        ("graspd_core/attic/old.py", "x = 1", "not in the table"),
        ("graspd_core/types.py", "\n" * (MAX_LINES + 1), "split it"),
        ("graspd_ros/node.py", "from graspd_core.optimize.losses import touch", "methods.losses"),
    ],
)
def test_the_checker_sees_a_planted_breach(path: str, source: str, culprit: str):
    (line,) = breaches(path, source)
    assert line.startswith(path)
    assert culprit in line


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("graspd_core/verify/world.py", "def build():\n    import mujoco"),
        ("graspd_core/mesh/mesh_files.py", "if TYPE_CHECKING:\n    import trimesh"),
        ("graspd_core/optimize/problem.py", "from graspd_core.optimize.losses import support"),
        ("graspd_core/optimize/graspd2022/contact_dynamics.py", "from .wrench_support import support"),
        ("graspd_ros/node.py", "import rclpy\nfrom graspd_core import plan_grasps"),
    ],
)
def test_the_checker_lets_good_code_pass(path: str, source: str):
    assert breaches(path, source) == []
