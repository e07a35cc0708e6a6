"""Whether the lights are as large as the layout's LEDs must look from where the poses put the brick.

A light that ran together with its own reflection in a glossy face, or with glare, has its middle elsewhere.
Where that befalls most LEDs alike, they agree with each other on a pose that is millimetres off, and an LED
that shows itself alone looks like the odd one. Their size gives them away.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.led_model.led_profile import collar_of, predict_brick
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracks import LedObservations, OpticalTrack

_LARGER = 1.2
"""Of the area: on 18 recordings of an independent renderer, with lights dim to blown out and pictures sharp
to blurred, the medians of LEDs that were seen alone are 0.90 to 1.03 of what is expected; with their own
reflections run into them 1.4 to 1.5 (simulated)."""
_SEEN_WELL = 0  # no flag: whole, alone, and not smeared
_MIN_FRAMES = 5
_UNKNOWN_COLLAR_RADII = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class LedSizes:
    """How large the lights are.

    Attributes
    ----------
    ratio : ndarray, shape (n_leds,)
        Of their area over what layout and pose explain, the median of frames; NaN where too few tell.
    radius_px : ndarray, shape (n_leds,), px
        What is expected.
    """

    ratio: FloatArray
    radius_px: FloatArray

    @property
    def sd_px(self) -> FloatArray:
        """How far the middle of each light may lie elsewhere, in either direction, shape (n_leds,).

        A second disc of the same size, d beside the first, adds 2 r d to the area and moves the middle by
        d / 2: by pi / 4 of the radius times the excess, in a direction that nothing tells.
        """
        excess = np.where(np.nan_to_num(self.ratio) > _LARGER, self.ratio - 1, 0.0)
        return np.asarray(np.pi / 4 * excess * np.nan_to_num(self.radius_px) / np.sqrt(2))

    def words(self, brick: BrickModel, *, in_covariance: bool) -> list[str]:
        """Return what to say of LEDs whose light is larger than the layout's radius and collar explain."""
        large = np.flatnonzero(self.sd_px)
        if not large.size:
            return []
        named = ", ".join(f"{brick.led_names[k]} {self.ratio[k]:.2f}" for k in large)
        hold = "hold that, and no more can be believed" if in_covariance else "do not hold that"
        return [
            f"LEDs look larger than the layout has them ({named} times the area): run together with their "
            "reflections or with glare, or of another radius. Their middles are then elsewhere, and all "
            f"poses off alike, by millimetres along the view: the standard deviations {hold}. Look at "
            "'bricktrack overlay RUN'; dull what reflects, expose shorter, or correct the radii"
        ]


def led_sizes(
    observations: LedObservations, optical: OpticalTrack, rays: RayModel, brick: BrickModel
) -> LedSizes:
    """Return how large the lights are against what layout and poses explain.

    Parameters
    ----------
    observations, optical : LedObservations, OpticalTrack
        Of the same frames.
    rays, brick : RayModel, BrickModel
    """
    frames = np.flatnonzero(all_finite(optical.t_camera_brick_mm, 1))
    collar_mm = collar_of(brick)
    if collar_mm is None:
        collar_mm = _UNKNOWN_COLLAR_RADII * float(np.median(brick.led_radii_mm))
    expected, _ = predict_brick(
        optical.R_camera_brick[frames], optical.t_camera_brick_mm[frames], rays, brick, collar_mm=collar_mm
    )
    well = observations.led_flags[frames] == _SEEN_WELL
    well &= (observations.area_px2[frames] > 0) & (expected.facing > 0)
    enough = well.sum(axis=0) >= _MIN_FRAMES

    def median(values: FloatArray) -> FloatArray:
        return np.array(
            [np.median(v[w]) if e else np.nan for v, w, e in zip(values.T, well.T, enough, strict=True)]
        )

    seen_px2, expected_px2 = observations.area_px2[frames], expected.area_px2
    ratio = np.divide(seen_px2, expected_px2, out=np.full(well.shape, np.nan), where=well)
    return LedSizes(median(ratio), np.sqrt(median(expected_px2) / np.pi))
