"""Judge how well the clocks of camera and IMU are found, beside the least that could be known of them.

The windows and their recipe are those of ``broad_windows.py`` (BROAD, CC BY 4.0; simulated camera noise and
clocks). For each window: the error of the offset, its mean and scatter over the seeds, and two limits.

- *bound*: the sd that no unbiased estimate can beat (Cramer and Rao), from the sensitivity of all poses that
  are left to the offset, beside all else that is not known: skew, start, gravity, biases, gains, lag of the
  accelerometer, place of the sensor. The camera's noise is what was simulated; the inertial samples are taken
  for perfect, so the true bound lies higher.
- *own*: the error that is left, on the mean over the seeds, with a fifth of the camera's noise: what the
  reference and the recorded sensor differ by, after the one constant lag that the windows' README takes out
  of all. It counts as an error of every method.

Run: ``python scripts/bench_offset.py --seeds 8``
"""

import argparse
import logging
from dataclasses import replace

import numpy as np
from broad_windows import LEVER_ARM_MM, Case, Recipe, add_windows_argument, make_case, windows_in
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.interpolate import CubicSpline

from bricktrack_common.arrays import FloatArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.fusion.inertial.imu_signal import chain_rotations
from bricktrack_host.tracks import ImuTrack, OpticalTrack

# What is not known beside the offset: how many numbers, and their sd before the data speak, as `FusionSettings`
# has it (skew; attitude, position and velocity at the middle; gravity; biases, gains, lag, lever arm).
_UNKNOWN = {
    "offset_s": (1, 0.25), "skew": (1, 1e-4), "turn_rad": (3, 1.0), "p_m": (3, 1.0), "v_mps": (3, 5.0),
    "gravity_mps2": (3, 20.0), "bg_radps": (3, 0.02), "ba_mps2": (3, 0.5), "gyro_gain": (9, 0.01),
    "acc_gain": (9, 0.01), "lag_s": (1, 4e-3), "arm_m": (3, 2e-3),
}  # fmt: skip
_FINE_S = 0.0025  # of the integration: coning over it is below 1e-8 rad
_STEP = 1e-4  # of sd, for derivatives
_ROUNDS = 4
_QUIET = 0.2  # of the camera's noise


class _Strapdown:
    """Poses at frames by the inertial samples, for any values of what is not known."""

    def __init__(self, optical: OpticalTrack, imu: ImuTrack, offset_s: float) -> None:
        epoch_ns = int(imu.t_ns[0])
        t_imu_s = (imu.t_ns - epoch_ns) * 1e-9
        self._gyro, self._acc = CubicSpline(t_imu_s, imu.gyro_radps), CubicSpline(t_imu_s, imu.acc_mps2)
        seen = np.isfinite(optical.R_camera_brick[:, 0, 0])
        self._at_s = (optical.t_ns[seen] - epoch_ns) * 1e-9 + offset_s
        self._mid_s = 0.5 * float(self._at_s[0] + self._at_s[-1])
        self._t_s = np.arange(self._at_s[0] - 0.02, self._at_s[-1] + 0.02, _FINE_S)
        self._R_seen, self._p_seen = optical.R_camera_brick[seen], 1e-3 * optical.t_camera_brick_mm[seen]
        variance = np.diagonal(optical.covariance[seen], axis1=1, axis2=2)
        self._sd = np.sqrt(variance) * np.repeat([1.0, 1e-3], 3)
        middle = len(self._at_s) // 2
        self._R_mid = self._R_seen[middle]

    def misfit(self, x: FloatArray) -> FloatArray:
        """Return camera less prediction in sd, shape (6 n,), for the unknowns in sd of their priors."""
        of, first = {}, 0
        for name, (n, sd) in _UNKNOWN.items():
            of[name], first = x[first : first + n] * sd, first + n
        t = self._t_s
        gyro_gain, acc_gain = (np.eye(3) + of[k].reshape(3, 3) for k in ("gyro_gain", "acc_gain"))
        rate = self._gyro(t) @ gyro_gain.T + of["bg_radps"]
        turn = 0.5 * (rate[1:] + rate[:-1]) * _FINE_S
        R = np.concatenate([np.eye(3)[None], chain_rotations(matrix_from_rvec(turn))])
        middle = len(t) // 2
        R = self._R_mid @ matrix_from_rvec(of["turn_rad"]) @ R[middle].T @ R
        force = self._acc(t + of["lag_s"]) @ acc_gain.T + of["ba_mps2"]
        fall = CubicSpline(t, np.einsum("nij,nj->ni", R, force) + of["gravity_mps2"])
        v, p = fall.antiderivative(), fall.antiderivative(2)
        at = self._at_s + of["offset_s"] + of["skew"] * (self._at_s - self._mid_s)
        i = np.clip(np.searchsorted(t, at), 1, len(t) - 1) - 1
        ahead = (at - t[i])[:, None]
        R_at = R[i] @ matrix_from_rvec(0.5 * (rate[i] + rate[i + 1]) * ahead)
        since = at - t[middle]
        p_at = p(at) - p(t[middle]) - since[:, None] * v(t[middle]) + of["p_m"] + since[:, None] * of["v_mps"]
        p_at = p_at - R_at @ (np.array(LEVER_ARM_MM) * 1e-3 + of["arm_m"])
        off = np.concatenate(
            [rvec_from_matrix(np.swapaxes(R_at, 1, 2) @ self._R_seen), self._p_seen - p_at], 1
        )
        return np.asarray((off / self._sd).reshape(-1))

    def derivative(self, x: FloatArray) -> FloatArray:
        """Return the derivative of `misfit`, shape (6 n, n_unknown)."""
        steps = _STEP * np.eye(len(x))
        return np.stack([(self.misfit(x + d) - self.misfit(x - d)) / (2 * _STEP) for d in steps], axis=1)


