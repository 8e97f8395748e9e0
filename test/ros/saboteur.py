"""A node like any other, but for its planner: it raises what the seed says, or is sure of no grasp.

Started by test_node_process.py.
"""

import sys
from dataclasses import replace
from typing import Any

from graspd_core.types import ROBUSTNESS, Outcome, TrialResult
from graspd_ros import request_planner as planning
from graspd_ros.node import main

ERRORS: dict[int, BaseException] = {
    1: MemoryError(),
    2: RuntimeError("[enforce fail at alloc_cpu.cpp:1] DefaultCPUAllocator: can't allocate memory: you tried 8 GB"),
    3: RuntimeError("shapes differ"),
    4: SystemExit(3),
    5: BaseException("no reason at all"),
}
DOUBTS = 7
honest = planning.plan_grasps


def rigged(*args: Any, seed: int, **kwargs: Any):
    if seed in ERRORS:
        raise ERRORS[seed]
    if seed != DOUBTS:
        return honest(*args, seed=seed, **kwargs)
    found = honest(*args, seed=seed, **kwargs | {"progress": lambda progress: None})
    doubt = TrialResult(ROBUSTNESS, False, 0.0, 0.0, "holds on the likeliest shape only")
    doubted = tuple(replace(grasp, trials=(*grasp.trials, doubt)) for grasp in found.tried)
    return replace(found, tried=doubted, outcome=Outcome.TOO_FEW)


if __name__ == "__main__":
    planning.plan_grasps = rigged
    sys.exit(main())
