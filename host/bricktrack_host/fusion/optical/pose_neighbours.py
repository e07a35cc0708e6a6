"""What the frames on either side say of a pose: which are lone outliers, and where the brick jumps."""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray

_JUMP_OVER_CALM = 20.0
_JUMP_WITHIN_PERIODS = 2.5  # one frame may be lost where the brick is put elsewhere


def interpolated(t_s: FloatArray, z: FloatArray, frames: list[int], at_s: float) -> FloatArray:
    """Return the polynomial through some frames at an instant: n frames, degree n - 1."""
    t = t_s[frames] - at_s
    n = len(frames)
    weights = [np.prod([-t[j] / (t[i] - t[j]) for j in range(n) if j != i]) for i in range(n)]
    return np.asarray(np.array(weights) @ z[frames])


def good_frames(t_s: FloatArray, z: FloatArray, cov: FloatArray, gate_chi2: float) -> BoolArray:
    """Return which frames are no lone outliers.

    A frame far off the cubic through two neighbours on each side is one only if its neighbours agree with
    theirs once it is left out: at an impact they do not, and the frame stays.
    """
    n = len(t_s)
    good = np.ones(n, dtype=np.bool_)

    def off(k: int, without: int) -> float:
        around = [i for i in range(k - 3, k + 4) if i not in (k, without) and 0 <= i < n and good[i]]
        before, after = [i for i in around if i < k], [i for i in around if i > k]
        if len(before) < 2 or len(after) < 2:
            return np.inf
        e = z[k] - interpolated(t_s, z, before[-2:] + after[:2], t_s[k])
        # The cubic's own noise adds 17/18 of a frame's variance on an even grid.
        return float(e @ np.linalg.solve(2 * cov[k], e))

    alone = np.array([off(k, k) for k in range(n)])
    far = np.where(np.isfinite(alone), alone, 0.0)
    for k in np.argsort(-far):
        if far[k] < gate_chi2:
            break
        least = max(gate_chi2, 0.05 * far[k])
        if all(off(j, int(k)) < least for j in (k - 1, k + 1) if 0 <= j < n):
            good[k] = False
    return good


def pose_jumps(t_s: FloatArray, z: FloatArray, cov: FloatArray) -> FloatArray:
    """Return by how much the pose jumps from each frame to the next, shape (n - 1, 6); zero where it moves.

    A jump is what neither side foresees, by parabolas through three frames, while each side foresees its own
    to a small part of that: calm before, calm after, and nothing says when it went from one to the other.
    Over a longer gap no parabola foresees anything, and the smoother's own covariance holds.

    Parameters
    ----------
    t_s : ndarray, shape (n,), s
    z : ndarray, shape (n, 6)
        Rotation vector, rad, and position, mm, of each frame.
    cov : ndarray, shape (n, 6, 6)
        Of these.
    """
    jumps = np.zeros((len(t_s) - 1, 6))
    steps = np.diff(t_s)
    is_short = steps < _JUMP_WITHIN_PERIODS * np.median(steps)
    for k in (np.flatnonzero(is_short[3:-3]) + 3).tolist():
        before, after = [k - 3, k - 2, k - 1, k], [k + 4, k + 3, k + 2, k + 1]
        calm = [z[side[3]] - interpolated(t_s, z, side[:3], t_s[side[3]]) for side in (before, after)]
        ahead = z[k + 1] - interpolated(t_s, z, before[1:], t_s[k + 1])
        back = interpolated(t_s, z, after[1:], t_s[k]) - z[k]
        for part in (slice(0, 3), slice(3, 6)):
            usual = max(float(np.linalg.norm(c[part])) for c in calm)
            usual = max(usual, float(np.sqrt(np.trace(cov[k][part, part] + cov[k + 1][part, part]))))
            if min(np.linalg.norm(ahead[part]), np.linalg.norm(back[part])) > _JUMP_OVER_CALM * usual:
                jumps[k, part] = 0.5 * (ahead + back)[part]
    return jumps
