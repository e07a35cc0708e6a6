"""Frames for `bench_pose.py`: lights of a simulated brick with LEDs hidden and false lights, and what is made of them."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel, ProfileEntry
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.evaluation.true_camera import TrueCamera
from bricktrack_host.tracking.identity.correspondence import search_correspondences
from bricktrack_host.tracking.identity.led_identity import identify_run
from bricktrack_host.tracking.led_model.led_profile import outline_moments
from bricktrack_host.tracking.pictures.run_lights import usual_radius_px
from bricktrack_host.tracking.pictures.segment import Blobs

COLLAR_MM = 0.7
N_FALSE = 5
_FALSE_AREA_PX2 = (900.0, 6000.0)
BESIDE_PX = 12.0  # of a brick at rest, lights farther from a hidden LED than some px are left out
_PICTURE_PX = np.array([[20.0, 20.0], [1900.0, 1060.0]])  # where false lights are
_APART_PX = 80.0  # an LED's diameter and some: nearer lights run together
_AREA_SD = 0.1  # of the logarithm: what exposure and threshold make of an outline
_CHUNK = 2000
Poses = Callable[[int], tuple[FloatArray, FloatArray]]


@dataclass
class Outcome:
    """What became of frames: all LEDs right, some missing, called ambiguous, any wrong."""

    right: int = 0
    missing: int = 0
    ambiguous: int = 0
    wrong: int = 0
    seconds: float = field(default=0.0)

    def add(self, said: IntArray, truth: IntArray, *, ambiguous: bool) -> None:
        """Count a frame; an LED that is said to be another light is wrong."""
        if ((said >= 0) & (said != truth)).any():
            self.wrong += 1
        elif (said == truth).all():
            self.right += 1
        elif ambiguous:
            self.ambiguous += 1
        else:
            self.missing += 1

    def __str__(self) -> str:
        n = self.right + self.missing + self.ambiguous + self.wrong
        shares = "  ".join(f"{100 * x / n:8.3f} %" for x in (self.right, self.missing, self.ambiguous))
        # No event in n: the rate is below 3 / n, at 95 %.
        rate = f"{self.wrong / n:.1e}" if self.wrong else f"< {3 / n:.0e}"
        return f"{n:8d}  {shares}  {self.wrong:6d}  {rate:>8s}  {1e3 * self.seconds / n:8.2f}"


HEADER = "                                  frames       right      missing   ambiguous   wrong      rate  ms a frame"


def fitted_brick(brick: BrickModel) -> BrickModel:
    """Return the brick with domes whose collar is known."""
    profile = ProfileEntry(collar_mm=COLLAR_MM, source="simulated")
    return replace(brick, led_profile=profile)


def lights_of(
    R: FloatArray,
    t: FloatArray,
    brick: BrickModel,
    camera: TrueCamera,
    noise_px: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return centroids (n, n_leds, 2) and areas (n, n_leds) of a brick at (n, 3, 3), (n, 3), or LED by LED."""
    R, t = (R, t) if R.ndim == 4 else (R[:, None], t[:, None])
    X = (
        np.einsum("nlij,lj->nli", np.broadcast_to(R, (len(R), brick.n_leds, 3, 3)), brick.led_positions_mm)
        + t
    )
    axes = np.einsum("nlij,lj->nli", np.broadcast_to(R, (len(R), brick.n_leds, 3, 3)), brick.led_axes)
    distance = np.linalg.norm(X, axis=-1)
    sight = X / distance[..., None]
    facing = -(axes * sight).sum(axis=-1)
    area_mm2, shift_mm, _ = outline_moments(
        facing, radius_mm=brick.led_radii_mm, collar_mm=COLLAR_MM, distance_mm=distance
    )
    across = axes + facing[..., None] * sight
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    uv = camera.project(X + shift_mm[..., None] * across)
    area = area_mm2 * (camera.focal_px / X[..., 2]) ** 2 * np.exp(rng.normal(0, _AREA_SD, distance.shape))
    return uv + rng.normal(0, noise_px, uv.shape), area


