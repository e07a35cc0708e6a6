"""Which blob is which LED, for any layout, from nothing.

Poses from triples of blobs and LEDs (`identity_search`), the likeliest of them fitted to the pixels
(`verification`) and compared by their `evidence` (`identity_verdict`). `pattern` carries identities from
picture to picture, and `paper_rules` has the source paper's way for its own layout.
"""

from collections.abc import Sequence

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.tracking.identity.assigned_lights import MIN_INLIERS
from bricktrack_host.tracking.identity.identity_candidates import N_KEPT, Candidates, Pattern
from bricktrack_host.tracking.identity.identity_search import Lights, propose
from bricktrack_host.tracking.identity.identity_verdict import Pictures
from bricktrack_host.tracking.identity.verification import (
    MIN_FACING,
    Correspondence,
    identity_gate_px,
    no_correspondence,
    verified_correspondence,
)
from bricktrack_host.tracking.led_model.hit_polynomials import expand_at, hit_polynomials
from bricktrack_host.tracking.pictures.segment import Blobs
from bricktrack_host.tracking.pose.p3p import ray_centre_mm

MAX_SEARCH_BLOBS = 12
_SHOWN_AREA = 0.8  # of its disc: a dome shows between half and all of it


def search_correspondence(
    blobs: Blobs, ray_model: RayModel, brick_model: BrickModel, *, collar_mm: float | None
) -> Correspondence:
    """Identify the LEDs of any layout in one picture from nothing; see `search_correspondences`."""
    return search_correspondences([blobs], ray_model, brick_model, collar_mm=collar_mm)[0]


def search_correspondences(
    pictures: Sequence[Blobs], ray_model: RayModel, brick_model: BrickModel, *, collar_mm: float | None
) -> list[Correspondence]:
    """Identify the LEDs of any layout from nothing, in each picture for itself.

    Parameters
    ----------
    pictures : sequence of Blobs
        LEDs, false lights among them; of more than twelve, those of the likeliest shape and size are taken.
    ray_model : RayModel
    brick_model : BrickModel
    collar_mm : float or None
        See `led_profile`.

    Returns
    -------
    list of Correspondence
        LEDs whose lights are in doubt are left out. Ambiguous where that leaves fewer than four, or four in a
        line, or where false lights alone would fit as well in more than one picture of 1000. Two
        poses of one assignment are no ambiguity of identity: the poses' stage tells them apart, or says so.

    Raises
    ------
    TrackingError
        If the layout has no triple of LEDs out of line.
    """
    P = brick_model.led_positions_mm
    if np.linalg.matrix_rank(P - P[0], tol=1e-6) < 2:
        raise TrackingError("layout: all LEDs stand in one line; a pose needs three that do not")
    n, n_leds = len(pictures), brick_model.n_leds
    out = [no_correspondence(n_leds, f"{len(b)} blobs; four are needed") for b in pictures]
    searched = np.array([i for i in range(n) if len(pictures[i]) >= MIN_INLIERS], dtype=np.int64)
    if searched.size == 0:
        return out
    chosen = [_likeliest(pictures[i]) for i in searched]
    blobs = [b for b, _ in chosen]
    found, centre, radius_px = _candidates(blobs, ray_model, brick_model)
    of, number = np.nonzero(np.arange(N_KEPT) < found.number[:, None])
    for empty in np.flatnonzero(found.number == 0):
        out[searched[empty]] = no_correspondence(n_leds, "no pose brings four LEDs onto blobs")
    if of.size == 0:
        return out
    seen = Pictures(
        blobs,
        ray_model,
        brick_model,
        collar_mm=collar_mm,
        gate_px=np.array([identity_gate_px(r) for r in radius_px]),
    )
    start = (found.R[of, number], found.t[of, number] + centre)
    verdict = seen.decide(of, found.blob_of_led[of, number], start)
    for row, i in enumerate(searched):
        if found.number[row] == 0:
            continue
        at, n_lit = verdict.row[row], len(blobs[row])
        if at < 0:
            out[i] = no_correspondence(n_leds, "no pose explains four LEDs within the gate")
        elif verdict.is_chance[row]:
            reason = f"among {n_lit} lights, {verdict.n_leds[row]} fit as well by chance"
            out[i] = no_correspondence(n_leds, reason, ambiguous=True)
        elif verdict.has_rival[row]:
            out[i] = no_correspondence(n_leds, "two assignments fit equally well", ambiguous=True)
        else:
            answer = verdict.blob_of_led[row]
            answer = np.where(answer >= 0, chosen[row][1][np.maximum(answer, 0)], -1)
            out[i] = verified_correspondence(answer, verdict.poses, at)
    return out


