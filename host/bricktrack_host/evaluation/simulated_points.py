"""The paper's sweeps with points in place of pictures: true pixels, noise, and the product from there on."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel, ProfileEntry
from bricktrack_common.camera_model import RayModel
from bricktrack_host.evaluation.bound import cramer_rao_covariance
from bricktrack_host.evaluation.scores import SweepScore, score_sweep
from bricktrack_host.evaluation.sweeps import Sweep, paper_sweeps, random_orientations
from bricktrack_host.evaluation.true_camera import PLANE_A_MM, PLANE_B_MM, TrueCamera
from bricktrack_host.quality import LedFlag
from bricktrack_host.tracking.identity.correspondence import search_correspondences
from bricktrack_host.tracking.identity.verification import Correspondence
from bricktrack_host.tracking.optical_track import solve_poses
from bricktrack_host.tracking.pictures.segment import Blobs
from bricktrack_host.tracks import LedObservations

_MIN_FACING = 0.08  # an LED seen more from the side than this shows too little to be measured
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class IdentityCount:
    """How identities from nothing came out.

    Attributes
    ----------
    n : int
        Pictures.
    right : int
        All LEDs that are seen, and each the right one.
    left_out : int
        An LED not found, all others right.
    wrong : int
        An LED with another one's light.
    ambiguous : int
        Two assignments fit, said so.
    refused : dict of str to int
        No assignment, by the reason given.
    """

    n: int
    right: int
    left_out: int
    wrong: int
    ambiguous: int
    refused: dict[str, int]

    def __add__(self, other: "IdentityCount") -> "IdentityCount":
        return IdentityCount(
            self.n + other.n,
            self.right + other.right,
            self.left_out + other.left_out,
            self.wrong + other.wrong,
            self.ambiguous + other.ambiguous,
            dict(Counter(self.refused) + Counter(other.refused)),
        )

    def __str__(self) -> str:
        parts = [
            f"{self.right} right",
            f"{self.left_out} right but for an LED left out",
            f"{self.wrong} wrong",
        ]
        parts.append(f"{self.ambiguous} reported ambiguous")
        parts += [f"{n} without an answer ({why})" for why, n in sorted(self.refused.items())]
        return ", ".join(parts)


@dataclass(frozen=True, slots=True, eq=False)
class PointsEvaluation:
    """Scores of the sweeps, and how random orientations within 45 degrees were identified."""

    scores: list[SweepScore]
    identity: IdentityCount


def evaluate_points(
    brick: BrickModel,
    *,
    noise_px: float,
    seed: int,
    n_orientations: int = 100,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> PointsEvaluation:
    """Run the paper's sweeps with noisy points, through a calibration from noisy dots.

    Parameters
    ----------
    brick : BrickModel
        Its LEDs count as points.
    noise_px : float, px
        Standard deviation of each of u and v, of LEDs and dots alike.
    seed : int
        Of the lens and all noise.
    n_orientations : int
    progress : callable
        Called with the number of parts done and of all.
    """
    rng = np.random.default_rng([seed, 61])
    camera = TrueCamera.of_seed(seed)
    rays = camera.calibrated(noise_px=noise_px, rng=rng)
    sweeps = paper_sweeps(brick, plane_a_mm=PLANE_A_MM, plane_b_mm=PLANE_B_MM, half_field=camera.half_field)
    n_parts = len(sweeps) + n_orientations
    scores = []
    for sweep in sweeps:
        scores.append(score_points(sweep, brick, camera, rays, noise_px=noise_px, rng=rng))
        progress(len(scores), n_parts)
    turned = random_orientations(brick, n_orientations, plane_a_mm=PLANE_A_MM, plane_b_mm=PLANE_B_MM, rng=rng)
    uv = seen_points(turned, brick, camera, noise_px=noise_px, rng=rng)
    shuffled = [_shuffled(uv[i], turned, i, brick, camera, noise_px, rng) for i in range(n_orientations)]
    found = search_correspondences([blobs for _, blobs in shuffled], rays, brick, collar_mm=None)
    progress(n_parts, n_parts)
    return PointsEvaluation(scores, _count([truth for truth, _ in shuffled], found))


def _count(truths: list[IntArray], found: list[Correspondence]) -> IdentityCount:
    right = left_out = wrong = ambiguous = 0
    refused: Counter[str] = Counter()
    for truth, answer in zip(truths, found, strict=True):
        said = answer.blob_of_led
        if answer.is_ambiguous:
            ambiguous += 1
        elif answer.n_found == 0:
            refused[answer.reason] += 1
        elif ((said >= 0) & (said != truth)).any():
            wrong += 1
        elif (said == truth).all():
            right += 1
        else:
            left_out += 1
    return IdentityCount(len(truths), right, left_out, wrong, ambiguous, dict(refused))


def score_points(
    sweep: Sweep,
    brick: BrickModel,
    camera: TrueCamera,
    rays: RayModel,
    *,
    noise_px: float,
    rng: np.random.Generator,
) -> SweepScore:
    """Return the errors of the product's poses along a sweep of points, with the bound."""
    uv = seen_points(sweep, brick, camera, noise_px=noise_px, rng=rng)
    seen = np.isfinite(uv[..., 0])
    track = solve_poses(_observations(uv, noise_px), rays, points_of(brick), rolling_shutter=False)
    bound = cramer_rao_covariance(
        camera.project,
        sweep.R_camera_brick,
        sweep.t_camera_brick_mm,
        brick.led_positions_mm,
        seen,
        noise_px=noise_px,
    )
    return score_sweep(
        sweep, track.R_camera_brick, track.t_camera_brick_mm, bound, covariance=track.covariance
    )


