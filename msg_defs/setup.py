"""graspd_msgs by pip, against the ROS wheels. colcon reads CMakeLists.txt and never runs this.

rosidl's generators turn msg/, srv/ and action/ into C and Python, and the system's compiler turns the C into the
libraries that a colcon build makes too (the C++ interface excepted: nothing in the wheels' world uses it).
"""

from __future__ import annotations

import atexit
import os
import shutil
import subprocess
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree

from setuptools import Distribution, setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
MANIFEST = ElementTree.parse(ROOT / "package.xml")
NAME = MANIFEST.findtext("name", "")
DEPENDENCIES = [element.text or "" for element in MANIFEST.iterfind("depend")]

# One library each, in an order in which each links to those before it.
GENERATORS = {
    "rosidl_generator_c": "GenerateC",
    "rosidl_typesupport_introspection_c": "GenerateIntrospectionCTypesupport",
    "rosidl_typesupport_fastrtps_c": "GenerateFastRTPSCTypesupport",
    "rosidl_typesupport_c": "GenerateCTypesupport",
    "rosidl_generator_py": "GeneratePython",
}
TYPESUPPORTS = [kind for kind in GENERATORS if "typesupport" in kind]
RUNTIME = ["rcutils", "rmw", "fastcdr", "rosidl_runtime_c", "rosidl_typesupport_fastrtps_cpp", *TYPESUPPORTS]
FLAGS = ["-O2", "-fPIC", "-w"]


def fail(message: str) -> NoReturn:
    raise SystemExit(f"{NAME}: {message}")


def interface_files() -> list[Path]:
    """Paths below this directory, such as msg/Grasp.msg."""
    return [path.relative_to(ROOT) for kind in ("msg", "srv", "action") for path in sorted((ROOT / kind).glob("*.*"))]


def ros_prefix() -> Path:
    """Where the ROS wheels are: the environment, or pip's isolated one."""
    try:
        generator = import_module("rosidl_generator_c")
    except ImportError as error:
        fail(f"the ROS wheels are missing ({error}); install graspd's `ros` extra, or drop --no-build-isolation")
    return Path(generator.__path__[0]).parents[3]


def compilers() -> tuple[str, str]:
    """The C and the C++ compiler; refuses what could not build a Python extension."""
    cc, cxx = os.environ.get("CC", "cc"), os.environ.get("CXX", "c++")
    for compiler in (cc, cxx):
        if not shutil.which(compiler.split()[0]):
            fail(f"no compiler {compiler!r}; install one with: sudo apt-get install build-essential")
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        package = f"python{sysconfig.get_python_version()}-dev"
        fail(f"Python.h is missing; install it with: sudo apt-get install {package}")
    return cc, cxx


def translate(share: Path) -> list[str]:
    """Write the .idl of every interface file into `share`; gives rosidl's names for them."""
    for path in interface_files():
        kind = path.parent.name
        convert = getattr(import_module(f"rosidl_adapter.{kind}"), f"convert_{kind}_to_idl")
        convert(ROOT, NAME, path, share / kind)
    return [f"{share}:{path.with_suffix('.idl')}" for path in interface_files()]


def generate(prefix: Path, share: Path, sources: Path) -> None:
    """Fill `share` with definitions and hashes, and `sources/<generator>/graspd_msgs` with code."""
    os.environ["AMENT_PREFIX_PATH"] = str(prefix)  # the generators look their templates up there
    includes = [str(prefix / "share" / name) for name in DEPENDENCIES]
    definitions = translate(share)
    hasher = import_module("rosidl_generator_type_description.cli").HashTypeDescription("hash")
    hashes = hasher.generate_type_hashes(NAME, definitions, includes, share)
    for kind, class_name in GENERATORS.items():
        generator = getattr(import_module(f"{kind}.cli"), class_name)(kind)
        options = {"type_description_files": hashes} if kind == "rosidl_generator_c" else {}
        generator.generate(NAME, definitions, includes, sources / kind / NAME, **options)


