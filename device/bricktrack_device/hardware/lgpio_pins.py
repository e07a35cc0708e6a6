"""The pins: gpiozero over lgpio and nothing else, because only lgpio hands on the kernel's edge stamps."""

import atexit
import logging
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.versions import require

if TYPE_CHECKING:
    import gpiozero

logger = logging.getLogger(__name__)

_BUSY_S = 1.0
_BUSY_POLL_S = 0.01

GPIOZERO_MINIMUM = "2.0.1.post3"
HEADER_CHIPS = ("pinctrl-rp1", "pinctrl-bcm2711", "pinctrl-bcm2835")
"""Labels of the chips that drive the 40-pin header: Pi 5, Pi 4, and all before."""
_WD = "LG_WD"
_INSTALL = "Install bricktrack[device] and lgpio in its virtual environment (docs/device-setup.md)"


@contextmanager
def lgpio_working_directory(folder: Path | None = None) -> Iterator[None]:
    """Give lgpio a writable directory while it is imported, and this process its own one back.

    At import lgpio makes a FIFO in its working directory, and fails where it cannot; told one by LG_WD it
    moves the whole process there. It keeps the FIFO open, so the process may move back afterwards.

    Parameters
    ----------
    folder : Path or None
        `None` takes LG_WD where it is set, then systemd's runtime directory, then a temporary folder.

    Raises
    ------
    HardwareError
        If the folder cannot be written.
    """
    if "lgpio" in sys.modules:
        yield
        return
    before = os.environ.get(_WD)
    chosen = folder or _default_folder(before)
    if not chosen.is_dir() or not os.access(chosen, os.W_OK | os.X_OK):
        raise HardwareError(
            f"{chosen}: lgpio cannot make its FIFO there; expected a folder that can be written. Set {_WD} "
            "to one"
        )
    here = Path.cwd()
    os.environ[_WD] = str(chosen.absolute())
    try:
        yield
    finally:
        os.chdir(here)
        if before is None:
            del os.environ[_WD]
        else:
            os.environ[_WD] = before


