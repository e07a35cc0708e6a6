"""The source paper's brick: seven LEDs, four of them in one line (its section 6)."""

from bricktrack_common.brick_model import BrickModel, LayoutFile, LedEntry, brick_model_from_file

_LEFT, _RIGHT = (0.838671, 0.0, -0.544639), (-0.838671, 0.0, -0.544639)
_LEDS = (
    ("m0", (0.0, 0.0, 0.0), _LEFT),
    ("m1", (24.607, 3.5, 12.584), (0.087156, 0.0, -0.996195)),
    ("m2", (51.62, 12.5, 0.0), (-0.809017, 0.0, -0.587785)),
    ("m3", (0.0, 14.5, 0.0), _LEFT),
    ("m4", (0.0, 25.0, 0.0), _LEFT),
    ("m5", (0.0, 46.5, 0.0), _LEFT),
    ("m6", (54.514, 49.0, 0.0), _RIGHT),
)


def paper_brick() -> BrickModel:
    """Return the layout; axes out of the wall, domes of 6 mm."""
    leds = [LedEntry(name=n, position_mm=p, axis=a, radius_mm=3.0) for n, p, a in _LEDS]
    return brick_model_from_file(LayoutFile(name="paper", led=leds), where="the paper's layout")
