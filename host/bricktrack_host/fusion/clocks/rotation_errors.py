"""Errors that hold over a run, of the frames' times and of their attitudes, against the integrated gyro.

Linear, from where the clocks were aligned: beside a slow drift, and beside scales and axes of the gyro, which
are free within what sensors have.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.fusion.clocks.posed_frames import MIN_POSES, FramesBesideGyro, PosedFrames, hats
from bricktrack_host.fusion.clocks.rotation_fit import DISPERSION_PRIOR_SD_S3, LOSS_PRIOR_SD_S2
from bricktrack_host.fusion.clocks.rotation_fit_kernel import drift_of
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal

_GYRO_AXES_SD = 0.02  # of scales, and of axes in rad: consumer sensors, and a layout measured by hand
_ROBUST_ROUNDS = 4
_BESIDE_STEP = 4  # frames on either side that a step needs
_STEP_TIME_SD_S = 0.02
_OFF_SHARE = 0.1
"""Of a period, that samples may be off by which were taken as they were read: few are, by a whole one."""
_STEPS_AT_ONCE = 256
_STEP_KNOTS = 20  # of the drift, 10 s: of what a step does beyond them 1e-11 is left


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeStep:
    """A step of optical attitudes against the gyro, from one frame on.

    Attributes
    ----------
    frame : int
        The first after it, from 0.
    rvec_rad : ndarray, shape (3,)
        In the axes that attitudes are compared in.
    covariance : ndarray, shape (3, 3), rad^2
    gain : float
        By so much chi-square (3 degrees of freedom) is less with it; less than that where samples that were
        not read may have made it.
    """

    frame: int
    rvec_rad: FloatArray
    covariance: FloatArray
    gain: float


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """A robust fit: what was found, its covariance, frames' weights, scale, and columns less their drift."""

    found: FloatArray
    covariance: FloatArray
    weight: FloatArray
    scale: float
    white: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _LinearFit:
    """Errors of attitudes, (n, 3), as a sum of columns, (n, 3, c), of prior sd (c,), beside a slow drift.

    ``turn_sd_rad``, (n,): how unsure it is what the gyro turned since the frame before, beside its drift.
    """

    inside: BoolArray
    columns: FloatArray
    sd: FloatArray
    error: FloatArray
    inverse_sd: FloatArray
    hats: tuple[IntArray, FloatArray, int]
    turn_sd_rad: FloatArray

    def drift(self, weight: FloatArray, values: FloatArray) -> FloatArray:
        """Return the slow drift in values, (n, c)."""
        return np.asarray(drift_of(weight, *self.hats, np.ascontiguousarray(values)))

    def near(self, frames: IntArray) -> tuple[slice, tuple[IntArray, FloatArray, int]]:
        """Return the rows that a step at one of some frames, rising, moves against the drift; their hats."""
        knot, share, _ = self.hats
        ends = knot[frames[[0, -1]]] + np.array([-_STEP_KNOTS, _STEP_KNOTS + 1])
        rows = slice(*np.searchsorted(knot, ends).tolist())
        near = knot[rows] - knot[rows.start]
        return rows, (near, share[rows], int(near[-1]) + 2)

    def fit(self) -> _Fitted:
        """Return the fit by weights that outliers lose."""
        columns = np.concatenate([self.columns, self.error[:, :, None]], axis=2)
        flat = columns.reshape(len(columns), -1)
        scale, weight = 1.0, self.inverse_sd
        for _ in range(_ROBUST_ROUNDS):
            white = (flat - self.drift(weight, flat)).reshape(columns.shape)
            A = (white * weight[:, None, None]).reshape(-1, columns.shape[2])
            information = A[:, :-1].T @ A[:, :-1] / scale**2 + np.diag(self.sd**-2.0)
            found = np.linalg.solve(information, A[:, :-1].T @ A[:, -1] / scale**2)
            left = np.linalg.norm(white[:, :, -1] - white[:, :, :-1] @ found, axis=1) / np.sqrt(3)
            # The median of sqrt(chi-square of 3 / 3) is 0.888.
            scale = max(float(np.median(left * self.inverse_sd)) / 0.888, 1e-6)
            weight = self.inverse_sd * (1 + (left * self.inverse_sd / (2.5 * scale)) ** 2) ** -0.25
        covariance = np.asarray(np.linalg.inv(information))
        return _Fitted(np.asarray(found), covariance, weight, scale, white)

    def unfelt(self, rows: slice) -> IntArray:
        """Return the frames among some rows before which the gyro's turn is unsure; not the first row."""
        return np.asarray(rows.start + 1 + np.flatnonzero(self.turn_sd_rad[rows][1:]))

    def steps(
        self, fitted: _Fitted, frames: IntArray, rows: slice, hats: tuple[IntArray, FloatArray, int]
    ) -> FloatArray:
        """Return steps at frames, less their drift and over the rows' sd, shape (n_rows, n_steps)."""
        since = np.greater_equal.outer(np.arange(rows.start, rows.stop), frames).astype(np.float64)
        weight = fitted.weight[rows] / fitted.scale
        return np.asarray((since - drift_of(fitted.weight[rows], *hats, since)) * weight[:, None])

    def covariance_by_turns(self, fitted: _Fitted) -> FloatArray:
        """Return what turns that the gyro did not feel add to the covariance of what was found."""
        frames = self.unfelt(slice(0, len(self.error)))
        weight = fitted.weight / fitted.scale
        out = np.zeros(fitted.covariance.shape)
        for first in range(0, len(frames), _STEPS_AT_ONCE):
            some = frames[first : first + _STEPS_AT_ONCE]
            rows, near = self.near(some)
            A = fitted.white[rows, :, :-1] * weight[rows, None, None]
            pull = np.einsum("nk,nip->kip", self.steps(fitted, some, rows, near), A, optimize=True)
            pull *= self.turn_sd_rad[some][:, None, None]
            off = pull.reshape(-1, len(out)) @ fitted.covariance
            out += off.T @ off
        return out


