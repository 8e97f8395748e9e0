"""Blocks of a data set. A block is one call of the planner and its file, named by a hash of the inputs: the key."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from graspd_core.errors import ConfigError
from graspd_core.hands.library import hand_hash
from graspd_core.mesh.shapes import object_hash, object_sources
from graspd_core.optimize.plan_config import PlanConfig, load_preset, to_mapping
from graspd_core.planning.plan_grasps import check_request
from graspd_dataset.dataset_store import SCHEMA_VERSION
from graspd_dataset.run_records import object_name

Measured = Literal["verified", "all", "none"]
MEASURED: tuple[str, ...] = get_args(Measured)
# Hexadecimal digits of a key: 128 bits.
_DIGITS = 32


def content_key(inputs: Any) -> str:
    """Return the key of JSON-ready values: the first 128 bits of the values' SHA-256, in hexadecimal."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:_DIGITS]


@dataclass(frozen=True)
class DatasetObject:
    """An object at one scale, with mass and friction.

    Attributes:
        source: shape:NAME (a built-in shape) or a mesh file.
        content: hash of the shape's or the file's content.
        scale: factor on the file's coordinates.
        mass: mass [kg]. If None, the greatest plausible mass for the object's volume.
        friction: Coulomb coefficient between hand and object.
    """

    source: str
    content: str
    scale: float
    mass: float | None
    friction: float

    @property
    def inputs(self) -> dict[str, Any]:
        """Return the values that identify the object, for JSON. The file's name is not one of them."""
        return {"content": self.content, "scale": self.scale, "mass": self.mass, "friction": self.friction}

    @cached_property
    def key(self) -> str:
        """Return the key of the object: a hash of `inputs`."""
        return content_key(self.inputs)


@dataclass(frozen=True)
class Block:
    """One call of `plan_grasps`. All candidates that the call tried are in one file.

    Attributes:
        object: the object to grasp.
        hand: name or path of the hand.
        hand_content: hash of the hand's files.
        preset: name of the preset, a set of settings.
        config: the settings of the preset.
        verify: which trials run: a name in `VERIFICATIONS`.
        measure: which grasps get metrics: verified, all or none.
        seed: random seed of `plan_grasps`.
        count: number of verified grasps wanted.
    """

    object: DatasetObject
    hand: str
    hand_content: str
    preset: str
    config: PlanConfig
    verify: str
    measure: str
    seed: int
    count: int

    @property
    def hand_name(self) -> str:
        """Return the name of the hand, as in the folder `hand=NAME` of the data set."""
        return object_name(self.hand)

    @property
    def inputs(self) -> dict[str, Any]:
        """Return all values that the rows depend on, except the code version, for JSON."""
        return {
            "schema": SCHEMA_VERSION,
            "object": self.object.inputs,
            "hand": self.hand_content,
            "settings": to_mapping(self.config),
            "verify": self.verify,
            "measure": self.measure,
            "seed": self.seed,
            "count": self.count,
        }

    @cached_property
    def key(self) -> str:
        """Return the key of the block: a hash of `inputs`. The block's file is named after the key."""
        return content_key(self.inputs)


@dataclass(frozen=True)
class DatasetRequest:
    """The requested content of a data set.

    Attributes:
        objects: built-in shapes (shape:NAME), mesh files, or folders of mesh files.
        hands: names or paths of the hands.
        per_object: number of verified grasps wanted for every object, scale and hand.
        block: number of verified grasps wanted in one block.
        preset: name or file of the preset.
        seed: random seed of the random scales, and of the first block of each object and hand. Each later block adds 1.
        scales: factors on every object's coordinates.
        random_scales: number of further random factors per object, then the least and the greatest factor. Their
            logarithms are drawn uniformly.
        mass: mass of every object [kg]. If None, the greatest plausible mass for each object's volume.
        friction: Coulomb coefficient between hand and object.
        verify: which trials run: a name in `VERIFICATIONS`.
        measure: which grasps get metrics: verified, all or none.

    Raises:
        ConfigError: a number is out of range.
    """

    objects: tuple[str, ...]
    hands: tuple[str, ...] = ("allegro_right",)
    per_object: int = 128
    block: int = 128
    preset: str = "balanced"
    seed: int = 0
    scales: tuple[float, ...] = (1.0,)
    random_scales: tuple[int, float, float] = (0, 1.0, 1.0)
    mass: float | None = None
    friction: float = 0.6
    verify: str = "standard"
    measure: str = "verified"

    def __post_init__(self) -> None:
        check_request(count=self.block, seed=self.seed, verify=self.verify, deadline=None, device="cpu")
        if self.per_object < 1:
            raise ConfigError(f"per-object: {self.per_object} grasps; valid: 1 or more")
        if self.measure not in MEASURED:
            raise ConfigError(f"measure: {self.measure!r}; valid: {', '.join(MEASURED)}")
        number, low, high = self.random_scales
        if number < 0 or not 0 < low <= high < np.inf:
            raise ConfigError(f"random-scales: {number} {low:g} {high:g}; valid: N >= 0 and 0 < LOW <= HIGH")
        for name, value in [("scales", s) for s in self.scales] + [("mass", self.mass), ("friction", self.friction)]:
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ConfigError(f"{name}: {value!r}; valid: a positive number")


def blocks_of(request: DatasetRequest) -> tuple[Block, ...]:
    """Return the blocks of a data set, object by object. Raises GraspdError: no such object, hand or preset."""
    config = load_preset(request.preset)
    hands = {name: hand_hash(name) for name in request.hands}
    preset = Path(request.preset).stem if request.preset.endswith((".yaml", ".yml")) else request.preset
    starts = range(0, request.per_object, request.block)
    return tuple(
        Block(found, hand, hashed, preset, config, request.verify, request.measure, request.seed + number, count)
        for found in _objects(request)
        for hand, hashed in hands.items()
        for number, count in enumerate(min(request.block, request.per_object - start) for start in starts)
    )


def by_object(blocks: Sequence[Block]) -> list[tuple[DatasetObject, list[Block]]]:
    """Return each object with its blocks. Objects are in the order of their first block."""
    groups: dict[str, tuple[DatasetObject, list[Block]]] = {}
    for block in blocks:
        groups.setdefault(block.object.key, (block.object, []))[1].append(block)
    return list(groups.values())


def _objects(request: DatasetRequest) -> list[DatasetObject]:
    """Return every object at every scale, without duplicates."""
    found: dict[str, DatasetObject] = {}
    for source in object_sources(request.objects):
        content = object_hash(source)
        for scale in (*request.scales, *_drawn_scales(content, request)):
            made = DatasetObject(source, content, scale, request.mass, request.friction)
            found.setdefault(made.key, made)
    return list(found.values())


def _drawn_scales(content: str, request: DatasetRequest) -> list[float]:
    number, low, high = request.random_scales
    draw = np.random.default_rng([int(content[:8], 16), request.seed]).uniform(np.log(low), np.log(high), number)
    return [round(float(scale), 4) for scale in np.exp(draw)]
