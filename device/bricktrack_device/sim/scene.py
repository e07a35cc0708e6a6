"""What the simulated camera sees besides the LEDs: a perforated wall that moves with the brick, and lamps.

Light is linear, 1 just fills the sensor; pictures are luma, BT.601 limited range, through the Rec. 709
curve. The wall follows the brick by whole pixels, row band by row band: it is there to be in the way, not
to be measured.
"""

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_device.sim.lens import Lens
from bricktrack_device.sim.settings import SimSettings

Plane = NDArray[np.uint8]
Single = NDArray[np.float32]

BAND_ROWS = 40
MAX_SHIFT_PX = 160
CARD_LIGHT = 0.004

_N_EXPOSURES = 4  # noisy pictures made once and shown in turn
_LEVELS = 4096
_READ_NOISE = 0.0012  # of the full range, standard deviation, linear light
_SHOT_NOISE = 0.010  # at full light: some 5000 electrons, and demosaicing that averages
_WALL_LIGHT, _HOLE_LIGHT, _DARK_LIGHT = 0.045, 0.004, 0.002
_WALL_BEYOND_LEDS_PX = 230


def _curve(light: FloatArray) -> FloatArray:
    return np.where(light < 0.018, 4.5 * light, 1.099 * np.maximum(light, 0.018) ** 0.45 - 0.099)


_LUMA_OF_LEVEL: Plane = np.rint(16 + 219 * _curve(np.arange(_LEVELS) / (_LEVELS - 1))).astype(np.uint8)
LIGHT_OF_LUMA: Single = np.interp(
    np.clip((np.arange(256) - 16) / 219, 0, 1),
    _curve(np.arange(_LEVELS) / (_LEVELS - 1)),
    np.arange(_LEVELS) / (_LEVELS - 1),
).astype(np.float32)
"""Linear light of a luma value: the inverse of `to_luma`."""


def to_luma(light: Single) -> Plane:
    """Return the luma of linear light; what is over the full range saturates."""
    return np.asarray(_LUMA_OF_LEVEL[np.clip(light * (_LEVELS - 1), 0, _LEVELS - 1).astype(np.uint16)])


def noise_sd(light: Single, settings: SimSettings) -> Single:
    """Return the standard deviation of the sensor's noise at this much light: read-out and photons."""
    return np.asarray(
        np.float32(settings.noise) * np.sqrt(_READ_NOISE**2 + _SHOT_NOISE**2 * np.maximum(light, 0)),
        dtype=np.float32,
    )


class Scene:
    """The surroundings, drawn anew for each frame from pictures made once.

    Parameters
    ----------
    settings : SimSettings
    lens : Lens
    led_uv_px : ndarray, shape (n, 2), px
        Where the LEDs are at rest: the wall carries them, and reflections lie near them.
    led_radius_px : float
    """

    def __init__(
        self, settings: SimSettings, lens: Lens, *, led_uv_px: FloatArray, led_radius_px: float
    ) -> None:
        self._settings = settings
        self._height = lens.height
        rng = np.random.default_rng([settings.seed, 3])
        left, right = led_uv_px[:, 0].min(), led_uv_px[:, 0].max()
        self._u0 = int(max(left - _WALL_BEYOND_LEDS_PX, 0))
        self._u1 = int(min(right + _WALL_BEYOND_LEDS_PX, lens.width))
        shape = lens.height + 2 * MAX_SHIFT_PX, self._u1 - self._u0
        at_rest = led_uv_px - [self._u0, -MAX_SHIFT_PX]
        wall = _wall(shape, at_rest, led_radius_px, settings.clutter, rng)
        around = _around(lens, settings.clutter)
        self._walls = [self._expose(wall, rng) for _ in range(_N_EXPOSURES)]
        self._arounds = [self._expose(around, rng) for _ in range(_N_EXPOSURES)]
        self.card = self._expose(np.full((lens.height, lens.width), CARD_LIGHT), rng)
        self._i_next = 0

    def _expose(self, light: FloatArray, rng: np.random.Generator) -> Plane:
        single = light.astype(np.float32)
        noise = rng.standard_normal(light.shape, dtype=np.float32)
        return to_luma(single + noise_sd(single, self._settings) * noise)

    def picture(self, shifts_px: IntArray) -> Plane:
        """Return a fresh picture with the wall moved by (u, v) in each band of rows, shape (bands, 2)."""
        self._i_next += 1
        picture = self._arounds[self._i_next % _N_EXPOSURES].copy()
        wall = self._walls[self._i_next % _N_EXPOSURES]
        width = picture.shape[1]
        for i, (du, dv) in enumerate(np.clip(shifts_px, -MAX_SHIFT_PX, MAX_SHIFT_PX).tolist()):
            v0, v1 = i * BAND_ROWS, min((i + 1) * BAND_ROWS, self._height)
            u0, u1 = max(self._u0 + du, 0), min(self._u1 + du, width)
            rows = slice(v0 - dv + MAX_SHIFT_PX, v1 - dv + MAX_SHIFT_PX)
            picture[v0:v1, u0:u1] = wall[rows, u0 - self._u0 - du : u1 - self._u0 - du]
        return picture


