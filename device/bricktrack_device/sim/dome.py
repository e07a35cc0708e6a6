"""The outline of an LED's lit body, a hemisphere on a cylinder, as rays from the camera meet it.

For each ray the *clearance* is how deep inside the outline it passes, mm across the ray: positive where it
hits the body, negative where it misses, and right to first order at the outline, whatever the angle of
view.
"""

import numpy as np
from numpy.typing import NDArray

_Single = NDArray[np.float32]
_TINY = np.float32(1e-9)


def clearance_mm(
    x: _Single, y: _Single, centre_mm: _Single, axis: _Single, *, radius_mm: float, collar_mm: float
) -> _Single:
    """Return the clearance of rays, mm.

    Parameters
    ----------
    x, y : ndarray, shape (rows, columns)
        Slopes of the rays, which leave the camera frame's origin along (x, y, 1).
    centre_mm, axis : ndarray, shape (rows, 3)
        The dome's sphere centre and the unit vector out of the wall, camera frame, at the instant of each
        row. The axis looks towards the camera.
    radius_mm, collar_mm : float
        Of the dome, and the length of the cylinder behind the sphere's centre.

    Returns
    -------
    clearance_mm : ndarray, shape (rows, columns)

    Notes
    -----
    With o the point of the ray in the centre's depth, less the centre (small, so that single precision will
    do), and d the ray's direction, points of the ray are ``o + s d``. The dome's outline is seen where the
    vector q from the centre to the nearest point of the ray looks forward, ``q . a >= 0``, at ``|q| = r``.
    Elsewhere the outline is the cylinder's: the least distance from the axis between foot and centre plane,
    brought from the cylinder's cross-section to across the ray.
    """
    r, collar = np.float32(radius_mm), np.float32(collar_mm)
    oo, od, dd, oa, da = _products(x, y, centre_mm, axis)
    nearest = -od / dd
    q_mm = np.sqrt(np.maximum(oo + nearest * od, 0))
    forward = oa + nearest * da
    dome = np.where(forward >= 0, r - q_mm, np.float32(-np.inf))

    across = np.maximum(dd - da * da, _TINY)
    s_axis = (oa * da - od) / across
    s_centre, s_foot = -oa / da, -(oa + collar) / da
    s: _Single = np.asarray(np.minimum(np.maximum(s_axis, s_centre), s_foot), dtype=np.float32)
    rho_mm = _from_axis(s, oo, od, dd, oa, da)
    height = oa + s * da
    slant = (od + s * dd - height * da) / (np.maximum(rho_mm, np.float32(1e-4)) * da)
    cylinder = (r - rho_mm) / np.sqrt(1 + slant * slant)
    return np.asarray(np.maximum(dome, cylinder), dtype=np.float32)


def foot_mm(x: _Single, y: _Single, centre_mm: _Single, axis: _Single, *, collar_mm: float) -> _Single:
    """Return how far rays pass from the axis in the plane of the cylinder's back rim; see `clearance_mm`."""
    oo, od, dd, oa, da = _products(x, y, centre_mm, axis)
    s: _Single = np.asarray(-(oa + np.float32(collar_mm)) / da, dtype=np.float32)
    return _from_axis(s, oo, od, dd, oa, da)


def _products(
    x: _Single, y: _Single, centre_mm: _Single, axis: _Single
) -> tuple[_Single, _Single, _Single, _Single, _Single]:
    """Return o.o, o.d, d.d, o.a and d.a."""
    cx, cy, cz = (centre_mm[:, i, None] for i in range(3))
    ax, ay, az = (axis[:, i, None] for i in range(3))
    ox, oy = x * cz - cx, y * cz - cy
    da = np.minimum(x * ax + y * ay + az, np.float32(-1e-3))
    return ox * ox + oy * oy, ox * x + oy * y, x * x + y * y + 1, ox * ax + oy * ay, da


def _from_axis(s: _Single, oo: _Single, od: _Single, dd: _Single, oa: _Single, da: _Single) -> _Single:
    height = oa + s * da
    return np.asarray(np.sqrt(np.maximum(oo + s * (2 * od + s * dd) - height * height, 0)), dtype=np.float32)
