"""What errors that stand still leave unsure of a smoothed motion, a stretch of the run at a time."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.fusion.smoothing.camera_errors import N_CAMERA_ERRORS, CameraWay
from bricktrack_host.fusion.smoothing.smoother import N_STATES, POS, Estimate, Filter, State
from bricktrack_host.fusion.smoothing.smoother_kernel import CHUNK
from bricktrack_host.fusion.smoothing.standing_errors_kernel import (
    N_GAINS,
    Sight,
    Way,
    carry_back,
    carry_forward,
)

ARM = slice(N_GAINS, N_GAINS + 3)
"""Of the errors, after the gains of gyro and accelerometer: where the sensor is in the brick."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorWay:
    """A filter's way over one run beside its derivatives by q errors that stand still.

    Attributes
    ----------
    way : Way
    camera : CameraWay or None
        Of a camera that moves; the last 23 errors are then its sensor's.
    normal, pull : ndarray, shape (q, q), (q,)
        Of the least squares that gives the errors: normal @ errors = -pull.
    """

    way: Way
    camera: CameraWay | None
    normal: FloatArray
    pull: FloatArray

    @classmethod
    def of(
        cls,
        passed: Filter,
        b: int,
        sight: Sight,
        camera: CameraWay | None,
        *,
        turning: FloatArray | None = None,
    ) -> "ErrorWay":
        """Go over run ``b`` of a batch, where the errors change by themselves what ``sight`` says.

        ``turning``, shape (K - 1, 3, d): what the first of its last errors turn in each step, rad.
        """
        run, kept = passed.runs[b], passed.kept(b)
        n_own = sight.shared.shape[2] + 2 * sight.by_view.shape[1] * sight.n_leds
        n_last = sight.last.shape[2]
        q = N_GAINS + n_own + n_last
        further = np.zeros((len(run.dt_s), 3, n_last))
        if camera is not None:
            further[..., -N_CAMERA_ERRORS:] = camera.velocity
        if turning is None:
            turning = np.zeros((len(run.dt_s), 3, 0))
        now_before = np.empty((len(kept[-1]), N_STATES * q))
        found = cls(
            Way(run, *kept, sight, further, now_before, turning), camera, np.empty((q, q)), np.empty(q)
        )
        carry_forward(found.way, found.normal, found.pull)
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """What q independent standing errors, one sd of each, move the smoothed states of a run by.

    Worked out when asked for: of the whole run it would be 4 kB a node.

    Attributes
    ----------
    errors : ErrorWay
    root : ndarray, shape (q, q)
        Of the errors' covariance, see `root_of`.
    of : ndarray of int64, shape (c,)
        The states that are wanted.
    """

    errors: ErrorWay
    root: FloatArray
    of: IntArray

    def stretches(self, state: State, b: int) -> Iterator[tuple[slice, FloatArray]]:
        """Yield what they move of run ``b``, shape (n, c, q), for some nodes after the other, the last first.

        ``state``: smoothed, leading shape (K, B).
        """
        way, camera, q = self.errors.way, self.errors.camera, len(self.root)
        n_nodes, later = len(way.run.has_frame), np.zeros(N_STATES * q)
        place = np.searchsorted(self.of, np.arange(POS.start, POS.stop))[:, None]
        for c in range(len(way.R_before) - 1, -1, -1):
            nodes = slice(c * CHUNK, min((c + 1) * CHUNK, n_nodes))
            R = state.R[nodes, b]
            changed = np.empty((len(R), len(self.of), q))
            carry_back(way, c, self.of, later, changed)
            # The origin is known as well as before: what an error of the arm moves is the point of the IMU.
            changed[:, place, np.arange(ARM.start, ARM.stop)] -= R
            if camera is not None:
                theirs = camera.of_output(R, state.x[nodes, b, POS], self.of, camera.t_s[nodes])
                changed[:, :, -N_CAMERA_ERRORS:] += theirs
            yield nodes, changed @ self.root

    def added_to(
        self, estimate: Estimate, b: int, *, moved_by: NDArray[np.float32] | None = None
    ) -> Estimate:
        """Return smoothed states with what they leave unsure of run ``b`` added to their covariance.

        ``moved_by``, shape (K, c, q), if given: written, what each of `stretches` moves.
        """
        covariance, variance = estimate.covariance.copy(), estimate.variance.copy()
        for nodes, moved in self.stretches(estimate.state, b):
            more = moved @ np.swapaxes(moved, 1, 2)
            covariance[nodes, b] += more
            variance[nodes, b, self.of] += np.diagonal(more, axis1=1, axis2=2)
            if moved_by is not None:
                moved_by[nodes] = moved
        return replace(estimate, covariance=covariance, variance=variance)


def root_of(covariance: FloatArray) -> FloatArray:
    """Return A with A A^T = covariance, which may lack rank; shape (q, q)."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
