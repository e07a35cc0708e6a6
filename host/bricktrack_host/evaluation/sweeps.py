"""The known positions of the source paper's section 6.2: depth, corner to corner, rotations, orientations."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.rotations import matrix_from_rvec

ROTATION_LIMIT_DEG = 30.0
IDENTITY_LIMIT_DEG = 45.0


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Known poses, one a step.

    Attributes
    ----------
    name : str
    step : ndarray, shape (n,)
        Where on the sweep: mm or degrees.
    unit : "mm" or "deg"
    R_camera_brick : ndarray, shape (n, 3, 3)
    t_camera_brick_mm : ndarray, shape (n, 3), mm
    """

    name: str
    step: FloatArray
    unit: str
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray

    def __len__(self) -> int:
        return len(self.step)


def paper_sweeps(
    brick: BrickModel, *, plane_a_mm: float, plane_b_mm: float, half_field: tuple[float, float]
) -> list[Sweep]:
    """Return the paper's sweeps for a brick before a camera.

    Parameters
    ----------
    brick : BrickModel
    plane_a_mm, plane_b_mm : float, mm
        The LEDs' middle goes from one plane to the other in steps of 1 mm.
    half_field : (float, float)
        Slopes x/z and y/z of the picture's borders, the smaller of either side.
    """
    low, high = brick.led_positions_mm.min(axis=0), brick.led_positions_mm.max(axis=0)
    middle = 0.5 * (low + high)
    between_mm = 0.5 * (plane_a_mm + plane_b_mm)
    depth = np.arange(plane_a_mm, plane_b_mm + 1e-9, 1.0)
    straight = np.zeros((len(depth), 2))
    sweeps = [
        _sweep("between the planes", depth - depth[0], "mm", np.column_stack([straight, depth]), middle)
    ]
    # From one corner of the picture to the other, as far as every LED stays in it.
    rim = 1.5 * float(brick.led_radii_mm.max()) + 0.5 * (high - low)[:2]
    reach = np.maximum(np.array(half_field) * (between_mm - 0.5 * (high - low)[2]) - rim, 0.0)
    length = float(np.hypot(*reach))
    n = max(round(2 * length), 2) + 1
    along = np.linspace(-1, 1, n)
    places = np.column_stack([along[:, None] * reach, np.full(n, between_mm)])
    sweeps.append(_sweep("corner to corner", (along + 1) * length, "mm", places, middle))
    angle = np.arange(-ROTATION_LIMIT_DEG, ROTATION_LIMIT_DEG + 1e-9, 1.0)
    fixed = np.tile([0.0, 0.0, between_mm], (len(angle), 1))
    for axis, name in enumerate("xyz"):
        rvec = np.zeros((len(angle), 3))
        rvec[:, axis] = np.radians(angle)
        sweeps.append(_sweep(f"rotation about {name}", angle, "deg", fixed, middle, matrix_from_rvec(rvec)))
    return sweeps


def random_orientations(
    brick: BrickModel, n: int, *, plane_a_mm: float, plane_b_mm: float, rng: np.random.Generator
) -> Sweep:
    """Return orientations with three simultaneous angles up to 45 degrees, midway between the planes."""
    limit = np.radians(IDENTITY_LIMIT_DEG)
    angles = rng.uniform(-limit, limit, (n, 3))
    R = [matrix_from_rvec(np.where(np.arange(3) == k, angles, 0.0)) for k in range(3)]
    middle = 0.5 * (brick.led_positions_mm.min(axis=0) + brick.led_positions_mm.max(axis=0))
    place = np.tile([0.0, 0.0, 0.5 * (plane_a_mm + plane_b_mm)], (n, 1))
    turned = np.asarray(R[0] @ R[1] @ R[2])
    return _sweep("orientations", np.arange(n, dtype=np.float64), "", place, middle, turned)


def _sweep(
    name: str,
    step: FloatArray,
    unit: str,
    middle_camera_mm: FloatArray,
    middle_brick_mm: FloatArray,
    R: FloatArray | None = None,
) -> Sweep:
    turned = np.tile(np.eye(3), (len(step), 1, 1)) if R is None else R
    return Sweep(name, step, unit, turned, middle_camera_mm - turned @ middle_brick_mm)
