"""Compiled: the likeliest poses of a picture so far, and what is made of them when all were tried.

They are fitted to all their LEDs, taken for points seen from the rays' common point: good to a few pixels,
and enough to rank them.
"""

import math
from typing import NamedTuple

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled_in_place
from bricktrack_host.tracking.pose.small_algebra import rotation, solve

N_KEPT = 12
"""Candidates a picture that are handed on."""
N_SLOTS = 64
_FITTED_GATE_RADII = 0.4
_POINT_SD_RADII = 0.03  # of a fitted LED's place, taken for a point, at least
_SAME_TURN = 0.01  # 3 - trace of the turn between two poses that are one: 6 degrees
_WORSE = 40.0  # log likelihood below the best at which a candidate is not worth a look


class Pattern(NamedTuple):
    """LEDs: positions, axes, the distances between them.

    ``radius`` (n,) is that of an LED in each picture and ``picture_area`` that of a picture, in slopes;
    ``min_facing`` the cosine to the line of sight from which on LEDs are believed to be seen.
    """

    P: FloatArray
    N: FloatArray
    gaps: FloatArray
    radius: FloatArray
    picture_area: float
    min_facing: float


class Candidates(NamedTuple):
    """Results: light of each LED (n, N_KEPT, L), -1 for none, poses from the rays' common point, number."""

    blob_of_led: IntArray
    R: FloatArray
    t: FloatArray
    number: IntArray


class Slots(NamedTuple):
    """The best poses so far: assignments, poses, scores, their number."""

    blob_of_led: IntArray
    R: FloatArray
    t: FloatArray
    score: FloatArray
    number: IntArray


class Room(NamedTuple):
    """Room to work in: for the distances and poses of triples, and for the fits."""

    four: FloatArray
    distance: FloatArray
    triads: FloatArray
    R: FloatArray
    t: FloatArray
    hit: IntArray
    apart: FloatArray
    cosine: FloatArray
    A: FloatArray
    g: FloatArray
    L: FloatArray
    x: FloatArray
    E: FloatArray
    J: FloatArray


@compiled_in_place
def hits(
    R: FloatArray,
    t: FloatArray,
    P: FloatArray,
    N: FloatArray,
    s: FloatArray,
    count: int,
    gate: float,
    hit: IntArray,
    apart: FloatArray,
) -> float:
    """Put the light of each LED into ``hit``; return how many there are, less half their mean distance.

    A light serves the nearest LED alone. The score is zero below four.
    """
    n_leds = len(P)
    n_hits = 0
    for k in range(n_leds):
        hit[k], apart[k] = -1, gate
        x = R[0, 0] * P[k, 0] + R[0, 1] * P[k, 1] + R[0, 2] * P[k, 2] + t[0]
        y = R[1, 0] * P[k, 0] + R[1, 1] * P[k, 1] + R[1, 2] * P[k, 2] + t[1]
        z = R[2, 0] * P[k, 0] + R[2, 1] * P[k, 1] + R[2, 2] * P[k, 2] + t[2]
        if not z > 1.0:
            continue
        ax = R[0, 0] * N[k, 0] + R[0, 1] * N[k, 1] + R[0, 2] * N[k, 2]
        ay = R[1, 0] * N[k, 0] + R[1, 1] * N[k, 1] + R[1, 2] * N[k, 2]
        az = R[2, 0] * N[k, 0] + R[2, 1] * N[k, 1] + R[2, 2] * N[k, 2]
        if not ax * x + ay * y + az * z < 0:
            continue
        u, v, nearest = x / z, y / z, gate * gate
        for i in range(count):
            d2 = (u - s[i, 0]) ** 2 + (v - s[i, 1]) ** 2
            if d2 < nearest:
                nearest, hit[k] = d2, i
        if hit[k] >= 0:
            apart[k] = math.sqrt(nearest)
            n_hits += 1
            for other in range(k):
                if hit[other] == hit[k]:
                    loser = other if apart[k] < apart[other] else k
                    hit[loser] = -1
                    n_hits -= 1
                    break
    if n_hits < 4:
        return 0.0
    total = 0.0
    for k in range(n_leds):
        if hit[k] >= 0:
            total += apart[k] / gate
    return n_hits - 0.5 * total / n_hits


@compiled_in_place
def keep(slots: Slots, hit: IntArray, R: FloatArray, t: FloatArray, score: float) -> None:
    """Keep a pose if it is among the best; of those that are one, the better."""
    worst, at = 0, -1
    for i in range(slots.number[0]):
        if slots.score[i] < slots.score[worst]:
            worst = i
        if at < 0 and _same(hit, slots.blob_of_led[i]) and 3 - _trace(R, slots.R[i]) < _SAME_TURN:
            at = i
    if at >= 0:
        if score <= slots.score[at]:
            return
    elif slots.number[0] < N_SLOTS:
        at = slots.number[0]
        slots.number[0] += 1
    elif score > slots.score[worst]:
        at = worst
    else:
        return
    _put(slots, at, hit, R, t, score)


@compiled_in_place
def _put(slots: Slots, at: int, hit: IntArray, R: FloatArray, t: FloatArray, score: float) -> None:
    slots.score[at] = score
    for k in range(len(hit)):
        slots.blob_of_led[at, k] = hit[k]
    for r in range(3):
        slots.t[at, r] = t[r]
        for c in range(3):
            slots.R[at, r, c] = R[r, c]


@compiled_in_place
def _same(a: IntArray, b: IntArray) -> bool:
    n_different = 0
    for k in range(len(a)):
        n_different += a[k] != b[k]
    return n_different == 0


