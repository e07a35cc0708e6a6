"""How a step and a measurement change a covariance of the 22 states, and what later frames say; compiled.

A matrix of states is flat here, row by row: with the distance of its rows known, the compiler works on many
columns at once. The transition is the identity but for the nine
moving states, and of their rows a third is not zero: only that is multiplied out.
"""

from typing import Any

import numpy as np

from bricktrack_host.compiled import compiled, compiled_fast, compiled_sums

N = 22  # states
M = 9  # moving states: attitude, position, velocity
SIZE = N * N  # of a matrix of states
F_SIZE = M * N  # of a transition: its moving rows, 22 long
_HALF = N // 2  # so many rows the compiler writes out, and works on many columns at once


@compiled_sums
def step_forward(F: Any, A: Any, dt: float, width: int) -> None:
    """Replace a matrix of rows ``width`` long by the transition times it: F holds the moving rows."""
    half = 0.5 * dt
    for j in range(width):
        turn0, turn1, turn2 = A[j], A[width + j], A[2 * width + j]
        bias0, bias1, bias2 = A[12 * width + j], A[13 * width + j], A[14 * width + j]
        lag, loss = A[20 * width + j], A[21 * width + j]
        for i in range(3):
            r, p, v = N * i, N * (3 + i), N * (6 + i)
            # What changes the velocity steadily over the step moves the brick by half a step of it.
            steady = F[v + 12] * bias0 + F[v + 13] * bias1 + F[v + 14] * bias2
            steady += F[v + 20] * lag + F[v + 21] * loss + dt * A[(15 + i) * width + j]
            moved = F[p] * turn0 + F[p + 1] * turn1 + F[p + 2] * turn2
            A[(3 + i) * width + j] += moved + dt * A[(6 + i) * width + j] + half * steady
            A[(6 + i) * width + j] += F[v] * turn0 + F[v + 1] * turn1 + F[v + 2] * turn2 + steady
            turned = F[r] * turn0 + F[r + 1] * turn1 + F[r + 2] * turn2
            A[i * width + j] = turned - dt * A[(9 + i) * width + j]


@compiled_sums
def propagate(F: Any, P: Any, room: Any, dt: float, gyro: float, acc: float, bg: float, ba: float) -> None:
    """Replace P by F P F^T + Q; ``room``, as long as F, is to work in."""
    step_forward(F, P, dt, N)
    for i in range(M):
        for j in range(N):
            room[j * M + i] = P[i * N + j]
    step_forward(F, room, dt, M)
    for i in range(M):
        for j in range(M, N):
            P[j * N + i] = P[i * N + j]
        for j in range(i + 1):
            P[i * N + j] = P[j * N + i] = room[i * M + j]
    for i in range(3):
        p, v = 3 + i, 6 + i
        P[i * N + i] += gyro * dt
        P[v * N + v] += acc * dt
        P[p * N + v] += 0.5 * acc * dt * dt
        P[v * N + p] += 0.5 * acc * dt * dt
        P[p * N + p] += acc * dt * dt * dt / 3.0
        P[(9 + i) * N + 9 + i] += bg * dt
        P[(12 + i) * N + 12 + i] += ba * dt


@compiled_sums
def step_back(F: Any, A: Any, dt: float, width: int) -> None:
    """Replace a matrix of rows ``width`` long by the transposed transition times it."""
    half = 0.5 * dt
    for j in range(width):
        turn0, turn1, turn2 = A[j], A[width + j], A[2 * width + j]
        before0 = F[0] * turn0 + F[N] * turn1 + F[2 * N] * turn2
        before1 = F[1] * turn0 + F[N + 1] * turn1 + F[2 * N + 1] * turn2
        before2 = F[2] * turn0 + F[N + 2] * turn1 + F[2 * N + 2] * turn2
        for i in range(3):
            p, v = N * (3 + i), N * (6 + i)
            moved, speed = A[(3 + i) * width + j], A[(6 + i) * width + j]
            before0 += F[p] * moved + F[v] * speed
            before1 += F[p + 1] * moved + F[v + 1] * speed
            before2 += F[p + 2] * moved + F[v + 2] * speed
            steady = speed + half * moved
            for m in range(12, 15):
                A[m * width + j] += F[v + m] * steady
            for m in range(20, 22):
                A[m * width + j] += F[v + m] * steady
            A[(15 + i) * width + j] += dt * steady
            A[(6 + i) * width + j] += dt * moved
            A[(9 + i) * width + j] -= dt * A[i * width + j]
        A[j], A[width + j], A[2 * width + j] = before0, before1, before2


