"""The child process of a process that serves: cheap to import, so that it can be started before all else."""

from __future__ import annotations

from graspd_core.runtime.worker_process import start_worker_process

# What the child's work imports: all of a scene from clouds, and the library behind it.
_MODULES = ("graspd_core.scene.scene_from_views", "open3d")


def start_planning_worker() -> None:
    """Start the child process, if there is none yet; it imports what it needs beside what this process does."""
    start_worker_process(*_MODULES)
