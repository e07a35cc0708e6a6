"""What the page shows of one still: the picture with its LEDs, sharpness, exposure, room to the border."""

import base64
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import IntArray
from bricktrack_common.errors import VideoError
from bricktrack_common.wire_messages import StillImage
from bricktrack_host.aiming import Aim, decode_grey, draw, look_at

_SHOWN_WIDTH_PX = 1100
_BLACK, _WHITE = 16, 235
_N_BINS = 55  # of four levels each
NEAR_BORDER_PX = 40.0
"""Closer than about one LED's own size: a small motion takes it out of the picture."""


@dataclass(frozen=True, slots=True)
class LedRow:
    """One LED of a still: its place, its edge, and how far its rim is from each border, px."""

    number: int
    u_px: float
    v_px: float
    edge_px: float
    left_px: float
    top_px: float
    right_px: float
    bottom_px: float

    @property
    def nearest_px(self) -> float:
        """The least of the four."""
        return min(self.left_px, self.top_px, self.right_px, self.bottom_px)


@dataclass(frozen=True, slots=True, eq=False)
class AimView:
    """A still, measured and drawn.

    Attributes
    ----------
    picture_uri : str
        JPEG with the LEDs marked.
    histogram_svg : str
        How many pixels have which level.
    focus_px : float
        The typical edge's width; NaN without an LED.
    n_bright : int
        LEDs whose middle is mostly at full level.
    full_share : float
        Share of all pixels at full level.
    """

    picture_uri: str
    histogram_svg: str
    leds: list[LedRow]
    n_others: int
    focus_px: float
    n_bright: int
    full_share: float
    exposure_us: int
    gain: float
    simulated: bool

    @property
    def advice(self) -> list[str]:
        """What to do about it; empty where all is well."""
        told = []
        if not self.leds:
            told.append("No LED is seen: are they lit, is the cap off, does the camera look at them?")
        near = [led for led in self.leds if led.nearest_px < NEAR_BORDER_PX]
        if near:
            names = ", ".join(str(led.number) for led in near)
            told.append(f"LED {names}: less than {NEAR_BORDER_PX:.0f} px from the border. Turn the camera")
        if self.n_bright:
            told.append(
                f"{self.n_bright} LEDs are at full level: their edges look sharper than they are. "
                "Expose for less, or dim them"
            )
        return told


def aim_view(image: StillImage, data: bytes, *, source: str) -> AimView:
    """Measure and draw a still.

    Raises
    ------
    VideoError
        If it is no grey picture.
    """
    luma = decode_grey(data, source=source)
    aim = look_at(luma)
    simulated = ", simulated" if image.simulated else ""
    focus = "" if math.isnan(aim.focus_px) else f", edges {aim.focus_px:.1f} px"
    title = f"{source}: {aim.n_found} LEDs{focus}, {image.exposure_us / 1000:g} ms{simulated}"
    counts = np.bincount(luma.ravel(), minlength=256)
    return AimView(
        picture_uri=_jpeg_uri(draw(luma, aim, title=title), source),
        histogram_svg=histogram_svg(counts),
        leds=led_rows(aim, luma.shape),
        n_others=len(aim.others),
        focus_px=aim.focus_px,
        n_bright=int((aim.saturated > 0.5).sum()),
        full_share=float(counts[_WHITE - 1 :].sum() / counts.sum()),
        exposure_us=image.exposure_us,
        gain=image.analogue_gain,
        simulated=image.simulated,
    )


def led_rows(aim: Aim, shape: tuple[int, ...]) -> list[LedRow]:
    """Return each LED's place, and the room between its rim and the borders of a picture of this shape."""
    rows, columns = shape
    radii = np.sqrt(aim.leds.area_px2 / np.pi)
    found = []
    for i, ((u, v), radius) in enumerate(zip(aim.leds.uv_px, radii, strict=True)):
        room = (u - radius + 0.5, v - radius + 0.5, columns - 0.5 - u - radius, rows - 0.5 - v - radius)
        left, top, right, bottom = (max(float(px), 0.0) for px in room)
        edge = float(aim.edge_width_px[i])
        found.append(LedRow(i + 1, float(u), float(v), edge, left, top, right, bottom))
    return found


def histogram_svg(counts: IntArray) -> str:
    """Return the exposure as bars over the levels from black to white, on a logarithmic scale."""
    levels = np.clip(np.arange(256), _BLACK, _WHITE)
    bins = np.bincount((levels - _BLACK) // 4, weights=counts, minlength=_N_BINS)
    heights = np.log10(bins + 1) / max(float(np.log10(bins.max() + 1)), 1.0) * 90
    bars = "".join(
        f'<rect x="{i * 8}" y="{100 - h:.1f}" width="7" height="{h:.1f}"'
        f' fill="{"#d55e00" if i == _N_BINS - 1 else "#4a5a6a"}"/>'
        for i, h in enumerate(heights)
        if h > 0
    )
    words = "".join(
        f'<text x="{x}" y="116" font-size="13" fill="#3c4148" text-anchor="{anchor}">{text}</text>'
        for x, anchor, text in ((0, "start", "black"), (220, "middle", "level"), (440, "end", "full"))
    )
    line = '<line x1="0" x2="440" y1="100" y2="100" stroke="#8a8f98"/>'
    return (
        '<svg viewBox="0 0 440 120" role="img" aria-label="Pixels by level, logarithmic">'
        f"{bars}{line}{words}</svg>"
    )


def _jpeg_uri(picture: NDArray[np.uint8], source: str) -> str:
    width = picture.shape[1]
    if width > _SHOWN_WIDTH_PX:
        size = (_SHOWN_WIDTH_PX, round(picture.shape[0] * _SHOWN_WIDTH_PX / width))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    good, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    if not good:
        raise VideoError(f"{source}: the picture cannot be drawn. Take another one")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
