"""How far frames and inertial samples are to be believed, found from how well they agree."""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.fusion.fusion_problem import (
    Linearisation,
    Nodes,
    NoiseLevel,
    NoiseParts,
    Run,
    build_problem,
    first_linearisation,
    place_nodes,
)
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.sensor_errors import estimate_sensor_errors
from bricktrack_host.fusion.smoother import LAG, LOSS, Estimate, Filter, Problem, residuals, score_noise

_LEVEL_STEP = 2.5  # between the noise levels that a run may choose from
_LEAST_SYSTEMATIC, _MOST_SYSTEMATIC = -4, 2  # steps: from a fortieth of what is stated to six times that
_EARN_PER_STEP = 2.0  # log-likelihood that a step away from the stated level must earn
_MAX_SCALE_ROUNDS = 4
_SCALE_STANDS = 1.25
_LEAST_SCALE = 0.3  # what frames have in common stays hidden; this much of their sd is left
_CLEARLY_LESS = 0.7
_CHI_3_MEDIAN = 1.538  # median of the root of chi-square with 3 degrees of freedom


def _with_sensors(lin: Linearisation, x: FloatArray) -> Linearisation:
    """Return a linearisation with the lag and the loss of the accelerometer from a state."""
    return replace(lin, lag_s=float(x[LAG]), loss_s2=max(float(x[LOSS]), 0.0))


