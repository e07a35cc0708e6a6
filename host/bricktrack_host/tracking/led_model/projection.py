"""Where points of space fall in the picture: by the rays' polynomials, quicker than by the camera model."""

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import RayModel
from bricktrack_host.compiled import compiled_fast
from bricktrack_host.tracking.led_model.hit_polynomials import expand_pixel, hit_polynomials
from bricktrack_host.tracking.led_model.led_view import pixel_near

_NEAR_PX = 0.05  # a step from there is exact: what the rays' third derivatives make of it is below 1e-9 px
_MAX_STEPS = 8
_DEPTHS = (0.3, 3.0)  # of the planes, in which rays are taken to be straight lines through the picture


def project_points(points_camera_mm: FloatArray, ray_model: RayModel) -> FloatArray:
    """Return the pixels of points, shape (..., 3), mm, camera frame; as `RayModel.project`, to 1e-5 px.

    Points outside the picture, or far from the planes, are left to the model itself.
    """
    points = np.ascontiguousarray(points_camera_mm.reshape(-1, 3))
    polynomials, mode = hit_polynomials(ray_model), ray_model.sensor_mode
    uv = np.empty((len(points), 2))
    found = _invert(
        points,
        polynomials.cells,
        polynomials.cell_px,
        float(polynomials.plane_a_mm),
        float(polynomials.plane_b_mm),
        float(mode.width),
        float(mode.height),
        uv,
        np.empty((1, 6, 4)),
    )
    if found < len(points):
        rest = np.isnan(uv[:, 0])
        uv[rest] = ray_model.project(points[rest]).uv_px
    return uv.reshape(*points_camera_mm.shape[:-1], 2)


@compiled_fast
def _invert(
    points: FloatArray,
    cells: FloatArray,
    cell_px: float,
    plane_a: float,
    plane_b: float,
    width: float,
    height: float,
    uv: FloatArray,
    hits: FloatArray,
) -> int:
    """Fill in pixels, NaN where there is none in the picture; return how many there are.

    Newton's method from the picture's middle, with the rays' second derivatives.
    """
    n_found = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        uv[i, 0], uv[i, 1] = np.nan, np.nan
        if not _DEPTHS[0] * plane_a < z < _DEPTHS[1] * plane_b:
            continue
        u, v = 0.5 * (width - 1), 0.5 * (height - 1)
        for _ in range(_MAX_STEPS):
            expand_pixel(u, v, cells, cell_px, hits, 0)
            du, dv, _, _, _, _, _, _ = pixel_near(x, y, (z - plane_a) / (plane_b - plane_a), hits, 0)
            is_near = abs(du) < _NEAR_PX and abs(dv) < _NEAR_PX
            u, v = u + du, v + dv
            is_inside = 0 <= u <= width - 1 and 0 <= v <= height - 1
            if is_near and is_inside:
                uv[i, 0], uv[i, 1] = u, v
                n_found += 1
            if is_near or not (u == u and v == v):
                break
            u, v = min(max(u, 0.0), width - 1), min(max(v, 0.0), height - 1)
    return n_found
