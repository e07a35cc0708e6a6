"""What a vibration too fast for the samples leaves in them as slow accelerations, found and taken out.

A vibration above half the rate of the samples, or of a clock inside the sensor, is folded down. Where it
comes to lie among the motions it looks like one: 0.1 m/s^2 at 3 Hz is a third of a millimetre, and in half a
second without a view nothing contradicts it. But its phase is that of the vibration that the samples show
(`vibration_phase`), and elsewhere the camera saw that nothing moved so. By how much the camera's
accelerations differ from the samples', at copies of that phase at fixed distances in frequency and at its
jumps, says how large each is in each axis: one least squares over the run. A copy is believed only where it
stands out of what is usual at frequencies nearby, jumps where they explain far more than chance.
"""

import logging
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment
from bricktrack_host.fusion.inertial.imu_samples import CleanSamples, clean_samples, is_vibrating
from bricktrack_host.fusion.inertial.vibration_phase import (
    ComplexArray,
    VibrationPhase,
    low_pass,
    phase_jumps,
    vibration_phase,
)
from bricktrack_host.fusion.pose_by_pose.camera_accelerations import CameraAccelerations
from bricktrack_host.tracks import ImuTrack, OpticalTrack

logger = logging.getLogger(__name__)

_FEWEST_ROWS = 120  # second differences of positions: four seconds in view
_MOST_COPIES = 8
_STANDS_OUT = 12.0  # power of a copy over the median nearby; of 8000 by chance the greatest is at 4
# Frequencies tried, of which 8192 are from zero to the rate: within 2.4 Hz. What camera and samples make of a
# motion differs more where there is more motion, and beside a wider stretch its ripples would stand out too.
_NEARBY = 401
_N_TRIED = 8192
_MOST_HZ = 12.0  # beyond, the camera tells little, and little is left once integrated
_OF_FRAME_RATE = 0.45
_JUMPS_EARN = 60.0  # chi-square of six factors, in units of what is left; by chance below 30
_LAG_HZ = 12.0


def samples_beside_camera(
    optical: OpticalTrack, imu: ImuTrack, alignment: TimeAlignment, lever_arm_m: FloatArray
) -> CleanSamples:
    """Return the samples of a run without the slow accelerations that a vibration too fast for them left.

    Samples without a vibration, or with one of which the camera sees nothing false, are returned as they are.
    Whether those that break the vibration are better filled is for the camera to say as well: where samples
    were lost they are, where a phase jumped they hold what was measured.

    Parameters
    ----------
    optical : OpticalTrack
        Of a camera that stands still.
    imu : ImuTrack
    alignment : TimeAlignment
    lever_arm_m : ndarray, shape (3,), m, brick axes
        From the origin LED to the IMU.

    Raises
    ------
    ShapeError
        As `clean_samples`.
    """
    samples = clean_samples(imu)
    if not is_vibrating(samples.acc_mps2):
        return samples
    is_filled = bool((samples.filled_sd_mps2 > 0).any())
    fits = []
    for one in [samples, clean_samples(imu, mend=False)] if is_filled else [samples]:
        fit = _fit_beside_camera(optical, one, alignment, lever_arm_m)
        if fit is None:
            return samples
        fits.append((fit.left(), fit, one))
    _, fit, samples = min(fits, key=lambda fit: fit[0])
    if not fit.waves:
        return samples
    logger.info(
        "a vibration leaves %d waves among the motions, by up to %.2g m/s^2", len(fit.waves), fit.most()
    )
    return replace(samples, acc_mps2=samples.acc_mps2 - fit.false_mps2())


def _fit_beside_camera(
    optical: OpticalTrack, samples: CleanSamples, alignment: TimeAlignment, lever_arm_m: FloatArray
) -> "_Fit | None":
    """Return what of a vibration the camera finds false, or None where it, or the samples, say too little."""
    phase = vibration_phase(samples.t_s, samples.acc_mps2)
    try:
        camera = CameraAccelerations(optical, samples, alignment, lever_arm_m)
    except TrackingError:
        return None
    if phase is None or camera.n_rows < _FEWEST_ROWS:
        return None
    fit = _Fit(camera, samples)
    jumps = phase_jumps(samples.acc_mps2)
    if jumps is not None:
        fit.add_jumps(phase, *jumps)
    frame_hz = 1e9 / float(np.median(np.diff(optical.t_ns)))
    fit.add_copies(phase, most_hz=min(_MOST_HZ, _OF_FRAME_RATE * frame_hz))
    return fit


