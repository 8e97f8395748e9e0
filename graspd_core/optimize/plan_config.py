"""Hold the settings of a run of `plan_grasps`: the methods, their own settings, and the presets.

A method of graspd_core is a row of `METHODS`. A method of another package registers itself: an entry point of the group
`graspd.methods` names its row, which is loaded when the method is first asked for. A plugin is a Python file that adds
rows to `METHODS`, `METRICS` or `TRIALS`. The environment names plugins, so that child processes run them too.
"""

from __future__ import annotations

import dataclasses
import importlib
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.config import CertaintyConfig, GraspStagesConfig, ProblemConfig, RobustConfig, RoundsConfig
from graspd_core.config.mapping import coerced, yaml_values
from graspd_core.errors import ConfigError, choices, shown
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig, at_budget
from graspd_core.optimize.graspd2022.graspd2022_config import Graspd2022Config
from graspd_core.paths import config_dir

if TYPE_CHECKING:
    from graspd_core.optimize.candidates import PlannerInput, PlannerOutput


@dataclass(frozen=True)
class Method:
    """One way to find grasps.

    Attributes:
        module: has `plan(PlannerInput) -> PlannerOutput`.
        config: dataclass of its settings. A preset's section of the method's name fills it.
        label: its name in charts.
        colour, marker: of its points in charts, as Matplotlib takes them.
        benchmark_count: grasps of one unfiltered batch in the benchmark.
        at_budget: its settings at a share of the usual budget. The default keeps the settings.
        searches: of a round at most, by its settings, repeated only if too few grasps are expected to hold.
    """

    module: str
    config: type
    label: str
    colour: str
    marker: str
    benchmark_count: int
    at_budget: Callable[[Any, float], Any] = lambda settings, budget: settings
    searches: Callable[[Any], int] = lambda settings: 1

    def plan(self, task: PlannerInput) -> PlannerOutput:
        """Find poses. Numerical trouble is a missing pose, never an exception.

        The module is imported here and not with this file, because it needs torch.
        """
        return importlib.import_module(self.module).plan(task)


METHODS: dict[str, Method] = {
    "closed_form": Method(
        "graspd_core.optimize.closed_form.closed_form",
        ClosedFormConfig,
        "closed form",
        "#0072B2",
        "o",
        16,
        at_budget,
        attrgetter("searches"),
    ),
    "graspd2022": Method(
        "graspd_core.optimize.graspd2022.graspd2022", Graspd2022Config, "Grasp'D (2022)", "#D55E00", "s", 8
    ),
}

_DEFAULT_METHOD, _GROUP, _PLUGINS = "closed_form", "graspd.methods", "GRASPD_PLUGINS"


@cache
def _registered() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=_GROUP)}


@cache
def _run_plugins() -> None:
    """Run the plugins that a parent process was given. They import this module, so that it cannot run them itself."""
    for path in filter(None, os.environ.get(_PLUGINS, "").split(os.pathsep)):
        load_plugin(path)


def method_names() -> tuple[str, ...]:
    """Return the names of all methods: those of graspd_core and those that other packages register."""
    _run_plugins()
    return tuple(dict.fromkeys((*METHODS, *_registered())))


def method_row(name: Any, where: str = "config") -> Method:
    """Return the row of a method. Raises ConfigError: there is no such method."""
    _run_plugins()
    if not isinstance(name, str) or (name not in METHODS and name not in _registered()):
        raise ConfigError(f"{where}.method: unknown method {shown(name)}; {choices(name, method_names())}")
    if name not in METHODS:
        METHODS[name] = _registered()[name].load()
    return METHODS[name]


