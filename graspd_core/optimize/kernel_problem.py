"""Convert a problem to the memory layout of the compiled kernel: arrays of float32 and int32.

The arrays of the last hands, objects and obstacles are cached, because the searches of a run share them.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import Structure, addressof, byref
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import collision_spheres
from graspd_core.mesh.sdf import GridSDF
from graspd_core.optimize.kernel import builds as structs
from graspd_core.optimize.loop import Rows, Values
from graspd_core.optimize.obstacle_distance import ObstacleTensors
from graspd_core.optimize.problem import (
    FEATURE_PAIRS,
    OBSTACLE_MARGIN,
    REACH_WHEN_SHARP,
    TASK_POINTS,
    HandTensors,
    ObjectTensors,
    PointSet,
    Problem,
)

# Floats in a vector of the widest build. The kernel may read up to this many floats past the last value.
_LANES = 16
Argument = Tensor | Structure | int | float
_KINDS = {"fixed": 0, "revolute": 1, "prismatic": 2}


@dataclass
class Arrays:
    """Owner of the arrays that kernel structures point into. The arrays live as long as this object."""

    kept: list[object] = field(default_factory=list)

    def floats(self, values: np.ndarray | Tensor) -> int:
        """Copy the values to aligned float32 memory, with zeros behind the last value. Return the address."""
        return self._keep(values, np.float32)

    def ints(self, values: np.ndarray | Tensor) -> int:
        """Copy the values to aligned int32 memory and return the address."""
        return self._keep(values, np.int32)

    def rows(self, columns: np.ndarray, width: int) -> int:
        """Copy each column of an (n, k) array to a row of `width` floats, padded by zeros. Return the address."""
        padded = np.zeros((columns.shape[1], width), dtype=np.float32)
        padded[:, : len(columns)] = columns.T
        return self.floats(padded)

    def _keep(self, values: np.ndarray | Tensor, dtype: type) -> int:
        flat = np.asarray(values, dtype=dtype).ravel()
        memory = np.zeros(len(flat) + 2 * _LANES, dtype=dtype)
        first = -memory.ctypes.data % 64 // 4
        memory[first : first + len(flat)] = flat
        self.kept.append(memory)
        return memory.ctypes.data + 4 * first


@dataclass(frozen=True, eq=False)
class KernelProblem:
    """A problem in the kernel's memory layout. `struct` points into `arrays`. See `Problem.compiled`."""

    struct: structs.Problem
    arrays: tuple[Arrays, ...]

    def call(self, function: str, *arguments: Argument, watch: Callable[[int], bool] | None = None) -> None:
        """Call a function of the kernel with the problem, the arguments, and as many threads as torch has.

        Args:
            function: name of the function.
            arguments: tensors are passed as addresses of their values and must be contiguous.
            watch: called in this thread every few milliseconds with the steps done, summed over all rows. True ends it.

        Raises:
            MemoryError: the threads need more memory than is available.
        """
        failures: list[BaseException] = []

        def poll(done: int) -> int:
            # An exception, such as Ctrl-C, cannot pass through C++. So it ends the call, and is raised afterwards.
            try:
                return bool(watch and watch(done))
            except BaseException as failure:
                failures.append(failure)
                return True

        last = () if watch is None else (structs.POLL(poll),)
        called = getattr(structs.kernel().library, function)
        status = called(byref(self.struct), *map(_given, arguments), torch.get_num_threads(), *last)
        if failures:
            raise failures[0]
        if status != 0:
            raise MemoryError(f"{function}: not enough memory for {torch.get_num_threads()} threads; use fewer threads")


def least_gap(compiled: KernelProblem, x: Rows, wide: float) -> Values:
    """Return the least distance of the hand at each row of `pack` to support and obstacles [m], at most `wide`."""
    gap = torch.empty(len(x), dtype=torch.float32)
    compiled.call("graspd_least_gap", len(x), x.contiguous(), wide, gap)
    return gap


