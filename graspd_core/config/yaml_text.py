"""YAML that a user wrote: what a page of it can stand for is bounded."""

from __future__ import annotations

from typing import Any

import yaml

# Entries of a mapping once what it merges is in it; each `<<` may take in all of another mapping, twice and again.
_MOST_MERGED = 10_000


class _Loader(yaml.SafeLoader):
    """The safe loader, with an end to merging."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        super().flatten_mapping(node)
        if len(node.value) > _MOST_MERGED:
            problem = f"a mapping of more than {_MOST_MERGED} entries"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def parse_yaml(text: str) -> tuple[yaml.Node | None, Any]:
    """The tree of a YAML text, which knows its lines, and the value that it stands for; both None where it is empty.

    Raises:
        ValueError: it is not well-formed, or has something in it that only looks like a value: one line says what, and
            its attribute `line` where.
    """
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader), yaml.load(text, Loader=_Loader)
    # Beside its own errors the library lets through whatever a value brings about that is not what its tag or its looks
    # say: a date of a thirteenth month, a number without end, `!!timestamp x`.
    except Exception as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or type(error).__name__
        raise YamlError(mark.line + 1 if mark else 1, " ".join(str(problem).split())[:200]) from error


class YamlError(ValueError):
    """What is wrong with a YAML text, and in which line of it."""

    def __init__(self, line: int, problem: str) -> None:
        super().__init__(f"line {line}: {problem}")
        self.line, self.problem = line, problem
