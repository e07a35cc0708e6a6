"""Whether the lights are as large as the layout's LEDs must look from where the poses put the brick.

A light that ran together with its own reflection in a glossy face, or with glare, has its middle elsewhere.
Where that befalls most LEDs alike, they agree with each other on a pose that is millimetres off, and an LED
that shows itself alone looks like the odd one. Their size gives them away.
"""

import numpy as np

from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.tracking.led_model.led_profile import collar_of, predict_brick
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracks import LedObservations, OpticalTrack

_LARGER = 1.2
"""Of the area: on 18 recordings of an independent renderer, with lights dim to blown out and pictures sharp
to blurred, the medians of LEDs that were seen alone are 0.90 to 1.03 of what is expected; with their own
reflections run into them 1.4 to 1.5."""
_SEEN_WELL = 0  # no flag: whole, alone, and not smeared
_MIN_FRAMES = 5
_UNKNOWN_COLLAR_RADII = 0.2


def words_on_sizes(
    observations: LedObservations, optical: OpticalTrack, rays: RayModel, brick: BrickModel
) -> list[str]:
    """Return what to say of LEDs whose light is larger than the layout's radius and collar explain.

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
    ratio = np.divide(
        observations.area_px2[frames], expected.area_px2, out=np.full(well.shape, np.nan), where=well
    )
    enough = well.sum(axis=0) >= _MIN_FRAMES
    of_led = np.array([np.nanmedian(r) if e else np.nan for r, e in zip(ratio.T, enough, strict=True)])
    large = np.flatnonzero(np.nan_to_num(of_led) > _LARGER)
    if not large.size:
        return []
    named = ", ".join(f"{brick.led_names[k]} {of_led[k]:.2f}" for k in large)
    return [
        f"LEDs look larger than the layout has them ({named} times the area): run together with their "
        "reflections or with glare, or of another radius. Their middles are then elsewhere, and poses may be "
        "millimetres off by more than they state. Look at 'bricktrack overlay RUN'; dull what reflects, "
        "expose shorter, or correct the radii"
    ]
