#!/usr/bin/env bash
# Builds the virtual environment: scripts/setup.sh VENV [PYTHON]. Safe to run again; `make setup` runs it when it is stale.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=$1
wanted=${2:-}
required=(libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libgomp.so.1:libgomp1) # Open3D loads these

fail() { echo "setup: $*" >&2; exit 1; }

suitable() { "$1" -c 'import sys; sys.exit(sys.version_info[:2] not in {(3, 11), (3, 12), (3, 13)})' 2>/dev/null; }

choose_python() {
    if [ -n "$wanted" ]; then
        command -v "$wanted" >/dev/null || fail "PYTHON=$wanted was not found; give a Python 3.11 to 3.13"
        suitable "$wanted" || fail "PYTHON=$wanted is $("$wanted" --version 2>&1); graspd needs Python 3.11 to 3.13"
        echo "$wanted"
        return
    fi
    for python in python3.12 python3.11 python3.13 python3; do
        if suitable "$python"; then echo "$python"; return; fi
    done
    fail "no Python 3.11 to 3.13 on the PATH; install one or name it: make setup PYTHON=/path/to/python3.11"
}

# As root, or with a sudo that asks nothing.
may_apt() { command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }; }

apt_install() {
    local sudo=()
    [ "$(id -u)" = 0 ] || sudo=(sudo -n)
    echo "setup: installing system packages: $*"
    { "${sudo[@]}" apt-get update -q && DEBIAN_FRONTEND=noninteractive "${sudo[@]}" apt-get install -q -y "$@"; } \
        >"$log" 2>&1 || { tail -n 5 "$log" >&2; return 1; }
}

missing_packages() {
    local entry
    for entry in "${required[@]}"; do
        "$1" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "${entry%%:*}" 2>/dev/null || echo "${entry##*:}"
    done
    # The interface package graspd_msgs is compiled.
    { command -v "${CC:-cc}" && command -v "${CXX:-c++}"; } >/dev/null || echo build-essential
    "$1" - <<'END'
import os, sys, sysconfig
if not os.path.exists(sysconfig.get_path("include") + "/Python.h"):
    print("python%d.%d-dev" % sys.version_info[:2])
END
}

install_packages() {
    local packages
    mapfile -t packages < <(missing_packages "$1")
    [ ${#packages[@]} -eq 0 ] && return
    if ! may_apt || ! apt_install "${packages[@]}"; then
        fail "missing system packages; install them once with: sudo apt-get install ${packages[*]}"
    fi
}

# Debian and Ubuntu split ensurepip off into python3.X-venv.
ensure_venv_module() {
    "$1" -c 'import ensurepip, venv' 2>/dev/null && return
    local package
    package=python$("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv
    if ! may_apt || ! apt_install "$package"; then
        fail "this Python has no venv module; install it once with: sudo apt-get install $package"
    fi
}

log=$(mktemp)
build=$(mktemp -d)
trap 'rm -rf "$log" "$build"' EXIT
python=$(choose_python)
install_packages "$python"
# Kept when it works; a half-built, moved or other-versioned one is made anew.
if ! suitable "$venv/bin/python" || ! "$venv/bin/python" -m pip --version >/dev/null 2>&1 \
    || { [ -n "$wanted" ] && [ "$("$venv/bin/python" -V)" != "$("$wanted" -V)" ]; }; then
    ensure_venv_module "$python"
    echo "setup: building $venv with $("$python" --version)"
    "$python" -m venv --clear "$venv"
fi
echo "setup: installing packages into $venv (about 4 GB, a few minutes the first time)"
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE # another environment's ROS may have set it
pip=("$venv/bin/python" -m pip install -qq --disable-pip-version-check)
"${pip[@]}" -c constraints.txt -e ".[clouds,ros,view,bench,dataset,cell,fuzz,docs,dev]" "setuptools>=70.1"
echo "setup: compiling the messages of graspd_msgs (20 seconds)"
# Against the very libraries that it will be loaded with; what it needs is installed by now.
"${pip[@]}" --no-build-isolation --no-deps ./msg_defs
# What comes with ROS and is not on PyPI: the type of /tf, MoveIt's grasp and collision object, two actions.
for needed in tf2_msgs.msg:TFMessage object_recognition_msgs.msg:ObjectType moveit_msgs.msg:AttachedCollisionObject \
    grasping_msgs.action:GraspPlanning control_msgs.action:FollowJointTrajectory; do
    package=${needed%%.*}
    if ! "$venv/bin/python" -c "from ${needed%%:*} import ${needed##*:}" 2>/dev/null; then
        rm -rf "$build" && mkdir "$build"
        cp -r "scripts/$package/." msg_defs/setup.py msg_defs/pyproject.toml "$build"
        "${pip[@]}" --no-build-isolation --no-deps "$build"
    fi
done
echo "setup: done"