def _given(argument: Argument) -> object:
    if isinstance(argument, Tensor):
        return argument.data_ptr()
    return byref(argument) if isinstance(argument, Structure) else argument


def kernel_problem(problem: Problem) -> KernelProblem:
    """Convert a problem to the kernel's memory layout. The kernel must be able to evaluate it (`Problem.compiled`)."""
    hand, hand_arrays = _hand(problem.hand)
    target, object_arrays = _object(problem.object)
    obstacles, obstacle_arrays = _obstacles(problem.obstacles)
    own = Arrays()
    struct = structs.Problem(
        object=target,
        obstacles=obstacles,
        directions=len(problem.directions),
        task_points=TASK_POINTS,
        feature_pairs=FEATURE_PAIRS,
        direction=own.floats(problem.directions),
        friction=problem.friction,
        sharp_reach=REACH_WHEN_SHARP,
        **hand,
    )
    return KernelProblem(struct, (hand_arrays, object_arrays, obstacle_arrays, own))


@lru_cache(maxsize=8)
def _hand(hand: HandTensors) -> tuple[dict[str, Structure], Arrays]:
    """Return the hand's fields of `builds.Problem`, and the arrays that they point to."""
    arrays = Arrays()
    spheres, radii, links = collision_spheres(hand.model)
    order = np.argsort(links, kind="stable")
    width = _padded(len(order))
    weight = np.zeros((len(order), width))
    # Each pair is stored once, above the diagonal. Sorting the spheres by link may move a pair below the diagonal.
    both = hand.spheres.weight + hand.spheres.weight.T
    weight[:, : len(order)] = np.triu(both.numpy()[np.ix_(order, order)], 1)
    centers = _points(spheres[order], links[order], arrays)
    radius = arrays.rows(radii[order, None], width)
    parts: dict[str, Structure] = {
        "hand": _links(hand, arrays),
        "coarse": _candidates(hand.model, hand.coarse, arrays),
        "fine": _candidates(hand.model, hand.fine, arrays),
        "solids": _solids(hand, arrays),
        "spheres": structs.Spheres(centers, radius, arrays.floats(weight)),
    }
    return parts, arrays


def _links(hand: HandTensors, arrays: Arrays) -> structs.Hand:
    model, k = hand.model, hand.kinematics
    count = model.num_links
    order = k.order.numpy()

    def rows(values: Tensor | None) -> int:
        return arrays.floats(np.zeros((count, 12)) if values is None else values.numpy()[order])

    return structs.Hand(
        links=count,
        joints=model.num_joints,
        groups=len(hand.reach),
        parent=arrays.ints(model.link_parent),
        joint=arrays.ints(np.maximum(model.link_joint, 0)),
        kind=arrays.ints(np.array([_KINDS[kind] for kind in model.joint_kind])),
        **{name: rows(getattr(k, name)) for name in ("constant", "sine", "cosine", "slide")},
        axis=arrays.floats(model.joint_axis),
        multiplier=arrays.floats(model.link_multiplier),
        shift=arrays.floats(model.link_shift),
        **{name: arrays.floats(getattr(hand, name)) for name in ("lower", "upper", "joint_scale", "pivot", "reach")},
    )


def _candidates(hand: HandModel, points: PointSet, arrays: Arrays) -> structs.Points:
    """Return the contact candidates sorted by candidate group (`PointSet.groups`), then by link."""
    links = points.links.numpy()
    # A candidate on links without coarse candidates is in no group, and comes last.
    group = np.full(len(links), len(points.groups))
    for index, members in enumerate(points.groups.numpy()):
        group[members] = index
    order = np.lexsort((links, group))
    starts = np.searchsorted(group[order], np.arange(len(points.groups) + 1))
    return _points(hand.candidate_points[order], links[order], arrays, starts)


