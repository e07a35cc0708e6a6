"""Ray models as the calibration file holds them, and back: coefficients, covariances and covered regions."""

from typing import Annotated

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_host.calibration.dots.picture_region import ConvexRegion
from bricktrack_host.calibration.rays.central_rays import CentralRays
from bricktrack_host.calibration.rays.fit_residuals import PlaneResiduals
from bricktrack_host.calibration.rays.irt import TwoPlaneIrt
from bricktrack_host.calibration.rays.pixel_polynomials import n_terms

Row = tuple[float, ...]
Order = Annotated[int, msgspec.Meta(ge=1, le=20)]


class CentralRaysRecord(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="model", tag="central"
):
    """`bricktrack_host.calibration.rays.central_rays.CentralRays` as stored.

    Attributes
    ----------
    order : int
    slope_coefficients_x, slope_coefficients_y : tuple of float
        Of s^i t^j by degree i + j, then by j; s and t are u and v scaled to [-1, 1] across the picture.
    centre_mm : (float, float, float), mm, camera frame
    walk_mm : float or None, mm
        How far the pupil walks along the axis for a ray of slope 1; null where it was not let to.
    covariance_order : int
        Highest degree of the covariance's terms.
    covariance_lower : tuple of float
        Lower triangle, row by row, of the covariance of [slope x, x0, slope y, y0, z0] and, with a walking
        pupil, w; the slopes as coefficients of P_i(s) P_j(t), Legendre polynomials, by degree, then by j.
    covered_px : tuple of (float, float), px
        Polygon around the dots seen at any plane.
    """

    order: Order
    slope_coefficients_x: Row
    slope_coefficients_y: Row
    centre_mm: tuple[float, float, float]
    walk_mm: float | None = None
    covariance_order: Order
    covariance_lower: Row
    covered_px: tuple[tuple[float, float], ...]


class TwoPlaneRecord(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="model", tag="two-plane"
):
    """`bricktrack_host.calibration.rays.irt.TwoPlaneIrt` as stored.

    Attributes
    ----------
    order : int
    C_a_mm, D_a_mm, C_b_mm, D_b_mm : tuple of float, mm
        The paper's C (x) and D (y) at planes A and B, of s^i t^j by degree i + j, then by j; s and t are u
        and v scaled to [-1, 1] across the picture.
    covariance_order : int
        Highest degree of the covariance's terms.
    covariance_lower : tuple of float, mm^2
        Lower triangle, row by row, of the covariance of [C at A, C at B, D at A, D at B], as coefficients of
        P_i(s) P_j(t), Legendre polynomials, by degree, then by j.
    covered_a_px, covered_b_px : tuple of (float, float), px
        Polygons around the dots seen at either plane.
    """

    order: Order
    C_a_mm: Row
    D_a_mm: Row
    C_b_mm: Row
    D_b_mm: Row
    covariance_order: Order
    covariance_lower: Row
    covered_a_px: tuple[tuple[float, float], ...]
    covered_b_px: tuple[tuple[float, float], ...]


def record_of(model: CentralRays | TwoPlaneIrt) -> CentralRaysRecord | TwoPlaneRecord:
    """Return what is stored of a ray model."""
    if isinstance(model, CentralRays):
        return CentralRaysRecord(
            order=model.order,
            slope_coefficients_x=_tuple(model.coefficients[0]),
            slope_coefficients_y=_tuple(model.coefficients[1]),
            centre_mm=(float(model.centre_mm[0]), float(model.centre_mm[1]), float(model.centre_mm[2])),
            walk_mm=model.walk_mm if model.walks else None,
            covariance_order=model.covariance_order,
            covariance_lower=_lower(model.covariance),
            covered_px=_corners(model.region),
        )
    return TwoPlaneRecord(
        order=model.order,
        C_a_mm=_tuple(model.coefficients_a[0]),
        D_a_mm=_tuple(model.coefficients_a[1]),
        C_b_mm=_tuple(model.coefficients_b[0]),
        D_b_mm=_tuple(model.coefficients_b[1]),
        covariance_order=model.covariance_order,
        covariance_lower=_lower(model.covariance),
        covered_a_px=_corners(model.region_a),
        covered_b_px=_corners(model.region_b),
    )


def model_of(
    record: CentralRaysRecord | TwoPlaneRecord,
    *,
    sensor_mode: SensorMode,
    plane_a_mm: float,
    plane_b_mm: float,
    residuals: tuple[PlaneResiduals, ...],
) -> CentralRays | TwoPlaneIrt:
    """Return the ray model of a record; the rest is what the calibration says besides.

    Raises
    ------
    CalibrationError
        If the numbers are not as many as the orders want, or a region has less than three corners.
    """
    m, m_covariance = n_terms(record.order), n_terms(record.covariance_order)
    if record.covariance_order < record.order:
        raise CalibrationError(
            f"a covariance of order {record.covariance_order} for rays of order {record.order}: "
            "expected as high"
        )
    if isinstance(record, CentralRaysRecord):
        return CentralRays(
            sensor_mode=sensor_mode,
            plane_a_mm=plane_a_mm,
            plane_b_mm=plane_b_mm,
            order=record.order,
            coefficients=_rows(m, record.slope_coefficients_x, record.slope_coefficients_y),
            centre_mm=np.array(record.centre_mm),
            covariance_order=record.covariance_order,
            covariance=_full(
                record.covariance_lower, 2 * m_covariance + (3 if record.walk_mm is None else 4)
            ),
            region=_region(record.covered_px),
            residuals=residuals,
            walk_mm=record.walk_mm or 0.0,
        )
    return TwoPlaneIrt(
        sensor_mode=sensor_mode,
        plane_a_mm=plane_a_mm,
        plane_b_mm=plane_b_mm,
        order=record.order,
        coefficients_a=_rows(m, record.C_a_mm, record.D_a_mm),
        coefficients_b=_rows(m, record.C_b_mm, record.D_b_mm),
        covariance_order=record.covariance_order,
        covariance=_full(record.covariance_lower, 4 * m_covariance),
        region_a=_region(record.covered_a_px),
        region_b=_region(record.covered_b_px),
        residuals=residuals,
    )


def _tuple(values: FloatArray) -> Row:
    return tuple(float(x) for x in values)


def _lower(matrix: FloatArray) -> Row:
    """Return the lower triangle, to nine digits: a covariance is not known better, and files stay small."""
    return tuple(float(f"{x:.8e}") for x in matrix[np.tril_indices(len(matrix))].tolist())


def _corners(region: ConvexRegion) -> tuple[tuple[float, float], ...]:
    return tuple((float(u), float(v)) for u, v in region.vertices_px)


def _full(lower: Row, n: int) -> FloatArray:
    if len(lower) != n * (n + 1) // 2:
        raise CalibrationError(
            f"a covariance of {len(lower)} numbers; expected {n * (n + 1) // 2} for {n} coefficients"
        )
    matrix = np.zeros((n, n))
    matrix[np.tril_indices(n)] = lower
    return matrix + np.tril(matrix, -1).T


def _rows(n: int, *rows: Row) -> FloatArray:
    for row in rows:
        if len(row) != n:
            raise CalibrationError(f"{len(row)} coefficients; expected {n} for the order given")
    return np.array(rows, dtype=np.float64)


def _region(corners: tuple[tuple[float, float], ...]) -> ConvexRegion:
    if len(corners) < 3:
        raise CalibrationError(f"a covered region of {len(corners)} corners; expected three or more")
    return ConvexRegion(np.array(corners, dtype=np.float64))