def _wall(
    shape: tuple[int, int], led_uv_px: FloatArray, radius_px: float, clutter: float, rng: np.random.Generator
) -> FloatArray:
    """Return the light of the brick's wall: mottled, holes in rows, a label, and glints of screws."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32)
    light = _WALL_LIGHT * (0.75 + 0.25 * _mottled(shape, rng))
    pitch, hole = 2.7 * radius_px, 0.7 * radius_px
    to_hole = np.hypot((u + pitch / 3) % pitch - pitch / 2, v % pitch - pitch / 2)
    light = np.where(to_hole < hole, _HOLE_LIGHT, light)
    label_u, label_v = 0.08 * shape[1], 0.4 * shape[0]
    on_label = (np.abs(u - label_u) < 38) & (np.abs(v - label_v) < 110)
    light = np.where(on_label, np.where((np.abs(u - label_u) < 26) & (v % 30 < 11), 0.02, 0.4), light)
    light = light * min(clutter, 4.0)
    for _ in range(6):
        at, size, turn = (
            _free_place(led_uv_px, radius_px, shape, rng),
            rng.uniform(2, 9, 2),
            rng.uniform(0, 3),
        )
        along = (u - at[0]) * np.cos(turn) + (v - at[1]) * np.sin(turn)
        across = (v - at[1]) * np.cos(turn) - (u - at[0]) * np.sin(turn)
        spot = np.exp(-(((along / size[0]) ** 2 + (across / size[1]) ** 2) ** 2))
        light = light + rng.uniform(0.3, 1.0) * min(clutter, 1.5) * spot
    return np.asarray(light, dtype=np.float64)


def _free_place(
    led_uv_px: FloatArray, radius_px: float, shape: tuple[int, int], rng: np.random.Generator
) -> FloatArray:
    """Return a place two or three radii from some LED and not upon another."""
    at = np.zeros(2)
    for _ in range(50):
        led = led_uv_px[rng.integers(len(led_uv_px))]
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(1.9, 3.2) * radius_px
        at = led + distance * np.array([np.cos(angle), np.sin(angle)])
        on_wall = 10 < at[0] < shape[1] - 10
        if on_wall and np.linalg.norm(led_uv_px - at, axis=1).min() > 1.7 * radius_px:
            break
    return np.asarray(at)


def _around(lens: Lens, clutter: float) -> FloatArray:
    """Return the light beside the brick: darkness, two ring lamps in a pane, a cable along the bottom."""
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float32)
    light = np.full((lens.height, lens.width), _DARK_LIGHT * min(clutter, 4.0))
    for at in ((0.095 * lens.width, 0.2 * lens.height), (0.9 * lens.width, 0.81 * lens.height)):
        ring = np.exp(-(((np.hypot(u - at[0], v - at[1]) - 76) / 10) ** 4))
        light = light + 0.8 * min(clutter, 1.2) * ring
    bottom = lens.height - 14 + 10 * np.cos(u / 400)
    return np.where(v > bottom, 0.12 * min(clutter, 4.0), light)


def _mottled(shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    """Return smooth noise between 0 and 1, some 60 px from lump to lump."""
    step = 60
    knots = rng.uniform(0, 1, (shape[0] // step + 2, shape[1] // step + 2))
    at_v, at_u = np.arange(shape[0]) / step, np.arange(shape[1]) / step
    i, j = at_v.astype(int), at_u.astype(int)
    fv, fu = (at_v - i)[:, None], (at_u - j)[None, :]
    top = knots[i][:, j] * (1 - fu) + knots[i][:, j + 1] * fu
    low = knots[i + 1][:, j] * (1 - fu) + knots[i + 1][:, j + 1] * fu
    return np.asarray(top * (1 - fv) + low * fv)