def _default_folder(lg_wd: str | None) -> Path:
    if lg_wd:
        return Path(lg_wd)
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    if runtime:
        return Path(runtime)
    folder = tempfile.mkdtemp(prefix="bricktrack-lgpio-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def import_lgpio(folder: Path | None = None) -> Any:
    """Return the module lgpio, imported where it can make its FIFO.

    Raises
    ------
    HardwareError
        If it is not installed or does not import.
    """
    with lgpio_working_directory(folder):
        try:
            import lgpio
        except ImportError as e:
            raise HardwareError(f"lgpio does not import: {e}. {_INSTALL}") from e
        except OSError as e:
            raise HardwareError(f"lgpio could not make its FIFO: {e}. Set {_WD} to a writable folder") from e
    return lgpio


def choose_chip(lgpio: Any, *, dev: Path = Path("/dev")) -> int:
    """Return the number of the chip that drives the 40-pin header, found by its label.

    The number differs between Pi models and kernels: on a Pi 5 it was 4 and is 0.

    Raises
    ------
    HardwareError
        If there is none, or none can be opened.
    """
    numbers = sorted(
        int(found[1]) for p in dev.glob("gpiochip*") if (found := re.fullmatch(r"gpiochip(\d+)", p.name))
    )
    if not numbers:
        raise HardwareError(
            "no GPIO chip: /dev/gpiochip* is missing; expected a Raspberry Pi with kernel 5.7 or newer"
        )
    labels = {}
    refused = []
    for number in numbers:
        node = dev / f"gpiochip{number}"
        if not os.access(node, os.R_OK | os.W_OK):
            refused.append(str(node))
            continue
        try:
            handle = lgpio.gpiochip_open(number)
        except lgpio.error as e:
            refused.append(f"{node} ({e})")
            continue
        try:
            _, _, name, label = lgpio.gpio_get_chip_info(handle)
        finally:
            lgpio.gpiochip_close(handle)
        if label in HEADER_CHIPS:
            return number
        labels[name] = label
    if refused:
        raise HardwareError(
            f"no permission for {', '.join(refused)}. The user needs the group 'gpio': "
            "sudo usermod -aG gpio USER"
        )
    raise HardwareError(
        f"none of the GPIO chips drives a Raspberry Pi's header: {labels}; expected a label of "
        f"{', '.join(HEADER_CHIPS)}"
    )


def sturdy(pin_class: type[Any], lgpio_error: type[Exception]) -> type[Any]:
    """Return gpiozero's lgpio pin, made safe to be given back while edges come, as at the end of most runs.

    lgpio has one thread for all reports of this process, and an error in one of them ends it: no edge would
    be heard any more until the daemon starts anew. gpiozero raises such an error (TypeError) when a report is
    under way while its pin is given back. And a line that lgpio still listens to for the moment is busy when
    it is claimed for another use: that is tried again.
    """

    class KernelStampPin(pin_class):  # type: ignore[misc]  # gpiozero has no types
        """See `sturdy`."""

        def close(self) -> None:
            """Give the line back."""
            _patiently(super().close, lgpio_error)

        def _enable_event_detect(self) -> None:
            _patiently(super()._enable_event_detect, lgpio_error)

        def _disable_event_detect(self) -> None:
            _patiently(super()._disable_event_detect, lgpio_error)

        def _call_when_changed(self, chip: int, gpio: int, level: int, ticks: int) -> None:
            try:
                super()._call_when_changed(chip, gpio, level, ticks)
            except Exception:
                if self._when_changed is not None:
                    logger.exception("a bug in taking an edge of GPIO%d; it is lost", gpio)

    return KernelStampPin


def _patiently(action: Callable[[], None], lgpio_error: type[Exception]) -> None:
    """Do something to a line, again while it is busy, for `_BUSY_S` at most."""
    deadline_ns = monotonic_ns() + round(_BUSY_S * 1e9)
    while True:
        try:
            return action()
        except lgpio_error as e:
            if not _is_busy(e) or monotonic_ns() > deadline_ns:
                raise
        time.sleep(_BUSY_POLL_S)


def open_pin_factory(*, working_directory: Path | None = None) -> "gpiozero.Factory":
    """Return a gpiozero factory whose pins carry kernel stamps.

    Raises
    ------
    HardwareError
        If lgpio or gpiozero is missing or too old, this is no Raspberry Pi, or its chip cannot be opened.
        There is no falling back to another factory: those stamp edges in Python.
    """
    lgpio = import_lgpio(working_directory)
    require(
        "gpiozero",
        GPIOZERO_MINIMUM,
        why="older ones open a GPIO chip that recent kernels do not have on a Pi 5",
        remedy=_INSTALL,
    )
    import gpiozero.exc
    from gpiozero.pins.lgpio import LGPIOFactory, LGPIOPin

    class KernelStampFactory(LGPIOFactory):  # type: ignore[misc]  # gpiozero has no types
        """LGPIOFactory, with lgpio's own errors in words, and pins that end no thread."""

        def __init__(self, chip: int) -> None:
            super().__init__(chip=chip)
            self.pin_class = sturdy(LGPIOPin, lgpio.error)

        def pin(self, name: object) -> Any:
            """Return a pin."""
            try:
                return super().pin(name)
            except lgpio.error as e:
                raise HardwareError(f"pin {name}: {e}. {_pin_advice(e)}") from e

    chip = choose_chip(lgpio)
    try:
        factory = KernelStampFactory(chip=chip)
    except lgpio.error as e:
        raise HardwareError(f"/dev/gpiochip{chip}: {e}") from e
    try:
        # Asked now, because gpiozero would only ask when the first pin is made.
        _ = factory.board_info
    except gpiozero.exc.PinUnknownPi as e:
        factory.close()
        raise HardwareError(
            f'this computer is no Raspberry Pi that gpiozero knows: {e}. Use backend = "sim" to work without'
        ) from e
    return factory


def _pin_advice(e: Exception) -> str:
    if _is_busy(e):
        return "Another program or an overlay holds the line: 'gpioinfo' names it. Stop it or use another pin"
    return "Check trigger.pin"


def _is_busy(e: Exception) -> bool:
    return "busy" in str(e).lower()
