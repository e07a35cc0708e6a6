"""How well a camera is aimed and focused: the LEDs in a still, their edges, their room to the border."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import StorageError, VideoError
from bricktrack_host.quality import LedFlag
from bricktrack_host.tracking.pictures.segment import Blobs, Picture, find_blobs

_N_RAYS = 72
_STEPS_PER_PX = 4
_FULL_LUMA = 234.0  # limited range ends at 235
_MIN_SHARE_OF_USUAL = 0.5
"""Of the usual diameter: reflections of LEDs are smaller; LEDs of one brick differ by less."""
_GOOD = (90, 220, 90)  # BGR
_DOUBTFUL = (60, 170, 255)
_OTHER = (170, 170, 170)
_GUIDE = (255, 190, 80)


@dataclass(frozen=True, slots=True, eq=False)
class Aim:
    """What one still says.

    Attributes
    ----------
    leds : Blobs
        The lights that look like LEDs, from left to right.
    others : Blobs
        Those that do not: too small beside the others, as reflections are, or of another shape.
    edge_width_px : ndarray, shape (n,), px
        How wide the edge of each is, from 20 % to 80 % of its brightness: the median over 72 directions; the
        smaller, the sharper. NaN where the LED leaves the picture.
    saturated : ndarray, shape (n,)
        Share of each LED's middle at full level.
    margins_px : (float, float, float, float) or None
        Room between the outermost LEDs and the picture's left, top, right and bottom border; `None`
        without LEDs.
    """

    leds: Blobs
    others: Blobs
    edge_width_px: FloatArray
    saturated: FloatArray
    margins_px: tuple[float, float, float, float] | None

    @property
    def n_found(self) -> int:
        """How many LEDs were found."""
        return len(self.leds)

    @property
    def focus_px(self) -> float:
        """The typical edge's width, px: the median over the LEDs; NaN without one that can be measured."""
        known = self.edge_width_px[np.isfinite(self.edge_width_px)]
        return float(np.median(known)) if len(known) else float("nan")


def decode_grey(data: bytes, *, source: str) -> NDArray[np.uint8]:
    """Return a grey PNG as it came, shape (rows, columns), 16 for black and 235 for white.

    Raises
    ------
    VideoError
        If it is no such picture.
    """
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 2 or picture.dtype != np.uint8:
        found = "no picture" if picture is None else f"shape {picture.shape} of {picture.dtype}"
        raise VideoError(
            f"{source}: expected a grey picture of 8 bits, got {found}. Install the same bricktrack"
        )
    return np.asarray(picture, dtype=np.uint8)


