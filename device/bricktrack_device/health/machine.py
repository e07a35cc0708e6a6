"""The computer: clocks, temperature and supply, real-time rights, permissions, versions.

Everything but `vcgencmd` reads a file or asks the kernel, so the daemon may look now and then.
"""

import ctypes
import grp
import os
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from bricktrack_common.clocks import check_monotonic_is_boottime, read_clock_triplet
from bricktrack_device.config import SamplerTable
from bricktrack_device.health.findings import CheckResult, failure, good, warning

THERMAL = Path("/sys/class/thermal/thermal_zone0/temp")
THROTTLED = Path("/sys/devices/platform/soc/soc:firmware/get_throttled")
"""The Raspberry Pi's kernel shows the firmware's word here; no process needs to be started for it."""
WARM_DEGC = 75.0
HOT_DEGC = 82.0  # a Raspberry Pi lowers its clock at 80 and 85 degrees Celsius
GROUPS = ("video", "gpio", "i2c")
NODES = ("/dev/gpiochip*", "/dev/video*", "/dev/media*", "/dev/dma_heap/*")

_NOW_BITS = {
    0: "the supply voltage is too low now",
    1: "the processor's frequency is capped now",
    2: "the processor is throttled now",
    3: "the soft temperature limit is active now",
}
_PAST_BITS = {
    16: "the supply voltage was too low since boot",
    17: "the frequency was capped since boot",
    18: "the processor was throttled since boot",
    19: "the soft temperature limit was active since boot",
}
_SUPPLY_BITS = 1 << 0 | 1 << 16
_MCL_CURRENT, _MCL_ONFAULT = 1, 4


def check_clocks() -> list[CheckResult]:
    """See that stamps mean the same on CLOCK_MONOTONIC and CLOCK_BOOTTIME; raise `HardwareError` if not."""
    triplet = read_clock_triplet()
    check_monotonic_is_boottime(triplet)
    difference_us = (triplet.boottime_ns - triplet.monotonic_ns) / 1000
    return [good("clocks", f"BOOTTIME - MONOTONIC = {difference_us:.1f} µs")]


def processor_temperature_degc(path: Path = THERMAL) -> float | None:
    """Return the processor's temperature, degrees Celsius, or `None` where the kernel tells none."""
    try:
        return int(path.read_text(encoding="ascii")) / 1000
    except (OSError, ValueError):
        return None


def check_temperature(path: Path = THERMAL) -> list[CheckResult]:
    """Look at the processor's temperature."""
    t_degc = processor_temperature_degc(path)
    if t_degc is None:
        return [good("temperature", "not available here")]
    words = f"{t_degc:.1f} °C"
    remedy = "Give the unit air or a heat sink, and let it cool before the test"
    if t_degc >= HOT_DEGC:
        return [failure("temperature", f"{words}; the processor slows down above {HOT_DEGC:g} °C", remedy)]
    if t_degc >= WARM_DEGC:
        return [warning("temperature", f"{words}; above {HOT_DEGC:g} °C the processor slows down", remedy)]
    return [good("temperature", words)]


def read_throttled(path: Path = THROTTLED, *, may_start_process: bool = False) -> int | None:
    """Return the firmware's throttling bits, or `None` on a machine without them."""
    try:
        return int(path.read_text(encoding="ascii").strip(), 16)
    except (OSError, ValueError):
        pass
    program = shutil.which("vcgencmd") if may_start_process else None
    if program is None:
        return None
    try:
        done = subprocess.run(
            [program, "get_throttled"], capture_output=True, text=True, timeout=5, check=True
        )
        return int(done.stdout.partition("=")[2], 16)
    except (OSError, ValueError, subprocess.SubprocessError):
        return None


def check_throttling(bits: int | None) -> list[CheckResult]:
    """Spell out the firmware's throttling bits."""
    if bits is None:
        return [good("throttling", "not available here")]
    now = [words for bit, words in _NOW_BITS.items() if bits >> bit & 1]
    past = [words for bit, words in _PAST_BITS.items() if bits >> bit & 1]
    if not now and not past:
        return [good("throttling", f"none since boot (0x{bits:x})")]
    words = f"{'; '.join(now + past)} (0x{bits:x})"
    if bits & _SUPPLY_BITS:
        remedy = "Use the official supply and a short, thick cable; then reboot, which clears what was"
    else:
        remedy = "Cool the processor; then reboot, which clears what was"
    return [(failure if now else warning)("throttling", words, remedy)]


