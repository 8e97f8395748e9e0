"""A node without an arm, a library or a MANO hand runs where none of them, nor any package beside it, can be imported.

Started as a program, this file is that node.
"""

import subprocess
import sys
from pathlib import Path

OPTIONAL = ("graspd_core.arms", "graspd_core.library", "graspd_core.hands.mano")
OPTIONAL += ("graspd_bench", "graspd_dataset", "graspd_viewer")


class Refuse:
    """Refuse to import what the node was not asked for."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name.startswith(OPTIONAL):
            raise ImportError(f"{name} is imported, though nobody asked for it")


def test_a_node_plans_on_a_mesh_without_the_optional_parts(client, start_node):
    client.forget()
    process = start_node(module=Path(__file__))
    client.send_mesh("sphere.obj")
    client.event(event="result")
    status, log = process.stop()
    assert status == 0
    assert "nobody asked for it" not in log


def test_a_node_that_is_not_asked_for_a_part_does_not_import_it():
    parts = {"sqlite3", "graspd_core.library", "moveit_msgs"}
    code = f"import sys, graspd_ros.grasp_node; print({parts} & {{*sys.modules}})"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "set()"


if __name__ == "__main__":
    sys.meta_path.insert(0, Refuse())  # pyright: ignore[reportArgumentType]
    from graspd_ros.node import main

    sys.exit(main())
