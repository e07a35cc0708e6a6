"""The paper's brick: seven LEDs, four of them in a column, and the place of its inertial sensor."""

from bricktrack_common.brick_model import ImuEntry, LayoutFile, LedEntry

_LEFT = (0.838671, 0.0, -0.544639)
_RIGHT = (-0.838671, 0.0, -0.544639)

PAPER_LAYOUT = LayoutFile(
    name="paper",
    led=[
        LedEntry(name="m0", position_mm=(0.0, 0.0, 0.0), axis=_LEFT, radius_mm=3.0),
        LedEntry(
            name="m1", position_mm=(24.607, 3.5, 12.584), axis=(0.087156, 0.0, -0.996195), radius_mm=3.0
        ),
        LedEntry(name="m2", position_mm=(51.62, 12.5, 0.0), axis=(-0.809017, 0.0, -0.587785), radius_mm=3.0),
        LedEntry(name="m3", position_mm=(0.0, 14.5, 0.0), axis=_LEFT, radius_mm=3.0),
        LedEntry(name="m4", position_mm=(0.0, 25.0, 0.0), axis=_LEFT, radius_mm=3.0),
        LedEntry(name="m5", position_mm=(0.0, 46.5, 0.0), axis=_LEFT, radius_mm=3.0),
        LedEntry(name="m6", position_mm=(54.514, 49.0, 0.0), axis=_RIGHT, radius_mm=3.0),
    ],
    imu=ImuEntry(lever_arm_mm=(26.045, 53.0, 14.199)),
)
"""Positions of the domes' sphere centres, axes out of the wall, and the lever arm (paper, section 7.3)."""
