"""What pages, docstrings and comments name in backticks exists: files, modules, functions, fields, settings.

`messages.txt` has all errors and warnings, to be read as a whole: `python test/test_references.py` writes it.
"""

import ast
import io
import re
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import product
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("test", "benchmarks", "examples", "config", "docs", "msg_defs", "scripts", "docker")
PACKAGES = tuple(path.parent.name for path in sorted(ROOT.glob("*/__init__.py")))
# Names that are none of this tree: transforms by their frames, messages and topics of ROS and MoveIt, files of users
# and of other projects, keys that code puts together, variables of an environment.
FOREIGN = re.compile(
    r"[RT](_[a-z]+)+|moveit_msgs/\w+|(object\.)?header\.frame_id|pre_grasp_approach\.direction|qos_overrides.*"
    r"|object\.(meshes|primitives|point_cluster|surface|name)|depth/(image_rect|camera_info)"
    r"|(DIR/)?\w+\.json|object_cloud\.xyz|my_hand\.yaml|cio\.py|setup\.bash|share/.*|results/.*|vX\.Y\.Z"
    r"|copy_reg\._\w+|hand\.mimic|metric_\w+|contact_\w+_(mm|cm2)|payload_kg|squeeze_quaternion_wxyz|gripper_frame|PATH\W?.*|AWS_\w+"
)
SPAN = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
DOTTED = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")
PATH = re.compile(r"[\w.{},-]+(/[\w.{},-]+)+/?|[\w{},-]+\.(py|md|hpp|cpp|yaml|toml|npz|msg|srv|action|xml|sh)")
# On a page a word may be anybody's if it has no underscore.
PAGE_WORD, WORD = re.compile(r"[A-Za-z]\w*_\w+"), re.compile(r"[A-Za-z]\w+")
SETTINGS = re.compile(r"(Config|Settings)$")
MESSAGES = Path(__file__).with_name("messages.txt")
# A text is a message by the name of the call, function or variable that it is in, or by its own words.
TROUBLE = re.compile(
    r"(?i)warn|doubt|error|bad_|wrong|fault|refus|reason|why|hint|advice|remedy|told|torn|fail|lost|_log|changed"
    r"|message|\btext\b|counts|looked_at|found\.append"
)
TROUBLE_WORDS = re.compile(
    r"valid|did you mean|not installed|missing|; give|\bis no\b|^parameter |^(cloud|target|transform|\{[^{}]*\}): "
)

Members = dict[str, set[str]]


@dataclass(frozen=True)
class Tree:
    """What can be named.

    Attributes:
        paths: of files and folders, from any folder on, with and without their extension.
        scopes: modules and classes by their dotted name, from any package on: what each holds, and of which classes.
        variables: parameters and fields by name: of which classes.
        settings: names of fields of configurations.
        words: that the code uses, and its whole strings.
        libraries: what the code imports from elsewhere.
    """

    paths: frozenset[str]
    scopes: dict[str, Members]
    variables: Members
    settings: frozenset[str]
    words: frozenset[str]
    libraries: frozenset[str]

    def classes_of(self, name: str) -> set[str] | None:
        """Return the scopes that a dotted name may be of; None if nothing is called so."""
        own = {name} & self.scopes.keys()
        head, _, last = name.rpartition(".")
        if not head:
            return own | self.variables[name] if name in self.variables else own or None
        found = [self._member(owner, last) for owner in self.classes_of(head) or ()]
        known = [classes for classes in found if classes is not None]
        return own.union(*known) if own or known else None

    def _member(self, owner: str, name: str) -> set[str] | None:
        members = self.scopes.get(owner, {})
        if name in members:
            return members[name]
        inherited = (self._member(base, name) for base in members.get("<bases>", ()))
        return next((classes for classes in inherited if classes is not None), None)


def suffixes(parts: tuple[str, ...], joint: str) -> list[str]:
    return [joint.join(parts[start:]) for start in range(len(parts))]


def names_in(annotation: ast.AST | None) -> set[str]:
    return set() if annotation is None else set(re.findall(r"[A-Z]\w+", ast.unparse(annotation)))


