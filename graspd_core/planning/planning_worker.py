"""The child process of a process that serves: cheap to import, so that it can be started before all else."""

from __future__ import annotations

from graspd_core.runtime.worker_process import start_worker_process

# What the child's work imports: all of a scene from clouds and of other shapes, and the library behind them.
_MODULES = ("graspd_core.scene.scene_from_views", "graspd_core.planning.hypotheses", "open3d")


def start_planning_worker() -> None:
    """Start the child process, if there is none yet; it imports what it needs beside what this process does."""
    start_worker_process(*_MODULES)