@compiled_sums
def rows_times(rows: Any, n: int, A: Any, out: Any) -> None:
    """Write ``n`` rows times a matrix."""
    for i in range(n):
        row = i * N
        for j in range(N):
            total = 0.0
            for m in range(N):
                total += rows[row + m] * A[m * N + j]
            out[row + j] = total


@compiled_fast
def dot(a: Any, i: int, b: Any, j: int) -> float:
    """Return the product of row i of one matrix and row j of another."""
    i, j = i * N, j * N
    total = 0.0
    for m in range(N):
        total += a[i + m] * b[j + m]
    return float(total)


@compiled_sums
def take_off(A: Any, left: Any, right: Any, n: int) -> None:
    """Replace a matrix by A - left^T right, of ``n`` rows each, an even number."""
    for m in range(0, n, 2):
        row = m * N
        for half in range(2):
            first, top = row + half * _HALF, half * _HALF * N
            for j in range(N):
                a, b = right[row + j], right[row + N + j]
                for i in range(_HALF):
                    A[top + i * N + j] -= left[first + i] * a + left[first + N + i] * b


@compiled_sums
def transpose(A: Any) -> None:
    """Turn a matrix over, in place."""
    for i in range(N):
        for j in range(i):
            A[i * N + j], A[j * N + i] = A[j * N + i], A[i * N + j]


@compiled_sums
def make_symmetric(A: Any) -> None:
    """Replace both halves by their mean: rounding alone tells them apart."""
    for i in range(N):
        for j in range(i):
            mean = 0.5 * (A[i * N + j] + A[j * N + i])
            A[i * N + j] = mean
            A[j * N + i] = mean


@compiled_sums
def factor(S: Any, n: int) -> None:
    """Replace the lower triangle of S, shape (6, 6), by its Cholesky factor, in the first ``n`` rows."""
    for i in range(n):
        for j in range(i + 1):
            s = S[i, j]
            for m in range(j):
                s -= S[i, m] * S[j, m]
            S[i, j] = np.sqrt(s) if i == j else s / S[j, j]


@compiled_sums
def whiten(L: Any, y: Any, n: int, out: Any) -> float:
    """Write L^-1 y and return its square."""
    total = 0.0
    for i in range(n):
        s = y[i]
        for m in range(i):
            s -= L[i, m] * out[m]
        out[i] = s / L[i, i]
        total += out[i] * out[i]
    return float(total)


@compiled_sums
def whiten_rows(L: Any, A: Any, n: int) -> None:
    """Replace ``n`` rows of states by those of L^-1 A."""
    for i in range(n):
        o = i * N
        for m in range(i):
            weight = L[i, m]
            for j in range(N):
                A[o + j] -= weight * A[m * N + j]
        scale = 1.0 / L[i, i]
        for j in range(N):
            A[o + j] *= scale


@compiled
def are_definite(covariance: Any) -> Any:
    """Return which of covariances, shape (n, 6, 6), are positive definite, shape (n,); NaN is not."""
    out, L = np.ones(len(covariance), dtype=np.bool_), np.empty((6, 6))
    for i in range(len(covariance)):
        L[:] = covariance[i]
        factor(L, 6)
        for j in range(6):
            out[i] &= L[j, j] > 0.0
    return out