def look_at(luma: NDArray[np.uint8]) -> Aim:
    """Find the LEDs in a still and measure how sharp they are and how far from the border.

    Parameters
    ----------
    luma : ndarray of uint8, shape (rows, columns)
        Limited range.
    """
    rows, columns = luma.shape
    grey = np.full(((rows + 1) // 2, (columns + 1) // 2), 128, np.uint8)
    found = find_blobs(Picture(luma, grey, grey))
    is_led = _look_like_leds(found)
    leds = found.take(np.flatnonzero(is_led)[np.argsort(found.uv_px[is_led, 0], kind="stable")])
    radii = np.sqrt(leds.area_px2 / np.pi)
    widths = [
        float("nan") if flags & LedFlag.BORDER else edge_width_px(luma, uv_px, radius_px)
        for flags, uv_px, radius_px in zip(leds.flags, leds.uv_px, radii, strict=True)
    ]
    shares = [_saturated_share(luma, uv, r) for uv, r in zip(leds.uv_px, radii, strict=True)]
    return Aim(
        leds, found.take(~is_led), np.array(widths), np.array(shares), _margins(leds, radii, rows, columns)
    )


def _look_like_leds(found: Blobs) -> NDArray[np.bool_]:
    """Tell which lights are round and about as large as the larger ones among the round are."""
    is_round = (found.flags & (LedFlag.MERGED | LedFlag.PARTLY_COVERED)) == 0
    if not is_round.any():
        return np.asarray(is_round, dtype=np.bool_)
    usual_area = float(np.quantile(found.area_px2[is_round], 0.75))
    return np.asarray(is_round & (found.area_px2 > _MIN_SHARE_OF_USUAL**2 * usual_area), dtype=np.bool_)


def edge_width_px(luma: NDArray[np.uint8], uv_px: FloatArray, radius_px: float) -> float:
    """Return how wide a light's edge is, from 80 % to 20 % of its height over the background.

    Parameters
    ----------
    uv_px : ndarray, shape (2,), px
        The light's centre.
    radius_px : float, px
        Of the disc of its area.

    Returns
    -------
    width_px : float, px
        Median over the directions; NaN where the levels are not told apart in most of them.

    Notes
    -----
    The light falls along each ray from its plateau, the median within half the radius, to the background,
    the median beyond 1.6 radii. Sampling between pixels adds about 0.3 px to a perfectly sharp edge.
    """
    reach_px = 2.0 * radius_px + 4.0
    polar = cv2.warpPolar(
        luma.astype(np.float32),
        (int(reach_px * _STEPS_PER_PX), _N_RAYS),
        (float(uv_px[0]), float(uv_px[1])),
        reach_px,
        cv2.INTER_LINEAR,
    )
    r_px = np.arange(polar.shape[1]) / polar.shape[1] * reach_px
    plateau = float(np.median(polar[:, r_px < 0.5 * radius_px]))
    background = float(np.median(polar[:, r_px > 1.6 * radius_px]))
    if plateau - background < 10:
        return float("nan")
    high, low = (background + share * (plateau - background) for share in (0.8, 0.2))
    widths = []
    for ray in polar:
        below = np.flatnonzero(ray < low)
        above = np.flatnonzero(ray[: below[0]] >= high) if len(below) else below
        if not len(above) or below[0] == 0:
            continue
        i, j = int(above[-1]), int(below[0])
        start = r_px[i] + (ray[i] - high) / (ray[i] - ray[i + 1]) * (r_px[1] - r_px[0])
        end = r_px[j] - (low - ray[j]) / (ray[j - 1] - ray[j]) * (r_px[1] - r_px[0])
        widths.append(end - start)
    return float(np.median(widths)) if len(widths) > _N_RAYS // 2 else float("nan")


def _saturated_share(luma: NDArray[np.uint8], uv_px: FloatArray, radius_px: float) -> float:
    rows, columns = luma.shape
    u, v = np.round(uv_px).astype(int)
    n = max(int(0.7 * radius_px), 1)
    inner = luma[max(v - n, 0) : min(v + n + 1, rows), max(u - n, 0) : min(u + n + 1, columns)]
    return float(np.mean(inner >= _FULL_LUMA))


def _margins(
    leds: Blobs, radii: FloatArray, rows: int, columns: int
) -> tuple[float, float, float, float] | None:
    if not len(leds):
        return None
    u, v = leds.uv_px.T
    return (
        float(max((u - radii).min() + 0.5, 0.0)),
        float(max((v - radii).min() + 0.5, 0.0)),
        float(max(columns - 0.5 - (u + radii).max(), 0.0)),
        float(max(rows - 0.5 - (v + radii).max(), 0.0)),
    )


def draw(luma: NDArray[np.uint8], aim: Aim, *, title: str) -> NDArray[np.uint8]:
    """Return the still in colour, shape (rows, columns, 3), BGR, with what was found drawn on it."""
    rows, columns = luma.shape
    grey = np.clip((luma.astype(np.float32) - 16) * (255 / 219), 0, 255).astype(np.uint8)
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    thick = max(round(rows / 540), 1)
    size = rows / 1080 * 0.9

    def write(text: str, at: tuple[float, float], colour: tuple[int, int, int]) -> None:
        place = (int(at[0]), int(at[1]))
        for stroke, ink in ((4 * thick, (0, 0, 0)), (thick, colour)):
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, ink, stroke, cv2.LINE_AA)

    if aim.margins_px is not None:
        left, top, right, bottom = aim.margins_px
        box = (round(left), round(top)), (round(columns - 1 - right), round(rows - 1 - bottom))
        cv2.rectangle(picture, *box, _GUIDE, thick)
        middle_u, middle_v = (box[0][0] + box[1][0]) / 2, (box[0][1] + box[1][1]) / 2
        step = 26 * size
        beside_u = middle_u + 75 * size
        for words, start, end, at in (
            (f"{left:.0f} px", (0, middle_v), (left, middle_v), (left / 2, middle_v - step)),
            (
                f"{right:.0f} px",
                (box[1][0], middle_v),
                (columns, middle_v),
                (columns - right / 2, middle_v - step),
            ),
            (f"{top:.0f} px", (middle_u, 0), (middle_u, top), (beside_u, top / 2)),
            (
                f"{bottom:.0f} px",
                (middle_u, box[1][1]),
                (middle_u, rows),
                (beside_u, rows - bottom / 2),
            ),
        ):
            ends = [(int(p[0]), int(p[1])) for p in (start, end)]
            cv2.line(picture, ends[0], ends[1], _GUIDE, thick, cv2.LINE_AA)
            width = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, thick)[0][0]
            write(words, (min(max(at[0] - width / 2, 4), columns - width - 4), max(at[1], 30 * size)), _GUIDE)
    for u, v, area in zip(*aim.others.uv_px.T, aim.others.area_px2, strict=True):
        cv2.circle(picture, (round(u), round(v)), round(np.sqrt(area / np.pi) + 4 * thick), _OTHER, thick)
    for i in range(aim.n_found):
        u, v = aim.leds.uv_px[i]
        radius = float(np.sqrt(aim.leds.area_px2[i] / np.pi))
        colour = _DOUBTFUL if aim.leds.flags[i] else _GOOD
        cv2.circle(picture, (round(u), round(v)), round(radius + 4 * thick), colour, thick, cv2.LINE_AA)
        words = f"{i + 1}" if np.isnan(aim.edge_width_px[i]) else f"{i + 1}: {aim.edge_width_px[i]:.1f} px"
        at = (min(u + radius + 8 * thick, columns - 130 * size), max(v - radius - 2 * thick, 30 * size))
        write(words, at, colour)
    write(title, (12 * thick, rows - 14 * thick), (255, 255, 255))
    return np.asarray(picture, dtype=np.uint8)


def save_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture; raise `StorageError` where that cannot be done."""
    good, data = cv2.imencode(".png", picture)
    try:
        if not good:
            raise OSError("the picture cannot be encoded")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())
    except OSError as e:
        raise StorageError(f"{path}: {e.strerror or e}. Choose another folder with -o") from e
