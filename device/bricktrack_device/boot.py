"""Which boot of the unit this is: a monotonic clock and a run's number mean something only within one."""

from pathlib import Path


def kernel_boot_id() -> str:
    """Return the kernel's name for this boot, a UUID."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
