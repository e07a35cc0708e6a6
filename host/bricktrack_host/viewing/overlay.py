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
from bricktrack_host.results.result_tables import FusedKind
from bricktrack_host.results.run_summary import main_kind
from bricktrack_host.tracks import FusedTrack, OpticalTrack

Colour = tuple[int, int, int]  # blue, green, red
Image = NDArray[np.uint8]

USED: Colour = (120, 220, 120)
UNUSED: Colour = (60, 160, 255)
RESIDUAL: Colour = (255, 190, 90)
INK: Colour = (240, 240, 240)
FAINT: Colour = (150, 150, 150)
AXES: tuple[Colour, Colour, Colour] = ((90, 130, 255), (110, 210, 110), (255, 170, 80))
"""Of the motion in the strip: a line where it is fused, dots for the camera's poses."""

RESIDUAL_SCALE = 100.0
"""A residual of 0.1 px is drawn 10 px long."""
_WORDS_ROWS = 132
STRIP_ROWS = _WORDS_ROWS + 228
"""Below the picture: words, and the motion of all frames that are shown."""
_GAIN = 255 / 219  # luma 16..235


@dataclass(frozen=True, slots=True, eq=False)
class OverlayArtist:
    """Draws single frames of one run.

    Attributes
    ----------
    result : RunResult
    optical, fused : ndarray, shape (n_frames, 6)
        Displacement, mm, and angles, deg, from rest where there is a rest pose, else as seen from the camera;
        by each frame alone, and fused; NaN where not known, or extrapolated.
    height_px : int
        Of the picture; the strip with the motion comes below it.
    """

    result: RunResult
    optical: FloatArray
    fused: FloatArray
    height_px: int
    _strip: Image
    _cursor: NDArray[np.int64]

    @classmethod
    def of(
        cls, result: RunResult, width_px: int, height_px: int, *, frames: tuple[int, int] | None = None
    ) -> "OverlayArtist":
        """Return an artist for pictures of this size; its strip is of ``frames``: first, after last."""
        optical, track = result.optical, result.fused.get("frame")
        n = len(optical.t_ns)
        seen = _from_rest(result, "optical", optical)
        fused = np.full((n, 6), np.nan)
        if track is not None and len(track.t_ns) == n:
            fused = _known_from_rest(result, "frame", track)
        origin_ns = optical.t_ns[0] if result.t0_ns is None else result.t0_ns
        t_s = (optical.t_ns - origin_ns) / 1e9
        first, stop = frames or (0, n)
        kind, line = main_kind(result), (t_s, seen[:, :3])
        if kind is not None:
            dense = result.fused[kind]
            line = ((dense.t_ns - origin_ns) / 1e9, _known_from_rest(result, kind, dense)[:, :3])
        strip, cursor = _draw_strip(
            (t_s, seen[:, :3]), line, width_px, span_s=(t_s[first], t_s[stop - 1]),
            from_rest=result.rest is not None, is_fused=kind is not None,
        )  # fmt: skip
        return cls(result, seen, fused, height_px, strip, cursor)

    def draw(self, index: int, luma: NDArray[np.uint8] | None) -> Image:
        """Return frame ``index`` in colour, shape (height + strip, width, 3), BGR; grey where it was lost."""
        width = self._strip.shape[1]
        if luma is None:
            picture = np.full((self.height_px, width, 3), 60, dtype=np.uint8)
        else:
            grey = np.clip((luma.astype(np.float32) - 16) * _GAIN, 0, 255).astype(np.uint8)
            picture = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        self._draw_leds(picture, index)
        strip = self._strip.copy()
        x = int(self._cursor[index])
        cv2.line(strip, (x, _WORDS_ROWS + 30), (x, STRIP_ROWS), INK, 2)
        for row, line in enumerate(self._words(index, lost=luma is None)):
            _write(strip, line, (16, 30 + 32 * row), INK)
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
            why = (flags.name or "not used").lower().replace("|", ", ").replace("_", " ")
            words = name if used else f"{name}: {why}"
            _write(picture, words, (at[0] + round(radius) + 6, at[1] - 6), USED if used else UNUSED)
            if used:
                tail = _pixel(uv - RESIDUAL_SCALE * residual)
                for ink, thickness in (((0, 0, 0), 5), (RESIDUAL, 2)):  # edged: lights are white
                    cv2.arrowedLine(picture, tail, at, ink, thickness, cv2.LINE_AA)

    def _words(self, index: int, *, lost: bool) -> list[str]:
        """Return four lines: the instant, the pose by the camera alone, the fused one, and the flags."""
        result = self.result
        t_ns = int(result.optical.t_ns[index])
        since = "" if result.t0_ns is None else f"   {(t_ns - result.t0_ns) / 1e9:+.4f} s from the trigger"
        sample = ""
        if result.edge_fit is not None:
            sample = f"   sample {float(result.edge_fit.sample_index_of(t_ns)):.2f}"
        simulated = "   SIMULATED" if result.manifest.simulated else ""
        flags = int(result.optical.flags[index])
        return [
            f"{result.manifest.run_id}   frame {index}{since}{sample}{simulated}",
            f"camera alone   {'picture lost' if lost else self._pose_words(self.optical[index])}",
            f"fused   {self._pose_words(self.fused[index])}",
            describe(flags & ~int(PoseFlag.NO_POSE)),
        ]

    def _pose_words(self, pose: FloatArray) -> str:
        if not np.isfinite(pose).all():
            return "no pose"
        x, y, z, a, b, c = pose.tolist()
        origin = "rest" if self.result.rest is not None else "the camera"
        place = f"x {x:+.3f}  y {y:+.3f}  z {z:+.3f} mm   {a:+.3f}  {b:+.3f}  {c:+.3f} deg"
        return f"{place}   from {origin}"