@dataclass(frozen=True)
class PlanConfig:
    """Settings of a run, apart from the scene, the hand and the seed.

    Attributes:
        resolution: the signed distance grid has at most its cube in nodes. A cube has as many along each side.
        method: how poses are searched for, one of `method_names`.
        settings: of that method, of the type that its row names. None takes the defaults.
        problem: how scene and hand are laid out.
        grasp_stages: pregrasp and squeeze.
        rounds: of optimiser and trial.
        robust: the order of the verified grasps.
        certainty: how sure a grasp of a partly guessed object must be.

    Raises:
        ConfigError: the method is unknown, or the settings are another method's.
    """

    resolution: int = 48
    method: str = _DEFAULT_METHOD
    settings: Any = None
    problem: ProblemConfig = field(default_factory=ProblemConfig)
    grasp_stages: GraspStagesConfig = field(default_factory=GraspStagesConfig)
    rounds: RoundsConfig = field(default_factory=RoundsConfig)
    robust: RobustConfig = field(default_factory=RobustConfig)
    certainty: CertaintyConfig = field(default_factory=CertaintyConfig)

    def __post_init__(self) -> None:
        config = method_row(self.method).config
        if self.settings is None:
            object.__setattr__(self, "settings", config())
        elif not isinstance(self.settings, config):
            raise ConfigError(f"settings: {type(self.settings).__name__} is not {config.__name__} of {self.method}")

    def at_budget(self, budget: float) -> PlanConfig:
        """Return the same method with more or less effort. A budget of 1 keeps its settings."""
        return dataclasses.replace(self, settings=method_row(self.method).at_budget(self.settings, budget))

    def with_method(self, method: str) -> PlanConfig:
        """Return the settings with another method at its defaults, unchanged if it is the same method."""
        return self if method == self.method else dataclasses.replace(self, method=method, settings=None)


def to_mapping(config: PlanConfig) -> dict[str, Any]:
    """Return the settings as a preset file has them: the method's own are in the section of its name."""
    values = dataclasses.asdict(config)
    return {config.method if key == "settings" else key: value for key, value in values.items()}


def plan_config(values: Any, where: str = "config") -> PlanConfig:
    """Build the settings of a run from a preset's nested mappings.

    Raises ConfigError: an unknown key or a value of the wrong type, by its dotted name, with the valid choices.
    """
    named = values.get("method", _DEFAULT_METHOD) if isinstance(values, Mapping) else _DEFAULT_METHOD
    row = method_row(named, where)
    hints = {f.name: f.default_factory for f in dataclasses.fields(PlanConfig) if f.name not in ("settings", "method")}
    hints |= {"resolution": int, "method": str, named: row.config}
    unknown = set(values) - set(hints) if isinstance(values, Mapping) else ()
    # Only an unknown key is worth the search for other packages' methods.
    if others := sorted(name for name in unknown if name in method_names()):
        raise ConfigError(f"{where}.{others[0]}: settings of another method; this one has method: {named}")
    found = coerced(hints, values, where)
    return PlanConfig(**{("settings" if key == named else key): value for key, value in found.items()})


def override(config: PlanConfig, changes: Mapping[str, Any]) -> PlanConfig:
    """Return the settings with some of a preset's values changed, each by its dotted name.

    Raises:
        ConfigError: there is no such value, or it is of another type.
    """
    if "method" in changes:
        config = config.with_method(changes["method"])
    values = to_mapping(config)
    for name, value in changes.items():
        *sections, last = name.split(".")
        section = values
        for key in sections:
            section = section.setdefault(key, {})
        section[last] = value
    return plan_config(values, "settings")


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets in `config/presets`."""
    return tuple(sorted(path.stem for path in (config_dir() / "presets").glob("*.yaml")))


def load_preset(name: str) -> PlanConfig:
    """Load a preset by name, or a preset file by path.

    Raises:
        ConfigError: no such preset (the valid ones are listed), malformed YAML, or a bad key or value.
    """
    by_path = Path(name).suffix in (".yaml", ".yml") or "/" in name
    path = Path(name) if by_path else config_dir() / "presets" / f"{name}.yaml"
    if not path.is_file():
        told = f"preset {name}: no such file" if by_path else f"unknown preset {name!r}"
        raise ConfigError(f"{told}; {choices(name, preset_names(), ', or a .yaml file')}")
    with yaml_values(path) as values:
        return plan_config(values, where=path.name)


def load_plugin(path: str) -> str:
    """Run a Python file that registers methods, metrics or trials, here and in child processes. Returns its path.

    Raises:
        ConfigError: there is no such file, its module's name is taken, or it raises.
    """
    file = Path(path).resolve()
    if file.suffix != ".py" or not file.is_file():
        raise ConfigError(f"plugin: {path} is not a Python file; valid: the path of a .py file")
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    try:
        module = importlib.import_module(file.stem)
    except Exception as error:
        raise ConfigError(f"plugin {path}: {type(error).__name__}: {error}") from error
    if module.__file__ is None or Path(module.__file__).resolve() != file:
        raise ConfigError(f"plugin {path}: a module called {file.stem} exists; give the file another name")
    named = os.environ.get(_PLUGINS, "").split(os.pathsep)
    os.environ[_PLUGINS] = os.pathsep.join(filter(None, dict.fromkeys((*named, str(file)))))
    return str(file)