def offset_bound_ms(optical: OpticalTrack, imu: ImuTrack, *, offset_s: float) -> float:
    """Return the least sd of the offset that the poses and samples of a run allow, ms.

    ``offset_s``: the true one, of samples to frames.
    """
    strapdown = _Strapdown(optical, imu, offset_s)
    n = sum(count for count, _ in _UNKNOWN.values())
    x = np.zeros(n)
    for _ in range(_ROUNDS):
        A = strapdown.derivative(x)
        normal = A.T @ A + np.eye(n)
        x = x - np.linalg.solve(normal, A.T @ strapdown.misfit(x) + x)
    return float(1e3 * _UNKNOWN["offset_s"][1] * np.sqrt(np.linalg.inv(normal)[0, 0]))


def offset_errors(case: Case) -> tuple[float, float, float]:
    """Return how far alignment and smoother are off, and what the smoother says of that, ms."""
    alignment = align_times(case.optical, case.imu, max_offset_s=0.25)
    result = fuse(
        case.optical,
        case.imu,
        lever_arm_mm=LEVER_ARM_MM,
        output_t_ns=case.t_out_ns[::50],
        alignment=alignment,
    )
    true_ms = 1e3 * case.offset_s
    return (
        alignment.offset_ns * 1e-6 - true_ms,
        result.offset_ns * 1e-6 - true_ms,
        result.offset_sd_ns * 1e-6,
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Print one table: a row a window, and the rms over all; ms."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_windows_argument(parser)
    parser.add_argument("--seeds", type=int, default=8, help="cases made of each window, two at least")
    args = parser.parse_args()
    logging.getLogger("bricktrack_host").setLevel(logging.ERROR)  # the hidden offset is known to be there
    if args.seeds < 2:
        parser.error("a scatter needs --seeds 2 or more")
    paths = windows_in(args.folder, parser)
    if not paths:
        return
    table = Table(title="offset of the clocks, ms (BROAD, CC BY 4.0; simulated camera and clocks)")
    for column in ("window", "aligned", "mean", "scatter", "rms", "stated", "bound", "own"):
        table.add_column(column, justify="left" if column == "window" else "right")
    usual = Recipe()
    quiet = replace(
        usual, position_sd_mm=_QUIET * usual.position_sd_mm, rotation_sd_deg=_QUIET * usual.rotation_sd_deg
    )
    rows: list[FloatArray] = []
    for path in track(paths, description="windows", transient=True):
        cases = [make_case(path, seed=seed) for seed in range(args.seeds)]
        aligned, fused, stated = np.array([offset_errors(case) for case in cases]).T
        own = np.mean([offset_errors(make_case(path, seed=s, recipe=quiet))[1] for s in range(args.seeds)])
        bound = np.array([offset_bound_ms(c.optical, c.imu, offset_s=c.offset_s) for c in cases])
        scatter = fused.std(ddof=1)
        rows.append(
            np.array([_rms(aligned), fused.mean(), scatter, _rms(fused), _rms(stated), _rms(bound), own])
        )
        table.add_row(path.stem, *(f"{v:.3f}" for v in rows[-1]))
    table.add_section()
    table.add_row("all, rms", *(f"{_rms(v):.3f}" for v in np.array(rows).T))
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