def _known_from_rest(result: RunResult, kind: FusedKind, track: FusedTrack) -> FloatArray:
    """Return fused motion as `_from_rest`, NaN where it is extrapolated or not known."""
    moved = _from_rest(result, kind, track)
    moved[track.flags & int(PoseFlag.EXTRAPOLATED | PoseFlag.NO_POSE) != 0] = np.nan
    return moved


def _from_rest(result: RunResult, kind: str, track: OpticalTrack | FusedTrack) -> FloatArray:
    seen = result.from_rest.get(kind)
    R, t_mm = (track.R_camera_brick, track.t_camera_brick_mm) if seen is None else (seen.R, seen.t_mm)
    return np.hstack([t_mm, np.rad2deg(angles_xyz_from_matrix(R))])


def _draw_strip(
    dots: tuple[FloatArray, FloatArray],
    line: tuple[FloatArray, FloatArray],
    width_px: int,
    *,
    span_s: tuple[float, float],
    from_rest: bool,
    is_fused: bool,
) -> tuple[Image, NDArray[np.int64]]:
    """Return the histories of three displacements, and the column of each frame.

    ``dots``, the camera's poses, and ``line``: seconds, shape (n,), and displacements, shape (n, 3), mm.
    """
    strip = np.full((STRIP_ROWS, width_px, 3), 24, dtype=np.uint8)
    left, right, top, bottom = 90, width_px - 30, _WORDS_ROWS + 34, STRIP_ROWS - 30

    def columns_of(t_s: FloatArray) -> NDArray[np.int64]:
        share = (t_s - span_s[0]) / max(span_s[1] - span_s[0], 1e-9)
        return np.rint(left + np.clip(share, 0, 1) * (right - left)).astype(np.int64)

    middle_mm = np.zeros(3) if from_rest else np.nanmedian(np.vstack([dots[1], line[1]]), axis=0)
    curves = []
    for t_s, mm in (line, dots):
        shown = (t_s >= span_s[0]) & (t_s <= span_s[1])
        curves.append((columns_of(t_s[shown]), (mm - middle_mm)[shown]))
    known = np.abs(np.vstack([mm for _, mm in curves]))
    limit = float(np.nanmax(known)) if np.isfinite(known).any() else 1.0
    limit = max(limit, 1e-3) * 1.05
    cv2.line(strip, (left, (top + bottom) // 2), (right, (top + bottom) // 2), (70, 70, 70), 1)
    for draw, (columns, mm) in zip((_draw_curve, _draw_dots), curves, strict=True):
        rows = (top + bottom) / 2 - mm / limit * (bottom - top) / 2
        for axis in range(3):
            draw(strip, columns, rows[:, axis], AXES[axis])
    for axis, letter in enumerate("xyz"):
        _write(strip, letter, (left + 30 * axis, top - 10), AXES[axis])
    what = "displacement from rest" if from_rest else "position less its median"
    words = f"{what}, mm, from {span_s[0]:.2f} to {span_s[1]:.2f} s; "
    words += "line: fused, dots: camera alone" if is_fused else "camera alone"
    _write(strip, words, (left + 100, top - 10), FAINT)
    _write(strip, f"arrows: residuals x {RESIDUAL_SCALE:g}", (width_px - 330, top - 10), RESIDUAL)
    for value, row in ((limit, top), (-limit, bottom)):
        _write(strip, f"{value:+.2g}", (8, row + 8), FAINT)
    return strip, columns_of(dots[0])


def _draw_dots(strip: Image, columns: NDArray[np.int64], rows: FloatArray, ink: Colour) -> None:
    """Draw a dot at each place that is known."""
    for i in np.flatnonzero(np.isfinite(rows)):
        cv2.circle(strip, (int(columns[i]), round(float(rows[i]))), 3, ink, cv2.FILLED, cv2.LINE_AA)


def _draw_curve(strip: Image, columns: NDArray[np.int64], rows: FloatArray, ink: Colour) -> None:
    """Draw a line through what is known."""
    known = np.isfinite(rows)
    for piece in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(known.astype(np.int8))) + 1):
        if len(piece) and known[piece[0]]:
            line = np.stack([columns[piece], np.rint(rows[piece])], axis=1).astype(np.int32)
            cv2.polylines(strip, [line], isClosed=False, color=ink, thickness=2, lineType=cv2.LINE_AA)


def _pixel(uv: FloatArray) -> tuple[int, int]:
    return round(float(uv[0])), round(float(uv[1]))


def _write(picture: Image, words: str, at: tuple[int, int], colour: Colour) -> None:
    # A shadow of thicker strokes would be a wider text: OpenCV 5 draws fonts, and spaces bold ones further.
    for aside, ink in ((-1, (0, 0, 0)), (1, (0, 0, 0)), (0, colour)):
        place = (at[0] + aside, at[1] + aside)
        cv2.putText(picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, ink, 1, cv2.LINE_AA)