def frame_chi2(
    problem: Problem, passed: Filter, estimate: Estimate, b: int, nodes: Nodes, used: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how far each frame lies from what all the others say: rotation and position (3), and both (6).

    The smoothed state holds the frame itself. Taken out of it again: with A = H P H', r the residual and R
    the covariance that the filter gave the frame, the others alone leave R (R - A)^-1 r, and know the frame
    to A + A (R - A)^-1 A. Both are taken along the axes in which R is one and A diagonal. Where A says more
    than R, the state was linearised too far off to take the frame out: there it is judged as it is.
    """
    at = nodes.node_of_frame
    r, H = residuals(problem, estimate.state, at, b)
    H = H[..., estimate.of]
    A = H @ estimate.covariance[at, b] @ np.swapaxes(H, -1, -2)
    stated = problem.cov_seen[at, b]
    inflation = passed.inflation[at, b][:, None]
    root = np.linalg.cholesky(stated * inflation[..., None])
    white = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, A), -1, -2))
    share, V = np.linalg.eigh(0.5 * (white + np.swapaxes(white, -1, -2)))
    # A frame that alone fixes the state leaves no residual, and R - A near zero: judge it by a share of R.
    rest = np.where(used[:, None] & (share <= 1), 1.02 - share, 1.0)
    known = np.where(used[:, None], np.where(share <= 1, share + share**2 / rest, 0.0), share)
    axes = root @ V
    along = np.linalg.solve(axes, r[..., None])[..., 0] / rest
    r = (axes @ along[..., None])[..., 0]
    S = axes * (1 / inflation + known)[:, None, :] @ np.swapaxes(axes, -1, -2)

    def chi2(part: slice) -> FloatArray:
        e = r[:, part]
        return np.asarray((e * np.linalg.solve(S[:, part, part], e[..., None])[..., 0]).sum(axis=1))

    return chi2(slice(0, 3)), chi2(slice(3, 6)), chi2(slice(0, 6))


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
) -> Settled:
    """Return a first pass with the noise of frames and samples, and the sensors' lags, as the run tells them.

    Optical noise understated by much lets the smoother follow the frames and hides itself, so the scale is
    taken again until it stands; when it does at once, as it should, this is one pass.
    """
    stated = NoiseLevel(settings.roughness_share, 1.0)
    levels = [(stated, stated) for _ in runs]
    scales = [np.ones(2) for _ in runs]
    runs, lins = _with_known_sensors(runs, lins, nodes, used, levels, settings)
    for _ in range(_MAX_SCALE_ROUNDS):
        problem, parts = build_problem(
            runs, nodes, lins, settings=settings, use_frame=used, noise_scale=scales, levels=levels
        )
        if settings.adapt_noise:
            levels, last = _choose_noise(problem, parts, settings)
            # What stands still is known by now: the accelerometer is taken as it is from here on.
            lins = [_with_sensors(lin, x) for lin, x in zip(lins, last, strict=True)]
            runs = [run.with_acc_loss(lin.loss_s2) for run, lin in zip(runs, lins, strict=True)]
            problem, _ = build_problem(
                runs, nodes, lins, settings=settings, use_frame=used, noise_scale=scales, levels=levels
            )
        passed = Filter(problem)
        estimate = passed.smooth()
        chi2s = [frame_chi2(problem, passed, estimate, b, nodes[b], used[b]) for b in range(len(runs))]
        more = [np.sqrt([np.median(turn), np.median(shift)]) / _CHI_3_MEDIAN for turn, shift, _ in chi2s]
        done = max(float(m.max()) for m in more) < _SCALE_STANDS
        # By the scales that have just been refined, not those the pass was made with.
        both = [c[2] / max(float(m.max()), 1.0) ** 2 for c, m in zip(chi2s, more, strict=True)]
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
) -> tuple[list[Run], list[Linearisation]]:
    """Return runs without the errors of their sensors that stand still, as a first pass finds them."""
    problem, _ = build_problem(
        runs, nodes, lins, settings=settings, use_frame=used,
        noise_scale=[np.ones(2) for _ in runs], levels=levels,
    )  # fmt: skip
    passed = Filter(problem)
    known = []
    for b, run in enumerate(runs):
        errors = estimate_sensor_errors(problem, passed, b, settings)
        known.append(run if errors is None else run.with_sensor(errors))
    return known, lins


def _settled_scale(scale: FloatArray, done: bool) -> FloatArray:
    """Return scales of the optical sd: below 1 only in the end, and only where that is beyond doubt."""
    less = np.maximum(scale, _LEAST_SCALE)
    return np.where(done & (scale < _CLEARLY_LESS), less, np.maximum(scale, 1.0))


def _choose_noise(
    problem: Problem, parts: list[NoiseParts], settings: FusionSettings
) -> tuple[list[tuple[NoiseLevel, NoiseLevel]], list[FloatArray]]:
    """Return the noise levels of gyro and accelerometer under which each run's frames are likeliest.

    And the last state of the filter that has them, shape (22,).

    The roughness of the accelerometer may count for less than stated, the systematic errors of both sensors
    for more or less: first these, then that, then these once more. The stated level stands unless another
    earns its price.
    """
    stated = (0, 0, 0)  # steps of the accelerometer's roughness, of its systematic errors, of the gyro's
    chosen = [stated] * len(parts)
    scores: list[dict[tuple[int, int, int], float]] = [{} for _ in parts]
    last: list[dict[tuple[int, int, int], FloatArray]] = [{} for _ in parts]
    for moves in (
        [(0, n, n) for n in (0, -1, -2, -3, -4, 1, 2)],
        [(0, 0, n) for n in (-2, -1, 1, 2, 3)],
        [(-1, 0, 0), (-2, 0, 0), (-3, 0, 0), (-4, 0, 0)],
        [(0, n, 0) for n in (-2, -1, 1, 2)],
    ):
        tried = [[(i + di, j + dj, k + dk) for di, dj, dk in moves] for i, j, k in chosen]
        shape = (len(parts), len(moves), len(problem.dt_s))
        gyro, acc = np.zeros(shape), np.zeros(shape)
        for b, part in enumerate(parts):
            for n, step in enumerate(tried[b]):
                of_gyro, of_acc = _levels(step, settings)
                gyro[b, n, : len(part.gyro_fixed)] = part.gyro(of_gyro)
                acc[b, n, : len(part.acc_fixed)] = part.acc(of_acc)
        log_likelihood, ends = score_noise(problem, gyro, acc)
        for b, steps in enumerate(tried):
            for n, (i, j, k) in enumerate(steps):
                if all(_LEAST_SYSTEMATIC <= m <= _MOST_SYSTEMATIC for m in (j, k)):
                    price = abs(i) + max(abs(j), abs(k)) + abs(j - k)
                    scores[b][i, j, k] = float(log_likelihood[b, n]) - _EARN_PER_STEP * price
                    last[b][i, j, k] = ends[b, n]
        chosen = [max(score, key=score.__getitem__) for score in scores]
    return [_levels(step, settings) for step in chosen], [last[b][step] for b, step in enumerate(chosen)]


def _levels(step: tuple[int, int, int], settings: FusionSettings) -> tuple[NoiseLevel, NoiseLevel]:
    """Return the levels of gyro and accelerometer, so many steps of roughness and systematic errors away."""
    rough, of_acc, of_gyro = (_LEVEL_STEP**n for n in step)
    share = settings.roughness_share
    return NoiseLevel(share, of_gyro), NoiseLevel(share * rough, of_acc)


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
