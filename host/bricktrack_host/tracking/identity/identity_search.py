"""Compiled: all poses that bring LEDs of a layout onto lights of a picture, the likeliest ones first.

Every three lights are tried as every three LEDs that their sizes allow (`p3p`); a pose counts by how many
other LEDs it brings onto lights. The best are kept and fitted (`identity_candidates`); `correspondence`
decides among the few that are left.
"""

import math
from typing import NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_in_place
from bricktrack_host.tracking.identity.identity_candidates import (
    N_SLOTS,
    Candidates,
    Pattern,
    Room,
    Slots,
    fit_slots,
    hand_on,
    hits,
    keep,
)
from bricktrack_host.tracking.pose.p3p import pose_of_three, triangle_distances

NEAREST, FARTHEST = 0.65, 1.55
"""Of the distance that a light's size tells: LEDs show from half to all of their disc, some glare more."""
_SAME_SCALE = 1.5  # of the distances told by lights of one picture: half a disc against a whole one, and some
_GATE_RADII = 0.8  # poses from three lights are off by what domes shift centroids, up to a fifth of a radius


class Lights(NamedTuple):
    """Lights of n pictures, at most B each: bearings (n, B, 3), slopes (n, B, 2), distances, number (n,).

    Distances, (n, B), mm, are what the sizes tell; NaN where a light is not whole.
    """

    bearings: FloatArray
    slopes: FloatArray
    distance_mm: FloatArray
    number: IntArray


@compiled
def propose(lights: Lights, pattern: Pattern, out: Candidates) -> None:
    """Fill in the candidates of all pictures."""
    n, n_lights = lights.distance_mm.shape
    n_leds = len(pattern.P)
    possible = np.empty((n_lights, n_lights, n_leds, n_leds), dtype=np.bool_)
    slots = Slots(
        np.empty((N_SLOTS, n_leds), dtype=np.int64),
        np.empty((N_SLOTS, 3, 3)),
        np.empty((N_SLOTS, 3)),
        np.empty(N_SLOTS),
        np.zeros(1, dtype=np.int64),
    )
    room = Room(
        np.empty(4),
        np.empty((4, 3)),
        np.empty((3, 3, 3)),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(n_leds, dtype=np.int64),
        np.empty(n_leds),
        np.empty((n_lights, n_lights)),
        np.empty((6, 6)),
        np.empty(6),
        np.empty((6, 6)),
        np.empty(6),
        np.empty((3, 3)),
        np.empty((2, 6)),
    )
    for i in range(n):
        f, s, z, count = lights.bearings[i], lights.slopes[i], lights.distance_mm[i], lights.number[i]
        _possible_pairs(f, z, count, pattern.gaps, possible)
        slots.number[0] = 0
        _try_triples(f, s, z, count, pattern, pattern.radius[i], possible, slots, room)
        fit_slots(s, count, pattern, pattern.radius[i], slots, room)
        hand_on(slots, out, i)


@compiled_in_place
def _possible_pairs(f: FloatArray, z: FloatArray, count: int, gaps: FloatArray, possible: BoolArray) -> None:
    """Fill in which two LEDs two lights can be, by the LEDs' distance and what the lights' sizes tell."""
    for i in range(count):
        for j in range(count):
            cosine = f[i, 0] * f[j, 0] + f[i, 1] * f[j, 1] + f[i, 2] * f[j, 2]
            sine = math.sqrt(max(1 - cosine * cosine, 0.0))
            known_i, known_j = math.isfinite(z[i]), math.isfinite(z[j])
            near_i, near_j = NEAREST * z[i] if known_i else 0.0, NEAREST * z[j] if known_j else 0.0
            far_i, far_j = FARTHEST * z[i] if known_i else 1e9, FARTHEST * z[j] if known_j else 1e9
            least = sine * max(near_i, near_j)
            most = math.hypot(
                math.sqrt(max(2 - 2 * cosine, 0.0)) * max(far_i, far_j), max(far_i - near_j, far_j - near_i)
            )
            for a in range(len(gaps)):
                for b in range(len(gaps)):
                    possible[i, j, a, b] = a != b and i != j and least <= gaps[a, b] <= most


@compiled_in_place
def _try_triples(
    f: FloatArray,
    s: FloatArray,
    z: FloatArray,
    count: int,
    pattern: Pattern,
    radius: float,
    possible: BoolArray,
    slots: Slots,
    room: Room,
) -> None:
    P, N, gaps, min_facing = pattern.P, pattern.N, pattern.gaps, pattern.min_facing
    n_leds = len(P)
    four, distance, triads, R, t = room.four, room.distance, room.triads, room.R, room.t
    hit, apart, cosine = room.hit, room.apart, room.cosine
    for i in range(count):
        for j in range(count):
            cosine[i, j] = f[i, 0] * f[j, 0] + f[i, 1] * f[j, 1] + f[i, 2] * f[j, 2]
    gate = _GATE_RADII * radius
    for i in range(count):
        for j in range(i + 1, count):
            for a in range(n_leds):
                for b in range(n_leds):
                    if not possible[i, j, a, b]:
                        continue
                    for k in range(j + 1, count):
                        for c in range(n_leds):
                            if not (possible[i, k, a, c] and possible[j, k, b, c]):
                                continue
                            found = triangle_distances(
                                gaps[b, c] ** 2,
                                gaps[a, c] ** 2,
                                gaps[a, b] ** 2,
                                cosine[j, k],
                                cosine[i, k],
                                cosine[i, j],
                                four,
                                distance,
                            )
                            for m in range(found):
                                if not _sizes_agree(
                                    distance[m, 0], distance[m, 1], distance[m, 2], z[i], z[j], z[k]
                                ):
                                    continue
                                if not pose_of_three(f, i, j, k, P, a, b, c, distance[m], R, t, triads):
                                    continue
                                if not (
                                    _facing(R, N, a, f, i) > min_facing
                                    and _facing(R, N, b, f, j) > min_facing
                                    and _facing(R, N, c, f, k) > min_facing
                                ):
                                    continue
                                score = hits(R, t, P, N, s, count, gate, hit, apart)
                                if score > 0:
                                    keep(slots, hit, R, t, score)


@compiled_in_place
def _sizes_agree(d0: float, d1: float, d2: float, z0: float, z1: float, z2: float) -> bool:
    """Tell whether distances are what the lights' sizes, where known, allow; each, and in their ratios."""
    least, most = np.inf, 0.0
    for d, z in ((d0, z0), (d1, z1), (d2, z2)):
        if math.isfinite(z):
            ratio = d / z
            if not NEAREST <= ratio <= FARTHEST:
                return False
            least, most = min(least, ratio), max(most, ratio)
    return most <= _SAME_SCALE * least


@compiled_in_place
def _facing(R: FloatArray, N: FloatArray, k: int, f: FloatArray, i: int) -> float:
    total = 0.0
    for r in range(3):
        total -= f[i, r] * (R[r, 0] * N[k, 0] + R[r, 1] * N[k, 1] + R[r, 2] * N[k, 2])
    return total