def section_of(configuration: str) -> str:
    """Return the section of a file of settings that a class holds: `closed_form` of `ClosedFormConfig`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", SETTINGS.sub("", configuration)).lower()


def members_of(body: Iterable[ast.AST]) -> Iterator[tuple[str, set[str]]]:
    """Yield what a module or a class defines or imports, and the classes that each is of."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, {node.name} if isinstance(node, ast.ClassDef) else names_in(node.returns)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from ((alias.asname or alias.name, {alias.name}) for alias in node.names)
        elif isinstance(node, ast.AnnAssign):
            yield ast.unparse(node.target), names_in(node.annotation)
        elif isinstance(node, ast.Assign):
            yield from ((ast.unparse(target), set()) for target in node.targets)
        elif isinstance(node, ast.If | ast.Try):
            yield from members_of([*node.body, *node.orelse])


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """Return the nodes of a module's syntax tree, the module first."""
    return tuple(ast.walk(ast.parse(source)))


def docstrings(source: str) -> list[ast.Constant]:
    nodes = [n for n in nodes_of(source) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
    return [node.value for node in nodes if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)]


def words_of(source: str) -> set[str]:
    """Return every word of the code, those in strings too, but none of a docstring."""
    prose = set(map(id, docstrings(source)))
    words: set[str] = set()
    for node in nodes_of(source):
        values = [value for value in vars(node).values() if isinstance(value, str)] if id(node) not in prose else []
        words.update(word for value in values for word in (value, *re.findall(r"\w+", value)))
    return words


def read_tree(sources: dict[str, str]) -> Tree:
    """Read the text of files by their path below the root."""
    paths, scopes, variables = set(), defaultdict[str, Members](dict), defaultdict[str, set[str]](set)
    settings, words, libraries = set(), set(), set(sys.stdlib_module_names)
    for path, text in sources.items():
        parts = Path(path).parts
        for length in range(1, len(parts) + 1):
            paths.update(suffixes(parts[:length], "/"))
        paths.update(suffixes((*parts[:-1], Path(path).stem), "/"))
        if not path.endswith(".py"):
            words.update(re.findall(r"\w+", text) if not path.endswith(".md") else ())
            continue
        words |= words_of(text)
        dotted = Path(path).with_suffix("").parts
        dotted = dotted[:-1] if dotted[-1] == "__init__" else dotted
        for name in suffixes(dotted, "."):
            scopes[name].update(members_of(ast.iter_child_nodes(nodes_of(text)[0])))
        for node in nodes_of(text):
            if isinstance(node, ast.ClassDef):
                members = {**dict(members_of(node.body)), "<bases>": {ast.unparse(base) for base in node.bases}}
                attributes = [n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute)]
                for name in suffixes((*dotted, node.name), "."):
                    scopes[name].update({**{attribute: set() for attribute in attributes}, **members})
                if SETTINGS.search(node.name):
                    settings.update(members)
                    variables[section_of(node.name)].add(node.name)
                for name, classes in members.items():
                    variables[name] |= classes
            elif isinstance(node, ast.arg):
                variables[node.arg] |= names_in(node.annotation)
            elif isinstance(node, ast.Import):
                libraries.update((alias.asname or alias.name).split(".")[0] for alias in node.names)
    return Tree(frozenset(paths), scopes, variables, frozenset(settings), frozenset(words), frozenset(libraries))


def expanded(path: str) -> list[str]:
    """Return the paths that braces stand for."""
    pieces = [piece.split(",") for piece in re.split(r"[{}]", path)]
    return ["".join(chosen) for chosen in product(*pieces)]


def exists(span: str, tree: Tree) -> bool:
    """Return whether a path or a dotted name is one of the tree, or of Python's own library."""
    if span in tree.words or span.split(".")[0] in tree.libraries:
        return True
    return all(
        one.rstrip("/") in tree.paths or tree.classes_of(one.replace("/", ".")) is not None for one in expanded(span)
    )


