"""The compiled kernel and the files outside the Python packages; names and dependencies are in pyproject.toml."""

import platform
from pathlib import Path

from setuptools import Extension, setup

ROOT = Path(__file__).parent
SHARE = Path("share")
KERNEL = "graspd_core/optimize/kernel"
# Builds of the kernel: one of them is chosen when it is loaded (graspd_core/optimize/kernel/builds.py).
TARGETS = {"baseline": []}
if platform.machine() in ("x86_64", "AMD64"):
    TARGETS |= {"v3": ["-march=x86-64-v3"], "v4": ["-march=x86-64-v4"]}


def kernel_build(name: str, target: list[str]) -> Extension:
    """A shared library that ctypes loads: it needs no Python, so that one wheel fits all versions.

    Without a compiler graspd is installed all the same, and torch does the kernel's work. Fast mathematics is for
    compiling only: linked with it, a library makes the whole process flush small numbers to zero.
    """
    return Extension(
        f"{KERNEL.replace('/', '.')}.{name}",
        sources=[f"{KERNEL}/src/kernel.cpp"],
        depends=[str(path.relative_to(ROOT)) for path in sorted((ROOT / KERNEL / "src").glob("*.hpp"))],
        extra_compile_args=["-std=c++17", "-O3", "-ffast-math", "-fno-finite-math-only", "-Wno-psabi", *target],
        extra_link_args=["-pthread"],
        language="c++",
        py_limited_api=True,
        optional=True,
    )


def files_below(source: str, target: Path) -> list[tuple[str, list[str]]]:
    """Every file below `source`, kept in its directory below `target`."""
    by_directory: dict[str, list[str]] = {}
    for path in sorted((ROOT / source).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            directory = target / path.relative_to(ROOT / source).parent
            by_directory.setdefault(str(directory), []).append(str(path.relative_to(ROOT)))
    return list(by_directory.items())


setup(
    python_requires=">=3.11,<3.14",
    ext_modules=[kernel_build(name, target) for name, target in TARGETS.items()],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
    data_files=[
        (str(SHARE / "ament_index" / "resource_index" / "packages"), ["resource/graspd_ros"]),
        # The last two for `colcon build --symlink-install`, which runs setup.py beside links to the files named here.
        (str(SHARE / "graspd_ros"), ["package.xml", "pyproject.toml", "README.md"]),
        *files_below("graspd_ros/launch", SHARE / "graspd_ros" / "launch"),
        *files_below("config", SHARE / "graspd" / "config"),
    ],
)
