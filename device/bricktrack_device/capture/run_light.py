"""The LEDs of a run, where they hang on pins: lit from arming until the run is on the card."""

import logging

from bricktrack_common.errors import HardwareError
from bricktrack_device.config import LedsTable
from bricktrack_device.interfaces import Leds, Rig

logger = logging.getLogger(__name__)


class RunLight:
    """Switches the LEDs of ``leds.pins``; does nothing where none are named. Used by one thread alone.

    Parameters
    ----------
    table : LedsTable
    rig : Rig
    """

    def __init__(self, table: LedsTable, rig: Rig) -> None:
        self._table = table
        self._rig = rig
        self._leds: Leds | None = None

    @property
    def words(self) -> str:
        """Which pins are lit, as the manifest says it; empty while none is."""
        return "" if self._leds is None else f"lit on {', '.join(self._table.pins)} from arming to saving"

    def light(self) -> None:
        """Light them; raises `HardwareError` where a pin cannot be had."""
        if self._table.pins and self._leds is None:
            self._leds = self._open()
            self._leds.switch(True)

    def put_out(self) -> None:
        """Put them out and give the pins back. Calling it twice does no harm."""
        leds, self._leds = self._leds, None
        if leds is not None:
            leds.close()

    def put_out_leftovers(self) -> None:
        """Put out what a daemon that was killed left lit: some kernels keep a pin's level."""
        if not self._table.pins:
            return
        try:
            self._open().close()
        except HardwareError as e:
            logger.warning("leds: %s", e)

    def _open(self) -> Leds:
        return self._rig.leds(self._table.pins, active_high=self._table.active_high)
