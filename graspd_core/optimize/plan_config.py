"""Settings of a run of `plan_grasps`: the methods, the settings of each method, and the presets.

A method of graspd_core is a row of `METHODS`. Another package registers a method by an entry point of the group
`graspd.methods`, which names the row. The row is loaded when the method is first used. A plugin is a Python file that
adds rows to `METHODS`, `METRICS` or `TRIALS`. Child processes load the plugins that an environment variable lists.
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
from graspd_core.errors import ConfigError, choices, short_repr
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig, at_budget
from graspd_core.optimize.graspd2022.graspd2022_config import Graspd2022Config
from graspd_core.paths import config_dir

if TYPE_CHECKING:
    from graspd_core.optimize.candidates import PlannerInput, PlannerOutput


@dataclass(frozen=True)
class Method:
    """A method that finds grasps.

    Attributes:
        module: dotted name of the module with `plan(PlannerInput) -> PlannerOutput`.
        config: dataclass of the method's settings. The preset section with the method's name fills it.
        label: name in charts.
        colour, marker: colour and marker in charts, as Matplotlib takes them.
        benchmark_count: number of grasps that the benchmark requests in a batch.
        at_budget: returns the settings for a multiple of the usual budget. The default keeps the settings.
        searches: returns the greatest number of searches per round. Fewer run if enough grasps are expected to hold.
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
        """Find poses. A numerical failure drops the pose and never raises.

        This function imports the method's module, because the module needs torch and is slow to import.
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

# Greatest value of a setting. The sum of three numbers of steps fits into the kernel's 32 bits.
_MOST = 500_000_000
# Settings with less as greatest value, because their time or memory grows fast.
_LESS = {
    **dict.fromkeys(("candidates", "fine_candidates"), 5000),
    **dict.fromkeys(("features", "starts_per_grasp"), 20_000),
    **dict.fromkeys(("directions", "drops"), 1000),
    **dict.fromkeys(("most", "first_budget", "growth"), 100),
}
# Settings that must not be zero: the least value of those that are no integers, and all names.
_TINY = 1e-9
_NOT_ZERO = {
    *("candidates", "fine_candidates", "directions", "friction", "stiffness", "slide_stiffness"),
    *("most", "first_budget", "trials", "hold_time", "searches", "rounds", "steps", "close_steps"),
    *("delta_start", "delta_end", "stopping_force", "time_step", "speed"),
}


@cache
def _registered() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=_GROUP)}


@cache
def run_plugins() -> None:
    """Load the plugins that GRASPD_PLUGINS lists. Do so after importing this module, because plugins import it."""
    for path in plugin_files():
        load_plugin(path, _PLUGINS, f"paths of .py files, separated by {os.pathsep!r}")


def method_names() -> tuple[str, ...]:
    """Return the names of all methods, of graspd_core and of other packages."""
    run_plugins()
    return tuple(dict.fromkeys((*METHODS, *_registered())))


def method_row(name: Any, where: str = "config") -> Method:
    """Return the row of a method. Raises ConfigError: the method is unknown. The message begins with `where`."""
    run_plugins()
    if not isinstance(name, str) or (name not in METHODS and name not in _registered()):
        raise ConfigError(f"{where}.method: unknown method {short_repr(name)}; {choices(name, method_names())}")
    if name not in METHODS:
        METHODS[name] = _registered()[name].load()
    return METHODS[name]


@dataclass(frozen=True)
class PlanConfig:
    """Settings of a run, apart from the scene, the hand and the seed.

    Attributes:
        resolution: the object's distance grid has at most `resolution`³ nodes, for a cube `resolution` per side.
        method: name of the method, one of `method_names`.
        settings: settings of the method, an instance of `Method.config`. None takes the defaults.
        problem: settings for converting scene and hand to tensors.
        grasp_stages: settings of pregrasp and squeeze.
        rounds: settings of the rounds of optimisation and trial.
        robust: settings for sorting the verified grasps by robustness.
        certainty: required certainty of a grasp if part of the object's surface is a guess.

    Raises:
        ConfigError: the method is unknown, the settings belong to another method, or a number is out of range.
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
            raise ConfigError(f"settings of {self.method}: {type(self.settings).__name__}; valid: {config.__name__}")
        values = to_mapping(self)
        # A plugin knows the range of its own settings.
        if not config.__module__.startswith("graspd_"):
            del values[self.method]
        _refuse_values(values)

    def at_budget(self, budget: float) -> PlanConfig:
        """Return the settings with the method's effort scaled by `budget`. A budget of 1 changes nothing."""
        return dataclasses.replace(self, settings=method_row(self.method).at_budget(self.settings, budget))

    def with_method(self, method: str) -> PlanConfig:
        """Return the settings with `method` at its defaults. Return them unchanged if they already have this method."""
        return self if method == self.method else dataclasses.replace(self, method=method, settings=None)


