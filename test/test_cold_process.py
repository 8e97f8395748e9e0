"""What a fresh interpreter has imported when it has planned on a mesh: only what the run used."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

# Each takes 0.1 s or more to import, or pulls in what does.
UNUSED = [
    "open3d",
    "trimesh",
    "matplotlib",
    "scipy.stats",
    "scipy.optimize",
    "fast_simplification",
    "pybullet",
]
UNUSED += [
    "rclpy",
    "networkx",
    "pandas",
    "dash",
    "sympy",
    "torch._dynamo",
    "graspd_core.perception.reconstruct.reconstruct",
]
UNUSED += ["graspd_core.perception.segment.segment", "graspd_bench.suites"]

LIBRARY = """
from graspd_core import load_hand, load_scene, plan_grasps
result = plan_grasps(load_scene("shape:mug"), load_hand("allegro_right"), count=1, preset="fast")
assert result.timing.verify > 0
"""
COMMAND = """
from graspd_core.cli import main
assert main(["synthesize", "shape:mug", "-n", "1", "--preset", "fast"]) in (0, 3)
"""


@pytest.mark.parametrize("program", [LIBRARY, COMMAND], ids=["library", "command"])
@pytest.mark.parametrize("kept", [False, True], ids=["nothing on disk", "all on disk"])
def test_a_plan_on_a_mesh_imports_what_it_uses(program, kept, tmp_path):
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "GRASPD_CACHE": ""}
    ask = f"{program}\nimport sys\nprint([name for name in {UNUSED!r} if name in sys.modules])"
    for _ in range(1 + kept):
        run = subprocess.run([sys.executable, "-c", ask], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.splitlines()[-1] == "[]"
