"""What the LEDs of each frame say among themselves of how far they stand beside their places.

The run as a whole says it too, and more. But it is wrong wherever the noise says too little: what a sensor
misses of an impact, or a picture's error that changes with the view, is explained best by LEDs that all stand
a pixel beside where they were seen, the way a pose would move them. So how large these errors are is asked
only of what no pose can hide, which is what is left of them on the mean over the frames, with the pose of
each frame left free.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.led_by_led.led_measurements import SeenLeds
from bricktrack_host.fusion.smoothing.observation_kernel import LedArrays

_FRAMES_AT_ONCE = 4096  # of more the products are only more memory
_LEAST_LEDS = 4  # fewer hold a pose and say nothing more
_LEAST_SEEN = 0.3
"""Share of an error that free poses leave. Of errors that look like poses a motion of ten degrees shows some
hundredths; of others nearly all is left."""


@dataclass(frozen=True, slots=True, eq=False)
class AmongThemselves:
    """Combinations of LEDs' standing offsets that no pose can hide, with their measured values.

    Attributes
    ----------
    by_error : ndarray, shape (k, q)
        What each of the standing errors of pictures is in each of k combinations, in its noise's units.
    value : ndarray, shape (k,)
        Measured, with noise of sd ``noise_sd``, shape (k,).
    """

    by_error: FloatArray
    value: FloatArray
    noise_sd: FloatArray

    @classmethod
    def of(
        cls, arrays: LedArrays, leds: SeenLeds, of_all: FloatArray, by_view: FloatArray, n_leds: int
    ) -> "AmongThemselves":
        """Return what is measured in a run.

        Of q = d + 2 V L errors: those that all LEDs share move their pictures by ``of_all``, shape (m, 2, d);
        then come (u, v) of each of ``n_leds``, V times: as they stand, and as they change with the view. Of
        each of these a sight has ``by_view``, shape (m, V).
        """
        n_shared, n_own = of_all.shape[2], 2 * by_view.shape[1] * n_leds
        n_in_frame = np.bincount(leds.frame[arrays.use], minlength=int(leds.frame.max(initial=0)) + 1)
        rows = np.flatnonzero(arrays.use & (n_in_frame[leds.frame] >= _LEAST_LEDS))
        if not rows.size:
            return cls(np.zeros((0, n_shared + n_own)), np.zeros(0), np.zeros(0))
        weight = 1 / np.sqrt(0.5 * np.trace(arrays.cov_px2[rows], axis1=1, axis2=2))
        whole = np.concatenate([arrays.J[rows], of_all[rows], arrays.residual_px[rows, :, None]], axis=2)
        sums = _Sums(np.zeros((n_own, n_own)), np.zeros(n_own), np.zeros((n_own, n_shared + 1)))
        numbers, frame = np.unique(leds.frame[rows], return_inverse=True)
        for start in range(0, len(numbers), _FRAMES_AT_ONCE):
            some = (frame >= start) & (frame < start + _FRAMES_AT_ONCE)
            at = frame[some] - start, leds.led[rows[some]]
            n_frames = int(at[0].max()) + 1
            seen = np.zeros((n_frames, n_leds, 2, whole.shape[2]))
            own = np.zeros((n_frames, n_leds, by_view.shape[1]))
            seen[at] = weight[some, None, None] * whole[some]
            own[at] = weight[some, None] * by_view[rows[some]]
            sums.add(seen.reshape(n_frames, 2 * n_leds, -1), own.repeat(2, axis=1))
        root = np.sqrt(np.where(sums.total > 0, sums.total, 1.0))
        share, ways = np.linalg.eigh(sums.normal / np.outer(root, root))
        kept = share > _LEAST_SEEN
        share, ways = share[kept], ways[:, kept]
        measured = (ways / root[:, None]).T @ sums.pull / share[:, None]
        by_error = np.concatenate([measured[:, :n_shared], (ways * root[:, None]).T], axis=1)
        return cls(by_error, measured[:, n_shared], 1 / np.sqrt(share))

    def belief(self, prior: FloatArray, known: FloatArray) -> FloatArray:
        """Return log-likelihoods of priors, shape (..., q, q), where ``known``, (q,), was taken out."""
        if not len(self.value):
            return np.zeros(prior.shape[:-2])
        off = self.value + self.by_error @ known
        S = self.by_error @ prior @ self.by_error.T + np.diag(self.noise_sd**2)
        square = (off * np.linalg.solve(S, off[:, None])[..., 0]).sum(axis=-1)
        return np.asarray(-0.5 * (square + np.linalg.slogdet(S)[1]))


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Sums over frames, of n = 2 V L errors of LEDs' own.

    Attributes
    ----------
    normal : ndarray, shape (n, n)
        Of their least squares with the pose of each frame left free.
    total : ndarray, shape (n,)
        What its diagonal would be were all poses known.
    pull : ndarray, shape (n, k)
        Of what is seen.
    """

    normal: FloatArray
    total: FloatArray
    pull: FloatArray

    def add(self, seen: FloatArray, own: FloatArray) -> None:
        """Add f frames: ``seen``, shape (f, 2 L, 6 + k), by pose and what is seen; ``own``, (f, 2 L, V)."""
        by_pose, target = np.linalg.qr(seen[..., :6])[0], seen[..., 6:]
        free = target - by_pose @ (np.swapaxes(by_pose, 1, 2) @ target)
        _, n_rows, n_views = own.shape
        own = np.ascontiguousarray(own.transpose(2, 1, 0))
        by_led = np.einsum("vif,uif->ivu", own, own)
        by_sight = np.zeros((n_views, n_rows, n_views, n_rows))
        i = np.arange(n_rows)
        by_sight[:, i, :, i] = by_led
        known = by_sight.reshape(self.normal.shape)
        hidden = (own[..., None] * by_pose.transpose(1, 0, 2)).reshape(len(known), -1)
        self.normal[:] += known - hidden @ hidden.T
        self.total[:] += np.diag(known)
        self.pull[:] += (own[:, :, None] @ free.transpose(1, 0, 2)).reshape(len(known), -1)
