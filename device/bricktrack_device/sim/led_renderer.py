"""Pictures of glowing domes: each pixel's ray is cast against each LED while its row is exposed.

Only windows around the LEDs are computed for each frame; the surroundings are `scene`'s. The LEDs are
white, so the chroma planes are constant.
"""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_device.sim.dome import clearance_mm, foot_mm
from bricktrack_device.sim.led_switch import LedSwitch
from bricktrack_device.sim.lens import Lens
from bricktrack_device.sim.scene import BAND_ROWS, LIGHT_OF_LUMA, Plane, Scene, Single, noise_sd, to_luma
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.world import SimWorld

_POSE_STEP_ROWS = 4  # poses are taken every 76 us and linear between: 0.2 um at 30 g
_PSF_SIGMA_PX = 0.8
_APERTURE_MM = 1.5  # f/2 of 3.04 mm
_FOCUS_MM = 126.0
_LIMB = 0.3  # how much darker the rim is than the middle
_BEZEL_RADII = 1.45
_MAX_INSTANTS = 12
_BLUR_STEP_PX = 0.8
_CARD_TILT = 0.15
_CARD_EDGE_PX = 12.0  # out of focus


class LedRenderer:
    """Draws the luma plane of frames; chroma planes never change.

    Parameters
    ----------
    settings : SimSettings
    world : SimWorld
    lens : Lens
    mode : SensorMode
    exposure_ns : int
    switch : LedSwitch or None
        When the LEDs glow; `None`: always.
    """

    def __init__(
        self,
        settings: SimSettings,
        world: SimWorld,
        *,
        lens: Lens,
        mode: SensorMode,
        exposure_ns: int,
        switch: LedSwitch | None = None,
    ) -> None:
        self._switch = switch
        self._settings = settings
        self._world = world
        self._lens = lens
        self._mode = mode
        self._exposure_ns = exposure_ns
        slopes = lens.pixel_slopes
        self._x, self._y = (np.ascontiguousarray(slopes[..., i], dtype=np.float32) for i in (0, 1))
        delays_ns = self._delays_ns = mode.row_delay_ns(np.arange(mode.height))
        self._first_delay_ns = float(delays_ns.min())
        self._step_ns = _POSE_STEP_ROWS * mode.line_time_ns
        # When rows' exposures begin, in steps of the pose grid; mid-exposure is half an exposure later.
        self._row_start = (delays_ns - self._first_delay_ns) / self._step_ns
        self._exposure_steps = exposure_ns / self._step_ns
        self._n_steps = int(np.ceil(self._row_start.max() + self._exposure_steps)) + 2
        brick = world.brick
        R, t_mm = world.rest_pose
        centres = brick.led_positions_mm @ R.T + t_mm
        self._rest_uv = lens.project(centres)
        radius_px = float(brick.led_radii_mm.max() * lens.focal_px / centres[:, 2].min())
        self._scene = Scene(settings, lens, led_uv_px=self._rest_uv, led_radius_px=radius_px)
        self._rng = np.random.default_rng([settings.seed, 2])
        self._noise = self._rng.standard_normal(1 << 20, dtype=np.float32)
        half = (mode.height // 2, mode.width // 2)
        self.chroma_u: Plane = np.full(half, 128, dtype=np.uint8)
        self.chroma_v: Plane = np.full(half, 128, dtype=np.uint8)

    def luma(self, sensor_timestamp_ns: int) -> Plane:
        """Return the luma plane (height, width) of the frame whose read-out starts at this instant.

        Row v is exposed from ``stamp + delay(v) - exposure`` to ``stamp + delay(v)``.
        """
        start_ns = sensor_timestamp_ns - self._exposure_ns + self._first_delay_ns
        grid_ns = round(start_ns) + np.rint(np.arange(self._n_steps) * self._step_ns).astype(np.int64)
        cover = self._world.card_cover(grid_ns)
        if cover.min() >= 1:
            return self._scene.card.copy()
        R, t_mm = self._world.pose(grid_ns)
        centres = np.einsum("nij,lj->nli", R, self._world.brick.led_positions_mm) + t_mm[:, None]
        axes = np.einsum("nij,lj->nli", R, self._world.brick.led_axes)
        uv = self._lens.project(centres)
        picture = self._scene.picture(self._wall_shifts(uv))
        lit = np.where(self._world.leds_hidden(grid_ns), 0.0, 1.0)
        end_ns = sensor_timestamp_ns + self._delays_ns
        glow = None if self._switch is None else self._switch.share_lit(end_ns - self._exposure_ns, end_ns)
        for i in range(centres.shape[1]):
            if lit[:, i].any():
                self._draw(picture, i, centres[:, i], axes[:, i], uv[:, i], lit[:, i], glow)
        if cover.max() > 0:
            self._draw_card(picture, self._at(cover[:, None], np.arange(self._mode.height), 0.5)[:, 0])
        return picture

    def _wall_shifts(self, uv: FloatArray) -> IntArray:
        rows = np.arange(BAND_ROWS // 2, self._mode.height + BAND_ROWS, BAND_ROWS)
        rows = np.minimum(rows[: -(-self._mode.height // BAND_ROWS)], self._mode.height - 1)
        moved = uv.mean(axis=1) - self._rest_uv.mean(axis=0)
        return np.rint(self._at(moved, rows, 0.5)).astype(np.int64)

    def _at(self, values: FloatArray, rows: IntArray, share: float) -> FloatArray:
        """Return ``values`` (steps, k) at the time when ``share`` of the exposure of each row was over."""
        x = self._row_start[rows] + share * self._exposure_steps
        i = np.minimum(x.astype(int), self._n_steps - 2)
        f = (x - i)[:, None]
        return np.asarray((1 - f) * values[i] + f * values[i + 1])

    def _window(self, uv: FloatArray, reach_px: float) -> tuple[int, int, int, int, float] | None:
        """Return u0, u1, v0, v1 of the rows and columns that the LED touches, and its blur in px."""
        rows = np.arange(self._mode.height)
        middle = self._row_start + 0.5 * self._exposure_steps
        order = np.argsort(middle)
        row_of_step = np.interp(np.arange(self._n_steps), middle[order], rows[order])
        exposure_rows = 0.5 * self._exposure_steps * _POSE_STEP_ROWS
        near = np.abs(row_of_step - uv[:, 1]) < reach_px + exposure_rows + 2 * _POSE_STEP_ROWS
        if near.sum() < 2:
            return None
        path = uv[near]
        u0, v0 = np.maximum(np.floor(path.min(axis=0) - reach_px), 0).astype(int).tolist()
        u1, v1 = np.minimum(
            np.ceil(path.max(axis=0) + reach_px) + 1, [self._mode.width, self._mode.height]
        ).astype(int)
        if u1 - u0 < 3 or v1 - v0 < 3:
            return None
        speed = np.linalg.norm(np.diff(path, axis=0), axis=1).max()
        return u0, u1, v0, v1, float(speed) * self._exposure_steps

    def _draw(
        self,
        picture: Plane,
        i_led: int,
        centres: FloatArray,
        axes: FloatArray,
        uv: FloatArray,
        lit: FloatArray,
        switched: FloatArray | None,
    ) -> None:
        brick, level = self._world.brick, np.float32(self._settings.led_level)
        radius, collar = float(brick.led_radii_mm[i_led]), self._settings.collar_mm
        facing = -np.einsum("nj,nj->n", axes, centres) / np.linalg.norm(centres, axis=1)
        if facing.min() < 0.05:
            return  # it looks past the camera
        z_mm = float(centres[:, 2].mean())
        scale = radius * self._lens.focal_px / z_mm
        moving = np.concatenate([centres, axes, lit[:, None]], axis=1)
        self._draw_bezel(picture, moving, self._window(uv, 1.2 * _BEZEL_RADII * scale + 4), radius, collar)
        window = self._window(uv, 1.15 * scale + (collar / radius) * scale + 6)
        if window is None:
            return
        u0, u1, v0, v1, blur_px = window
        rows = np.arange(v0, v1)
        x, y = self._x[v0:v1, u0:u1], self._y[v0:v1, u0:u1]
        px_per_mm = _px_per_slope(x, y) / np.float32(z_mm)
        out_of_focus_px = self._lens.focal_px * _APERTURE_MM * abs(1 / z_mm - 1 / _FOCUS_MM)
        soft_px = np.float32(0.5 + np.hypot(1.8 * _PSF_SIGMA_PX, 0.5 * out_of_focus_px))
        n = int(np.clip(np.ceil(blur_px / _BLUR_STEP_PX), 1, _MAX_INSTANTS))
        covered, glow = np.zeros(x.shape, dtype=np.float32), np.zeros(x.shape, dtype=np.float32)
        for k in range(n):
            now = self._at(moving, rows, (k + 0.5) / n).astype(np.float32)
            deep = clearance_mm(x, y, now[:, :3], now[:, 3:6], radius_mm=radius, collar_mm=collar)
            share = _edge(deep * px_per_mm, soft_px) * now[:, 6:]
            from_middle = 1 - np.clip(deep / np.float32(radius), 0, 1)
            bright = 1 - np.float32(_LIMB) * (1 - np.sqrt(np.maximum(1 - from_middle * from_middle, 0)))
            covered += share
            glow += share * bright
        fall_off = 1 / (1 + x * x + y * y)  # the lens is darker towards the corners
        led: Single = np.asarray(level / np.float32(n) * glow * fall_off, dtype=np.float32)
        if switched is not None:
            led *= switched[rows, None].astype(np.float32)
        first = int(self._rng.integers(0, self._noise.size - x.size))
        noise = self._noise[first : first + x.size].reshape(x.shape)
        grain = noise_sd(led, self._settings) * noise * (covered > 0)
        behind = LIGHT_OF_LUMA[picture[v0:v1, u0:u1]]
        light = np.asarray(behind * (1 - covered / np.float32(n)) + led + grain, dtype=np.float32)
        picture[v0:v1, u0:u1] = to_luma(light)

    def _draw_bezel(
        self,
        picture: Plane,
        moving: FloatArray,
        window: tuple[int, int, int, int, float] | None,
        radius_mm: float,
        collar_mm: float,
    ) -> None:
        """Darken the wall around the foot of an LED, sharp: it frames the LED and is not to be measured."""
        if window is None:
            return
        u0, u1, v0, v1, _ = window
        x, y = self._x[v0:v1, u0:u1], self._y[v0:v1, u0:u1]
        now = self._at(moving, np.arange(v0, v1), 0.5).astype(np.float32)
        from_axis = foot_mm(x, y, now[:, :3], now[:, 3:6], collar_mm=collar_mm)
        px_per_mm = _px_per_slope(x, y) / np.float32(moving[:, 2].mean())
        shade = _edge((np.float32(_BEZEL_RADII * radius_mm) - from_axis) * px_per_mm, np.float32(2))
        there = LIGHT_OF_LUMA[picture[v0:v1, u0:u1]]
        picture[v0:v1, u0:u1] = to_luma(np.asarray(there * (1 - np.float32(0.9) * shade), dtype=np.float32))

    def _draw_card(self, picture: Plane, cover: FloatArray) -> None:
        """Slide the card in from the left; 1 covers the whole picture."""
        half = _CARD_EDGE_PX + 0.5 * _CARD_TILT * self._mode.height
        rows = np.arange(self._mode.height)
        edge = -half + cover * (self._mode.width + 2 * half) + _CARD_TILT * (rows - self._mode.height / 2)
        u = np.arange(self._mode.width, dtype=np.float32)
        share = _edge(edge.astype(np.float32)[:, None] - u, np.float32(_CARD_EDGE_PX))
        there = picture.astype(np.float32)
        there += share * (self._scene.card - there)
        np.rint(there, out=there)
        picture[:] = there.astype(np.uint8)


def _edge(inside_px: Single, half_width_px: np.float32) -> Single:
    """Return a smooth step from 0 to 1 over an edge, symmetric about 0."""
    t = np.clip(np.float32(0.5) + inside_px * (np.float32(0.5) / half_width_px), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _px_per_slope(x: Single, y: Single) -> np.float32:
    """Return the scale of a window of the slope tables."""
    rows, columns = x.shape
    area = abs(float(x[-1, -1] - x[-1, 0]) * float(y[-1, 0] - y[0, 0])) / ((columns - 1) * (rows - 1))
    return np.float32(1 / np.sqrt(area))
