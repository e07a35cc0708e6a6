"""The families of ray models as functions of their parameters: what a fit needs to know of each.

A family says where the rays of pixels meet given depths, and how that changes with its parameters. All are
made of Legendre products of the scaled pixel (`calibration.rays.pixel_legendre`); V is their matrix at
the pixels.

- central: ``(x, y) = (x0, y0) + (z - z0) P``, P the slopes; parameters [P_x, x0, P_y, y0, z0];
- walking pupil: ``(x, y) = (x0, y0) + (z - z0 - w |P|^2) P``: the steeper a ray, the farther along the axis
  it crosses it; parameters as before, then w;
- two-plane: ``(x, y) = N + (z - z_c) P`` with free N; parameters [P_x, N_x, P_y, N_y]. N and P together are
  the paper's polynomials at planes A and B; kept apart because a lens that is nearly central has a small N.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.calibration.rays.pixel_legendre import term_degrees
from bricktrack_host.calibration.rays.pixel_polynomials import n_terms

ALWAYS_FREE = -1
"""The degree of a parameter that is no polynomial's: never held back."""
NON_CENTRAL = 100
"""Added to the degree of coefficients of N: they are held by variances of their own."""


@dataclass(frozen=True, slots=True, eq=False)
class RayPoints:
    """Where rays meet their depths.

    Attributes
    ----------
    xy_mm : ndarray, shape (n, 2), mm
    slopes : ndarray, shape (n, 2)
        dx/dz, dy/dz.
    D : ndarray, shape (n, 2, n_parameters)
        Derivative of ``xy_mm`` by the parameters.
    """

    xy_mm: FloatArray
    slopes: FloatArray
    D: FloatArray


class RayFamily(Protocol):
    """A ray model as a function of its parameters."""

    @property
    def name(self) -> str:
        """How messages call it."""
        ...

    def degrees(self, order: int) -> IntArray:
        """Return the group of each parameter: its degree, `ALWAYS_FREE`, or degree + `NON_CENTRAL`."""
        ...

    def start(self, slopes: FloatArray, centre_mm: FloatArray) -> FloatArray:
        """Return the parameters of central rays, coefficients of the slopes shape (2, n_terms)."""
        ...

    def points(self, parameters: FloatArray, V: FloatArray, z_mm: FloatArray) -> RayPoints:
        """Return where the rays with V, shape (n, n_terms), meet the depths z, shape (n,)."""
        ...


@dataclass(frozen=True, slots=True)
class CentralFamily:
    """Rays through one point, or through one that walks along the axis (``walks``)."""

    walks: bool = False

    @property
    def name(self) -> str:
        """How messages call it."""
        return "walking pupil" if self.walks else "central rays"

    def degrees(self, order: int) -> IntArray:
        """Return the group of each parameter."""
        own = np.append(term_degrees(order), ALWAYS_FREE)
        return np.concatenate([own, own, np.full(2 if self.walks else 1, ALWAYS_FREE)])

    def start(self, slopes: FloatArray, centre_mm: FloatArray) -> FloatArray:
        """Return the parameters of central rays."""
        walk = [0.0] if self.walks else []
        return np.concatenate([slopes[0], centre_mm[:1], slopes[1], centre_mm[1:2], centre_mm[2:], walk])

    def points(self, parameters: FloatArray, V: FloatArray, z_mm: FloatArray) -> RayPoints:
        """Return where the rays meet the depths."""
        m = V.shape[1]
        P = V @ np.stack([parameters[:m], parameters[m + 1 : 2 * m + 1]], axis=1)
        walk = float(parameters[-1]) if self.walks else 0.0
        z0 = float(parameters[2 * m + 2])
        xy0 = parameters[[m, 2 * m + 1]]
        return self.points_of(P, V, z_mm, centre_mm=np.array([*xy0, z0]), walk_mm=walk)

    def points_of(
        self, P: FloatArray, V: FloatArray, z_mm: FloatArray, *, centre_mm: FloatArray, walk_mm: float
    ) -> RayPoints:
        """Return where rays of slopes P, shape (n, 2), meet the depths; V gives the derivatives' terms."""
        n, m = V.shape
        r2 = np.sum(P * P, axis=1)
        reach = z_mm - centre_mm[2] - walk_mm * r2
        D = np.zeros((n, 2, 2 * m + (4 if self.walks else 3)))
        for axis in (0, 1):
            first = axis * (m + 1)
            D[:, axis, first : first + m] = reach[:, None] * V
            D[:, axis, first + m] = 1.0
        D[:, :, 2 * m + 2] = -P
        if self.walks:
            D[:, :, -1] = -r2[:, None] * P
            for axis in (0, 1):  # d(-w |P|^2) P = -2 w P P' dP
                D[:, :, axis * (m + 1) : axis * (m + 1) + m] -= (
                    2 * walk_mm * (P * P[:, axis : axis + 1])[:, :, None] * V[:, None, :]
                )
        return RayPoints(centre_mm[:2] + reach[:, None] * P, P, D)


