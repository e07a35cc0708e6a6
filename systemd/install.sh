#!/usr/bin/env bash
# Installs the bricktrack daemon on a Raspberry Pi, or takes it away again. Running it twice changes nothing more.
#
#   sudo systemd/install.sh [--enable-i2c-gpio] [--no-apt] [--no-venv] [--source WHEEL_OR_FOLDER]
#   sudo systemd/install.sh --uninstall [--purge]
#
#   --enable-i2c-gpio   put the bit-banged I2C bus of the sensor into config.txt; without it the lines are printed
#   --no-apt            do not install Debian packages
#   --no-venv           do not make the virtual environment
#   --source            what to install with pip; default: the folder above this script
#   --uninstall         remove service, user files and virtual environment; runs and configuration stay
#   --purge             with --uninstall: remove runs and configuration too
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
venv=/opt/bricktrack
doc=$venv/share/doc/bricktrack
unit=/etc/systemd/system/bricktrackd.service
sysusers=/etc/sysusers.d/bricktrack.conf
tmpfiles=/etc/tmpfiles.d/bricktrack.conf
modules=/etc/modules-load.d/bricktrack.conf
config=/etc/bricktrack/bricktrackd.toml
state=/var/lib/bricktrack
packages=(python3-venv python3-numpy python3-picamera2 python3-lgpio i2c-tools)
overlay='dtoverlay=i2c-gpio,bus=3,i2c_gpio_sda=2,i2c_gpio_scl=3,i2c_gpio_delay_us=2'
begin='# bricktrack: begin' end='# bricktrack: end'

source=$(dirname "$here") enable_i2c=no apt=yes make_venv=yes uninstall=no purge=no
while [ $# -gt 0 ]; do
    case $1 in
        --enable-i2c-gpio) enable_i2c=yes ;;
        --no-apt) apt=no ;;
        --no-venv) make_venv=no ;;
        --source) source=${2:?--source needs a wheel or a folder}; shift ;;
        --uninstall) uninstall=yes ;;
        --purge) purge=yes ;;
        -h | --help) sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//p}' "$0"; exit 0 ;;
        *) echo "install.sh: unknown option $1; see --help" >&2; exit 2 ;;
    esac
    shift
done
if [ "$purge" = yes ] && [ "$uninstall" = no ]; then
    echo "install.sh: --purge goes with --uninstall" >&2
    exit 2
fi
[ "$(id -u)" = 0 ] || { echo "install.sh: run it as root: sudo $0" >&2; exit 1; }

say() { echo "install.sh: $*"; }

# systemctl only where systemd is running: not in a chroot or while an image is made.
control() { if [ -d /run/systemd/system ]; then systemctl "$@"; fi; }

boot_config() {
    local file
    for file in /boot/firmware/config.txt /boot/config.txt; do
        if [ -f "$file" ]; then echo "$file"; return; fi
    done
}

without_our_lines() { sed "/^$begin\$/,/^$end\$/d" "$1"; }

# Replaces a file's text as a whole, and only if it differs: a cut in the middle leaves the old file.
replace() {
    local file=$1 new
    new=$(mktemp "$file.XXXXXX")
    cat > "$new"
    if cmp -s "$new" "$file"; then rm "$new"; return; fi
    chmod --reference="$file" "$new" 2> /dev/null || true
    mv "$new" "$file"
    say "changed $file; reboot for it to count"
}

if [ "$uninstall" = yes ]; then
    control disable --now bricktrackd.service 2> /dev/null || true
    rm -f "$unit" "$tmpfiles" "$sysusers" "$modules"
    rm -rf "$venv"
    control daemon-reload
    boot=$(boot_config)
    if [ -n "$boot" ] && grep -q "^$begin\$" "$boot"; then without_our_lines "$boot" | replace "$boot"; fi
    if [ "$purge" = yes ]; then
        rm -rf "$state" "$(dirname "$config")"
        if getent passwd bricktrack > /dev/null; then userdel bricktrack; fi
        say "removed everything, runs and configuration too"
    else
        say "removed; runs in $state and $config stay"
    fi
    exit 0
fi

if [ "$apt" = yes ]; then
    apt-get install --yes --no-install-recommends "${packages[@]}"
fi

if [ "$make_venv" = yes ]; then
    # picamera2, libcamera and numpy must be the system's own: they are built for each other.
    [ -x "$venv/bin/python" ] || python3 -m venv --system-site-packages "$venv"
    "$venv/bin/python" -m pip install --quiet --upgrade "bricktrack[device,discovery] @ file://$(realpath "$source")"
    "$venv/bin/bricktrackd" --help > /dev/null
fi

install -D -m 0644 "$here/bricktrack.sysusers.conf" "$sysusers"
install -D -m 0644 "$here/bricktrack.tmpfiles.conf" "$tmpfiles"
install -D -m 0644 "$here/bricktrack.modules.conf" "$modules"
install -D -m 0644 "$here/bricktrackd.service" "$unit"
if [ -f "$here/../docs/device-setup.md" ]; then
    install -D -m 0644 "$here/../docs/device-setup.md" "$doc/device-setup.md"
fi
systemd-sysusers "$sysusers"
systemd-tmpfiles --create "$tmpfiles"
if [ ! -f "$config" ]; then
    # The example simulates, so that it can be tried anywhere; a unit is hardware.
    sed 's/^backend = "sim"$/backend = "hardware"/' "$here/bricktrackd.toml" > "$config.new"
    chown root:bricktrack "$config.new"
    chmod 0640 "$config.new"
    mv "$config.new" "$config"
    say "wrote $config: give the unit its name there"
fi

boot=$(boot_config)
if [ "$enable_i2c" = yes ]; then
    if [ -z "$boot" ]; then
        echo "install.sh: no config.txt in /boot/firmware or /boot: is this Raspberry Pi OS?" >&2
        exit 1
    fi
    {
        without_our_lines "$boot"
        printf '%s\n' "$begin" '[all]' 'dtparam=i2c_arm=off' "$overlay" "$end"
    } | replace "$boot"
elif [ -z "$boot" ] || ! grep -q '^dtoverlay=i2c-gpio' "$boot"; then
    say "the sensor needs a bit-banged bus; add to ${boot:-config.txt}, or run again with --enable-i2c-gpio:"
    printf '    %s\n' '[all]' 'dtparam=i2c_arm=off' "$overlay"
fi

if [ -d /run/systemd/system ]; then modprobe i2c-dev || say "no module i2c-dev in this kernel"; fi
control daemon-reload
control enable bricktrackd.service
say "installed; edit $config, then: sudo systemctl restart bricktrackd"