class _Fit:
    """Least squares of what camera and samples differ by: errors of the sensor, and waves at a vibration."""

    def __init__(self, camera: CameraAccelerations, samples: CleanSamples) -> None:
        self._camera, self._t_s = camera, samples.t_s
        self.waves: list[ComplexArray] = []
        R, acc = camera.R, samples.acc_mps2
        still = [np.broadcast_to(axis, acc.shape) for axis in np.eye(3)]  # gravity
        rate_hz = 1 / float(np.median(np.diff(samples.t_s)))
        lag = np.gradient(low_pass(acc, _LAG_HZ, rate_hz=rate_hz), samples.t_s, axis=0)
        gains = [R[:, :, i] * acc[:, j, None] for i in range(3) for j in range(3)]
        biases = [R[:, :, i] for i in range(3)]
        A = camera.of([*still, *biases, *gains, np.einsum("nij,nj->ni", R, lag)])
        self._basis, _ = np.linalg.qr(A / np.linalg.norm(A, axis=0))
        self._off = self._beside(camera.off()[:, None])[:, 0]
        self._A = np.zeros((len(self._off), 0))

    def _beside(self, columns: FloatArray) -> FloatArray:
        """Return columns without what errors of the sensor could explain."""
        return np.asarray(columns - self._basis @ (self._basis.T @ columns))

    def _columns(self, wave: ComplexArray) -> FloatArray:
        """Return what a complex wave does in each axis of the brick, real and imaginary part: (m, 6)."""
        R = self._camera.R
        return self._beside(
            self._camera.of([R[:, :, i] * part[:, None] for i in range(3) for part in (wave.real, wave.imag)])
        )

    def _solution(self) -> FloatArray:
        return np.asarray(np.linalg.lstsq(self._A, self._off, rcond=None)[0])

    def _add(self, wave: ComplexArray) -> None:
        self.waves.append(wave)
        self._A = np.concatenate([self._A, self._columns(wave)], axis=1)

    def add_jumps(self, phase: VibrationPhase, beat: float, place: float) -> None:
        """Add pulses where the phase jumps, if they explain enough.

        A vibration turns many times from jump to jump, so the beat is needed more sharply than the jumps
        show it: of those near to it the one that explains most is taken.
        """
        n = len(self._t_s)
        # Turned about the middle of the run, a beat moves the first and the last jump by a tenth of a turn.
        middle = place + np.round((0.5 * n - place) / beat) * beat
        turn = 0.1 / (phase.frequency_hz * float(np.median(np.diff(self._t_s)))) * 2 * beat / n
        tried: dict[int, tuple[float, ComplexArray]] = {}

        def likeliest(among: Iterable[int]) -> int:
            for step in among:
                wave = pulses(phase, beat + turn * step, middle)
                columns = self._columns(wave)
                tried[step] = float(self._off @ (columns @ np.linalg.lstsq(columns, self._off)[0])), wave
            return max(tried, key=lambda step: tried[step][0])

        near = likeliest(range(-15, 16, 3))
        explained, wave = tried[likeliest([near - 2, near - 1, near + 1, near + 2])]
        left = (float(self._off @ self._off) - explained) / max(len(self._off) - 6, 1)
        if explained > _JUMPS_EARN * left:
            self._add(wave)

    def add_copies(self, phase: VibrationPhase, *, most_hz: float) -> None:
        """Add copies of the vibration, the strongest first, as long as they stand out."""
        rate_hz = 1 / float(np.median(np.diff(self._t_s)))
        distances = np.fft.fftfreq(_N_TRIED, 1 / rate_hz)
        appears = np.mod(phase.frequency_hz + distances + 0.5 * rate_hz, rate_hz) - 0.5 * rate_hz
        order = np.argsort(appears)
        distances, is_slow = distances[order], np.abs(appears[order]) < most_hz
        span_s = float(self._t_s[-1] - self._t_s[0])
        even_s = self._t_s[0] + np.arange(round(span_s * rate_hz)) / rate_hz
        for _ in range(_MOST_COPIES):
            left = self._off - self._A @ self._solution()
            told = self._camera.seen_by_samples(left)
            told = np.stack([np.interp(even_s, self._t_s, axis) for axis in told.T], axis=1)
            turned = told * np.conj(phase.at(even_s))[:, None]
            power = (np.abs(np.fft.fft(turned, _N_TRIED, axis=0)) ** 2).sum(axis=1)[order]
            above = np.where(is_slow, power / median_filter(power, _NEARBY, mode="wrap"), 0.0)
            i = int(np.argmax(above))
            if above[i] < _STANDS_OUT:
                break
            self._add(phase.at(self._t_s, distance_hz=float(distances[i])))
            is_slow &= np.abs(distances - distances[i]) > 0.5 / span_s

    def left(self) -> float:
        """Return the mean square of what is not explained, in units of the camera's variance."""
        left = self._off - self._A @ self._solution()
        return float(left @ left) / max(len(left) - self._A.shape[1], 1)

    def most(self) -> float:
        """Return the largest of the false accelerations, m/s^2."""
        return float(np.abs(self.false_mps2()).max())

    def false_mps2(self) -> FloatArray:
        """Return the accelerations of all waves at the samples, shape (n, 3), brick axes."""
        # The camera says less where the samples say too much.
        factors = -self._solution().reshape(len(self.waves), 3, 2)
        return np.asarray(
            sum(
                wave.real[:, None] * of[:, 0] + wave.imag[:, None] * of[:, 1]
                for wave, of in zip(self.waves, factors, strict=True)
            )
        )


def pulses(phase: VibrationPhase, beat: float, place: float) -> ComplexArray:
    """Return pulses of unit area, turned as the vibration is there, at every beat; complex, shape (n,).

    ``beat``, ``place``: samples from one to the next, and to one of them.
    """
    t_s = phase.t_s
    at = np.arange(place % beat, len(t_s) - 1, beat)
    before, part = at.astype(np.int64), at % 1
    rate_hz = 1 / float(np.median(np.diff(t_s)))
    turned = phase.at(np.interp(at, np.arange(len(t_s)), t_s)) * rate_hz
    wave = np.zeros(len(t_s), dtype=np.complex128)
    np.add.at(wave, before, turned * (1 - part))
    np.add.at(wave, before + 1, turned * part)
    return wave
