"""How well the rig's planes are known: the board's small shifts, turns and bend as unknowns of the fit.

The nearest plane defines the camera frame: its board lies in z = a, square to z. Every other plane may be off
by a shift and a turn (about x and y: a tilt; about z: in its plane), and the board, the same at all planes,
may be bent like a quadric. What the pictures do not tell stays at zero with the tolerance as its standard
deviation, and so enters the rays' covariance: with two planes a shift cannot be told from the place of the
projection centre.
"""

from dataclasses import dataclass, field

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.errors import CalibrationError
from bricktrack_common.rotations import matrix_from_rvec

OBSERVABLE_SHARE = 0.5
"""An unknown is called observed where the pictures at least halve its standard deviation."""
BEND_NAMES = ("bend along x", "bend across", "bend along y")


@dataclass(frozen=True, slots=True)
class RigTolerance:
    """Standard deviations of what is not quite known of the rig; 0 takes it as exact.

    Attributes
    ----------
    shift_mm : float, mm
        Of each plane but the nearest, along x, y and z.
    turn_rad : float, rad
        Of each plane but the nearest, about x, y and z.
    bend_mm : float, mm
        Of the board: height at its farthest dot.
    """

    shift_mm: float = 0.0
    turn_rad: float = 0.0
    bend_mm: float = 0.0

    def __post_init__(self) -> None:
        for name in ("shift_mm", "turn_rad", "bend_mm"):
            value = float(getattr(self, name))
            object.__setattr__(self, name, value)
            if not 0 <= value < np.inf:
                raise CalibrationError(f"rig tolerance {name} = {value:g}: expected 0 (exact) or more")


@dataclass(frozen=True, slots=True)
class RigUnknown:
    """One unknown of the rig after the fit.

    Attributes
    ----------
    name : str
        As "plane 2: shift along x".
    unit : "mm" or "rad"
    value, sd, prior_sd : float
        Estimate, its standard deviation, and the tolerance.
    """

    name: str
    unit: str
    value: float
    sd: float
    prior_sd: float

    @property
    def is_observed(self) -> bool:
        """Whether the pictures tell it, rather than the tolerance."""
        return self.sd < OBSERVABLE_SHARE * self.prior_sd


@dataclass(eq=False)
class RigUnknowns:
    """The unknowns of a rig: where its dots are for given values, and how that changes with them.

    Parameters
    ----------
    tolerance : RigTolerance
    plane : ndarray of int64, shape (n,)
        Which plane each dot is on; 0 is the nearest.
    z_mm : ndarray, shape (n_planes,), mm
    xy_mm : ndarray, shape (n, 2), mm
        Nominal place of the dots.
    """

    tolerance: RigTolerance
    plane: IntArray
    z_mm: FloatArray
    xy_mm: FloatArray
    names: list[tuple[str, str]] = field(init=False)
    prior_sd: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        t = self.tolerance
        sd: list[float] = []
        self.names = []
        for k in range(1, len(self.z_mm)):
            for size, kind, unit in ((t.shift_mm, "shift along", "mm"), (t.turn_rad, "turn about", "rad")):
                if size > 0:
                    self.names += [(f"plane {k + 1}: {kind} {axis}", unit) for axis in "xyz"]
                    sd += [size] * 3
        if t.bend_mm > 0:
            self.names += [(name, "mm") for name in BEND_NAMES]
            sd += [t.bend_mm] * 3
        self.prior_sd = np.array(sd)
        reach = max(float(np.abs(self.xy_mm).max()), 1e-9)
        x, y = (self.xy_mm / reach).T
        self._bend = np.stack([x * x, 2 * x * y, y * y], axis=1)

    def __len__(self) -> int:
        return len(self.prior_sd)

    def places(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the dots' places, shape (n, 3), mm, and their derivative, shape (n, 3, n_unknowns)."""
        n = len(self.plane)
        board = np.column_stack([self.xy_mm, np.zeros(n)])
        by = np.zeros((n, 3, len(self)))
        n_bend = 3 if self.tolerance.bend_mm > 0 else 0
        if n_bend:
            board[:, 2] = self._bend @ values[-3:]
        places = board + np.column_stack([np.zeros((n, 2)), self.z_mm[self.plane]])
        k = 0
        if n_bend:
            by[:, 2, -3:] = self._bend
        for plane in range(1, len(self.z_mm)):
            own = np.flatnonzero(self.plane == plane)
            if self.tolerance.shift_mm > 0:
                places[own] += values[k : k + 3]
                by[own, :, k : k + 3] = np.eye(3)
                k += 3
            if self.tolerance.turn_rad > 0:
                R = matrix_from_rvec(values[k : k + 3])
                turned = board[own] @ R.T
                places[own] += turned - board[own]
                for axis in range(3):  # to first order in the turn: e x (R p)
                    by[own, :, k + axis] = np.cross(np.eye(3)[axis], turned)
                if n_bend:
                    by[own, :, -3:] = np.einsum("ij,njk->nik", R, by[own, :, -3:])
                k += 3
        return places, by

    def results(self, values: FloatArray, sd: FloatArray) -> tuple[RigUnknown, ...]:
        """Return the unknowns after the fit."""
        return tuple(
            RigUnknown(name, unit, float(v), float(s), float(p))
            for (name, unit), v, s, p in zip(self.names, values, sd, self.prior_sd, strict=True)
        )
