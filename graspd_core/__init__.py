"""graspd: verified grasps for multi-fingered hands.

from graspd_core import plan_grasps, load_hand, load_scene
result = plan_grasps(load_scene("mug.obj"), load_hand("allegro_right"), count=16, seed=0)
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from graspd_core.pipeline import load_hand, load_scene, plan_grasps

__all__ = ["load_hand", "load_scene", "plan_grasps"]


def __getattr__(name: str) -> Any:
    # The front door pulls torch in; `import graspd_core.errors` should not.
    if name in __all__:
        from graspd_core import pipeline

        return getattr(pipeline, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
