"""A run's pictures with what was found in them: LEDs, residuals, pose, flags, and the motion so far.

Residuals are drawn magnified, since they are fractions of a pixel. Everything comes from the results on disk;
no pose is computed here.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray
from bricktrack_common.rotations import angles_xyz_from_matrix
from bricktrack_host.quality import LedFlag, PoseFlag, describe
from bricktrack_host.results.result_store import RunResult

Colour = tuple[int, int, int]  # blue, green, red
Image = NDArray[np.uint8]

USED: Colour = (120, 220, 120)
UNUSED: Colour = (60, 160, 255)
RESIDUAL: Colour = (255, 190, 90)
INK: Colour = (240, 240, 240)
FAINT: Colour = (150, 150, 150)
AXES: tuple[Colour, Colour, Colour] = ((90, 130, 255), (110, 210, 110), (255, 170, 80))

RESIDUAL_SCALE = 100.0
"""A residual of 0.1 px is drawn 10 px long."""
STRIP_ROWS = 240
_GAIN = 255 / 219  # luma 16..235


@dataclass(frozen=True, slots=True, eq=False)
class OverlayArtist:
    """Draws single frames of one run.

    Attributes
    ----------
    result : RunResult
    displacement_mm, angles_deg : ndarray, shape (n_frames, 3)
        From rest where there is a rest pose, else as seen from the camera.
    height_px : int
        Of the picture; the strip with the motion comes below it.
    """

    result: RunResult
    displacement_mm: FloatArray
    angles_deg: FloatArray
    height_px: int
    _strip: Image
    _cursor: NDArray[np.int64]

    @classmethod
    def of(cls, result: RunResult, width_px: int, height_px: int) -> "OverlayArtist":
        """Return an artist for pictures of this size."""
        optical = result.optical
        R, t_mm = optical.R_camera_brick, optical.t_camera_brick_mm
        if result.rest is not None:
            relative = result.rest.relative(R, t_mm)
            R, t_mm = relative.R, relative.t_mm
        t_s = (optical.t_ns - optical.t_ns[0]) / 1e9
        strip, cursor = _draw_strip(t_s, t_mm, width_px, from_rest=result.rest is not None)
        angles = np.rad2deg(angles_xyz_from_matrix(R))
        return cls(result, t_mm, angles, height_px, strip, cursor)

    def draw(self, index: int, luma: NDArray[np.uint8] | None) -> Image:
        """Return frame ``index`` in colour, shape (height + strip, width, 3), BGR; grey where it was lost."""
        width = self._strip.shape[1]
        if luma is None:
            picture = np.full((self.height_px, width, 3), 60, dtype=np.uint8)
        else:
            grey = np.clip((luma.astype(np.float32) - 16) * _GAIN, 0, 255).astype(np.uint8)
            picture = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        self._draw_leds(picture, index)
        self._write_words(picture, index, lost=luma is None)
        strip = self._strip.copy()
        x = int(self._cursor[index])
        cv2.line(strip, (x, 0), (x, STRIP_ROWS), INK, 2)
        return np.asarray(np.vstack([picture, strip]), dtype=np.uint8)

    def _draw_leds(self, picture: Image, index: int) -> None:
        seen = self.result.observations
        for i, name in enumerate(self.result.led_names):
            uv = seen.uv_px[index, i]
            if not np.isfinite(uv).all():
                continue
            residual = self.result.optical.residual_px[index, i]
            used = bool(np.isfinite(residual).all())
            radius = float(np.sqrt(max(np.nan_to_num(seen.area_px2[index, i]), 16.0) / np.pi)) + 6
            at = _pixel(uv)
            cv2.circle(picture, at, round(radius), USED if used else UNUSED, 2, cv2.LINE_AA)
            flags = LedFlag(int(seen.led_flags[index, i]))
            words = name if used else f"{name}: {(flags.name or 'not used').lower().replace('|', ', ')}"
            _write(picture, words, (at[0] + round(radius) + 6, at[1] - 6), USED if used else UNUSED)
            if used:
                cv2.arrowedLine(picture, _pixel(uv - RESIDUAL_SCALE * residual), at, RESIDUAL, 2, cv2.LINE_AA)

    def _write_words(self, picture: Image, index: int, *, lost: bool) -> None:
        result = self.result
        t_ns = int(result.optical.t_ns[index])
        since = "" if result.t0_ns is None else f"   {(t_ns - result.t0_ns) / 1e9:+.4f} s from the trigger"
        sample = ""
        if result.edge_fit is not None:
            sample = f"   sample {float(result.edge_fit.sample_index_of(t_ns)):.2f}"
        simulated = "   SIMULATED" if result.manifest.simulated else ""
        lines = [f"{result.manifest.run_id}   frame {index}{since}{sample}{simulated}"]
        flags = int(result.optical.flags[index])
        if lost:
            lines.append("picture lost")
        elif flags & PoseFlag.NO_POSE:
            lines.append("no pose")
        else:
            origin = "rest" if result.rest is not None else "the camera"
            x, y, z = self.displacement_mm[index]
            a, b, c = self.angles_deg[index]
            lines.append(
                f"from {origin}   x {x:+.3f}  y {y:+.3f}  z {z:+.3f} mm   {a:+.3f}  {b:+.3f}  {c:+.3f} deg"
            )
        if flags:
            lines.append(describe(flags))
        for row, line in enumerate(lines):
            _write(picture, line, (16, 34 + 32 * row), INK)
        _write(picture, f"residuals x {RESIDUAL_SCALE:g}", (16, self.height_px - 18), RESIDUAL)


def _draw_strip(
    t_s: FloatArray, t_mm: FloatArray, width_px: int, *, from_rest: bool
) -> tuple[Image, NDArray[np.int64]]:
    """Return the time histories of three displacements, and the column of each frame."""
    strip = np.full((STRIP_ROWS, width_px, 3), 24, dtype=np.uint8)
    left, right, top, bottom = 90, width_px - 30, 34, STRIP_ROWS - 30
    span_s = max(float(t_s[-1]), 1e-9)
    columns = np.rint(left + t_s / span_s * (right - left)).astype(np.int64)
    shown = t_mm if from_rest else t_mm - np.nanmedian(t_mm, axis=0)
    known = np.asarray(np.isfinite(shown).all(axis=1))
    limit = float(np.abs(shown[known]).max()) if known.any() else 1.0
    limit = max(limit, 1e-3) * 1.05
    rows = (top + bottom) / 2 - np.nan_to_num(shown) / limit * (bottom - top) / 2
    cv2.line(strip, (left, (top + bottom) // 2), (right, (top + bottom) // 2), (70, 70, 70), 1)
    for axis, letter in enumerate("xyz"):
        pieces = np.split(np.arange(len(t_s)), np.flatnonzero(np.diff(known.astype(np.int8))) + 1)
        for piece in pieces:
            if known[piece[0]]:
                line = np.stack([columns[piece], np.rint(rows[piece, axis])], axis=1).astype(np.int32)
                cv2.polylines(
                    strip, [line], isClosed=False, color=AXES[axis], thickness=2, lineType=cv2.LINE_AA
                )
        _write(strip, letter, (left + 30 * axis, 24), AXES[axis])
    what = "displacement from rest" if from_rest else "position less its median"
    _write(strip, f"{what}, mm, over {span_s:.2f} s", (left + 100, 24), FAINT)
    for value, row in ((limit, top), (-limit, bottom)):
        _write(strip, f"{value:+.2g}", (8, row + 8), FAINT)
    return strip, columns


def _pixel(uv: FloatArray) -> tuple[int, int]:
    return round(float(uv[0])), round(float(uv[1]))


def _write(picture: Image, words: str, at: tuple[int, int], colour: Colour) -> None:
    # A shadow of thicker strokes would be a wider text: OpenCV 5 draws fonts, and spaces bold ones further.
    for aside, ink in ((-1, (0, 0, 0)), (1, (0, 0, 0)), (0, colour)):
        place = (at[0] + aside, at[1] + aside)
        cv2.putText(picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, ink, 1, cv2.LINE_AA)
