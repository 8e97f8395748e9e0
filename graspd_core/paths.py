"""Find graspd's configuration files, in a checkout or in an installation."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from graspd_core.errors import ConfigError

ENVIRONMENT_VARIABLE = "GRASPD_CONFIG"
_INSTALLED = Path("share") / "graspd" / "config"


def config_dir() -> Path:
    """Return the directory that holds `hands/`, `presets/` and the node parameters.

    The search order is: the environment variable GRASPD_CONFIG, the checkout of this file, then `share/graspd/config`
    under the installation's prefix (a virtual environment, `~/.local`, a colcon workspace) and under `sys.prefix`.
    Raises ConfigError: GRASPD_CONFIG names no directory, or the installation is incomplete.
    """
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    if named:
        if not Path(named).is_dir():
            raise ConfigError(f"{ENVIRONMENT_VARIABLE}={named}: not a directory; it must hold hands/ and presets/")
        return Path(named).resolve()
    here = Path(__file__).resolve()
    checkout = here.parents[1] / "config"
    candidates = [checkout, *(parent / _INSTALLED for parent in here.parents), Path(sys.prefix) / _INSTALLED]
    for candidate in candidates:
        if (candidate / "hands").is_dir():
            return candidate
    raise ConfigError(
        f"graspd's config directory was found neither at {checkout} nor at {Path(sys.prefix) / _INSTALLED}; "
        f"set {ENVIRONMENT_VARIABLE} to the config directory of a checkout"
    )
