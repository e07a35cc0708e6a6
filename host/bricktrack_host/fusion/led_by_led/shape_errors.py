"""What LEDs show that are seen at other angles than their profile was fitted at.

A profile is one number, and the LEDs that are seen from the side say which: one seen from in front shows
little of its shape. What a brighter tip, a darker limb or the lens do to the light is fitted along with it,
so for them it is right; how much of it is left for the LED that looks into the camera nothing tells. Where
that one is also the one that stands out of the others' plane, as in many layouts, a hundredth of its radius
in the picture is some hundredths of a degree in all poses.
"""

import numpy as np

from bricktrack_common.arrays import FloatArray

_SD_PER_RADIUS = 0.008
"""Of the shift of the light's middle over radius times sine: as far as limb darkening and lens put it beside
that of the shape (simulated; see `brick_model.DEFAULT_SHIFT_SD_PER_RADIUS`). A run hardly tells how much:
in 14 simulated recordings what LEDs say among themselves was 0.4 to 5 times as likely by it as without."""
_ALIKE_RAD = 0.5
"""LEDs seen at angles so far apart show different parts of their shape."""


def shape_covariance_px2(angle_rad: FloatArray, side_on_px: FloatArray) -> FloatArray:
    """Return the covariance of L LEDs' standing errors, shape (2 L, 2 L), px^2, u and v of each by turns.

    Parameters
    ----------
    angle_rad : ndarray, shape (L,)
        Between each LED's axis and the line of sight, on the mean.
    side_on_px : ndarray, shape (L, 2), px
        One radius along the LED's axis as it is seen; zero of LEDs that are not.

    Notes
    -----
    The error over radius times sine is a Gaussian process over the angle. Of it the profile's fit has taken
    out the mean, LEDs weighted by what they show of their side.
    """
    alike = np.exp(-0.5 * ((angle_rad[:, None] - angle_rad) / _ALIKE_RAD) ** 2)
    weight = np.square(side_on_px).sum(axis=1)
    beside = np.eye(len(weight)) - weight / max(float(weight.sum()), 1e-12)
    share = _SD_PER_RADIUS**2 * beside @ alike @ beside.T
    by_led = np.einsum("kl,ki,lj->kilj", share, side_on_px, side_on_px)
    return np.asarray(by_led.reshape(side_on_px.size, -1))
