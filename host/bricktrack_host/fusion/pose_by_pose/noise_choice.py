"""How far frames and inertial samples are to be believed, found from how well they agree."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fusion_problem import (
    Nodes,
    Run,
    build_problem,
    first_linearisation,
    place_nodes,
)
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel, NoiseParts
from bricktrack_host.fusion.smoothing.linearisation import Linearisation
from bricktrack_host.fusion.smoothing.sensor_errors import estimate_sensor_errors
from bricktrack_host.fusion.smoothing.smoother import (
    LAG,
    LOSS,
    Estimate,
    Filter,
    Problem,
    residuals,
    score_noise,
)

_LEVEL_STEP = 2.5  # between the noise levels that a run may choose from
_LEAST_SYSTEMATIC, _MOST_SYSTEMATIC = -6, 2  # steps: from a 250th of what is stated to six times that
_LEAST_ROUGH = -8  # of a vibration at one pitch next to nothing is left once it is integrated
_EARN_PER_STEP = 2.0  # log-likelihood that a step away from the stated level must earn
_MAX_SCALE_ROUNDS = 4
_SCALE_STANDS = 1.25
_LEAST_SCALE = 0.3  # what frames have in common stays hidden; this much of their sd is left
_CLEARLY_LESS = 0.7
_TURN_AND_SHIFT = slice(0, 3), slice(3, 6)
_CHI_3_MEDIAN = 1.538  # median of the root of chi-square with 3 degrees of freedom


def _with_sensors(lin: Linearisation, x: FloatArray) -> Linearisation:
    """Return a linearisation with the lag and the loss of the accelerometer from a state."""
    return replace(lin, lag_s=float(x[LAG]), loss_s2=max(float(x[LOSS]), 0.0))


def frame_chi2(
    problem: Problem, passed: Filter, estimate: Estimate, b: int, nodes: Nodes, used: BoolArray
) -> FloatArray:
    """Return how far each frame of run ``b`` lies from what all the others say, 6 degrees of freedom.

    The smoothed state holds the frame itself. Taken out of it again: with A = H P H', r the residual and R
    the covariance that the filter gave the frame, the others alone leave R (R - A)^-1 r, and know the frame
    to A + A (R - A)^-1 A. Both are taken along the axes in which R is one and A diagonal. Where A says more
    than R, the state was linearised too far off to take the frame out: there it is judged as it is. Where
    rounding left no A (NaN), a frame is judged by its own covariance alone.
    """
    return _off_the_others(problem, passed, estimate, b, nodes, used).chi2_of_all()


class _Off(NamedTuple):
    """How far frames lie from what all the others say: along axes of their own, each with its variance.

    ``axes``, shape (n_frames, 6, 6): in columns; ``along`` and ``variance``, shape (n_frames, 6).
    """

    axes: FloatArray
    along: FloatArray
    variance: FloatArray

    def chi2_of_all(self) -> FloatArray:
        """Return how far by all six components, shape (n_frames,)."""
        return np.asarray((self.along**2 / self.variance).sum(axis=1))

    def chi2(self, part: slice) -> FloatArray:
        """Return how far by some of the six components alone, shape (n_frames,)."""
        axes = self.axes[:, part]
        r = (axes @ self.along[..., None])[..., 0]
        S = (axes * self.variance[:, None]) @ np.swapaxes(axes, -1, -2)
        return np.asarray((r * np.linalg.solve(S, r[..., None])[..., 0]).sum(axis=1))


def _off_the_others(
    problem: Problem, passed: Filter, estimate: Estimate, b: int, nodes: Nodes, used: BoolArray
) -> _Off:
    """Return how far the frames of run ``b`` lie from what all the others say, see `frame_chi2`."""
    at = nodes.node_of_frame
    r, H = residuals(problem, estimate.state, at, b)
    H = H[..., estimate.of]
    inflation = passed.inflation[at, b][:, None]
    root = np.linalg.cholesky(problem.cov_seen[at, b] * inflation[..., None])
    whiten = np.linalg.inv(root)
    H = whiten @ H
    A = H @ estimate.covariance[at, b] @ np.swapaxes(H, -1, -2)
    A[~np.isfinite(A).all(axis=(1, 2))] = 0.0
    share, V = np.linalg.eigh(0.5 * (A + np.swapaxes(A, -1, -2)))
    # A frame that alone fixes the state leaves no residual, and R - A near zero: judge it by a share of R.
    rest = np.where(used[:, None] & (share <= 1), 1.02 - share, 1.0)
    known = np.where(used[:, None], np.where(share <= 1, share + share**2 / rest, 0.0), share)
    along = (np.swapaxes(V, -1, -2) @ (whiten @ r[..., None]))[..., 0] / rest
    return _Off(root @ V, along, 1 / inflation + known)


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """What the first pass over a batch found; lists hold one entry for each run.

    Attributes
    ----------
    runs, lins, nodes : list of Run, Linearisation, Nodes
        With the sensors as they turned out.
    estimate : Estimate
    scales : list of ndarray, shape (2,)
        Of the optical sd, rotation and position: above 1 where frames agree less with each other than they
        promise, below where more.
    levels : list of (NoiseLevel, NoiseLevel)
    chi2 : list of ndarray, shape (n_frames,)
        Of each frame by all others, by the sd as scaled, but never less than stated.
    """

    runs: list[Run]
    lins: list[Linearisation]
    nodes: list[Nodes]
    estimate: Estimate
    scales: list[FloatArray]
    levels: list[tuple[NoiseLevel, NoiseLevel]]
    chi2: list[FloatArray]


def settle_noise(
    runs: list[Run],
    lins: list[Linearisation],
    nodes: list[Nodes],
    used: list[BoolArray],
    settings: FusionSettings,
    *,
    levels: list[tuple[NoiseLevel, NoiseLevel]] | None = None,
) -> Settled:
    """Return a first pass with the noise of frames and samples, and the sensors' lags, as the run tells them.

    Optical noise understated by much lets the smoother follow the frames and hides itself, so the scale is
    taken again until it stands; when it does at once, as it should, this is one pass.

    ``levels``: of gyro and accelerometer, by which their standing errors are sought; if not given, as stated.
    """
    stated = NoiseLevel(settings.roughness_share, 1.0)
    levels = levels or [(stated, stated) for _ in runs]
    scales = [np.ones(2) for _ in runs]
    as_given, found_by = runs, levels
    runs = _with_known_sensors(runs, lins, nodes, used, levels, settings)
    for _ in range(_MAX_SCALE_ROUNDS):
        problem, parts = build_problem(
            runs, nodes, lins, settings=settings, use_frame=used, noise_scale=scales, levels=levels
        )
        if settings.adapt_noise:
            levels, last = _choose_noise(problem, parts, settings)
            # What stands still is known by now: the accelerometer is taken as it is from here on.
            lins = [_with_sensors(lin, x) for lin, x in zip(lins, last, strict=True)]
            if levels != found_by:
                # By samples believed to vibrate as much as they are rough, hardly an error is found.
                runs = [run.with_acc_loss(lin.loss_s2) for run, lin in zip(as_given, lins, strict=True)]
                runs, found_by = _with_known_sensors(runs, lins, nodes, used, levels, settings), levels
            runs = [run.with_acc_loss(lin.loss_s2) for run, lin in zip(runs, lins, strict=True)]
            problem, _ = build_problem(
                runs, nodes, lins, settings=settings, use_frame=used, noise_scale=scales, levels=levels
            )
        passed = Filter(problem)
        estimate = passed.smooth()
        offs = [_off_the_others(problem, passed, estimate, b, nodes[b], used[b]) for b in range(len(runs))]
        more = [np.sqrt([np.median(off.chi2(p)) for p in _TURN_AND_SHIFT]) / _CHI_3_MEDIAN for off in offs]
        done = max(float(m.max()) for m in more) < _SCALE_STANDS
        # By the scales that have just been refined, not those the pass was made with.
        both = [off.chi2_of_all() / max(float(m.max()), 1.0) ** 2 for off, m in zip(offs, more, strict=True)]
        scales = [_settled_scale(scale * m, done) for scale, m in zip(scales, more, strict=True)]
        if done:
            break
    return Settled(runs, lins, nodes, estimate, scales, levels, both)


def _with_known_sensors(
    runs: list[Run],
    lins: list[Linearisation],
    nodes: list[Nodes],
    used: list[BoolArray],
    levels: list[tuple[NoiseLevel, NoiseLevel]],
    settings: FusionSettings,
) -> list[Run]:
    """Return runs without the errors of their sensors that stand still, as a first pass finds them."""
    if not (settings.sensor_gain_sd or settings.lever_arm_sd_mm):
        return runs
    problem, _ = build_problem(
        runs, nodes, lins, settings=settings, use_frame=used,
        noise_scale=[np.ones(2) for _ in runs], levels=levels,
    )  # fmt: skip
    passed = Filter(problem)
    known = []
    for b, run in enumerate(runs):
        errors = estimate_sensor_errors(
            problem, passed, b, settings, R_still_camera=nodes[b].camera_attitudes(run)
        )
        known.append(run if errors is None else run.with_sensor(errors))
    return known


def _settled_scale(scale: FloatArray, done: bool) -> FloatArray:
    """Return scales of the optical sd: below 1 only in the end, and only where that is beyond doubt."""
    less = np.maximum(scale, _LEAST_SCALE)
    return np.where(done & (scale < _CLEARLY_LESS), less, np.maximum(scale, 1.0))


class _Steps(NamedTuple):
    """How many steps the noise of a run lies away from what is stated."""

    acc_rough: int = 0
    gyro_rough: int = 0
    acc_systematic: int = 0
    gyro_systematic: int = 0

    def moved(self, way: "_Steps", sign: int) -> "_Steps":
        """Return those one step farther along a way."""
        return _Steps(*(n + sign * step for n, step in zip(self, way, strict=True)))

    def is_allowed(self) -> bool:
        """Return whether roughness and systematic errors lie within what is ever believed."""
        return all(_LEAST_ROUGH <= n <= 0 for n in self[:2]) and all(
            _LEAST_SYSTEMATIC <= n <= _MOST_SYSTEMATIC for n in self[2:]
        )

    def price(self) -> float:
        """Return the log-likelihood to be earned."""
        return _EARN_PER_STEP * sum(abs(n) for n in self)

    def levels(self, settings: FusionSettings) -> tuple[NoiseLevel, NoiseLevel]:
        """Return the levels of gyro and accelerometer."""
        share = settings.roughness_share
        return (
            NoiseLevel(share * _LEVEL_STEP**self.gyro_rough, _LEVEL_STEP**self.gyro_systematic),
            NoiseLevel(share * _LEVEL_STEP**self.acc_rough, _LEVEL_STEP**self.acc_systematic),
        )


_NOT_ALLOWED = _Steps(acc_rough=1)
_WAYS = (
    _Steps(acc_systematic=1),
    _Steps(gyro_systematic=1),
    _Steps(acc_rough=1),
    _Steps(gyro_rough=1),
)


def _choose_noise(
    problem: Problem, parts: list[NoiseParts], settings: FusionSettings
) -> tuple[list[tuple[NoiseLevel, NoiseLevel]], list[FloatArray]]:
    """Return the noise levels of gyro and accelerometer under which each run's frames are likeliest.

    And the last state of the filter that has them, shape (22,).

    The roughness of a sensor may count for less than stated, its systematic errors for more or less. One way
    after the other is walked step by step, down and else up, as long as each step earns its price. Each
    sensor goes for itself: what the frames say of the accelerometer is no word on a gyro.
    """
    chosen = [_Steps()] * len(parts)
    best, last = _earned(problem, parts, chosen, settings)
    for way in _WAYS:
        before = chosen.copy()
        for sign in (-1, 1):
            tried = [
                now.moved(way, sign) if now == then else _NOT_ALLOWED
                for now, then in zip(chosen, before, strict=True)
            ]
            while any(steps.is_allowed() for steps in tried):
                earned, ends = _earned(problem, parts, tried, settings)
                for b, steps in enumerate(tried):
                    if steps.is_allowed() and earned[b] > best[b]:
                        chosen[b], best[b], last[b] = steps, earned[b], ends[b]
                        tried[b] = steps.moved(way, sign)
                    else:
                        tried[b] = _NOT_ALLOWED
    return [steps.levels(settings) for steps in chosen], last


def _earned(
    problem: Problem, parts: list[NoiseParts], steps: list[_Steps], settings: FusionSettings
) -> tuple[list[float], list[FloatArray]]:
    """Return what one choice for each run earns beyond its price, and the filter's last states."""
    gyro, acc = np.zeros((2, len(parts), 1, len(problem.dt_s)))
    for b, (part, of_run) in enumerate(zip(parts, steps, strict=True)):
        of_gyro, of_acc = (of_run if of_run.is_allowed() else _Steps()).levels(settings)
        gyro[b, 0, : len(part.gyro_fixed)] = part.gyro(of_gyro)
        acc[b, 0, : len(part.acc_fixed)] = part.acc(of_acc)
    log_likelihood, ends = score_noise(problem, gyro, acc)
    return [float(v) - s.price() for v, s in zip(log_likelihood[:, 0], steps, strict=True)], list(ends[:, 0])


def frames_log_likelihood(run: Run, settings: FusionSettings) -> float:
    """Return how likely the frames of a run are under the filter, with the noise that is stated."""
    lin = first_linearisation(run, settings)
    nodes = place_nodes(run, lin)
    level = NoiseLevel(settings.roughness_share, 1.0)
    problem, parts = build_problem(
        [run], [nodes], [lin], settings=settings, use_frame=[np.ones(len(run.t_cam_s), dtype=np.bool_)],
        noise_scale=[np.ones(2)], levels=[(level, level)],
    )  # fmt: skip
    gyro, acc = parts[0].gyro(level), parts[0].acc(level)
    return float(score_noise(problem, gyro[None, None], acc[None, None])[0][0, 0])
