"""The files that live outside the Python packages; names, dependencies and commands are in pyproject.toml."""

from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent
SHARE = Path("share")


def config_files() -> list[tuple[str, list[str]]]:
    """Every file under config/, kept in its directory below share/graspd/config."""
    by_directory: dict[str, list[str]] = {}
    for path in sorted((ROOT / "config").rglob("*")):
        if path.is_file():
            relative = path.relative_to(ROOT)
            by_directory.setdefault(str(SHARE / "graspd" / relative.parent), []).append(str(relative))
    return list(by_directory.items())


setup(
    data_files=[
        (str(SHARE / "ament_index" / "resource_index" / "packages"), ["resource/graspd_ros"]),
        (str(SHARE / "graspd_ros"), ["package.xml"]),
        (str(SHARE / "graspd_ros" / "launch"), ["graspd_ros/launch/graspd.launch.py"]),
        *config_files(),
    ],
)
