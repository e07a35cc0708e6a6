"""Coarse offset of two clocks from one rotation that both saw: the correlation of angular rates over lags."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.fusion.clocks.posed_frames import MIN_POSES
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal

GRID_S = 0.004  # of the cross-correlation


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
    pair = np.flatnonzero(dt < 1.5 * np.median(dt))
    dt = dt[pair]
    optical = rvec_from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:])[pair] / dt[:, None]
    n_side = int(np.ceil(max_offset_s / GRID_S))
    lags = np.asarray(centre_s + np.arange(-n_side, n_side + 1) * GRID_S, dtype=np.float64)
    at = t_s + lags[:, None]
    inertial = np.diff(signal.angle_at(at), axis=1).take(pair, axis=1)
    inertial /= dt[:, None]
    is_missing = signal.in_gap(at)
    use = ~(is_missing[:, :-1] | is_missing[:, 1:]).take(pair, axis=1)
    n_used = use.sum(axis=1)
    weight = use / np.maximum(n_used, 1)[:, None]

    def normalised(a: FloatArray, b: FloatArray) -> FloatArray:
        """Return the correlation over pairs and components, for a (n, c) and b (lags, n, c), used up."""
        a = a - a.mean(axis=0)
        mean_a = weight @ a
        b -= weight[:, None] @ b
        aa = weight @ (a * a).sum(axis=1) - (mean_a**2).sum(axis=1)
        bb = np.einsum("ln,lnc,lnc->l", weight, b, b)
        b *= weight[..., None]
        ab = b.reshape(len(b), -1) @ a.ravel()
        ok = (n_used >= MIN_POSES) & (aa > 0) & (bb > 0)
        return np.asarray(np.where(ok, ab / np.sqrt(np.where(ok, aa * bb, 1.0)), np.nan))

    size = np.sqrt(np.einsum("lnc,lnc->ln", inertial, inertial))[..., None]
    speed = normalised(np.linalg.norm(optical, axis=-1, keepdims=True), size)
    return Correlation(lags, speed, normalised(optical, inertial))
