#!/usr/bin/env bash
# Runs the camera tests in the virtual Pi: the real picamera2, libcamera and libx264 on a virtual sensor.
#   BRICKTRACK_VIRTUAL_PI=.../virtual-pi tests/virtual_pi/run_camera.sh [pytest arguments]
# The first run makes a Debian root of 1 GB (3 to 5 minutes) in BRICKTRACK_CAMERA_ROOT, which must lie outside
# the repository; it needs mmdebstrap and root's rights.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
repository=$(cd "$here/../.." && pwd)
vpi=${BRICKTRACK_VIRTUAL_PI:?set it to the folder of the virtual Pi}
root=${BRICKTRACK_CAMERA_ROOT:-${TMPDIR:-/tmp}/bricktrack-camera-root}
case $(realpath -m "$root") in "$repository"/*) echo "$root lies inside the repository" >&2; exit 2 ;; esac

[ -x "$root/opt/venv/bin/python" ] || "$vpi/make-camera-root.sh" "$root"
deps=$root/opt/bricktrack
if [ ! -e "$deps/.complete" ]; then
    # The root's Python is newer than this machine's: its wheels are chosen by name.
    version=$(basename "$(echo "$root"/opt/venv/lib/python3*)")
    version=${version#python}
    platforms=()
    for p in manylinux_2_28_x86_64 manylinux_2_17_x86_64 manylinux2014_x86_64 any; do platforms+=(--platform "$p"); done
    python3 -m pip install --quiet --disable-pip-version-check --upgrade --target "$deps" \
        --python-version "$version" --implementation cp --abi "cp${version/./}" --abi abi3 --abi none \
        "${platforms[@]}" --only-binary=:all: \
        adafruit-circuitpython-bno055 'gpiod>=2.2.2,<3' 'gpiozero>=2.0.1.post3' msgpack msgspec pytest pyzmq rich \
        smbus2 typer
    # The daemon tells its version; here it runs from the tree, uninstalled.
    mkdir -p "$deps/bricktrack-0.dist-info"
    printf 'Metadata-Version: 2.1\nName: bricktrack\nVersion: 0\n' > "$deps/bricktrack-0.dist-info/METADATA"
    touch "$deps/.complete"
fi
sources=/opt/bricktrack:$repository/common:$repository/device:$repository/host:$here:/opt/tests
exec "$vpi/vpi" --root "$root" --mem 1536 --timeout 500 --share "$repository" -- \
    /usr/bin/env "PYTHONPATH=$sources" PYTHONDONTWRITEBYTECODE=1 "LIBCAMERA_LOG_LEVELS=*:ERROR" \
    /opt/venv/bin/python -m pytest -q -p no:cacheprovider -W ignore::DeprecationWarning \
    --rootdir "$here" -c /dev/null "$@" "$here/guest_unit.py" "$here/guest_camera.py"
