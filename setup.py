"""The files that live outside the Python packages; names, dependencies and commands are in pyproject.toml."""

from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent
SHARE = Path("share")


def files_below(source: str, target: Path) -> list[tuple[str, list[str]]]:
    """Every file below `source`, kept in its directory below `target`."""
    by_directory: dict[str, list[str]] = {}
    for path in sorted((ROOT / source).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            directory = target / path.relative_to(ROOT / source).parent
            by_directory.setdefault(str(directory), []).append(str(path.relative_to(ROOT)))
    return list(by_directory.items())


setup(
    python_requires=">=3.11,<3.13",
    data_files=[
        (str(SHARE / "ament_index" / "resource_index" / "packages"), ["resource/graspd_ros"]),
        # The last two for `colcon build --symlink-install`, which runs setup.py beside links to the files named here.
        (str(SHARE / "graspd_ros"), ["package.xml", "pyproject.toml", "README.md"]),
        *files_below("graspd_ros/launch", SHARE / "graspd_ros" / "launch"),
        *files_below("config", SHARE / "graspd" / "config"),
    ],
)
