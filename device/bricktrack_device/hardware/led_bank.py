"""LEDs on GPIO pins, switched together: for focusing, background pictures and the timing self-test."""

from collections.abc import Sequence
from types import TracebackType
from typing import Self

import gpiozero

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError


class LedBank:
    """Some LEDs, each on a pin of its own, or one transistor that drives them all.

    Parameters
    ----------
    pins : sequence of str
        As gpiozero names them, ``GPIO22``.
    factory : gpiozero.Factory
    active_high : bool
        False where a pin sinks the current.

    Raises
    ------
    HardwareError
        If a pin cannot be had.
    """

    def __init__(self, pins: Sequence[str], factory: gpiozero.Factory, *, active_high: bool = True) -> None:
        self._leds: list[gpiozero.LED] = []
        try:
            for pin in pins:
                self._leds.append(gpiozero.LED(pin, active_high=active_high, pin_factory=factory))
        except (gpiozero.GPIOZeroError, OSError, ValueError) as e:
            self.close()
            raise HardwareError(f"LED pins {', '.join(pins)}: {e}. Check the pins' names") from e

    def switch(self, on: bool) -> tuple[int, int]:
        """Switch all of them; return CLOCK_MONOTONIC before and after, ns."""
        before_ns = monotonic_ns()
        for led in self._leds:
            led.value = on
        return before_ns, monotonic_ns()

    def close(self) -> None:
        """Switch off and give the pins back. Calling it twice does no harm."""
        while self._leds:
            led = self._leds.pop()
            led.off()  # a kernel may keep the level of a pin that is given back
            led.close()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Switch off and give the pins back."""
        self.close()