@dataclass(frozen=True, slots=True, eq=False)
class _AgainstGyro:
    """What frames are turned against the gyro, and what explains it; n frames with gyro beside them.

    Attributes
    ----------
    inside : ndarray of bool, shape (n_frames,)
        Which frames those are.
    error : ndarray, shape (n, 3)
    by_time : ndarray, shape (n, 3, 1)
        Its derivative by the frame's time.
    by_gyro : ndarray, shape (n, 3, 11)
        By the low-pass's c and d, and by scales and axes, row by row.
    inverse_sd : ndarray, shape (n,)
    hats
        Of the drift, see `hats`.
    turn_sd_rad : ndarray, shape (n,)
        How unsure it is, by samples that were not read, what the gyro turned since the frame before.
    """

    inside: BoolArray
    error: FloatArray
    by_time: FloatArray
    by_gyro: FloatArray
    inverse_sd: FloatArray
    hats: tuple[IntArray, FloatArray, int]
    turn_sd_rad: FloatArray


class RotationErrors:
    """Errors of frames against the gyro, beside scales and axes of the gyro and a slow drift.

    Parameters
    ----------
    frames : PosedFrames
        By IMU time as far as the clocks are aligned.
    signal : ImuSignal
    gyro_bias_radps : ndarray, shape (3,)
    unsure_s : ndarray, shape (m,), s
        Rising, after the signal's epoch: near these the samples may be those of a period earlier or later.
    """

    def __init__(
        self, frames: PosedFrames, signal: ImuSignal, gyro_bias_radps: FloatArray, unsure_s: FloatArray
    ) -> None:
        self.frames = frames
        self._signal, self._bias, self._unsure_s = signal, gyro_bias_radps, unsure_s

    @property
    def epoch_ns(self) -> int:
        """Zero of the frames' seconds, on the samples' clock."""
        return self._signal.epoch_ns

    def some(self, frames: BoolArray) -> "RotationErrors":
        """Return those of some frames alone; itself for all."""
        if frames.all():
            return self
        return RotationErrors(self.frames.some(frames), self._signal, self._bias, self._unsure_s)

    def time_errors(self, basis: FloatArray, prior_sd_s: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return errors of the frames' times as a sum of functions, and their covariance; linear, from zero.

        None where too few frames have gyro beside them.

        Parameters
        ----------
        basis : ndarray, shape (n_frames, c)
            Functions of the frames' times, to be added to them.
        prior_sd_s : ndarray, shape (c,), s
        """
        linear = self._linear(basis, prior_sd_s)
        if linear is None:
            return None
        n, fit = basis.shape[1], linear.fit()
        covariance = fit.covariance + linear.covariance_by_turns(fit)
        return fit.found[:n], covariance[:n, :n]

    def attitude_step(self) -> AttitudeStep | None:
        """Return the step of the attitudes against the gyro that explains most; None as in `time_errors`.

        One offset of the clocks, and scales and axes of the gyro, are free beside it.
        """
        linear = self._linear(np.ones((len(self.frames.t_s), 1)), np.array([_STEP_TIME_SD_S]))
        if linear is None:
            return None
        fit, n = linear.fit(), len(linear.error)
        weight = fit.weight / fit.scale
        A = fit.white[:, :, :-1] * weight[:, None, None]
        left = fit.white[:, :, -1] * weight[:, None] - A @ fit.found
        stop, found = n - _BESIDE_STEP + 1, []
        for first in range(_BESIDE_STEP, stop, _STEPS_AT_ONCE):
            steps = np.arange(first, min(first + _STEPS_AT_ONCE, stop))
            rows, hats = linear.near(steps)
            white = linear.steps(fit, steps, rows, hats)
            beside = np.einsum("nk,nip->kip", white, A[rows], optimize=True)
            # The least is for steps that the drift takes up, as it does between stretches with samples.
            normal = (np.einsum("nk,nk->k", white, white)[:, None, None] + 1e-9) * np.eye(3)
            normal -= beside @ fit.covariance @ np.swapaxes(beside, 1, 2)
            pull = white.T @ left[rows]
            size = np.linalg.solve(normal, pull[..., None])[..., 0]
            # What the gyro did not feel pulls at steps nearby, too.
            unfelt = linear.unfelt(rows)
            others = linear.steps(fit, unfelt, rows, hats) * linear.turn_sd_rad[unfelt]
            beside_others = np.einsum("nk,nip->kip", others, A[rows], optimize=True)
            by_others = (white.T @ others)[:, :, None, None] * np.eye(3) - np.einsum(
                "kip,pq,gjq->kgij", beside, fit.covariance, beside_others, optimize=True
            )
            pull_covariance = normal + np.einsum("kgij,kglj->kil", by_others, by_others, optimize=True)
            gain = np.einsum("ki,ki->k", pull, np.linalg.solve(pull_covariance, pull[..., None])[..., 0])
            best = int(np.argmax(gain))
            frame = int(np.flatnonzero(linear.inside)[steps[best]])
            inverse = np.linalg.inv(normal[best])
            covariance = inverse @ pull_covariance[best] @ inverse
            found.append(AttitudeStep(frame, size[best], covariance, float(gain[best])))
        return max(found, key=lambda step: step.gain)

    @cached_property
    def _against_gyro(self) -> _AgainstGyro | None:
        """Return what all fits begin with; None where too few frames have gyro beside them."""
        beside = FramesBesideGyro(self.frames, self._signal)
        inside, segment = beside.covered(0.0)
        if inside.sum() < MIN_POSES:
            return None
        t = self.frames.t_s[inside]
        attitude, error, design = beside.compared(
            inside, t, np.zeros_like(t), beside.integrated(self._bias), self._bias
        )
        turned = np.diff(self._signal.angle_at(t), axis=0) - np.diff(t)[:, None] * self._bias
        by_axes = 0.5 * (attitude[1:] + attitude[:-1])[:, :, :, None] * turned[:, None, None, :]
        by_axes = np.concatenate([np.zeros((1, 3, 9)), np.cumsum(by_axes.reshape(-1, 3, 9), axis=0)])
        return _AgainstGyro(
            inside=inside,
            error=error,
            by_time=design[:, :, :1],
            by_gyro=np.concatenate([design[:, :, 2:], by_axes], axis=2),
            inverse_sd=1 / self.frames.sd_rad[inside],
            hats=hats(t, segment[inside]),
            turn_sd_rad=_turn_sd(self._signal, t, self._unsure_s),
        )

    def _linear(self, basis: FloatArray, prior_sd_s: FloatArray) -> _LinearFit | None:
        """Return the fit of functions of time, shape (n_frames, c), of prior sd (c,)."""
        known = self._against_gyro
        if known is None:
            return None
        by_time = basis[known.inside][:, None, :] * known.by_time
        return _LinearFit(
            inside=known.inside,
            columns=np.concatenate([by_time, known.by_gyro], axis=2),
            sd=np.concatenate(
                [prior_sd_s, [LOSS_PRIOR_SD_S2, DISPERSION_PRIOR_SD_S3], np.full(9, _GYRO_AXES_SD)]
            ),
            error=known.error,
            inverse_sd=known.inverse_sd,
            hats=known.hats,
            turn_sd_rad=known.turn_sd_rad,
        )


def _turn_sd(signal: ImuSignal, t_s: FloatArray, unsure_s: FloatArray) -> FloatArray:
    """Return how unsure it is what the gyro turned since the instant before, rad.

    That is the error of the cubic across an interval without samples, in which it is of one sign, times its
    length; and what the rate changed, times a part of a period, where samples may be a whole one off.
    Instants rise, shape (n,), as what is returned is.
    """
    variance = np.zeros(len(t_s))
    start = np.searchsorted(signal.t_s, signal.gaps_s[:, 0])
    bridge = np.maximum(signal.gyro_bridge_radps[start], signal.gyro_bridge_radps[start + 1])
    after = np.searchsorted(t_s, signal.gaps_s.mean(axis=1))
    inside = (after > 0) & (after < len(t_s))
    turn = bridge * np.diff(signal.gaps_s, axis=1)[:, 0]
    np.add.at(variance, after[inside], turn[inside] ** 2)
    is_unsure = np.diff(np.searchsorted(unsure_s, t_s)) > 0
    changed = np.linalg.norm(np.diff(signal.gyro_at(t_s), axis=0), axis=1) * signal.period_s
    variance[1:] += np.where(is_unsure, (_OFF_SHARE * changed) ** 2, 0.0)
    return np.sqrt(variance)