@dataclass(frozen=True, slots=True)
class TwoPlaneFamily:
    """Free rays: a polynomial on each of two planes; ``z_c`` only says how they are written."""

    z_c_mm: float

    @property
    def name(self) -> str:
        """How messages call it."""
        return "two-plane"

    def degrees(self, order: int) -> IntArray:
        """Return the group of each parameter."""
        d = term_degrees(order)
        return np.concatenate([d, d + NON_CENTRAL, d, d + NON_CENTRAL])

    def start(self, slopes: FloatArray, centre_mm: FloatArray) -> FloatArray:
        """Return the parameters of central rays."""
        m = slopes.shape[1]
        parameters = np.zeros(4 * m)
        for axis in (0, 1):
            parameters[2 * axis * m : (2 * axis + 1) * m] = slopes[axis]
            N = (self.z_c_mm - centre_mm[2]) * slopes[axis]
            N[0] += centre_mm[axis]
            parameters[(2 * axis + 1) * m : (2 * axis + 2) * m] = N
        return parameters

    def points(self, parameters: FloatArray, V: FloatArray, z_mm: FloatArray) -> RayPoints:
        """Return where the rays meet the depths."""
        n, m = V.shape
        P_x, N_x, P_y, N_y = parameters.reshape(4, m)
        P, N = V @ np.stack([P_x, P_y], axis=1), V @ np.stack([N_x, N_y], axis=1)
        reach = z_mm - self.z_c_mm
        D = np.zeros((n, 2, 4 * m))
        for axis in (0, 1):
            D[:, axis, 2 * axis * m : (2 * axis + 1) * m] = reach[:, None] * V
            D[:, axis, (2 * axis + 1) * m : (2 * axis + 2) * m] = V
        return RayPoints(N + reach[:, None] * P, P, D)

    def on_planes(self, order: int, a_mm: float, b_mm: float) -> FloatArray:
        """Return T: [P_x, N_x, P_y, N_y] to the planes' coefficients [x at a, x at b, y at a, y at b]."""
        one = np.array([[a_mm - self.z_c_mm, 1.0], [b_mm - self.z_c_mm, 1.0]])
        return np.asarray(np.kron(np.eye(2), np.kron(one, np.eye(n_terms(order)))))


def two_plane_rows(V: FloatArray, z_mm: FloatArray, *, a_mm: float, b_mm: float) -> FloatArray:
    """Return the derivative, shape (n, 2, 4 n_terms), of (x, y) at z by [x at a, x at b, y at a, y at b]."""
    n, m = V.shape
    share = (z_mm - a_mm) / (b_mm - a_mm)
    D = np.zeros((n, 2, 4 * m))
    for axis in (0, 1):
        D[:, axis, 2 * axis * m : (2 * axis + 1) * m] = (1 - share)[:, None] * V
        D[:, axis, (2 * axis + 1) * m : (2 * axis + 2) * m] = share[:, None] * V
    return D
