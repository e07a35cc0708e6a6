"""A sampled vector as a continuous signal: splines, how rough it is, and how it moves.

What is linear in the samples is made once: a low-pass undone, or gains taken out, change the splines by
matrices.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.inertial.cubic_pieces import CubicPieces, cubic_through
from bricktrack_host.fusion.inertial.imu_samples import BRIDGE_PERIODS, bridge_error, fill_instants, roughness

GAP_PERIODS = 1.5  # an interval longer than this holds a missing sample
# Weights of neighbours. What is in proportion to a vibration turns its sign with it, before it adds up: at
# 100 Hz this keeps 0.88 of what moves at 8 Hz, and 0.02 of what shakes at 37 Hz.
_SMOOTH = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0


def _second_and_third(t_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of samples by five points, shape (n, 3) each."""
    step = float(np.median(np.diff(t_s)))
    at = cubic_through(t_s, values)
    far_before, before, after, far_after = (
        at(np.clip(t_s + k * step, t_s[0], t_s[-1])) for k in (-2, -1, 1, 2)
    )
    second = (16 * (before + after) - 30 * values - far_before - far_after) / (12 * step**2)
    third = (far_after - far_before - 2 * (after - before)) / (2 * step**3)
    return second, third


def _spline(
    t_s: FloatArray, values: FloatArray, period_s: float, fill: tuple[FloatArray, FloatArray] | None
) -> CubicPieces:
    """Return the cubic through samples and the fill's instants and values, shape (m,) and (m, 3).

    In a long gap without a fill, points on the chord keep it from swinging across.
    """
    knots, at_knots = t_s, values
    for i in np.flatnonzero(np.diff(t_s) > BRIDGE_PERIODS * period_s)[::-1]:
        between, at = fill_instants(t_s[i], t_s[i + 1], period_s), None
        if fill is not None:
            inside = (fill[0] > t_s[i]) & (fill[0] < t_s[i + 1])
            between, at = (fill[0][inside], fill[1][inside]) if inside.any() else (between, None)
        if at is None:
            share = (between[:, None] - t_s[i]) / (t_s[i + 1] - t_s[i])
            at = values[i] + share * (values[i + 1] - values[i])
        knots = np.insert(knots, i + 1, between)
        at_knots = np.insert(at_knots, i + 1, at, axis=0)
    return cubic_through(knots, at_knots)