def run(command: list[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode:
        fail(f"{command[0]} failed to make {Path(command[-1]).name}: {result.stderr[-2000:]}")


def compile_all(cc: str, cxx: str, prefix: Path, sources: Path) -> None:
    """An object file beside every C and C++ source."""
    import numpy

    include = [
        # First: an installed package of the same name has the headers of its own version.
        *(sources / kind for kind in GENERATORS),
        prefix / "include",
        *(path for path in (prefix / "include").iterdir() if path.is_dir()),
        sysconfig.get_path("include"),
        numpy.get_include(),
    ]
    flags = [*FLAGS, *(f"-I{path}" for path in include)]

    def compile_one(path: Path) -> None:
        compiler = [*cxx.split(), "-std=c++17"] if path.suffix == ".cpp" else cc.split()
        run([*compiler, *flags, "-c", str(path), "-o", f"{path}.o"])

    # The largest first, so that no processor idles at the end.
    files = sorted(sources.rglob("*.c*"), key=lambda path: -path.stat().st_size)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(compile_one, files))


def link_all(cxx: str, prefix: Path, sources: Path, libraries: Path, package: Path) -> None:
    """The shared libraries, and the extension modules of the Python package."""
    libraries.mkdir(parents=True)
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    theirs = [f"-l{name}__{kind}" for name in DEPENDENCIES for kind in GENERATORS] + [f"-l{name}" for name in RUNTIME]

    def link(target: Path, objects: list[Path]) -> None:
        ours = [str(path) for path in sorted(libraries.glob("*.so"))]
        options = ["-shared", "-s", f"-Wl,-soname,{target.name}", *map(str, sorted(objects))]
        run([*cxx.split(), *options, "-Wl,--as-needed", *ours, f"-L{prefix / 'lib'}", *theirs, "-o", str(target)])

    for kind in GENERATORS:
        objects = [path for path in (sources / kind).rglob("*.o") if ".ep." not in path.name]
        link(libraries / f"lib{NAME}__{kind}.so", objects)
    for support in TYPESUPPORTS:
        objects = list((sources / "rosidl_generator_py").rglob(f"*.ep.{support}.c.o"))
        link(package / f"{NAME}_s__{support}{suffix}", objects)


def copy_python(sources: Path, package: Path) -> None:
    generated = sources / "rosidl_generator_py" / NAME
    for path in generated.rglob("*.py"):
        target = package / path.relative_to(generated)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    (package / "__init__.py").touch()


def copy_headers(sources: Path, include: Path) -> None:
    """The C headers, for packages whose messages hold these."""
    for kind in GENERATORS:
        generated = sources / kind
        for path in generated.rglob("*.h"):
            target = include / path.relative_to(generated)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)


def write_index(share: Path, index: Path) -> None:
    """What `ros2 interface` and ament look up."""
    definitions = [str(path.relative_to(share)) for path in share.glob("*/*") if path.suffix != ".json"]
    contents = {
        "packages": "",
        "rosidl_interfaces": "\n".join(sorted(definitions)),
        "package_run_dependencies": ";".join(DEPENDENCIES),
    }
    for resource, content in contents.items():
        (index / resource).mkdir(parents=True)
        (index / resource / NAME).write_text(content)


def data_files(tree: Path) -> list[tuple[str, list[str]]]:
    """Everything in `tree`, for the same place below the installation's prefix."""
    directories = {path.parent for path in tree.rglob("*") if path.is_file()}
    return [
        (str(directory.relative_to(tree)), [str(path) for path in sorted(directory.iterdir()) if path.is_file()])
        for directory in sorted(directories)
    ]


class BuildInterfaces(build_py):
    """Generates, compiles and links instead of copying a package that is there."""

    def run(self) -> None:
        cc, cxx = compilers()
        prefix, package = ros_prefix(), Path(self.build_lib) / NAME
        tree, sources = WORK / "tree", WORK / "sources"
        share = tree / "share" / NAME
        for path in interface_files():
            (share / path.parent).mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / path, share / path)
        shutil.copyfile(ROOT / "package.xml", share / "package.xml")
        generate(prefix, share, sources)
        copy_python(sources, package)
        compile_all(cc, cxx, prefix, sources)
        link_all(cxx, prefix, sources, tree / "lib", package)
        copy_headers(sources, tree / "include" / NAME)
        write_index(share, tree / "share" / "ament_index" / "resource_index")
        self.distribution.data_files += data_files(tree)


class InterfaceDistribution(Distribution):
    """Compiled, although setuptools sees no extension module."""

    def has_ext_modules(self) -> bool:
        return True


# Not in the source tree: no left-over of an earlier build can get into a wheel.
WORK = Path(tempfile.mkdtemp(prefix=f"{NAME}-"))
atexit.register(shutil.rmtree, WORK, ignore_errors=True)
(WORK / NAME).mkdir()  # setuptools asks for it before anything is generated

setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description=MANIFEST.findtext("description"),
    license=MANIFEST.findtext("license"),
    python_requires=">=3.11,<3.14",
    install_requires=["ros-rclpy[fastrtps]==7.1.6", "ros-common-interfaces==5.3.6"],
    packages=[NAME],
    package_dir={NAME: str(WORK / NAME)},
    data_files=[("share", [])],
    distclass=InterfaceDistribution,
    cmdclass={"build_py": BuildInterfaces},
    options={"build": {"build_base": str(WORK / "build")}, "egg_info": {"egg_base": str(WORK)}},
)