def picture(
    uv: FloatArray,
    area: FloatArray,
    shown: IntArray,
    false_uv: FloatArray,
    noise_px: float,
    rng: np.random.Generator,
) -> tuple[Blobs, IntArray]:
    """Return the shuffled lights of one frame, and which of them each LED is, -1 for hidden ones."""
    low, high = np.log(_FALSE_AREA_PX2)
    places = np.concatenate([uv[shown], false_uv])
    areas = np.concatenate([area[shown], np.exp(rng.uniform(low, high, len(false_uv)))])
    order = rng.permutation(len(places))
    truth = np.full(len(uv), -1)
    truth[shown] = np.argsort(order)[: len(shown)]
    n = len(places)
    blobs = Blobs(
        uv_px=places[order],
        cov_px2=np.tile(noise_px**2 * np.eye(2), (n, 1, 1)),
        area_px2=areas[order],
        eccentricity=np.zeros(n),
        fill=np.ones(n),
        flags=np.zeros(n, dtype=np.int64),
    )
    return blobs, truth


def mirrored(
    R: FloatArray, t: FloatArray, brick: BrickModel, camera: TrueCamera, rng: np.random.Generator
) -> FloatArray:
    """Return the images of five LEDs in a pane or table top beside one brick, shape (k, 2), px, those in view."""
    normal = rng.normal(size=3) * [1.0, 1.0, 0.2]
    normal /= np.linalg.norm(normal)
    X = brick.led_positions_mm @ R.T + t
    depth = X @ normal - (X @ normal).max() - rng.uniform(2, 15)
    uv = camera.project(X - 2 * depth[:, None] * normal)
    return uv[camera.sees(uv)][:N_FALSE]


