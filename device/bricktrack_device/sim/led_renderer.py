"""Pictures of glowing domes: each pixel's ray is cast against each LED when its row was exposed.

A dome is a hemisphere on a lit cylinder, the collar. Only the windows around LEDs are drawn anew for each
frame; the surroundings come from a few noisy pictures made once. Grey levels are BT.601 limited range, as from
the encoder's own converter; the LEDs are white, so the chroma planes are constant.
"""

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_device.sim.lens import Lens
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.world import SimWorld

Plane = NDArray[np.uint8]
_Single = NDArray[np.float32]

_N_SURROUNDINGS = 6
_N_INSTANTS = 48  # of the pose over a frame's read-out: 0.5 ms apart, between which it is taken as linear
_PSF_SIGMA_PX = 1.1
_MARGIN_PX = 8
_READ_NOISE = 0.004
_SHOT_NOISE = 0.006
_LIMB = 0.3  # how much darker the dome's rim is than its middle
_SUB_PIXEL = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_LEVELS = 4096


class LedRenderer:
    """Draws the luma plane of frames; chroma planes never change."""

    def __init__(
        self, settings: SimSettings, world: SimWorld, *, lens: Lens, mode: SensorMode, exposure_ns: int
    ) -> None:
        self._settings = settings
        self._world = world
        self._lens = lens
        self._mode = mode
        self._exposure_ns = exposure_ns
        self._directions = lens.directions.astype(np.float32)
        self._rng = np.random.default_rng([settings.seed, 2])
        self._luma_of_light = _transfer()
        light = _surroundings(lens, settings)
        self._light = light.astype(np.float32)
        self._pictures = [self._expose(light) for _ in range(_N_SURROUNDINGS)]
        self._card = self._expose(np.full_like(light, 0.002))
        self._noise = self._rng.standard_normal((1 << 20) + 7).astype(np.float32)
        self._n_drawn = 0
        half = (mode.height // 2, mode.width // 2)
        self.chroma_u: Plane = np.full(half, 128, dtype=np.uint8)
        self.chroma_v: Plane = np.full(half, 128, dtype=np.uint8)

    def luma(self, sensor_timestamp_ns: int) -> Plane:
        """Return the luma plane (height, width) of the frame whose read-out starts at this instant.

        Row v is exposed from ``stamp + v line_time - exposure`` to ``stamp + v line_time``.
        """
        mode = self._mode
        span = self._exposure_ns + float(mode.row_delay_ns(mode.height))
        start = sensor_timestamp_ns - self._exposure_ns
        self._instants_ns = start + np.rint(np.linspace(0, span, _N_INSTANTS)).astype(np.int64)
        self._n_drawn += 1
        middle = np.array([sensor_timestamp_ns - self._exposure_ns // 2], dtype=np.int64)
        if self._world.view_is_covered(middle)[0]:
            return self._card.copy()
        picture = self._pictures[self._n_drawn % _N_SURROUNDINGS].copy()
        self._R, self._t = (a.astype(np.float64) for a in self._world.pose(self._instants_ns))
        hidden = self._world.hidden_leds(int(middle[0]))
        for i, name in enumerate(self._world.brick.led_names):
            if name not in hidden:
                self._draw(picture, i)
        return picture

    def _draw(self, picture: Plane, i_led: int) -> None:
        brick = self._world.brick
        radius = float(brick.led_radii_mm[i_led])
        centres = np.einsum("nij,j->ni", self._R, brick.led_positions_mm[i_led]) + self._t
        uv = self._lens.project(centres[:: _N_INSTANTS // 6])
        reach = 1.15 * radius * self._lens.focal_px / centres[:, 2].min() + _MARGIN_PX
        u0, v0 = np.maximum(np.floor(uv.min(axis=0) - reach), 0).astype(int)
        u1 = min(int(np.ceil(uv[:, 0].max() + reach)) + 1, self._mode.width)
        v1 = min(int(np.ceil(uv[:, 1].max() + reach)) + 1, self._mode.height)
        if u1 - u0 < 3 or v1 - v0 < 3:
            return
        axis = brick.led_axes[i_led]
        d = self._directions[v0:v1, u0:u1]
        # Rows and columns of neighbouring pixels' directions give those of sub-pixel points.
        du, dv = np.gradient(d, axis=1), np.gradient(d, axis=0)
        rows = np.arange(v0, v1)
        lit = np.zeros(d.shape[:2], dtype=np.float32)
        for k, (off_u, off_v) in enumerate(_SUB_PIXEL):
            share = (k + 0.5) / len(_SUB_PIXEL)
            R, t = self._pose_of_rows(rows + off_v, share)
            to_led = np.einsum("nij,j->ni", R, brick.led_positions_mm[i_led]) + t
            lit += _dome_light(
                d + np.float32(off_u) * du + np.float32(off_v) * dv,
                to_led.astype(np.float32),
                np.einsum("nij,j->ni", R, axis).astype(np.float32),
                radius,
                self._settings.collar_mm,
            )
        light = self._light[v0:v1, u0:u1]
        blurred = _blur(lit / np.float32(len(_SUB_PIXEL)))
        light = light * (1 - np.minimum(blurred, 1)) + np.float32(self._settings.led_level) * blurred
        picture[v0:v1, u0:u1] = self._digitise(light)

    def _pose_of_rows(self, rows: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
        """Return the poses at which rows stood when ``share`` of their exposure was over."""
        delay = self._mode.row_delay_ns(rows)
        span = float(self._instants_ns[-1] - self._instants_ns[0])
        x = np.clip((delay + share * self._exposure_ns) / span, 0, 1) * (_N_INSTANTS - 1)
        i = np.minimum(x.astype(int), _N_INSTANTS - 2)
        f = (x - i)[:, None]
        t = (1 - f) * self._t[i] + f * self._t[i + 1]
        R = (1 - f[..., None]) * self._R[i] + f[..., None] * self._R[i + 1]
        return R, t

    def _expose(self, light: FloatArray) -> Plane:
        noise = self._rng.standard_normal(light.shape, dtype=np.float32)
        return self._to_luma(light.astype(np.float32), noise)

    def _digitise(self, light: _Single) -> Plane:
        start = (
            int(self._rng.integers(0, self._noise.size - light.size)) if light.size < self._noise.size else 0
        )
        return self._to_luma(light, np.resize(self._noise[start : start + light.size], light.shape))

    def _to_luma(self, light: _Single, noise: _Single) -> Plane:
        sd = np.float32(self._settings.noise) * np.sqrt(_READ_NOISE**2 + _SHOT_NOISE**2 * light)
        level = np.clip((light + sd * noise) * (_LEVELS - 1), 0, _LEVELS - 1).astype(np.uint16)
        return np.asarray(self._luma_of_light[level])


def _dome_light(d: _Single, centre: _Single, axis: _Single, radius: float, collar_mm: float) -> _Single:
    """Return the light (rows, columns) of one dome seen along unit rays from the origin.

    ``d`` is (rows, columns, 3); ``centre`` and ``axis`` are (rows, 3): the brick moves from row to row.
    """
    c, a = centre[:, None, :], axis[:, None, :]
    along = np.einsum("rci,rki->rc", d, c)  # distance to the point of the ray nearest to the centre
    cc = np.einsum("rki,rki->rk", c, c)
    half2 = along**2 - (cc - np.float32(radius**2))
    hit = half2 > 0
    half = np.sqrt(np.maximum(half2, 0))
    s = along - half
    da, ca = np.einsum("rci,rki->rc", d, a), np.einsum("rki,rki->rk", c, a)
    height = s * da - ca  # of the point of entry above the plane through the sphere's centre
    dome = hit & (height >= 0)
    facing = half / np.float32(radius)
    light = np.where(dome, 1 - np.float32(_LIMB) * (1 - facing), np.float32(0))
    if collar_mm > 0:
        # The cylinder: the same in the plane across the axis.
        A = np.maximum(1 - da**2, np.float32(1e-6))
        B = along - da * ca
        C = cc - ca**2 - np.float32(radius**2)
        disc = B**2 - A * C
        side = np.sqrt(np.maximum(disc, 0))
        h = (B - side) / A * da - ca
        wall = (disc > 0) & (h <= 0) & (h >= -np.float32(collar_mm)) & ~dome
        facing = side / (np.sqrt(A) * np.float32(radius))
        light = np.where(wall, 1 - np.float32(_LIMB) * (1 - np.clip(facing, 0, 1)), light)
    return np.asarray(light, dtype=np.float32)


def _blur(image: _Single) -> _Single:
    """Return the image through the lens's point spread, a Gaussian."""
    x = np.arange(-3, 4, dtype=np.float32)
    kernel = np.exp(-0.5 * (x / np.float32(_PSF_SIGMA_PX)) ** 2)
    kernel /= kernel.sum()
    out = image
    for axis in (0, 1):
        padded = np.pad(out, [(3, 3) if a == axis else (0, 0) for a in (0, 1)])
        n = out.shape[axis]
        parts = [padded[k : k + n] if axis == 0 else padded[:, k : k + n] for k in range(7)]
        out = sum((w * p for w, p in zip(kernel, parts, strict=True)), np.zeros_like(out))
    return out


def _transfer() -> Plane:
    """Return the table from linear light to BT.601 limited luma through the Rec. 709 curve."""
    light = np.arange(_LEVELS) / (_LEVELS - 1)
    curve = np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    return np.rint(16 + 219 * curve).astype(np.uint8)


def _surroundings(lens: Lens, settings: SimSettings) -> FloatArray:
    """Return the linear light of everything but the LEDs: a dark wall, mottled, with a few reflections."""
    rng = np.random.default_rng([settings.seed, 3])
    coarse = rng.uniform(0.2, 1.0, (lens.height // 40 + 2, lens.width // 40 + 2))
    mottled = np.repeat(np.repeat(coarse, 40, axis=0), 40, axis=1)[: lens.height, : lens.width]
    for axis in (0, 1):
        padded = np.pad(mottled, [(31, 30) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        total = np.cumsum(padded, axis=axis)
        n = mottled.shape[axis]
        mottled = (np.take(total, range(61, 61 + n), axis) - np.take(total, range(n), axis)) / 61
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float64)
    radius2 = ((u - lens.width / 2) ** 2 + (v - lens.height / 2) ** 2) / (lens.width / 2) ** 2
    light = 0.012 * settings.clutter * mottled * (1 - 0.3 * radius2)
    for _ in range(5):  # reflections: smaller than an LED, and drawn out
        at = rng.uniform([60, 60], [lens.width - 60, lens.height - 60])
        size = rng.uniform([5, 2], [14, 6])
        turn = rng.uniform(0, np.pi)
        x, y = u - at[0], v - at[1]
        along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
        light += (
            0.5
            * min(settings.clutter, 1.5)
            * np.exp(-(((along / size[0]) ** 2 + (across / size[1]) ** 2) ** 2))
        )
    return np.asarray(light)
