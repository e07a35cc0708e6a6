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
    def of(cls, arrays: LedArrays, leds: SeenLeds, of_all: FloatArray, n_leds: int) -> "AmongThemselves":
        """Return what is measured in a run.

        Of q = d + 2 L errors: those that all LEDs share move their pictures by ``of_all``, shape (m, 2, d);
        then come (u, v) of each of ``n_leds``.
        """
        n_shared = of_all.shape[2]
        q = n_shared + 2 * n_leds
        n_in_frame = np.bincount(leds.frame[arrays.use], minlength=int(leds.frame.max(initial=0)) + 1)
        rows = np.flatnonzero(arrays.use & (n_in_frame[leds.frame] >= _LEAST_LEDS))
        if not rows.size:
            return cls(np.zeros((0, q)), np.zeros(0), np.zeros(0))
        weight = 1 / np.sqrt(0.5 * np.trace(arrays.cov_px2[rows], axis1=1, axis2=2))
        led, (_, frame) = leds.led[rows], np.unique(leds.frame[rows], return_inverse=True)
        whole = np.concatenate([arrays.J[rows], arrays.residual_px[rows, :, None]], axis=2)
        seen = np.zeros((frame.max() + 1, n_leds, 2, 7))
        seen[frame, led] = weight[:, None, None] * whole
        seen = seen.reshape(-1, 2 * n_leds, 7)
        weights = np.zeros((len(seen), n_leds))
        weights[frame, led] = weight
        weights = np.repeat(weights, 2, axis=1)
        by_pose = np.linalg.qr(seen[..., :6])[0]
        hidden = weights[..., None] * by_pose
        total = (weights**2).sum(axis=0)
        normal = np.diag(total) - np.einsum("fik,fjk->ij", hidden, hidden, optimize=True)
        pull = (weights * seen[..., 6]).sum(axis=0)
        pull -= np.einsum("fik,fjk,fj->i", hidden, by_pose, seen[..., 6], optimize=True)
        root = np.sqrt(np.where(total > 0, total, 1.0))
        share, ways = np.linalg.eigh(normal / np.outer(root, root))
        kept = share > _LEAST_SEEN
        share, ways = share[kept], ways[:, kept]
        count = np.bincount(led, minlength=n_leds)
        mean = np.zeros((2 * n_leds, q))
        for i, moved in enumerate(of_all[rows].reshape(len(rows), 2 * n_shared).T):
            mean[i // n_shared :: 2, i % n_shared] = np.bincount(led, moved, n_leds) / np.maximum(count, 1)
        mean[:, n_shared:] = np.diag(np.repeat(count > 0, 2))
        weighted = (ways * root[:, None]).T
        return cls(weighted @ mean, ways.T @ (pull / root) / share, 1 / np.sqrt(share))

    def belief(self, prior: FloatArray, known: FloatArray) -> FloatArray:
        """Return log-likelihoods of priors, shape (..., q, q), where ``known``, (q,), was taken out."""
        if not len(self.value):
            return np.zeros(prior.shape[:-2])
        off = self.value + self.by_error @ known
        S = self.by_error @ prior @ self.by_error.T + np.diag(self.noise_sd**2)
        square = (off * np.linalg.solve(S, off[:, None])[..., 0]).sum(axis=-1)
        return np.asarray(-0.5 * (square + np.linalg.slogdet(S)[1]))