def unknown(text: str, tree: Tree, word: re.Pattern[str] = WORD) -> list[str]:
    """Return what a text names in backticks that does not exist."""
    spans = [re.sub(r"\(.*\)$", "", span) for span in SPAN.findall(text)]
    named = [span for span in spans if (PATH.fullmatch(span) or DOTTED.fullmatch(span)) and not FOREIGN.fullmatch(span)]
    words = [span for span in spans if word.fullmatch(span) and not FOREIGN.fullmatch(span)]
    strange = [word for word in words if word not in tree.words and word not in tree.paths]
    return [span for span in named if not exists(span, tree)] + strange


def unknown_settings(page: str, tree: Tree) -> list[str]:
    """Return what the first column of a page's tables of settings names and no configuration has."""
    found, inside = [], False
    for line in page.splitlines():
        cells = line.split("|")
        inside = line.startswith("|") and (inside or cells[1].strip() in ("setting", "parameter"))
        names = SPAN.findall(cells[1]) if inside else []
        found += [n for n in names if "." not in n and n not in tree.settings]
    return found


def prose_of(source: str) -> str:
    """Return the docstrings and comments of a module."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = [token.string for token in tokens if token.type == tokenize.COMMENT]
    return "\n".join([str(node.value) for node in docstrings(source)] + comments)


def text_of(node: ast.Constant | ast.JoinedStr) -> str:
    """Return the text of a string, with the code of what is put into it in braces."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    found = ""
    for part in node.values:
        if isinstance(part, ast.FormattedValue):
            # Versions of Python print a nested f-string differently.
            nested = any(isinstance(inner, ast.JoinedStr) for inner in ast.walk(part.value))
            found += "{…}" if nested else f"{{{ast.unparse(part.value)}}}"
        elif isinstance(part, ast.Constant):
            found += str(part.value)
    return found


def texts_in(node: ast.AST | None) -> Iterator[ast.Constant | ast.JoinedStr]:
    """Yield the strings of a tree. A string within a formatted one is part of that."""
    if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str)):
        yield node
    elif node is not None:
        for child in ast.iter_child_nodes(node):
            yield from texts_in(child)


def is_trouble(node: ast.AST) -> bool:
    """Return whether a statement or a call is about an error or a warning."""
    if isinstance(node, ast.Call):
        return bool(TROUBLE.search(ast.unparse(node.func)))
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return bool(TROUBLE.search(node.name))
    if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return any(TROUBLE.search(ast.unparse(target)) for target in targets)
    return isinstance(node, ast.Raise) or (isinstance(node, ast.keyword) and bool(TROUBLE.search(node.arg or "")))


def messages_of(source: str) -> set[str]:
    """Return the errors and warnings of a module: texts of three words or more."""
    prose = set(map(id, docstrings(source)))
    marked = {id(text) for node in nodes_of(source) if is_trouble(node) for text in texts_in(node)}
    texts = [text for text in texts_in(nodes_of(source)[0]) if id(text) not in prose]
    kept = [text_of(text) for text in texts if id(text) in marked or TROUBLE_WORDS.search(text_of(text))]
    return {" ".join(text.split()) for text in kept if len(text.split()) >= 3}


def all_messages() -> str:
    modules = {path: text for path, text in sources().items() if path.endswith(".py") and path.startswith(PACKAGES)}
    return "".join(sorted(f"{path}: {text}\n" for path, source in modules.items() for text in messages_of(source)))


@lru_cache
def sources() -> dict[str, str]:
    places = [path for folder in (*PACKAGES, *FOLDERS) for path in (ROOT / folder).rglob("*")]
    texts = {}
    for path in [*places, *(path for path in ROOT.iterdir() if not path.name.startswith("."))]:
        if path.is_file() and "__pycache__" not in path.parts:
            texts[str(path.relative_to(ROOT))] = path.read_bytes().decode(errors="replace")
    # The breaches that are planted below.
    texts[str(Path(__file__).relative_to(ROOT))] = ""
    return texts


@lru_cache
def tree() -> Tree:
    return read_tree(sources())


