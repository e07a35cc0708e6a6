"""What LEDs show that are seen at other angles than their profile was fitted at.

A profile is one number, and the LEDs that are seen from the side say which: one seen from in front shows
little of its shape. What a brighter tip, a darker limb or the lens do to the light is fitted along with it,
so for them it is right. What is left is one function of the angle of view for all LEDs of a type. A hundredth
of the radius in the picture is some hundredths of a degree in all poses where the LED that looks into the
camera also stands out of the others' plane, and where the brick turns it is another one at each angle.
"""

import numpy as np

from bricktrack_common.arrays import FloatArray

_SIDE_ON_SD = 0.008
"""Of the shift of the light's middle over radius times sine, of LEDs seen from the side."""
_IN_FRONT_SD = 0.045
"""More by so much of LEDs seen from in front. Half spheres without and with a lit collar of up to 0.4 radii,
their limb 0 to 60 % darker and their tip 0 to 20 % brighter, full pixels or not, measured as centroids are:
beside the middle of the outline 0.046, 0.029, 0.018, 0.011, 0.009, 0.008 at 4, 12, 20, 28, 36, 52 degrees
(rms, simulated)."""
_IN_FRONT_RAD = 0.25  # how fast that falls off
_ALIKE_RAD = 0.5
"""LEDs seen at angles so far apart show different parts of their shape: of the same half spheres, shifts at 4
degrees went with those at 16 and 28 by 0.96 and 0.56."""
_KNOTS_RAD = np.array([0.0, 0.35, 0.7, 1.05, 1.4])
"""Between the angles at which it is known a function so smooth is known as well."""
N_SHAPES = len(_KNOTS_RAD)


def shape_shifts_px(facing: FloatArray, side_on_px: FloatArray) -> FloatArray:
    """Return one sd of each of the independent errors that make up the function, shape (m, 2, N_SHAPES), px.

    Parameters
    ----------
    facing : ndarray, shape (m,)
        Cosine of the angle between each LED's axis and the line of sight.
    side_on_px : ndarray, shape (m, 2), px
        One radius along the LED's axis as it is seen; zero of LEDs that are not.

    Notes
    -----
    The error over radius times sine is a Gaussian process over the angle, given by its values at some knots.
    Of it the profile's fit has taken out the mean, sights weighted by what they show of their side.
    """
    angle_rad = np.arccos(np.clip(facing, -1.0, 1.0))
    root = np.linalg.cholesky(_covariance(_KNOTS_RAD, _KNOTS_RAD))
    share = np.linalg.solve(root, _covariance(_KNOTS_RAD, angle_rad)).T
    weight = np.square(side_on_px).sum(axis=1)
    share -= weight @ share / max(float(weight.sum()), 1e-12)
    return np.asarray(side_on_px[:, :, None] * share[:, None])


def _covariance(a_rad: FloatArray, b_rad: FloatArray) -> FloatArray:
    """Return the covariance of the errors at two sets of angles, shape (len(a), len(b))."""
    alike = np.exp(-0.5 * ((a_rad[:, None] - b_rad) / _ALIKE_RAD) ** 2)
    return np.asarray(_sd(a_rad)[:, None] * alike * _sd(b_rad))


def _sd(angle_rad: FloatArray) -> FloatArray:
    return np.asarray(_SIDE_ON_SD + _IN_FRONT_SD * np.exp(-angle_rad / _IN_FRONT_RAD))
