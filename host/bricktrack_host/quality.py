"""Per-sample flags: what a reader must know before trusting one pose. Each bit is documented here, once."""

from enum import IntFlag


class LedFlag(IntFlag):
    """One LED in one frame."""

    NONE = 0
    MISSING = 1
    """Not found in the picture; its coordinates are NaN."""
    BORDER = 2
    """Touches the picture's border: the centroid is of a part only, and is not used."""
    PARTLY_COVERED = 4
    """Smaller or less round than its neighbours allow, or its residual says so: not used."""
    MERGED = 8
    """Two lights run together: not used."""
    BLURRED = 16
    """Moved by more than its radius during the exposure: used with a wider covariance."""
    OUTLIER = 32
    """Elsewhere than all the others say: left out of the fused motion in this frame; or, where so in all
    frames alike, doubted by as much."""
    UNCOVERED = 64
    """Its ray lies where no calibration dot was: the ray model extrapolates."""


class PoseFlag(IntFlag):
    """One pose, optical or fused."""

    NONE = 0
    NO_POSE = 1
    """No pose could be had; its values are NaN."""
    FRAME_LOST = 2
    """The frame was dropped by the camera, its bytes are damaged or missing, or its picture is a copy of
    the one before."""
    LED_MISSING = 4
    """At least one LED is not used in this pose."""
    AMBIGUOUS = 8
    """More than one pose or assignment fits the picture; not believed, values are NaN."""
    UNVERIFIED = 16
    """Too few LEDs to check the identity of each independently of the prediction."""
    UNCOVERED = 32
    """A ray of this pose lies where the calibration extrapolates."""
    LED_PROFILE_UNKNOWN = 64
    """LED shape fitted from this run alone, or not at all: then a bias of some 0.1 mm is possible. The
    covariance says so."""
    DROPOUT = 128
    """Fused: no optical pose within one and a half frame periods."""
    IMPACT = 256
    """The velocity changed faster than the sensors can follow: fused, by the accelerometer, or where poses
    jump between calm ones; optical, by a moving frame whose LEDs obey no one motion. The covariance says
    so."""
    CLIPPED = 512
    """Fused: an inertial sample was at its range limit."""
    IMU_GAP = 1024
    """Fused: inertial samples are missing here and were bridged by interpolation, or where many are, by what
    the camera saw."""
    EXTRAPOLATED = 2048
    """Fused: before the first or after the last optical pose."""
    OPTICAL_ONLY = 4096
    """Fused: smoothed from the optical poses alone; the position owes nothing to inertial data."""
    UNSURE_TIME = 8192
    """The stamps here disagree with the camera's steady rate or with the inertial samples, so the instant of
    the pose is unsure. The covariance says so."""
    CONTESTED = 16384
    """Fused: a frame and all the rest contradict each other here, and either may be right. The pose
    is the mean of both, and the covariance reaches both."""
    RESTAMPED = 32768
    """The stamp of this frame was whole periods of the camera off and was mended; without a pose, the frame
    is a copy of another, or moves where it is not known from which frame on the stamps slip."""


def describe(flags: int) -> str:
    """Return the names of the set bits of a `PoseFlag`, as ``"dropout, impact"``.

    Examples
    --------
    >>> describe(128 | 256)
    'dropout, impact'
    """
    return ", ".join(f.name.lower().replace("_", " ") for f in PoseFlag if f & flags and f.name)
