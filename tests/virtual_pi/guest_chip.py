"""Says which GPIO chip the factory opened, or why it did not."""

import gpiozero

from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.lgpio_pins import open_pin_factory

try:
    factory = open_pin_factory()
    pin = gpiozero.DigitalInputDevice("GPIO17", pull_up=False, pin_factory=factory)
    print("chip", factory.chip, factory.board_info.model)
except HardwareError as e:
    print("HardwareError", e)