@compiled_in_place
def _trace(A: FloatArray, B: FloatArray) -> float:
    """Return the trace of A' B, which is 1 + 2 cos of the turn between them."""
    total = 0.0
    for r in range(3):
        for c in range(3):
            total += A[r, c] * B[r, c]
    return total


@compiled_in_place
def fit_slots(s: FloatArray, count: int, pattern: Pattern, radius: float, slots: Slots, room: Room) -> None:
    """Fit the kept poses to all their LEDs; their scores become log likelihood ratios, up to a constant."""
    n_leds = len(pattern.P)
    A, g, L, x, E, J, hit, apart = room.A, room.g, room.L, room.x, room.E, room.J, room.hit, room.apart
    best = 0.0
    for i in range(slots.number[0]):
        best = max(best, math.floor(slots.score[i] + 0.5))
    for i in range(slots.number[0]):
        if slots.score[i] < best - 2.6:
            slots.score[i] = -np.inf
            continue
        R, t = slots.R[i], slots.t[i]
        for round_ in range(3):
            for k in range(n_leds):
                hit[k] = slots.blob_of_led[i, k]
            for _ in range(3):
                if not _point_step(s, hit, pattern.P, R, t, A, g, L, x, E, J):
                    break
            hits(R, t, pattern.P, pattern.N, s, count, _FITTED_GATE_RADII * radius, hit, apart)
            if round_ == 2 or _same(hit, slots.blob_of_led[i]):
                break
            _put(slots, i, hit, R, t, 0.0)
        n_hits, squares = 0, 0.0
        for k in range(n_leds):
            slots.blob_of_led[i, k] = hit[k]
            if hit[k] >= 0:
                n_hits += 1
                squares += apart[k] ** 2
        if n_hits < 4:
            slots.score[i] = -np.inf
            continue
        freedom = 2 * n_hits - 6
        floor = (_POINT_SD_RADII * radius) ** 2
        variance = (squares + 2 * floor) / (freedom + 2)
        slots.score[i] = -0.5 * (
            freedom * math.log(2 * math.pi * variance / pattern.picture_area) + squares / variance
        )


@compiled_in_place
def _point_step(
    s: FloatArray,
    hit: IntArray,
    P: FloatArray,
    R: FloatArray,
    t: FloatArray,
    A: FloatArray,
    g: FloatArray,
    L: FloatArray,
    x: FloatArray,
    E: FloatArray,
    J: FloatArray,
) -> bool:
    """Move a pose by one Gauss-Newton step on its LEDs' slopes; false where it cannot be."""
    A[:], g[:] = 0.0, 0.0
    for k in range(len(P)):
        if hit[k] < 0:
            continue
        px, py, pz = P[k, 0], P[k, 1], P[k, 2]
        X = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        Y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        Z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
        if not Z > 1.0:
            return False
        u, v = X / Z, Y / Z
        r0, r1 = s[hit[k], 0] - u, s[hit[k], 1] - v
        J[0, 3], J[0, 4], J[0, 5] = 1 / Z, 0.0, -u / Z
        J[1, 3], J[1, 4], J[1, 5] = 0.0, 1 / Z, -v / Z
        for row in range(2):
            c0, c1, c2 = J[row, 3], J[row, 4], J[row, 5]
            w0 = R[0, 0] * c0 + R[1, 0] * c1 + R[2, 0] * c2
            w1 = R[0, 1] * c0 + R[1, 1] * c1 + R[2, 1] * c2
            w2 = R[0, 2] * c0 + R[1, 2] * c1 + R[2, 2] * c2
            J[row, 0], J[row, 1], J[row, 2] = py * w2 - pz * w1, pz * w0 - px * w2, px * w1 - py * w0
        for c in range(6):
            g[c] += J[0, c] * r0 + J[1, c] * r1
            for b in range(c + 1):
                A[c, b] += J[0, c] * J[0, b] + J[1, c] * J[1, b]
    if not solve(A, g, 1e-6, 6, L, x):
        return False
    size = math.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    share = min(1.0, 0.3 / max(size, 1e-12))
    rotation(x[0] * share, x[1] * share, x[2] * share, E)
    for r in range(3):
        r0, r1, r2 = R[r, 0], R[r, 1], R[r, 2]
        for c in range(3):
            R[r, c] = r0 * E[0, c] + r1 * E[1, c] + r2 * E[2, c]
        t[r] += share * x[3 + r]
    return True


@compiled_in_place
def hand_on(slots: Slots, out: Candidates, i: int) -> None:
    """Put the likeliest candidates, each once, into the results, best first."""
    n, best = 0, -np.inf
    while n < N_KEPT:
        top = -1
        for j in range(slots.number[0]):
            if slots.score[j] > -np.inf and (top < 0 or slots.score[j] > slots.score[top]):
                top = j
        if top < 0:
            break
        score = slots.score[top]
        slots.score[top] = -np.inf
        best = max(best, score)
        if score < best - _WORSE:
            break
        is_new = True
        for j in range(n):
            if (
                _same(slots.blob_of_led[top], out.blob_of_led[i, j])
                and 3 - _trace(slots.R[top], out.R[i, j]) < _SAME_TURN
            ):
                is_new = False
        if is_new:
            for k in range(len(out.blob_of_led[i, n])):
                out.blob_of_led[i, n, k] = slots.blob_of_led[top, k]
            for r in range(3):
                out.t[i, n, r] = slots.t[top, r]
                for c in range(3):
                    out.R[i, n, r, c] = slots.R[top, r, c]
            n += 1
    out.number[i] = n
