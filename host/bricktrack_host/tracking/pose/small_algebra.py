"""Compiled: the small matrices of the pose fits: rotations, and normal equations by Cholesky's method."""

import math

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled_fast


@compiled_fast
def rotation(x: float, y: float, z: float, out: FloatArray) -> None:
    """Put the matrix of a rotation vector into ``out`` (Rodrigues' formula)."""
    angle2 = x * x + y * y + z * z
    if angle2 < 0.01:  # the series' next terms are below 1e-17
        a = 1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42 * (1 - angle2 / 72)))
        b = 0.5 - angle2 / 24 * (1 - angle2 / 30 * (1 - angle2 / 56 * (1 - angle2 / 90)))
    else:
        angle = math.sqrt(angle2)
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2
    out[0, 0], out[1, 1], out[2, 2] = (
        1 - b * (y * y + z * z),
        1 - b * (x * x + z * z),
        1 - b * (x * x + y * y),
    )
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x


@compiled_fast
def solve(A: FloatArray, g: FloatArray, damping: float, n: int, L: FloatArray, x: FloatArray) -> bool:
    """Solve (A + damping diag(A)) x = g by Cholesky; false if A is singular to precision.

    L is left, on its diagonal the inverses: divisions take ten times as long as products.
    """
    for c in range(n, len(x)):
        x[c] = 0.0
    for c in range(n):
        for b in range(c + 1):
            total = A[c, b]
            if b == c:
                total += damping * A[c, c]
            for k in range(b):
                total -= L[c, k] * L[b, k]
            if b == c:
                if not total > 1e-14 * A[c, c]:
                    return False
                L[c, c] = 1 / math.sqrt(total)
            else:
                L[c, b] = total * L[b, b]
    for c in range(n):
        total = g[c]
        for k in range(c):
            total -= L[c, k] * x[k]
        x[c] = total * L[c, c]
    for c in range(n - 1, -1, -1):
        total = x[c]
        for k in range(c + 1, n):
            total -= L[k, c] * x[k]
        x[c] = total * L[c, c]
    return True


@compiled_fast
def quadratic(A: FloatArray, x: FloatArray, n: int) -> float:
    """Return x' A x, of which the lower half is given."""
    total = 0.0
    for c in range(n):
        total += A[c, c] * x[c] * x[c]
        for b in range(c):
            total += 2 * A[c, b] * x[c] * x[b]
    return total


@compiled_fast
def inverse_columns(L: FloatArray, n: int, out: FloatArray, column: FloatArray) -> None:
    """Put the first six columns of the inverse of L L', (n, n), into ``out``, L as from `solve`.

    ``column`` has room for n.
    """
    for j in range(6):
        for c in range(n):
            total = 1.0 if c == j else 0.0
            for k in range(j, c):
                total -= L[c, k] * column[k]
            column[c] = total * L[c, c] if c >= j else 0.0
        for c in range(n - 1, -1, -1):
            total = column[c]
            for k in range(c + 1, n):
                total -= L[k, c] * column[k]
            column[c] = total * L[c, c]
        for c in range(n):
            out[c, j] = column[c]
