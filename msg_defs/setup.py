"""Build graspd_msgs with pip, against the ROS wheels. colcon reads CMakeLists.txt and never runs this file.

rosidl's generators make C and Python code from msg/, srv/ and action/. The system's compiler makes the same libraries
as a colcon build, except for the C++ interface, which no ROS wheel uses.
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

# Each generator makes one library. A library may link to the libraries before it in this order.
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
    """Return the interface files relative to this directory, such as msg/Grasp.msg."""
    return [path.relative_to(ROOT) for kind in ("msg", "srv", "action") for path in sorted((ROOT / kind).glob("*.*"))]


def ros_prefix() -> Path:
    """Return the directory of the ROS wheels: this environment, or pip's isolated build environment."""
    try:
        generator = import_module("rosidl_generator_c")
    except ImportError as error:
        fail(f"the ROS wheels are missing ({error}); install graspd's `ros` extra, or drop --no-build-isolation")
    return Path(generator.__path__[0]).parents[3]


def compilers() -> tuple[str, str]:
    """Return the commands of the C and C++ compilers. Exit if a compiler or Python.h is missing."""
    cc, cxx = os.environ.get("CC", "cc"), os.environ.get("CXX", "c++")
    for compiler in (cc, cxx):
        if not shutil.which(compiler.split()[0]):
            fail(f"no compiler {compiler!r}; install one with: sudo apt-get install build-essential")
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        package = f"python{sysconfig.get_python_version()}-dev"
        fail(f"Python.h is missing; install it with: sudo apt-get install {package}")
    return cc, cxx


def translate(share: Path) -> list[str]:
    """Write an .idl file for each interface file into `share`. Return their paths, as rosidl takes them."""
    for path in interface_files():
        kind = path.parent.name
        convert = getattr(import_module(f"rosidl_adapter.{kind}"), f"convert_{kind}_to_idl")
        convert(ROOT, NAME, path, share / kind)
    return [f"{share}:{path.with_suffix('.idl')}" for path in interface_files()]


def generate(prefix: Path, share: Path, sources: Path) -> None:
    """Write definitions and hashes into `share`, and code into `sources/<generator>/graspd_msgs`."""
    os.environ["AMENT_PREFIX_PATH"] = str(prefix)  # the generators search their templates there
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
    """Compile every C and C++ source into an object file beside it."""
    import numpy

    include = [
        # These come first, because an installed graspd_msgs may have other headers.
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

    # Compile the largest files first, so that no processor idles at the end.
    files = sorted(sources.rglob("*.c*"), key=lambda path: -path.stat().st_size)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(compile_one, files))


def link_all(cxx: str, prefix: Path, sources: Path, libraries: Path, package: Path) -> None:
    """Link the shared libraries and the extension modules of the Python package."""
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
    """Copy the C headers, for packages whose messages contain graspd's messages."""
    for kind in GENERATORS:
        generated = sources / kind
        for path in generated.rglob("*.h"):
            target = include / path.relative_to(generated)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)


def write_index(share: Path, index: Path) -> None:
    """Write the index files that `ros2 interface` and ament read."""
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
    """Return every file in `tree` as setuptools' data files. Paths below the installation prefix stay the same."""
    directories = {path.parent for path in tree.rglob("*") if path.is_file()}
    return [
        (str(directory.relative_to(tree)), [str(path) for path in sorted(directory.iterdir()) if path.is_file()])
        for directory in sorted(directories)
    ]


class BuildInterfaces(build_py):
    """Build step that generates, compiles and links the package. setuptools would only copy an existing package."""

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
    """Distribution with compiled code, although setuptools finds no extension module."""

    def has_ext_modules(self) -> bool:
        return True


# A folder outside the source tree, so that no file of an earlier build can get into a wheel.
WORK = Path(tempfile.mkdtemp(prefix=f"{NAME}-"))
atexit.register(shutil.rmtree, WORK, ignore_errors=True)
(WORK / NAME).mkdir()  # setuptools needs this folder before the code is generated

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
