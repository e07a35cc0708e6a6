"""Instants of switching LEDs, found in the rows of pictures.

A row is exposed from ``stamp + delay - exposure`` to ``stamp + delay``. Where an LED is switched in between,
the row has got a share f of the change: ``f = (stamp + delay - t) / exposure``, for on and off alike. So each
row that shows 0 < f < 1 gives an instant of its own, ``t = stamp + delay - f * exposure``; its difference
from the GPIO's instant is the error of the recorded time of that row's mid-exposure.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import HardwareError
from bricktrack_device.health.blobs import find_blobs

_SHARES = (0.15, 0.85)
_MIN_ROWS = 8
_MIN_CONTRAST = 0.01  # linear light, of full scale, mean over a row's pixels
_CLIPPED_LUMA = 232
_LED_SHARE = 0.3
_SETTLED_NS = 1_000_000  # how far a frame must keep from a switch to count as one that did not see it


@dataclass(frozen=True, slots=True)
class Switching:
    """One change of the LEDs: CLOCK_MONOTONIC before and after the pin was written, ns."""

    before_ns: int
    after_ns: int
    on: bool

    @property
    def t_ns(self) -> int:
        """The middle."""
        return (self.before_ns + self.after_ns) // 2


@dataclass(frozen=True, slots=True, eq=False)
class LedWindow:
    """Where one LED is: its rows, columns and pixels; ``mask`` has the shape (rows, columns)."""

    v0: int
    v1: int
    u0: int
    u1: int
    mask: NDArray[np.bool_]

    @property
    def rows(self) -> IntArray:
        """The picture's rows, shape (v1 - v0,)."""
        return np.arange(self.v0, self.v1)


@dataclass(frozen=True, slots=True, eq=False)
class RowErrors:
    """What the rows say of every switching that they saw, one entry a row.

    Attributes
    ----------
    i_switch, i_led, row : ndarray of int, shape (n,)
    share : ndarray, shape (n,)
        f of the module's first lines.
    error_us : ndarray, shape (n,), us
        The row's instant less that of the GPIO: positive where pictures are stamped late.
    """

    i_switch: IntArray
    i_led: IntArray
    row: IntArray
    share: FloatArray
    error_us: FloatArray


def linear_light(luma: NDArray[np.uint8]) -> FloatArray:
    """Return linear light, 0 to 1, of limited-range luma by the inverse of the BT.709 curve."""
    return np.asarray(_LIGHT[luma])


def _light_table() -> FloatArray:
    signal = np.clip((np.arange(256) - 16) / 219, 0, 1)
    return np.where(signal < 0.081, signal / 4.5, ((signal + 0.099) / 1.099) ** (1 / 0.45))


_LIGHT = _light_table()


def find_leds(lit: FloatArray, dark: FloatArray) -> list[LedWindow]:
    """Return the LEDs in the difference of two mean luma planes, from left to right.

    Parameters
    ----------
    lit, dark : ndarray, shape (height, width)

    Raises
    ------
    HardwareError
        If nothing round changes.
    """
    change = np.clip((lit - dark) * (255 / 219), 0, 255)
    h, w = (n // 2 for n in change.shape)
    half = change[: 2 * h, : 2 * w].reshape(h, 2, w, 2).mean(axis=(1, 3))
    windows = []
    for blob in find_blobs(half):
        v0 = max(0, int(blob.v_px - 0.6 * blob.height_px))
        v1 = min(change.shape[0], int(blob.v_px + 0.6 * blob.height_px) + 1)
        u0 = max(0, int(blob.u_px - 0.6 * blob.width_px))
        u1 = min(change.shape[1], int(blob.u_px + 0.6 * blob.width_px) + 1)
        part = change[v0:v1, u0:u1]
        # Clipped pixels know no share of their light.
        mask = (part > _LED_SHARE * part.max()) & (lit[v0:v1, u0:u1] < _CLIPPED_LUMA)
        if mask.any(axis=1).sum() >= _MIN_ROWS:
            windows.append(LedWindow(v0, v1, u0, u1, mask))
    if not windows:
        raise HardwareError(
            "no LED changes in the picture when the pins are switched, or all are saturated. Check "
            "leds.pins, the LEDs' wiring and camera.exposure_us with 'bricktrackd check'"
        )
    return windows


def row_light(luma: NDArray[np.uint8], window: LedWindow) -> FloatArray:
    """Return the mean linear light of an LED's pixels in each row, (rows,); NaN where there are none."""
    part = linear_light(luma[window.v0 : window.v1, window.u0 : window.u1])
    n = window.mask.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(n > 0, (part * window.mask).sum(axis=1) / np.maximum(n, 1), np.nan))