def _points(
    points: Float[np.ndarray, "points 3"],
    links: Int[np.ndarray, "points"],
    arrays: Arrays,
    group_start: Int[np.ndarray, "groups"] | None = None,
) -> structs.Points:
    starts = np.flatnonzero(np.diff(links, prepend=-1))
    return structs.Points(
        count=len(points),
        stride=_padded(len(points)),
        runs=len(starts),
        xyz=arrays.rows(points, _padded(len(points))),
        run_start=arrays.ints(np.append(starts, len(points))),
        run_link=arrays.ints(links[starts]),
        group_start=None if group_start is None else arrays.ints(group_start),
    )


def _solids(hand: HandTensors, arrays: Arrays) -> structs.Solids:
    solids = hand.solids
    group = hand.group_of_solid.numpy()
    near, reach = np.zeros((len(group), _padded(len(group)))), (solids.core.norm(dim=-1) + solids.radius).numpy()
    first, second = hand.solid_pairs.numpy().T
    near[first, second] = (reach[first] + reach[second]) ** 2
    return structs.Solids(
        count=len(group),
        pose=arrays.floats(torch.cat([solids.rotation, solids.translation[..., None]], -1)),
        core=arrays.floats(solids.core),
        radius=arrays.floats(solids.radius),
        round=arrays.ints(solids.is_round),
        link=arrays.ints(solids.link),
        group=arrays.ints(np.where(group < len(hand.reach), group, -1)),
        near=arrays.floats(near),
        stride=near.shape[1],
    )


@lru_cache(maxsize=4)
def _object(target: ObjectTensors) -> tuple[structs.Object, Arrays]:
    arrays = Arrays()
    width = _padded(len(target.features))
    return structs.Object(
        grid=_grid(target.sdf, arrays),
        confidence=None if target.confidence is None else arrays.floats(target.confidence),
        center=tuple(target.center.tolist()),
        length=target.length,
        features=arrays.rows(target.features.numpy(), width),
        feature_count=len(target.features),
        feature_stride=width,
        coarse_features=min(target.coarse_features, len(target.features)),
    ), arrays


def _grid(sdf: GridSDF, arrays: Arrays) -> structs.Grid:
    nodes = arrays.floats(sdf.field.permute(1, 2, 3, 0))
    return structs.Grid(nodes, *sdf.field.shape[1:], tuple(sdf.origin.tolist()), float(sdf.spacing))


@lru_cache(maxsize=4)
def _obstacles(obstacles: ObstacleTensors | None) -> tuple[structs.Obstacles, Arrays]:
    arrays = Arrays()
    if obstacles is None:
        return structs.Obstacles(), arrays
    grids = (structs.Grid * len(obstacles.sdfs))(*(_grid(sdf, arrays) for sdf in obstacles.sdfs))
    arrays.kept.append(grids)
    corners, corner_radius = _balls(obstacles, slice(obstacles.corners), arrays)
    spheres, sphere_radius = _balls(obstacles, slice(obstacles.corners, None), arrays)
    return structs.Obstacles(
        grids=len(obstacles.sdfs),
        has_support=obstacles.normal is not None,
        grid=addressof(grids) if obstacles.sdfs else None,
        normal=(0.0, 0.0, 0.0) if obstacles.normal is None else tuple(obstacles.normal.tolist()),
        offset=obstacles.offset,
        margin=OBSTACLE_MARGIN,
        corners=corners,
        spheres=spheres,
        corner_radius=corner_radius,
        sphere_radius=sphere_radius,
    ), arrays


def _balls(obstacles: ObstacleTensors, some: slice, arrays: Arrays) -> tuple[structs.Points, int]:
    points, radii, links = (x[some].numpy() for x in (obstacles.points, obstacles.radii, obstacles.links))
    order = np.argsort(links, kind="stable")
    return _points(points[order], links[order], arrays), arrays.floats(radii[order])


def _padded(count: int) -> int:
    return -(-count // _LANES) * _LANES
