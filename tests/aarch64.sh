#!/bin/sh
# Run the tests of kernels on emulated aarch64: the wheel for it, Debian's Python 3.11, packages from PyPI. Some minutes.
# Needs Debian 12 and, as root: dpkg --add-architecture arm64 && apt-get update && apt-get install qemu-user
#
#   tests/aarch64.sh [PYTHON that has what the build needs]
set -eu
cd "$(dirname "$0")/.."
python=$(command -v "${1:-.venv/bin/python}")
work=$PWD/build/aarch64
mkdir -p "$work/debs"
if [ ! -d "$work/system" ]; then
    (cd "$work/debs" && apt-get -q download python3.11-minimal:arm64 libpython3.11-minimal:arm64 libpython3.11-stdlib:arm64 \
        libc6:arm64 libgcc-s1:arm64 libstdc++6:arm64 zlib1g:arm64 libexpat1:arm64 libffi8:arm64 libbz2-1.0:arm64 \
        liblzma5:arm64 libssl3:arm64 libsqlite3-0:arm64 libuuid1:arm64)
    for each in "$work"/debs/*.deb; do dpkg -x "$each" "$work/system"; done
    "$python" -m pip install -q --target "$work/site" --python-version 311 --only-binary=:all: \
        --platform manylinux_2_28_aarch64 --platform manylinux_2_27_aarch64 --platform manylinux2014_aarch64 \
        numpy scipy opencv-python-headless click rich pytest hypothesis
    touch "$work/site/ruckig.py" # has no wheel for aarch64; the tests here plan no motion
fi
rm -rf "$work/armsight"
ARMSIGHT_TARGET=linux-aarch64 "$python" -m pip wheel -q --no-build-isolation --no-deps -w "$work/armsight" .
"$python" -m zipfile -e "$work"/armsight/*.whl "$work/armsight"
# Left out: a process that a test starts would not be emulated; images painted in Python, and most arms of one test, take minutes.
cp -r tests pyproject.toml "$work/armsight"
cd "$work/armsight"
exec qemu-aarch64 -L "$work/system" -E PYTHONPATH="$work/armsight:$work/site" "$work/system/usr/bin/python3.11" -m pytest -q \
    tests/kernels tests/robot/kinematics tests/vision/markers/disc --ignore=tests/robot/kinematics/test_peers.py \
    -k "not (test_compiled_kernels_give or test_centre_reaches_the_bound or (test_every_solution and not (puma560 or odd)))"