def points_of(brick: BrickModel) -> BrickModel:
    """Return a brick whose LEDs are points: a tenth of a micrometre, of a shape beyond doubt."""
    profile = ProfileEntry(collar_mm=0.0, source="simulated: the LEDs are points")
    return replace(brick, led_radii_mm=np.full(brick.n_leds, 1e-4), led_profile=profile)


def seen_points(
    sweep: Sweep, brick: BrickModel, camera: TrueCamera, *, noise_px: float, rng: np.random.Generator
) -> FloatArray:
    """Return noisy pixels, shape (n, n_leds, 2); NaN for LEDs outside the picture or seen from behind."""
    centres = np.einsum("nij,lj->nli", sweep.R_camera_brick, brick.led_positions_mm)
    centres += sweep.t_camera_brick_mm[:, None]
    axes = np.einsum("nij,lj->nli", sweep.R_camera_brick, brick.led_axes)
    facing = -(axes * centres).sum(axis=-1) / np.linalg.norm(centres, axis=-1)
    uv = camera.project(centres)
    hidden = (facing < _MIN_FACING) | ~camera.sees(uv)
    uv = uv + rng.normal(0, noise_px, uv.shape)
    uv[hidden] = np.nan
    return uv


def _observations(uv: FloatArray, noise_px: float) -> LedObservations:
    n, n_leds = uv.shape[:2]
    seen = np.isfinite(uv[..., 0])
    return LedObservations(
        sensor_timestamp_ns=np.arange(n, dtype=np.int64) * _SECOND_NS,
        exposure_ns=np.full(n, 1_000_000, dtype=np.int64),
        uv_px=uv,
        cov_px2=np.tile(noise_px**2 * np.eye(2), (n, n_leds, 1, 1)),
        area_px2=np.full((n, n_leds), np.nan),
        led_flags=np.where(seen, int(LedFlag.NONE), int(LedFlag.MISSING)).astype(np.int64),
        frame_flags=np.zeros(n, dtype=np.int64),
    )


def _shuffled(
    uv: FloatArray,
    sweep: Sweep,
    i: int,
    brick: BrickModel,
    camera: TrueCamera,
    noise_px: float,
    rng: np.random.Generator,
) -> tuple[IntArray, Blobs]:
    """Return one frame's LEDs as lights in no order, and which light is which LED; -1 where hidden."""
    leds = rng.permutation(np.flatnonzero(np.isfinite(uv[:, 0])))
    truth = np.full(brick.n_leds, -1, dtype=np.int64)
    truth[leds] = np.arange(len(leds))
    z_mm = (brick.led_positions_mm @ sweep.R_camera_brick[i].T + sweep.t_camera_brick_mm[i])[leds, 2]
    n = len(leds)
    # A dome shows from its disc to a half of it: the size says the distance no better than that.
    area = np.pi * (brick.led_radii_mm[leds] * camera.focal_px / z_mm) ** 2 * rng.uniform(0.6, 1.0, n)
    blobs = Blobs(
        uv_px=uv[leds],
        cov_px2=np.tile(noise_px**2 * np.eye(2), (n, 1, 1)),
        area_px2=area,
        eccentricity=np.zeros(n),
        fill=np.ones(n),
        flags=np.zeros(n, dtype=np.int64),
    )
    return truth, blobs
