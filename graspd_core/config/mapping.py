"""Read config dataclasses from nested mappings and YAML files. Errors name the key."""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml

from graspd_core.errors import ConfigError, choices, short_repr

T = TypeVar("T")

# Greatest integer that fits into the 64 bits of the libraries.
_LARGEST_INTEGER = 2**63 - 1


def from_mapping(cls: type[T], values: Any, where: str = "config", start: T | None = None) -> T:
    """Build a config dataclass from nested mappings.

    Missing values come from `start`. If `start` is None, they are the defaults of the class. Raises ConfigError: a key
    is unknown, or a value has the wrong type. The error begins with `where` and the dotted key. It names valid choices.
    """
    fields = dataclasses.fields(typing.cast(Any, cls))
    factories = {f.name: f.default_factory for f in fields if f.default_factory is not dataclasses.MISSING}
    starts = {name: getattr(start, name) if start else make() for name, make in factories.items()}
    given = coerced(typing.get_type_hints(cls), values, where, starts)
    return cls(**given) if start is None else dataclasses.replace(typing.cast(Any, start), **given)


def coerced(
    hints: Mapping[str, Any], values: Any, where: str, starts: Mapping[str, Any] = types.MappingProxyType({})
) -> dict[str, Any]:
    """Return a mapping with its values converted to the types in `hints`. Raises ConfigError: see `from_mapping`."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: expected a mapping of {sorted(hints)}, got {short_repr(values)}")
    if unknown := sorted(set(values) - set(hints), key=short_repr):
        raise ConfigError(f"{where}: unknown key {short_repr(unknown[0])}; {choices(unknown[0], sorted(hints))}")
    return {key: _coerce(hints[key], value, f"{where}.{key}", starts.get(key)) for key, value in values.items()}


@contextmanager
def yaml_values(path: Path) -> Iterator[Any]:
    """Yield the values of a YAML file. An empty file gives an empty mapping.

    If a ConfigError inside the `with` block begins with a dotted key, the error gets the file's path and the key's
    line. Raises ConfigError: the file is missing or malformed.
    """
    try:
        node, values = parse_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    except (YamlError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {error}") from None
    try:
        yield {} if values is None else values
    except ConfigError as error:
        text = str(error).removeprefix(path.name)
        unknown = re.search(r"unknown key '([^']*)'", text)
        keys = [*re.sub(r"\[.*", "", text.partition(":")[0]).split("."), *(unknown.groups() if unknown else ())]
        raise ConfigError(f"{path}:{line_of(node, [key for key in keys if key])}: {text.lstrip('.: ')}") from None


def line_of(node: yaml.Node | None, keys: list[str]) -> int:
    """Follow nested `keys` as far as the file holds them. Return the line of the last found key, or 1."""
    line = 1
    for key in keys:
        found = [pair for pair in node.value if pair[0].value == key] if isinstance(node, yaml.MappingNode) else []
        if not found:
            break
        line, node = found[-1][0].start_mark.line + 1, found[-1][1]
    return line


def _coerce(hint: Any, value: Any, where: str, start: Any = None, *, signed: bool = False) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_mapping(typing.cast(type, hint), value, where, start)
    origin = typing.get_origin(hint)
    if origin is Literal:
        if value in (valid := typing.get_args(hint)):
            return value
        raise ConfigError(f"{where}: {short_repr(value)} is not one of {', '.join(map(str, valid))}")
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in typing.get_args(hint):
            return None
        hint = next(h for h in typing.get_args(hint) if h is not type(None))
    if typing.get_origin(hint) is tuple:
        return _tuple(typing.get_args(hint), value, where)
    if isinstance(value, int) and abs(value) > _LARGEST_INTEGER:
        raise ConfigError(f"{where}: {short_repr(value)} is too large; valid: up to {_LARGEST_INTEGER}")
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{where}: expected {hint.__name__}, got {short_repr(value)}")
    if isinstance(value, int | float) and not (math.isfinite(value) and (signed or value >= 0)):
        raise ConfigError(f"{where}: {value!r} must be a finite number{'' if signed else ', zero or more'}")
    return value


def _tuple(hints: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple) or len(value) != len(hints):
        raise ConfigError(f"{where}: expected {len(hints)} values, got {short_repr(value)}")
    pairs = enumerate(zip(hints, value, strict=True))
    return tuple(_coerce(hint, given, f"{where}[{k}]", signed=True) for k, (hint, given) in pairs)


# Maximum number of entries of a mapping after `<<` merges. Nested merges could multiply the entries without limit.
_MOST_MERGED = 10_000


class _Loader(yaml.SafeLoader):
    """The safe YAML loader. It refuses a key that occurs twice, and limits the entries that `<<` merges add."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node, known = super().compose_mapping_node(anchor), set[tuple[str, str]]()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and ((key.tag, key.value) in known or known.add((key.tag, key.value))):
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} occurs twice", key.start_mark)
        return node

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        super().flatten_mapping(node)
        if len(node.value) > _MOST_MERGED:
            problem = f"a mapping of more than {_MOST_MERGED} entries"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def parse_yaml(text: str) -> tuple[yaml.Node | None, Any]:
    """Return the node tree of a YAML text, with line numbers, and the value of the text.

    Both are None for an empty text. Raises YamlError (a ValueError): the text or a value is malformed.
    """
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader), yaml.load(text, Loader=_Loader)
    # For a value that does not fit its tag or format, PyYAML may raise any exception: a date in month 13, a number with
    # too many digits, `!!timestamp x`.
    except Exception as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or type(error).__name__
        raise YamlError(mark.line + 1 if mark else 1, " ".join(str(problem).split())[:200]) from error


class YamlError(ValueError):
    """A problem in a YAML text, with its line number."""

    def __init__(self, line: int, problem: str) -> None:
        super().__init__(f"line {line}: {problem}")
        self.line, self.problem = line, problem
