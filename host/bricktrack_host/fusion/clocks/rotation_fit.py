"""Offset of two clocks from one rotation that both saw: correlation, then least squares.

The coarse offset comes from the angular rates, the fine one from optical attitudes against the integrated
gyro.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.clocks.rotation_fit_kernel import (
    compare_with_gyro,
    drift_of,
    integrated_attitudes,
    normal_equations,
)
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal

MIN_POSES = 20
GRID_S = 0.004  # of the cross-correlation
_NODE_S = 0.0025  # of the integrated gyro
_KNOT_S = 0.5  # of the slow drift between integrated gyro and optics: its noise, bias and scale error
_AMBIGUOUS_SIGMA = 5.0
_GYRO_AXES_SD = 0.02  # of scales, and of axes in rad: consumer sensors, and a layout measured by hand
_SETTLED_S = 1e-6  # a twentieth of the sharpest sd
_ROBUST_ROUNDS = 4
_MISFIT_CAP = 25.0
_BESIDE_STEP = 4  # frames on either side that a step needs
_STEP_TIME_SD_S = 0.02
_STEPS_AT_ONCE = 256
_STEP_KNOTS = 20  # of the drift, 10 s: of what a step does beyond them 1e-11 is left
LOSS_PRIOR_SD_S2 = 2e-5  # of c: 4.5 ms squared, the BNO055's narrower settings
DISPERSION_PRIOR_SD_S3 = 5e-8
"""Of d: a second-order low-pass of 7 ms mean delay has 3e-8 (critically damped) to -6e-8 (Butterworth)."""
_NEXT_TERM_SHARE = 0.25
"""How unsure terms left out make what d does to the offset: 2 pi f times 3.5 ms, squared, at 23 Hz."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One least-squares fit: offset and skew with covariance, gyro bias, and how well the attitudes agree.

    ``misfit`` is the sum of squares behind ``residual_sd``, in which no frame counts more than `_MISFIT_CAP`
    times what it should.
    """

    offset_s: float
    skew: float
    loss_s2: float
    bias_radps: FloatArray
    bias_sd_radps: FloatArray
    covariance: FloatArray
    residual_sd: float
    misfit: float
    n_frames: int

    @property
    def offset_sd_s(self) -> float:
        """Return the sd of the offset, s."""
        return float(np.sqrt(self.covariance[0, 0]))


@dataclass(frozen=True, slots=True, eq=False)
class Correlation:
    """Of optical with inertial angular rates, over lags: of their sizes, and of the vectors."""

    lags_s: FloatArray
    speed: FloatArray
    vector: FloatArray

    def at(self, lag_s: float) -> tuple[float, float]:
        """Return both at the grid point nearest to a lag."""
        i = int(np.argmin(np.abs(self.lags_s - lag_s)))
        return float(self.speed[i]), float(self.vector[i])

    def candidates_s(self) -> FloatArray:
        """Return the lags of the local maxima that come near the greatest, at most four of each kind."""
        found: list[float] = []
        for c in (self.speed, self.vector):
            c = np.where(np.isfinite(c), c, -np.inf)
            padded = np.concatenate([[-np.inf], c, [-np.inf]])
            top = (c >= padded[:-2]) & (c >= padded[2:]) & (c > max(c.max() - 0.3, 0.0))
            index = np.flatnonzero(top)
            for lag in self.lags_s[index[np.argsort(-c[index])][:4]]:
                if all(abs(lag - other) > 0.012 for other in found):
                    found.append(float(lag))
        return np.array(found)


def correlate(
    t_s: FloatArray, R: FloatArray, signal: ImuSignal, *, centre_s: float, max_offset_s: float
) -> Correlation:
    """Return the normalised correlations over lags within ``centre_s +- max_offset_s``.

    The angular speed is the same in all axes, so it finds the offset even when the IMU's axes are wrongly
    known; the vector is the sharper of the two when they are right. The optical rate of a pair of frames is
    compared with the gyro's mean over the same interval.
    """
    dt = np.diff(t_s)
    pair = dt < 1.5 * np.median(dt)
    dt = dt[pair]
    optical = rvec_from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:])[pair] / dt[:, None]
    n_side = int(np.ceil(max_offset_s / GRID_S))
    lags = np.asarray(centre_s + np.arange(-n_side, n_side + 1) * GRID_S, dtype=np.float64)
    at = t_s + lags[:, None]
    inertial = np.diff(signal.angle_at(at), axis=1)[:, pair] / dt[:, None]
    is_missing = signal.in_gap(at)
    use = ~(is_missing[:, :-1] | is_missing[:, 1:])[:, pair]
    n_used = use.sum(axis=1)
    weight = use / np.maximum(n_used, 1)[:, None]

    def normalised(a: FloatArray, b: FloatArray) -> FloatArray:
        """Return the correlation over pairs and components, for a (n, c) and b (lags, n, c)."""
        a, b = a - a.mean(axis=0), b - b.mean(axis=1, keepdims=True)
        mean_a, mean_b = weight @ a, np.einsum("ln,lnc->lc", weight, b)
        aa = weight @ (a * a).sum(axis=1) - (mean_a**2).sum(axis=1)
        bb = np.einsum("ln,lnc,lnc->l", weight, b, b) - (mean_b**2).sum(axis=1)
        ab = np.einsum("ln,nc,lnc->l", weight, a, b) - (mean_a * mean_b).sum(axis=1)
        ok = (n_used >= MIN_POSES) & (aa > 0) & (bb > 0)
        return np.asarray(np.where(ok, ab / np.sqrt(np.where(ok, aa * bb, 1.0)), np.nan))

    speed = normalised(
        np.linalg.norm(optical, axis=-1, keepdims=True), np.linalg.norm(inertial, axis=-1, keepdims=True)
    )
    return Correlation(lags, speed, normalised(optical, inertial))


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
        By so much chi-square (3 degrees of freedom) is less with it.
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
    """Errors of attitudes, (n, 3), as a sum of columns, (n, 3, c), of prior sd (c,), beside a slow drift."""

    inside: BoolArray
    columns: FloatArray
    sd: FloatArray
    error: FloatArray
    inverse_sd: FloatArray
    hats: tuple[IntArray, FloatArray, int]

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
        return _Fitted(np.asarray(found), np.asarray(np.linalg.inv(information)), weight, scale, white)


class RotationFit:
    """Least squares of optical attitudes against the integrated gyro, for offset, skew and slow drift.

    The optical noise of neighbouring frame-to-frame rotations is anticorrelated. Whitened, their least
    squares is that of the attitudes themselves less a slowly varying misalignment: hat functions every half
    second for each axis, which take up start attitude, bias, gyro noise and scale error.

    What the gyro's low-pass does beside its delay is free too, to third order in frequency: it makes fast
    motion smaller (c), and delays it otherwise than slow motion (d). Without d the offset would be that of
    the motion's own frequencies, some 0.2 ms off at 12 Hz.
    """

    def __init__(
        self, t_s: FloatArray, R: FloatArray, sd_rad: FloatArray, signal: ImuSignal, *, skew_prior_sd: float
    ) -> None:
        self._t, self._R, self._sd, self._signal = t_s, R, sd_rad, signal
        self._t_mid = 0.5 * (t_s[0] + t_s[-1])
        self._skew_prior_sd = skew_prior_sd
        n = int(np.ceil((signal.t_s[-1] - signal.t_s[0]) / _NODE_S))
        self._nodes = np.linspace(signal.t_s[0], signal.t_s[-1], n + 1)
        self._pieces = signal.gyro_pieces()
        self._remove_bias(np.zeros(3))
        self._unbiased = self._attitude  # every solution begins with it

    def _remove_bias(self, bias_radps: FloatArray) -> None:
        """Integrate the gyro anew, less a bias."""
        self._gyro_bias = bias_radps
        self._attitude = integrated_attitudes(self._pieces, self._nodes, bias_radps)

    def _hats(self, t_s: FloatArray, segment: IntArray) -> tuple[IntArray, FloatArray, int]:
        """Return hat functions of time, separate for each stretch between IMU gaps.

        Of each frame: the knot before it, and its share of the way to the next; and how many knots there are.
        """
        knot, share = np.zeros(len(t_s), dtype=np.int64), np.zeros(len(t_s))
        n_before = 0
        for k in np.unique(segment):
            inside = segment == k
            lo, hi = t_s[inside].min(), t_s[inside].max()
            n_knots = max(2, round((hi - lo) / _KNOT_S) + 1)
            place = (t_s[inside] - lo) / (hi - lo) * (n_knots - 1)
            first = np.minimum(place.astype(np.int64), n_knots - 2)
            knot[inside], share[inside] = n_before + first, place - first
            n_before += n_knots
        return knot, share, n_before

    def _frames_beside_gyro(self, offset_s: float) -> tuple[BoolArray, IntArray]:
        """Return the frames whose IMU time has samples around, and the stretch between long gaps of each."""
        signal, t_imu = self._signal, self._t + offset_s
        inside = (t_imu > signal.t_s[0] + 0.005) & (t_imu < signal.t_s[-1] - 0.005) & ~signal.in_gap(t_imu)
        long = np.diff(signal.gaps_s, axis=1)[:, 0] > 2.5 * signal.period_s
        segment = np.searchsorted(signal.gaps_s[long, 0], t_imu)
        for k in np.unique(segment):
            if (inside & (segment == k)).sum() < 6:
                inside[segment == k] = False
        return inside, segment

    def solve(self, offset_s: float, *, reach_s: float = np.inf) -> Fit | None:
        """Return the fit that starts at an offset, or None where too few frames have gyro beside them.

        None as well where it goes farther than ``reach_s`` from there.
        """
        inside, segment = self._frames_beside_gyro(offset_s)
        if inside.sum() < MIN_POSES:
            return None
        t, R, inverse_sd = self._t[inside], self._R[inside], 1 / self._sd[inside]
        knot, share, n_knots = self._hats(t, segment[inside])
        n, since_mid = len(t), t - self._t_mid
        self._gyro_bias, self._attitude = np.zeros(3), self._unbiased
        offset, skew, sd = float(offset_s), 0.0, float("nan")
        prior_sd = np.array([np.inf, self._skew_prior_sd, LOSS_PRIOR_SD_S2, DISPERSION_PRIOR_SD_S3])
        prior = np.diag(prior_sd**-2.0)
        lost = 0.0
        weight = np.ones(n)
        for iteration in range(12):
            t_imu = t + offset + skew * since_mid
            attitude, error, design = compare_with_gyro(
                self._pieces, self._nodes, self._attitude, self._gyro_bias, t_imu, since_mid, R
            )
            w = weight * inverse_sd
            normal, right = normal_equations(w, knot, share, n_knots, design, error)
            normal += prior
            if not (np.isfinite(normal).all() and normal[0, 0] > 0):
                return None
            step = np.linalg.solve(normal, right - np.array([0.0, skew, 0.0, 0.0]) @ prior)
            remainder = error - design @ step
            lost = float(step[2])
            drift = drift_of(w, knot, share, n_knots, remainder)
            residual = np.linalg.norm((remainder - drift) * inverse_sd[:, None], axis=1) / np.sqrt(3)
            freedom = max(n - n_knots - 1, 1) / n
            # The median of sqrt(chi-square of 3 / 3) is 0.888.
            sd = max(float(np.median(residual)) / 0.888 / np.sqrt(freedom), 1e-6)
            weight = (1 + (residual / (2.5 * sd)) ** 2) ** -0.25  # soft-L1 by reweighting
            offset, skew = offset + float(np.clip(step[0], -0.02, 0.02)), skew + float(step[1])
            if abs(offset - offset_s) > reach_s:
                return None
            if iteration == 2:
                # A bias left in turns the axes in which the errors are compared.
                bias, _ = self._bias(t, segment[inside], attitude, drift, sd * self._sd[inside])
                self._remove_bias(bias)
            elif abs(step[0]) < _SETTLED_S and iteration > 3:
                break
        bias, bias_covariance = self._bias(t, segment[inside], attitude, drift, sd * self._sd[inside])
        covariance = np.linalg.inv(normal) * sd**2
        drawn_s = step[3] * covariance[0, 3] / covariance[3, 3]  # what d did to the offset
        covariance[0, 0] += (_NEXT_TERM_SHARE * drawn_s) ** 2
        misfit = 3 * float(np.minimum(residual**2, _MISFIT_CAP * sd**2).sum())
        bias_sd = np.sqrt(np.diag(bias_covariance))
        return Fit(offset, skew, lost, self._gyro_bias + bias, bias_sd, covariance, sd, misfit, n)

    def time_errors(
        self, basis: FloatArray, prior_sd_s: FloatArray, gyro_bias_radps: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return errors of the frames' times as a sum of functions, and their covariance; linear, from zero.

        Scales and axes of the gyro are free beside them within what sensors have. None where too few frames
        have gyro beside them.

        Parameters
        ----------
        basis : ndarray, shape (n_frames, c)
            Functions of the frames' times, to be added to them.
        prior_sd_s : ndarray, shape (c,), s
        gyro_bias_radps : ndarray, shape (3,)
        """
        linear = self._linear(basis, prior_sd_s, gyro_bias_radps)
        if linear is None:
            return None
        n, fit = basis.shape[1], linear.fit()
        return fit.found[:n], fit.covariance[:n, :n]

    def attitude_step(self, gyro_bias_radps: FloatArray) -> AttitudeStep | None:
        """Return the step of the attitudes against the gyro that explains most; None as in `time_errors`.

        One offset of the clocks, and scales and axes of the gyro, are free beside it.
        """
        n_frames = len(self._t)
        linear = self._linear(np.ones((n_frames, 1)), np.array([_STEP_TIME_SD_S]), gyro_bias_radps)
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
            since = np.greater_equal.outer(np.arange(n)[rows], steps).astype(np.float64)
            white = (since - drift_of(fit.weight[rows], *hats, since)) * weight[rows, None]
            beside = np.einsum("nk,nip->kip", white, A[rows], optimize=True)
            # The least is for steps that the drift takes up, as it does between stretches with samples.
            normal = (np.einsum("nk,nk->k", white, white)[:, None, None] + 1e-9) * np.eye(3)
            normal -= beside @ fit.covariance @ np.swapaxes(beside, 1, 2)
            pull = white.T @ left[rows]
            size = np.linalg.solve(normal, pull[..., None])[..., 0]
            gain = np.einsum("ki,ki->k", pull, size)
            best = int(np.argmax(gain))
            frame = int(np.flatnonzero(linear.inside)[steps[best]])
            found.append(AttitudeStep(frame, size[best], np.linalg.inv(normal[best]), float(gain[best])))
        return max(found, key=lambda step: step.gain)

    def _linear(
        self, basis: FloatArray, prior_sd_s: FloatArray, gyro_bias_radps: FloatArray
    ) -> _LinearFit | None:
        inside, segment = self._frames_beside_gyro(0.0)
        if inside.sum() < MIN_POSES:
            return None
        t = self._t[inside]
        self._remove_bias(gyro_bias_radps)
        attitude, error, design = compare_with_gyro(
            self._pieces, self._nodes, self._attitude, gyro_bias_radps, t, np.zeros_like(t), self._R[inside]
        )
        turned = np.diff(self._signal.angle_at(t), axis=0) - np.diff(t)[:, None] * gyro_bias_radps
        by_axes = 0.5 * (attitude[1:] + attitude[:-1])[:, :, :, None] * turned[:, None, None, :]
        by_axes = np.concatenate([np.zeros((1, 3, 9)), np.cumsum(by_axes.reshape(-1, 3, 9), axis=0)])
        by_time = basis[inside][:, None, :] * design[:, :, :1]
        return _LinearFit(
            inside=inside,
            columns=np.concatenate([by_time, design[:, :, 2:], by_axes], axis=2),
            sd=np.concatenate(
                [prior_sd_s, [LOSS_PRIOR_SD_S2, DISPERSION_PRIOR_SD_S3], np.full(9, _GYRO_AXES_SD)]
            ),
            error=error,
            inverse_sd=1 / self._sd[inside],
            hats=self._hats(t, segment[inside]),
        )

    @staticmethod
    def _bias(
        t: FloatArray, segment: IntArray, attitude: FloatArray, drift: FloatArray, sd_rad: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the bias, and its covariance, of ``drift = const - integral of attitude @ bias``.

        With a constant of its own for each stretch between gaps: what turned in a gap is no bias.
        """
        span = np.concatenate([[0.0], np.diff(t)])[:, None, None]
        integral = np.cumsum(span * attitude, axis=0)
        stretch = segment[:, None] == np.unique(segment)
        constants = np.einsum("ns,ij->nisj", stretch, np.eye(3)).reshape(len(t), 3, -1)
        design = np.concatenate([-integral, constants], axis=2)
        n = design.shape[2]
        A = (design / sd_rad[:, None, None]).reshape(-1, n)
        covariance = np.asarray(np.linalg.inv(A.T @ A + np.eye(n)), dtype=np.float64)
        bias = covariance @ (A.T @ (drift / sd_rad[:, None]).reshape(-1))
        return np.asarray(bias[:3], dtype=np.float64), covariance[:3, :3]


def as_likely(fit: Fit, best: Fit) -> bool:
    """Return whether the data tell two fits apart by less than five sd."""
    excess = 3 * min(fit.n_frames, best.n_frames) * ((fit.residual_sd / best.residual_sd) ** 2 - 1)
    return bool(excess < _AMBIGUOUS_SIGMA**2)
