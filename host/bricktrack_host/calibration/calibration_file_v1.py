"""Calibration files of version 1 as read today: their covariances know no misfit, and each plane its own."""

from typing import Any

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import CalibrationError
from bricktrack_common.typed_data import convert
from bricktrack_host.calibration.rays.pixel_legendre import monomials_of_legendre
from bricktrack_host.calibration.rays.pixel_polynomials import n_terms

Row = tuple[float, ...]


class _Central(msgspec.Struct, tag_field="model", tag="central"):
    """What changed of central rays: the covariance was of monomials' coefficients."""

    order: int
    covariance_lower: Row


class _TwoPlane(msgspec.Struct, tag_field="model", tag="two-plane"):
    """What changed of two planes: one covariance for each plane, alike in x and y."""

    order: int
    covariance_lower_a: Row
    covariance_lower_b: Row


class _File(msgspec.Struct):
    rays: _Central | _TwoPlane


def upgraded_from_v1(data: dict[str, Any], *, where: str) -> dict[str, Any]:
    """Return the content of a version 1 file as version 2 has it.

    Parameters
    ----------
    data : dict
        The decoded file.
    where : str
        Its name, for messages.

    Raises
    ------
    CalibrationError
        If the rays are not as version 1 stored them.
    """
    rays = convert(data, _File, where=where, error=CalibrationError).rays
    if not 1 <= rays.order <= 20:
        raise CalibrationError(f"{where}: rays.order is {rays.order}; expected 1 to 20")
    m = n_terms(rays.order)
    to_legendre = np.linalg.inv(monomials_of_legendre(rays.order))
    new = {k: v for k, v in data["rays"].items() if not k.startswith("covariance")}
    if isinstance(rays, _Central):
        T = np.eye(2 * m + 3)
        T[:m, :m] = T[m + 1 : 2 * m + 1, m + 1 : 2 * m + 1] = to_legendre
        covariance = T @ _full(rays.covariance_lower, 2 * m + 3, where) @ T.T
    else:
        covariance = np.zeros((4 * m, 4 * m))
        for k, lower in enumerate(2 * (rays.covariance_lower_a, rays.covariance_lower_b)):
            own = slice(k * m, (k + 1) * m)
            covariance[own, own] = to_legendre @ _full(lower, m, where) @ to_legendre.T
    new["covariance_order"] = rays.order
    new["covariance_lower"] = covariance[np.tril_indices(len(covariance))].tolist()
    return {**data, "version": 2, "rays": new}


def _full(lower: Row, n: int, where: str) -> FloatArray:
    if len(lower) != n * (n + 1) // 2:
        raise CalibrationError(
            f"{where}: a covariance of {len(lower)} numbers; expected {n * (n + 1) // 2} for {n} coefficients"
        )
    matrix = np.zeros((n, n))
    matrix[np.tril_indices(n)] = lower
    return np.asarray(matrix + np.tril(matrix, -1).T)