@dataclass(frozen=True, eq=False)
class SampledVector:
    """A vector as a continuous signal; what is asked of it is made when first asked for, and kept.

    Attributes
    ----------
    t_s, values : ndarray, shape (n,), (n, 3)
    period_s : float
    fill : (ndarray, ndarray) or None
        Instants and values, shape (m,) and (m, 3), that stand for samples missing in long gaps.
    parts : tuple of (ndarray, SampledVector)
        Vectors, each with a matrix, shape (3, 3), of which it is the sum: so are then its splines. The first
        matrix is what it is turned by. None: it was sampled itself.
    turned_from : SampledVector or None
        That which was turned; next to equal, it is as rough.
    like : SampledVector or None
        Another that is next to equal.
    """

    t_s: FloatArray
    values: FloatArray
    period_s: float
    fill: tuple[FloatArray, FloatArray] | None
    parts: tuple[tuple[FloatArray, "SampledVector"], ...] = ()
    turned_from: "SampledVector | None" = None
    like: "SampledVector | None" = None

    @property
    def first_alike(self) -> "SampledVector":
        """Return the first of those that are next to equal to each other."""
        return self if self._alike is None else self._alike.first_alike

    @property
    def _alike(self) -> "SampledVector | None":
        return self.turned_from if self.like is None else self.like

    @cached_property
    def _roughness(self) -> tuple[FloatArray, FloatArray]:
        return roughness(self.values) if self._alike is None else self._alike._roughness

    @property
    def steady(self) -> FloatArray:
        """Return what of it is steadily faster than the samples, shape (n,), see `roughness`."""
        return self._roughness[0]

    @cached_property
    def impacts(self) -> FloatArray:
        """Return the pulses, shape (n,), see `roughness`; across a gap the spline stands for neighbours."""
        if self._alike is not None:
            return self._alike.impacts
        t_s = self.t_s
        missing = np.flatnonzero(np.diff(t_s) > GAP_PERIODS * self.period_s)
        if not missing.size:
            return self._roughness[1]
        gaps = zip(t_s[missing], t_s[missing + 1], strict=True)
        even_s = np.concatenate([t_s, *(fill_instants(*gap, self.period_s) for gap in gaps)])
        order = np.argsort(even_s)
        return np.asarray(roughness(self.spline(even_s[order]))[1][order < len(t_s)])

    @cached_property
    def bridge_error(self) -> FloatArray:
        """Return the error of the cubic where one sample is missing, shape (n,)."""
        return bridge_error(self.values) if self._alike is None else self._alike.bridge_error

    @cached_property
    def slow(self) -> FloatArray:
        """Return the samples without what is faster than bricks move, shape (n, 3)."""
        if self._alike is not None:
            return self._alike.slow
        side = len(_SMOOTH) // 2
        padded = np.pad(self.values, ((side, side), (0, 0)), mode="edge")
        return np.stack([np.convolve(axis, _SMOOTH, "valid") for axis in padded.T], axis=1)

    @cached_property
    def slow_change(self) -> FloatArray:
        """Return how fast the slow part changes, shape (n,)."""
        if self._alike is not None:
            return self._alike.slow_change
        return np.asarray(np.linalg.norm(np.gradient(self.slow, self.t_s, axis=0), axis=1))

    @cached_property
    def slow_aside(self) -> FloatArray:
        """Return how far the slow part lies from its median, shape (n,)."""
        if self._alike is not None:
            return self._alike.slow_aside
        return np.asarray(np.linalg.norm(self.slow - np.median(self.slow, axis=0), axis=1))

    @cached_property
    def spline(self) -> CubicPieces:
        """Return the signal."""
        if self.parts:
            return self._sum([part.spline for _, part in self.parts])
        return _spline(self.t_s, self.values, self.period_s, self.fill)

    @cached_property
    def once(self) -> CubicPieces:
        """Return its integral."""
        if self.parts:
            return self._sum([part.once for _, part in self.parts])
        return self.spline.antiderivative()

    @cached_property
    def twice(self) -> CubicPieces:
        """Return its double integral."""
        if self.parts:
            return self._sum([part.twice for _, part in self.parts])
        return self.once.antiderivative()

    def _sum(self, of_parts: list[CubicPieces]) -> CubicPieces:
        c = of_parts[0].c @ self.parts[0][0].T
        for (turn, _), piece in zip(self.parts[1:], of_parts[1:], strict=True):
            c += piece.c @ turn.T
        return CubicPieces(of_parts[0].x, c)

    @cached_property
    def _second_and_third(self) -> tuple["SampledVector", "SampledVector"]:
        """Return the derivatives by five points; what fills a gap stays as it is."""
        fill = None if self.fill is None else (self.fill[0], np.zeros_like(self.fill[1]))
        second, third = _second_and_third(self.t_s, self.values)
        return (
            SampledVector(self.t_s, second, self.period_s, fill),
            SampledVector(self.t_s, third, self.period_s, fill),
        )

    def turned(self, turn: FloatArray) -> "SampledVector":
        """Return the vector times a matrix near to one, shape (3, 3), in place of any other."""
        if self.turned_from is not None:
            return self.turned_from.turned(turn)
        fill = None if self.fill is None else (self.fill[0], self.fill[1] @ turn.T)
        # Of the same parts as that: its splines, of which nothing else would be made, need not be.
        parts = tuple((turn @ own, part) for own, part in self.parts) or ((turn, self),)
        return replace(self, values=self.values @ turn.T, fill=fill, parts=parts, turned_from=self)

    def sharpened(self, filter_s: float, *, like: "SampledVector | None" = None) -> "SampledVector":
        """Return the vector with the amplitudes that a low-pass took from it, at the times where it put them.

        The low-pass is of second order and critically damped, ``1 / (1 + s filter_s)^2``: mean delay
        ``2 filter_s``, -3 dB at ``0.102 / filter_s`` Hz. Without its delay its inverse is
        ``1 - u^2 + 2/3 u^3 + O(u^5)`` with ``u = s filter_s``, whose derivatives are those of five points.
        Nothing is done at zero. ``like``: the same by nearly the same low-pass.
        """
        if filter_s <= 0:
            return self
        if self.turned_from is not None:
            return self.turned_from.sharpened(filter_s, like=like).turned(self.parts[0][0])
        second, third = self._second_and_third
        of_second, of_third = -(filter_s**2), 2 / 3 * filter_s**3
        values = self.values + of_second * second.values + of_third * third.values
        eye = np.eye(3)
        parts = (eye, self), (of_second * eye, second), (of_third * eye, third)
        return replace(self, values=values, parts=parts, like=None if like is None else like.first_alike)