def test_what_pages_name_exists():
    pages = {path: text for path, text in sources().items() if path.endswith(".md")}
    # What a version changed may be gone since.
    del pages["CHANGELOG.md"]
    assert len(pages) > 15
    prose = {path: re.sub(r"^```.*?^```", "", text, flags=re.M | re.S) for path, text in pages.items()}
    found = [f"{path}: {name}" for path, text in prose.items() for name in unknown(text, tree(), PAGE_WORD)]
    found += [f"{path}: setting {name}" for path, text in prose.items() for name in unknown_settings(text, tree())]
    assert not found, "\n".join(found)


def test_what_docstrings_and_comments_name_exists():
    modules = {path: text for path, text in sources().items() if path.endswith(".py") and path.startswith(PACKAGES)}
    assert len(modules) > 100
    found = [f"{path}: {name}" for path, text in modules.items() for name in unknown(prose_of(text), tree())]
    headers = {path: re.findall(r"[\w/]+\.py", text) for path, text in sources().items() if path.endswith(".hpp")}
    found += [f"{path}: {name}" for path, names in headers.items() for name in names if not exists(name, tree())]
    assert not found, "\n".join(found)


PLANTED = read_tree(
    {
        "core/mesh/sdf.py": "def build_sdf(mesh): ...\nclass GridSDF:\n    origin: float\n",
        "core/plan/config.py": (
            "class LevelSetConfig:\n    schedule: str\nclass PlanConfig:\n    level_set: LevelSetConfig\n"
        ),
        "core/kernel/layout.hpp": "struct grid_layout;",
    }
)


@pytest.mark.parametrize(
    "span",
    [
        *("core/mesh/sdf.py", "mesh/sdf", "mesh/", "sdf.py", "layout.hpp", "{mesh,core/mesh}/sdf.py"),
        *("mesh.sdf", "sdf.build_sdf", "build_sdf(mesh)", "GridSDF.origin", "mesh/sdf.build_sdf", "ast.walk"),
        *("level_set.schedule", "PlanConfig.level_set.schedule", "plan.level_set.schedule", "grid_layout", "T_a_b"),
    ],
)
def test_the_checker_lets_good_references_pass(span: str):
    assert unknown(f"See `{span}`.", PLANTED) == []


@pytest.mark.parametrize(
    "span",
    [
        *("core/mesh/grid.py", "mesh/grid", "grid.py", "mesh/{sdf,grid}", "mesh/sdf.make_sdf", "rows.hpp"),
        *("mesh.grid", "sdf.make_sdf", "make_sdf(mesh)", "GridSDF.size", "level_set.radius", "PlanConfig.schedule"),
        *("make_sdf", "starts"),
    ],
)
def test_the_checker_sees_a_planted_breach(span: str):
    assert unknown(f"See `{span}`.", PLANTED) == [re.sub(r"\(.*", "", span)]


def test_the_checker_sees_a_setting_that_no_configuration_has():
    page = "| setting | paper |\n|---|---|\n| `schedule` | `code` |\n| `memory`, `level_set` | 0.9 |\n\n"
    page += "| x | `y` |\n| `z` | |\n"
    assert unknown_settings(page, PLANTED) == ["memory"]


def test_the_checker_reads_docstrings_and_comments_alone():
    assert prose_of('"""A `b`."""\nx = "`c`"  # `d`\n').split() == ["A", "`b`.", "#", "`d`"]


def test_the_list_of_messages_is_that_of_the_code():
    assert MESSAGES.read_text() == all_messages(), "write it anew: python test/test_references.py"


def test_the_list_has_what_is_raised_and_warned_of():
    source = 'def f(x):\n    """One two three."""\n    raise A(f"{x.y}: no such file")\n'
    source += 'warnings.append("it is odd")\nprint("all is well")\nprint("x: 3 is not valid")\n'
    assert messages_of(source) == {"{x.y}: no such file", "it is odd", "x: 3 is not valid"}


if __name__ == "__main__":
    MESSAGES.write_text(all_messages())
