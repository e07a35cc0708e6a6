"""Fine offset of two clocks from one rotation that both saw: optics against the integrated gyro."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.fusion.clocks.posed_frames import MIN_POSES, FramesBesideGyro, PosedFrames, hats
from bricktrack_host.fusion.clocks.rotation_fit_kernel import drift_of, normal_equations
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal

_AMBIGUOUS_SIGMA = 5.0
_SETTLED_S = 1e-6  # a twentieth of the sharpest sd
_MISFIT_CAP = 25.0
LOSS_PRIOR_SD_S2 = 2e-5  # of c: 4.5 ms squared, the BNO055's narrower settings
DISPERSION_PRIOR_SD_S3 = 5e-8
"""Of d: a second-order low-pass of 7 ms mean delay has 3e-8 (critically damped) to -6e-8 (Butterworth).

A BNO055 read by the daemon has that: 32 Hz, set where the mode leaves it open, the chip's own in its fusion
modes. Imported samples of a gyro below 20 Hz have more, and their offset is less sure than said.
"""
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


def left_out_s2(with_offset: float, variance: float, dispersion_s3: float) -> float:
    """Return the variance of an offset by what a low-pass does in orders higher than the third.

    Parameters
    ----------
    with_offset, variance : float, s^4 and s^6
        Covariance of the low-pass's d with the offset, and its variance.
    dispersion_s3 : float
        d, as found.
    """
    drawn_s = dispersion_s3 * with_offset / variance  # what d did to the offset
    return float((_NEXT_TERM_SHARE * drawn_s) ** 2)


class RotationFit:
    """Least squares of optical attitudes against the integrated gyro, for offset, skew and slow drift.

    The optical noise of neighbouring frame-to-frame rotations is anticorrelated. Whitened, their least
    squares is that of the attitudes themselves less a slowly varying misalignment: hat functions every half
    second for each axis, which take up start attitude, bias, gyro noise and scale error.

    What the gyro's low-pass does beside its delay is free too, to third order in frequency: it makes fast
    motion smaller (c), and delays it otherwise than slow motion (d). Without d the offset would be that of
    the motion's own frequencies, some 0.2 ms off at 12 Hz.
    """

    def __init__(self, frames: PosedFrames, signal: ImuSignal, *, skew_prior_sd: float) -> None:
        self._frames, self._skew_prior_sd = frames, skew_prior_sd
        self._beside = FramesBesideGyro(frames, signal)
        self._start: tuple[FloatArray, FloatArray] | None = None
        """A rough bias and the gyro integrated without it, with which every solution begins."""

    def solve(self, offset_s: float, *, reach_s: float = np.inf) -> Fit | None:
        """Return the fit that starts at an offset, or None where too few frames have gyro beside them.

        None as well where it goes farther than ``reach_s`` from there.
        """
        inside, segment = self._beside.covered(offset_s)
        if inside.sum() < MIN_POSES:
            return None
        t_s, sd_rad = self._frames.t_s, self._frames.sd_rad[inside]
        t, segment, inverse_sd = t_s[inside], segment[inside], 1 / sd_rad
        knot, share, n_knots = hats(t, segment)
        n, since_mid = len(t), t - 0.5 * (t_s[0] + t_s[-1])
        if self._start is None:
            rough = self._beside.mean_bias(offset_s)
            self._start = rough, self._beside.integrated(rough)
        gyro_bias, integrated = self._start
        offset, skew, sd = float(offset_s), 0.0, float("nan")
        prior_sd = np.array([np.inf, self._skew_prior_sd, LOSS_PRIOR_SD_S2, DISPERSION_PRIOR_SD_S3])
        prior = np.diag(prior_sd**-2.0)
        lost = 0.0
        weight = np.ones(n)
        for iteration in range(12):
            t_imu = t + offset + skew * since_mid
            attitude, error, design = self._beside.compared(inside, t_imu, since_mid, integrated, gyro_bias)
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
                gyro_bias = gyro_bias + self._bias(t, segment, attitude, drift, sd * sd_rad)[0]
                integrated = self._beside.integrated(gyro_bias)
            elif abs(step[0]) < _SETTLED_S and iteration > 3:
                break
        bias, bias_covariance = self._bias(t, segment, attitude, drift, sd * sd_rad)
        covariance = np.linalg.inv(normal) * sd**2
        covariance[0, 0] += left_out_s2(covariance[0, 3], covariance[3, 3], float(step[3]))
        misfit = 3 * float(np.minimum(residual**2, _MISFIT_CAP * sd**2).sum())
        bias_sd = np.sqrt(np.diag(bias_covariance))
        return Fit(offset, skew, lost, gyro_bias + bias, bias_sd, covariance, sd, misfit, n)

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