def read_out(
    R: FloatArray,
    t: FloatArray,
    speed_mm_s: float,
    brick: BrickModel,
    camera: TrueCamera,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return poses when each LED's own row is read, (n, n_leds, 3, 3) and (n, n_leds, 3), of bricks at speed."""
    velocity = rng.normal(size=(len(R), 1, 3))
    velocity *= speed_mm_s / np.linalg.norm(velocity, axis=-1, keepdims=True)
    led_s = np.zeros((len(R), brick.n_leds, 1))
    P = np.einsum("nij,lj->nli", R, brick.led_positions_mm)
    for _ in range(10):
        at_led = t[:, None] + velocity * led_s
        v = camera.project(P + at_led)[..., 1:]
        led_s = (v - 0.5 * (camera.mode.height - 1)) * camera.mode.line_time_ns * 1e-9
    return np.repeat(R[:, None], brick.n_leds, axis=1), at_led


def searched(
    n: int,
    n_hidden: int,
    poses: Poses,
    brick: BrickModel,
    camera: TrueCamera,
    rays: RayModel,
    rng: np.random.Generator,
    *,
    noise_px: float = 0.05,
    mirrors: bool = False,
    beside: bool = False,
    fitted: bool = True,
    speed_mm_s: float = 0.0,
) -> Outcome:
    """Identify frames from nothing, each for itself; at a speed, the brick moves within each some other way.

    ``mirrors``: the false lights are mirror images. ``beside``: one of them is within `BESIDE_PX` of where a
    hidden LED would be seen, as in every `one_beside_in`-th frame by chance: wrong ones become frequent enough to
    be counted.
    """
    out = Outcome()
    while n > 0:
        m = min(n, _CHUNK)
        n -= m
        R, t = poses(m)
        shown_at = read_out(R, t, speed_mm_s, brick, camera, rng) if speed_mm_s else (R, t)
        uv, area = lights_of(*shown_at, brick, camera, noise_px, rng)
        frames = []
        for i in range(m):
            shown = np.sort(rng.permutation(brick.n_leds)[n_hidden:])
            false = mirrored(R[i], t[i], brick, camera, rng) if mirrors else _anywhere(rng, uv[i, shown])
            if beside:
                hidden = np.setdiff1d(np.arange(brick.n_leds), shown)
                false[0] = _beside(rng, uv[i, rng.choice(hidden)], uv[i, shown], false[0])
            frames.append(picture(uv[i], area[i], shown, false, noise_px, rng))
        start = time.process_time()
        found = search_correspondences(
            [b for b, _ in frames], rays, brick, collar_mm=COLLAR_MM if fitted else None
        )
        out.seconds += time.process_time() - start
        for answer, (_, truth) in zip(found, frames, strict=True):
            out.add(answer.blob_of_led, truth, ambiguous=answer.is_ambiguous)
    return out


def tracked(
    n: int,
    brick: BrickModel,
    camera: TrueCamera,
    rays: RayModel,
    rng: np.random.Generator,
    *,
    speed_share: float,
) -> Outcome:
    """Identify runs of 450 frames, swinging at up to 0.3 m/s times a share, read out in 20 ms.

    One or two LEDs are hidden at a time, for ten frames, and five false lights shine elsewhere in each frame.
    """
    out = Outcome()
    mode, noise_px, period_s = camera.mode, 0.05, 33.327e-3
    middle = 0.5 * (brick.led_positions_mm.min(axis=0) + brick.led_positions_mm.max(axis=0))
    frame_s = np.arange(450) * period_s
    for _ in range(0, n, len(frame_s)):
        phase, omega = rng.uniform(0, 6.28, 3), 2 * np.pi * rng.uniform(3, 6)

        def pose(
            t_s: FloatArray, phase: FloatArray = phase, omega: float = omega
        ) -> tuple[FloatArray, FloatArray]:
            wave = np.sin(omega * t_s[..., None] + phase)
            R = matrix_from_rvec(np.radians(2.0) * speed_share * wave[..., [1, 2, 0]])
            reach_mm = 300.0 * speed_share / omega * np.array([1.0, 0.5, 0.5])
            return R, np.array([0.0, 0.0, 134.0]) + reach_mm * wave - R @ middle

        led_s = np.repeat(frame_s[:, None], brick.n_leds, axis=1)
        for _ in range(10):  # each LED is seen when its own row is
            R, t = pose(led_s)
            uv = camera.project(np.einsum("nlij,lj->nli", R, brick.led_positions_mm) + t)
            led_s = frame_s[:, None] + (uv[..., 1] - 0.5 * (mode.height - 1)) * mode.line_time_ns * 1e-9
        uv, area = lights_of(*pose(led_s), brick, camera, noise_px, rng)
        frames = []
        for i in range(len(frame_s)):
            if i % 10 == 0:
                shown = np.sort(rng.permutation(brick.n_leds)[rng.integers(1, 3) :])
            frames.append(picture(uv[i], area[i], shown, _anywhere(rng, uv[i, shown]), noise_px, rng))
        start = time.process_time()
        found = identify_run(
            [b for b, _ in frames],
            np.rint(frame_s * 1e9).astype(np.int64),
            rays,
            brick,
            radius_px=usual_radius_px(rays, brick),
            collar_mm=COLLAR_MM,
        )
        out.seconds += time.process_time() - start
        believed = np.where(found.is_strayed, -1, found.blob_of_led)
        for i, (_, truth) in enumerate(frames):
            out.add(believed[i], truth, ambiguous=bool(found.is_ambiguous[i]))
    return out


def one_beside_in(n_hidden: int) -> float:
    """Return in one frame of how many a false light that fell anywhere is beside a hidden LED."""
    share = np.pi * BESIDE_PX**2 / np.prod(_PICTURE_PX[1] - _PICTURE_PX[0])
    return float(1 / (N_FALSE * n_hidden * share))


def _beside(
    rng: np.random.Generator, hidden_px: FloatArray, leds_px: FloatArray, otherwise_px: FloatArray
) -> FloatArray:
    """Return a place beside a hidden LED, shape (2,), px; the other one where that touches an LED shown."""
    angle, away = rng.uniform(0, 2 * np.pi), BESIDE_PX * np.sqrt(rng.uniform())
    place = hidden_px + away * np.array([np.cos(angle), np.sin(angle)])
    touches = (np.linalg.norm(leds_px - place, axis=-1) < _APART_PX).any()
    return otherwise_px if touches else place


def _anywhere(rng: np.random.Generator, leds_px: FloatArray) -> FloatArray:
    """Return places of false lights, shape (N_FALSE, 2), px, that touch no LED shown: they would be one light."""
    places = np.full((N_FALSE, 2), np.nan)
    touching = np.ones(N_FALSE, dtype=bool)
    while touching.any():
        places[touching] = rng.uniform(*_PICTURE_PX, (touching.sum(), 2))
        touching = (np.linalg.norm(places[:, None] - leds_px, axis=-1) < _APART_PX).any(axis=1)
    return places
