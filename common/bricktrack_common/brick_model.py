"""Where the LEDs and the inertial sensor sit on a brick: the layout file.

Brick frame: origin at the first LED (m0 of the paper), axes as in the drawing, mm.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.errors import ConfigError
from bricktrack_common.typed_data import load_toml

MIN_LEDS = 5
_MIN_DEPTH_MM = 1.0  # thinner than this, the pseudo-inverse H of PRSOI amplifies centroid noise without bound

_Vector = tuple[float, float, float]
_Positive = Annotated[float, msgspec.Meta(gt=0)]


class LedEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[led]]`` of a layout file."""

    name: Annotated[str, msgspec.Meta(min_length=1)]
    position_mm: _Vector
    axis: _Vector
    radius_mm: _Positive


class ImuEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[imu]`` of a layout file: where the sensor is, and how its axes lie in the brick's."""

    lever_arm_mm: _Vector
    rotation: tuple[_Vector, _Vector, _Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


DEFAULT_SHIFT_SD_PER_RADIUS = 0.005
"""Of an LED profile that does not say how good it is, as one from a drawing: limb darkening and the lens put
the middle of the light up to 0.008 of radius times sine beside that of the shape (simulated)."""


class ProfileEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[led_profile]`` of a layout file: the shape that an LED of this type shows.

    Attributes
    ----------
    collar_mm : float
        Length of the lit cylinder behind the dome's sphere centre. Below zero there is none, and the dome is
        so much taller than half a sphere.
    source : str
        How the figure was had: a fit names its recording. Never assumed.
    shift_sd_per_radius : float
        How far off the shape may be, as a standard deviation: a shift of the light's middle along the LED's
        axis, over the LED's radius and the sine of the angle that it is seen at.
    """

    collar_mm: Annotated[float, msgspec.Meta(ge=-50, le=50)]
    source: Annotated[str, msgspec.Meta(min_length=1)]
    shift_sd_per_radius: Annotated[float, msgspec.Meta(ge=0, le=0.2)] = DEFAULT_SHIFT_SD_PER_RADIUS


class LayoutFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A layout file as written."""

    version: Annotated[int, msgspec.Meta(ge=1, le=1)] = 1
    name: str = ""
    led: list[LedEntry]
    imu: ImuEntry | None = None
    led_profile: ProfileEntry | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BrickModel:
    """A checked layout.

    Attributes
    ----------
    name : str
    led_names : tuple of str
        In the file's order; index 0 is the origin LED.
    led_positions_mm : ndarray, shape (n, 3), mm, brick frame
        Centres of the domes' spheres; row 0 is zero.
    led_axes : ndarray, shape (n, 3), brick frame
        Unit vectors out of the wall, along which the domes look.
    led_radii_mm : ndarray, shape (n,), mm
    imu_lever_arm_mm : ndarray, shape (3,), mm, brick frame, or None
        From the origin LED to the inertial sensor.
    R_brick_imu : ndarray, shape (3, 3), or None
    led_profile : ProfileEntry or None
        `None`: the shape of this LED type was never fitted; centroids then carry a wider covariance.
    """

    name: str
    led_names: tuple[str, ...]
    led_positions_mm: FloatArray
    led_axes: FloatArray
    led_radii_mm: FloatArray
    imu_lever_arm_mm: FloatArray | None
    R_brick_imu: FloatArray | None
    led_profile: ProfileEntry | None

    @property
    def n_leds(self) -> int:
        """Number of LEDs."""
        return len(self.led_names)


def load_brick_model(path: Path) -> BrickModel:
    """Return the layout of a TOML file, checked.

    Raises
    ------
    ConfigError
        If a key is unknown, missing or wrong, if there are fewer than five LEDs, two names or places are
        the same, the first LED is not the origin, an axis is no direction, or all LEDs lie in a plane:
        PRSOI needs the third dimension.
    """
    file = load_toml(path, LayoutFile)
    return brick_model_from_file(file, where=str(path))


def brick_model_from_file(file: LayoutFile, *, where: str) -> BrickModel:
    """Check a `LayoutFile` and return its `BrickModel`; see `load_brick_model`."""
    names = tuple(led.name for led in file.led)
    if len(names) < MIN_LEDS:
        raise ConfigError(f"{where}: led: {len(names)} LEDs; a pose needs at least {MIN_LEDS}")
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise ConfigError(f"{where}: led: the name '{twice}' stands twice")
    positions = np.array([led.position_mm for led in file.led])
    if not np.isfinite(positions).all():
        raise ConfigError(f"{where}: led: a position is not a number")
    if np.abs(positions[0]).max() > 1e-9:
        raise ConfigError(
            f"{where}: led[0].position_mm: {positions[0].tolist()}; the first LED is the origin of the brick "
            "frame and must be at [0, 0, 0]"
        )
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + np.diag([np.inf] * len(names))
    if gaps.min() < 0.1:
        i, j = np.unravel_index(np.argmin(gaps), gaps.shape)
        raise ConfigError(f"{where}: led: '{names[i]}' and '{names[j]}' are {gaps.min():.3f} mm apart")
    depth_mm = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)[-1]
    if depth_mm < _MIN_DEPTH_MM:
        raise ConfigError(
            f"{where}: led: all {len(names)} LEDs lie in one plane (to {depth_mm:.3f} mm); at least one must "
            f"stand out of it by more than {_MIN_DEPTH_MM:g} mm for the depth and tilt to be found"
        )
    axes = np.array([led.axis for led in file.led])
    lengths = np.linalg.norm(axes, axis=1)
    if not np.all(np.abs(lengths - 1) < 1e-3):
        worst = int(np.argmax(np.abs(lengths - 1)))
        raise ConfigError(f"{where}: led[{worst}].axis: length {lengths[worst]:.4f}; expected a unit vector")
    lever_arm, R_brick_imu = None, None
    if file.imu is not None:
        lever_arm = np.array(file.imu.lever_arm_mm)
        R_brick_imu = np.array(file.imu.rotation)
        if np.abs(R_brick_imu @ R_brick_imu.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R_brick_imu) < 0:
            raise ConfigError(f"{where}: imu.rotation: not a rotation matrix")
    return BrickModel(
        name=file.name,
        led_names=names,
        led_positions_mm=positions,
        led_axes=axes / lengths[:, None],
        led_radii_mm=np.array([led.radius_mm for led in file.led]),
        imu_lever_arm_mm=lever_arm,
        R_brick_imu=R_brick_imu,
        led_profile=file.led_profile,
    )