def _likeliest(blobs: Blobs) -> tuple[Blobs, IntArray]:
    """Return the blobs most like LEDs, at most `MAX_SEARCH_BLOBS`, and their indices."""
    index = np.arange(len(blobs))
    if len(blobs) <= MAX_SEARCH_BLOBS:
        return blobs, index
    usual = np.median(blobs.area_px2[blobs.flags == 0]) if (blobs.flags == 0).any() else 1.0
    odd = (blobs.flags != 0) * 2.0 + np.abs(np.log(blobs.area_px2 / usual)) + 10 * np.abs(1 - blobs.fill)
    index = np.sort(np.argsort(odd, kind="stable")[:MAX_SEARCH_BLOBS])
    return blobs.take(index), index


def _candidates(
    blobs: Sequence[Blobs], ray_model: RayModel, brick_model: BrickModel
) -> tuple[Candidates, FloatArray, FloatArray]:
    """Return candidates of all pictures, the rays' common point, and the radius of an LED in each, px."""
    n, n_leds = len(blobs), brick_model.n_leds
    count = np.array([len(b) for b in blobs])
    most = int(count.max())
    here = np.arange(most) < count[:, None]

    def padded(name: str) -> FloatArray:
        first = getattr(blobs[0], name)
        out = np.full((n, most, *first.shape[1:]), np.nan)
        out[here] = np.concatenate([getattr(b, name) for b in blobs])
        return out

    uv, area, whole = padded("uv_px"), padded("area_px2"), padded("flags") == 0
    centre = ray_centre_mm(ray_model)
    hits = expand_at(hit_polynomials(ray_model), uv)
    d = np.concatenate([hits[..., 0, :2], np.full((n, most, 1), ray_model.plane_a_mm)], axis=-1) - centre
    distance_a = np.linalg.norm(d, axis=-1)
    M = hits[..., 1:3, :2]
    px_per_mm = 1 / np.sqrt(np.abs(M[..., 0, 0] * M[..., 1, 1] - M[..., 0, 1] * M[..., 1, 0]))
    radius_px = np.sqrt(area / np.pi / _SHOWN_AREA)
    radius_mm = float(np.median(brick_model.led_radii_mm))
    distance = distance_a * px_per_mm * radius_mm / np.maximum(radius_px, 1e-6)
    usual_px = np.nanmedian(radius_px, axis=1)
    px_per_slope = np.nanmedian(px_per_mm * d[..., 2], axis=1)
    P, mode = brick_model.led_positions_mm, ray_model.sensor_mode
    pattern = Pattern(
        P=np.ascontiguousarray(P),
        N=np.ascontiguousarray(brick_model.led_axes),
        gaps=np.linalg.norm(P[:, None] - P[None], axis=-1),
        radius=usual_px / px_per_slope,
        picture_area=mode.width * mode.height / float(np.median(px_per_slope)) ** 2,
        min_facing=MIN_FACING,
    )
    lights = Lights(
        bearings=d / distance_a[..., None],
        slopes=np.ascontiguousarray(d[..., :2] / d[..., 2:]),
        distance_mm=np.where(whole, distance, np.nan),
        number=count,
    )
    out = Candidates(
        blob_of_led=np.full((n, N_KEPT, n_leds), -1, dtype=np.int64),
        R=np.full((n, N_KEPT, 3, 3), np.nan),
        t=np.full((n, N_KEPT, 3), np.nan),
        number=np.zeros(n, dtype=np.int64),
    )
    propose(lights, pattern, out)
    return out, centre, usual_px