def _refuse_values(values: Mapping[str, Any], prefix: str = "") -> None:
    for key, value in values.items():
        name = prefix + key
        if isinstance(value, Mapping):
            _refuse_values(value, f"{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            least = (1 if isinstance(value, int) else _TINY) if key in _NOT_ZERO else 0
            most = _LESS.get(key, _MOST)
            if not least <= value <= most:
                raise ConfigError(f"{name}: {value!r}; valid: {least} to {most}")


def to_mapping(config: PlanConfig) -> dict[str, Any]:
    """Return the settings as nested mappings, as in a preset file. The method's name is the key of its settings."""
    values = dataclasses.asdict(config)
    return {config.method if key == "settings" else key: value for key, value in values.items()}


def plan_config(values: Any, where: str = "config") -> PlanConfig:
    """Build the settings of a run from a preset's nested mappings.

    Raises ConfigError: unknown key, wrong type or value. The message has the dotted name and the valid choices.
    """
    named = values.get("method", _DEFAULT_METHOD) if isinstance(values, Mapping) else _DEFAULT_METHOD
    row = method_row(named, where)
    hints = {f.name: f.default_factory for f in dataclasses.fields(PlanConfig) if f.name not in ("settings", "method")}
    hints |= {"resolution": int, "method": str, named: row.config}
    unknown = set(values) - set(hints) if isinstance(values, Mapping) else ()
    # `method_names` searches other packages, which is slow. So it is called only for an unknown key.
    if others := sorted(name for name in unknown if name in method_names()):
        raise ConfigError(f"{where}.{others[0]}: not used with method: {named}; remove it, or set method: {others[0]}")
    found = coerced(hints, values, where)
    try:
        return PlanConfig(**{("settings" if key == named else key): value for key, value in found.items()})
    except ConfigError as error:
        raise ConfigError(f"{where}.{error}") from None


def override(config: PlanConfig, changes: Mapping[str, Any]) -> PlanConfig:
    """Return the settings with the values in `changes`, which maps dotted names of a preset file to new values.

    Raises:
        ConfigError: a name is unknown, or a value has the wrong type or is out of range.
    """
    if "method" in changes:
        config = config.with_method(changes["method"])
    values = to_mapping(config)
    for name, value in changes.items():
        *sections, last = name.split(".")
        section = values
        for key in sections:
            # A name below a number replaces the number, and `plan_config` refuses the mapping.
            inner = section.get(key)
            section[key] = section = inner if isinstance(inner, dict) else {}
        section[last] = value
    return plan_config(values, "settings")


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets in `config/presets`."""
    return tuple(sorted(path.stem for path in (config_dir() / "presets").glob("*.yaml")))


def load_preset(name: str) -> PlanConfig:
    """Load a preset by name, or a preset file by path.

    Raises:
        ConfigError: the preset does not exist, the YAML is malformed, or a key or value is invalid.
    """
    run_plugins()  # Otherwise, `yaml_values` would report a fault of a plugin as a fault of the preset's file.
    by_path = Path(name).suffix in (".yaml", ".yml") or "/" in name
    path = Path(name) if by_path else config_dir() / "presets" / f"{name}.yaml"
    if not path.is_file():
        fault = f"preset {name}: no such file" if by_path else f"unknown preset {name!r}"
        raise ConfigError(f"{fault}; {choices(name, preset_names(), ', or a .yaml file')}")
    with yaml_values(path) as values:
        return plan_config(values, where=path.name)


def load_plugin(path: str, where: str = "plugin", valid: str = "the path of a .py file") -> str:
    """Run a Python file that registers methods, metrics or trials. Child processes run it too. Return its path.

    `where` and `valid` are words for an error: what gave the path, and what is valid there.

    Raises:
        ConfigError: the file does not exist, its module name is taken, or the file raises.
    """
    file = Path(path).resolve()
    if file.suffix != ".py" or not file.is_file():
        raise ConfigError(f"{where}: {path} is not a Python file; valid: {valid}")
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    try:
        module = importlib.import_module(file.stem)
    except Exception as error:
        raise ConfigError(f"plugin {path}: {type(error).__name__}: {error}") from error
    if module.__file__ is None or Path(module.__file__).resolve() != file:
        raise ConfigError(f"plugin {path}: a module called {file.stem} exists; give the file another name")
    os.environ[_PLUGINS] = os.pathsep.join(dict.fromkeys((*plugin_files(), str(file))))
    return str(file)


def plugin_files() -> tuple[str, ...]:
    """Return the paths of the plugins of this process and of its parent."""
    return tuple(filter(None, os.environ.get(_PLUGINS, "").split(os.pathsep)))
