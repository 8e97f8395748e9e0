"""`graspd doctor`: check the installation and name the remedy for each failure.

Each library is imported in a subprocess, because a library that aborts at import would end the report. The ROS check
also runs in a subprocess, so that this process never loads rclpy.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from graspd_core.cli.output import answer, waiting

PROBE_TIMEOUT = 60.0  # Seconds. Importing torch or Open3D from a cold disk takes several seconds.
_SETUP = "run `make setup` in the checkout, or pip install graspd again"
_CLOUDS = "only clouds need it: pip install 'graspd[clouds]'"
# Shared libraries that Open3D loads, and the packages that provide them.
_SYSTEM_LIBRARIES = {"libusb-1.0.so.0": "libusb-1.0-0", "libGL.so.1": "libgl1", "libgomp.so.1": "libgomp1"}
# Name of each library's distribution, and name of the module to import.
_LIBRARIES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "trimesh": "trimesh",
    "libigl": "igl",
    "fast-simplification": "fast_simplification",
    "pytorch-kinematics": "pytorch_kinematics",
    "pyyaml": "yaml",
}
_LIBRARY = "import {module}; from importlib.metadata import version; print(version({name!r}))"
_LOADED = "import ctypes; ctypes.CDLL({name!r}); print('found')"
_TORCH = """
import torch
torch.linalg.inv(torch.eye(3))
device = "CUDA " + torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
print(f"{torch.__version__}, {device}, {torch.get_num_threads()} threads")
"""
_MUJOCO = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_step(model, data, 10)
assert data.qpos[2] < 0, "a dropped ball did not fall"
print(f"{mujoco.__version__}, steps a model")
"""
_BULLET = """
import sys
if sys.version_info >= (3, 12):
    print("none for this Python; benchmarks leave the displacement trial out")
else:
    import pybullet
    from importlib.metadata import version
    pybullet.disconnect(pybullet.connect(pybullet.DIRECT))
    print(version("pybullet"))
"""
_KERNEL = """
from graspd_core.optimize.kernel.builds import kernel
found = kernel()
assert found.library, found.reason
print(f"{found.name}, {found.library.graspd_lanes()} floats at once")
"""
# graspd_ros checks ROS, because graspd_core must not import rclpy.
_ROS = "from graspd_ros.node import probe; print(probe())"
_HANDS = """
import torch
torch.set_num_threads(1)
from graspd_core.hands.library import hand_names, load_hand
print(", ".join(f"{name} ({len(load_hand(name).joint_names)} joints)" for name in hand_names()))
"""


@dataclass(frozen=True)
class Check:
    """The result of checking one library or one part of the installation. `needed` says whether graspd needs it.

    `detail` is a version or a number. If the check failed, `detail` is the error in one line, and `hint` is the remedy.
    """

    name: str
    ok: bool
    detail: str
    hint: str = ""
    needed: bool = True


def run_checks() -> list[Check]:
    """Check the installation and all dependencies of graspd. This takes a few seconds."""
    clouds = importlib.util.find_spec("open3d") is not None
    loaded = _SYSTEM_LIBRARIES.items() if clouds else ()
    probes = [
        *((name, _LOADED.format(name=name), f"sudo apt-get install {package}", True) for name, package in loaded),
        ("torch", _TORCH, _SETUP, True),
        ("mujoco", _MUJOCO, _SETUP, True),
        ("compiled kernel", _KERNEL, f"torch replaces it and is 30 times slower: {_SETUP}", False),
        *((name, _LIBRARY.format(module=module, name=name), _SETUP, True) for name, module in _LIBRARIES.items()),
        ("open3d", _LIBRARY.format(module="open3d", name="open3d"), _CLOUDS, clouds),
        ("hands", _HANDS, "check the files under config/hands, or unset GRASPD_CONFIG", True),
        ("pybullet", _BULLET, "only benchmarks need it: make setup, on Python 3.11", False),
        ("ROS 2 (rclpy)", _ROS, "only the node needs it: make setup (docs/ros.md)", False),
    ]
    with ThreadPoolExecutor(max_workers=2) as pool:
        probed = list(waiting(pool.map(lambda probe: try_code(*probe), probes), "check", len(probes)))
    return [_check_python(), *probed, _check_cache()]


def try_code(name: str, code: str, hint: str, needed: bool) -> Check:
    """Run Python code in a subprocess. If the code fails, the check fails. The last line of output is the `detail`."""
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PROBE_TIMEOUT)
    except subprocess.TimeoutExpired:
        return Check(name, False, f"no answer within {PROBE_TIMEOUT:.0f} s", hint, needed)
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    last = lines[-1] if lines else f"ended with status {done.returncode}"
    return Check(name, done.returncode == 0, last, hint, needed)


def format_checks(checks: Iterable[Check]) -> str:
    """Return the report as text: one line per check, and one line with the hint below each failed check."""
    lines = []
    for check in checks:
        verdict = "ok  " if check.ok else "FAIL" if check.needed else "-   "
        lines.append(f"{verdict} {check.name:<20} {check.detail}")
        if check.hint and not check.ok:
            lines.append(f"     {'':<20} -> {check.hint}")
    return "\n".join(lines)


def add_command(commands: Any) -> None:
    """Add the command `doctor` to the parser."""
    commands.add_parser("doctor").set_defaults(run=lambda options: main())


def main() -> int:
    """Print the report. Return 0 if all needed checks pass, else 1."""
    checks = run_checks()
    print(format_checks(checks))
    answer(checks)
    return 0 if all(check.ok for check in checks if check.needed) else 1


def _check_python() -> Check:
    version = ".".join(map(str, sys.version_info[:3]))
    ok = (3, 11) <= sys.version_info[:2] <= (3, 13)
    return Check("Python", ok, f"{version} at {sys.executable}", "use Python 3.11 to 3.13")


def _check_cache() -> Check:
    from graspd_core.runtime.disk_cache import cache_path

    path = cache_path("doctor")
    if path is None:
        return Check("cache", True, "kept in memory only (GRASPD_CACHE=off)")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        hint = "make the directory writable, or set XDG_CACHE_HOME or GRASPD_CACHE=off (then every start is slow)"
        return Check("cache", False, str(error), hint, needed=False)
    return Check("cache", True, f"{path.parent} is writable")
