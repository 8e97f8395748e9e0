"""Plan verified grasps for multi-fingered hands. This package exports every name that a user of the library needs.

    from graspd_core import load_hand, load_scene, plan_grasps

    result = plan_grasps(load_scene("mug.obj"), load_hand("allegro_right"), count=16, seed=0)

Names are loaded on first use, so `import graspd_core` takes milliseconds and does not import torch. Lengths are in
metres, angles in radians, quaternions wxyz. Bad input raises a `GraspdError`. docs/api.md lists the names by purpose,
`__init__.pyi` by module.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

_IMPORT = re.compile(r"^from graspd_core\.(\S+) import (\w+)", re.MULTILINE)
_MODULE_OF = {name: module for module, name in _IMPORT.findall(Path(__file__).with_suffix(".pyi").read_text())}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