def check_realtime(wishes: SamplerTable) -> list[CheckResult]:
    """See whether the kernel grants what the inertial samplers ask of it, by asking and giving back."""
    granted: list[str] = []
    refused: list[str] = []
    if wishes.priority:
        problem = _try_fifo(wishes.priority)
        words = f"SCHED_FIFO {wishes.priority}"
        (refused if problem else granted).append(f"{words} refused ({problem})" if problem else words)
    if wishes.lock_memory:
        problem = _try_mlockall()
        (refused if problem else granted).append(
            f"mlockall refused ({problem})" if problem else "locked memory"
        )
    if not granted and not refused:
        return [good("real-time rights", "none wanted ([sampler] asks for none)")]
    words = ", ".join([*refused, *(f"{g} granted" for g in granted)])
    if not refused:
        return [good("real-time rights", words)]
    remedy = (
        "Run as the service does: LimitRTPRIO=60 and LimitMEMLOCK=infinity in the unit file, or in "
        "/etc/security/limits.d 'bricktrack - rtprio 60' and 'bricktrack - memlock unlimited'"
    )
    return [warning("real-time rights", f"{words}: inertial slots will be later", remedy)]


def _try_fifo(priority: int) -> str:
    """Return why a thread may not have a fixed priority, or ``""``; the thread that tries ends at once."""
    problem: list[str] = []

    def attempt() -> None:
        try:
            # For 0 the kernel takes the calling thread, not the process.
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as e:
            problem.append(e.strerror or str(e))

    thread = threading.Thread(target=attempt, name="try-fifo")
    thread.start()
    thread.join()
    return problem[0] if problem else ""


def _try_mlockall() -> str:
    """Return why memory may not be locked, or ``""``; it is unlocked again."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_ONFAULT) != 0:
        return os.strerror(ctypes.get_errno())
    libc.munlockall()
    return ""


def check_permissions(
    buses: Sequence[str],
    *,
    nodes: Iterable[str] = NODES,
    is_root: bool | None = None,
    access: Callable[[str, int], bool] = os.access,
    groups: Callable[[], Iterable[str]] | None = None,
) -> list[CheckResult]:
    """See that this user may use the device nodes that the hardware needs.

    Parameters
    ----------
    buses : sequence of str
        I2C device nodes.
    nodes : iterable of str
        Patterns of the others.
    is_root, access, groups
        The system's own, unless a test says otherwise.
    """
    member_of = set((groups or _own_groups)())
    is_root = os.geteuid() == 0 if is_root is None else is_root
    found = {str(p) for pattern in nodes for p in Path("/").glob(pattern.lstrip("/"))}
    paths = sorted(found | {bus for bus in buses if Path(bus).exists()})
    closed = [p for p in paths if not access(p, os.R_OK | os.W_OK)]
    missing = [] if is_root else [g for g in GROUPS if g not in member_of]
    if closed:
        wanted = ",".join(missing or GROUPS)
        return [
            failure(
                "permissions",
                f"no access to {', '.join(closed)}",
                f"sudo usermod -aG {wanted} USER, log in again; the service's user has these groups",
            )
        ]
    if missing:
        return [
            warning(
                "permissions",
                f"{len(paths)} device nodes are open, but this user is not in {', '.join(missing)}",
                f"sudo usermod -aG {','.join(missing)} USER, log in again",
            )
        ]
    who = "root" if is_root else f"groups {', '.join(GROUPS)}"
    return [good("permissions", f"{who}; {len(paths)} device nodes are open")]


def _own_groups() -> list[str]:
    names = []
    for gid in {os.getegid(), *os.getgroups()}:
        try:
            names.append(grp.getgrgid(gid).gr_name)
        except KeyError:
            names.append(str(gid))
    return names


def check_versions(software: dict[str, str], hardware: dict[str, str]) -> list[CheckResult]:
    """List what runs here; for people who compare units."""
    parts = [f"{k} {v}" for k, v in sorted(software.items())]
    parts += [
        f"{k.removeprefix('library.')} {v}"
        for k, v in sorted(hardware.items())
        if k.removeprefix("library.") not in software
    ]
    return [good("versions", ", ".join(parts))]