def row_errors(
    light: Sequence[FloatArray],
    windows: Sequence[LedWindow],
    *,
    stamps_ns: IntArray,
    exposure_ns: IntArray,
    mode: SensorMode,
    switchings: Sequence[Switching],
) -> RowErrors:
    """Return what every row says that saw an LED change.

    Parameters
    ----------
    light : sequence of ndarray, each of shape (n_frames, rows of the LED)
        As from `row_light`, one array an LED.
    windows : sequence of LedWindow
    stamps_ns, exposure_ns : ndarray of int64, shape (n_frames,), ns
    mode : SensorMode
    switchings : sequence of Switching
        In order of time. Between two of them must lie a whole frame that arrived: one that saw neither.

    Notes
    -----
    A switch is compared with the last frame that was read out before it and the first that began to be
    exposed after it. Frames that were lost beside it do no harm, unless they were the ones that saw it.
    """
    columns: list[tuple[NDArray[Any], ...]] = []
    delays_ns = mode.row_delay_ns(np.array([0, mode.height - 1]))
    begins_ns = stamps_ns + np.min(delays_ns) - exposure_ns
    ends_ns = stamps_ns + np.max(delays_ns)
    instants = [s.t_ns for s in switchings]
    for i_switch, (previous_ns, t_ns, next_ns) in enumerate(
        zip([-np.inf, *instants], instants, [*instants[1:], np.inf], strict=False)
    ):
        since_last = (begins_ns > previous_ns + _SETTLED_NS) & (ends_ns < t_ns - _SETTLED_NS)
        until_next = (begins_ns > t_ns + _SETTLED_NS) & (ends_ns < next_ns - _SETTLED_NS)
        if not since_last.any() or not until_next.any():
            continue
        before, after = int(np.flatnonzero(since_last)[-1]), int(np.flatnonzero(until_next)[0])
        near = np.arange(before + 1, after)
        for i_led, window in enumerate(windows):
            delays_ns = mode.row_delay_ns(window.rows)
            change = light[i_led][after] - light[i_led][before]
            usable = np.abs(change) > _MIN_CONTRAST
            for j in near.tolist():
                share = (light[i_led][j] - light[i_led][before]) / np.where(usable, change, np.nan)
                seen = np.flatnonzero((share > _SHARES[0]) & (share < _SHARES[1]))
                if seen.size < _MIN_ROWS:
                    continue
                late_ns = stamps_ns[j] - t_ns + delays_ns[seen] - share[seen] * exposure_ns[j]
                n = np.ones(seen.size)
                columns.append((i_switch * n, i_led * n, window.rows[seen] * 1.0, share[seen], late_ns / 1e3))
    if not columns:
        empty = np.empty(0)
        return RowErrors(empty.astype(np.int64), empty.astype(np.int64), empty.astype(np.int64), empty, empty)
    i_switch_, i_led_, row, share_, error_us = (np.concatenate(c) for c in zip(*columns, strict=True))
    as_int = [a.astype(np.int64) for a in (i_switch_, i_led_, row)]
    return RowErrors(as_int[0], as_int[1], as_int[2], share_, error_us)
