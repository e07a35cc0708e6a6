"""What is drawn in a panel of a chart, each as few elements of SVG: lines, bands, dots, signs, arrows, words.

The paths are in whole units of `UNITS_PER_PT`, each point relative to the one before: short, and exact.
"""

from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import Literal, Protocol

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.reporting.thinning import thinned_dots

UNITS_PER_PT = 20
_WORDS_PT = 8.5
_CELLS_OF_DOT = 3
"""Dots closer together than this part of their width are one."""
_NOWHERE = np.empty(0)
_TEXT = "S8"
"""Short pieces of ASCII side by side in an array, filled up with zero bytes."""
_N_WRITTEN = 2048
_WRITTEN = np.array([str(i) for i in (*range(_N_WRITTEN), *range(-_N_WRITTEN, 0))], dtype=_TEXT)
"""Numbers as text, at their own index, which may be negative: a report holds 200,000, nearly all small."""

ToPage = Callable[[FloatArray, FloatArray], IntArray]
"""From values along x and y to units of the page, shape (n, 2)."""


class Mark(Protocol):
    """Something drawn in a panel."""

    @property
    def label(self) -> str:
        """Its words in the legend; empty for none."""
        ...

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """Return values along x and along y that the axes should show."""
        ...

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """Return its elements; ``top`` and ``bottom`` are the panel's, in units."""
        ...

    def swatch(self, x: int, y: int, width: int) -> str:
        """Return a sample for the legend, from (x, y) to the right."""
        ...


def units(points: float) -> int:
    """Return a length in points as units of the page."""
    return round(points * UNITS_PER_PT)


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A line through samples; NaN interrupts it."""

    x: FloatArray
    y: FloatArray
    colour: str
    width_pt: float = 1.0
    label: str = ""

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """See `Mark`."""
        return self.x, self.y

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """See `Mark`."""
        known = np.isfinite(self.x) & np.isfinite(self.y)
        path = "".join(polyline(to_page(self.x[run], self.y[run])) for run in _runs(known))
        return f'<path fill="none" {_stroke(self.colour, self.width_pt)} stroke-linejoin="round" d="{path}"/>'

    def swatch(self, x: int, y: int, width: int) -> str:
        """See `Mark`."""
        return f'<path {_stroke(self.colour, self.width_pt)} d="M{x} {y}h{width}"/>'


@dataclass(frozen=True, slots=True, eq=False)
class Area:
    """A closed outline, filled; with ``low`` and ``high`` of a band, see `band`."""

    outlines: list[tuple[FloatArray, FloatArray]]
    colour: str
    opacity: float = 1.0
    edge: str = ""
    label: str = ""

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """See `Mark`."""
        xs, ys = [o[0] for o in self.outlines], [o[1] for o in self.outlines]
        return np.concatenate([_NOWHERE, *xs]), np.concatenate([_NOWHERE, *ys])

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """See `Mark`."""
        path = "".join(polyline(to_page(x, y)) + "z" for x, y in self.outlines)
        return f'<path {self._style()} d="{path}"/>'

    def swatch(self, x: int, y: int, width: int) -> str:
        """See `Mark`."""
        half = units(3.2)
        return f'<path {self._style()} d="M{x} {y - half}h{width}v{2 * half}h{-width}z"/>'

    def _style(self) -> str:
        edge = f" {_stroke(self.edge, 0.9)}" if self.edge else ""
        return f'fill="{self.colour}" fill-opacity="{self.opacity:g}"{edge}'


def band(
    x: FloatArray, low: FloatArray, high: FloatArray, *, colour: str, opacity: float, label: str = ""
) -> Area:
    """Return the area between two lines; NaN interrupts it."""
    known = np.isfinite(low) & np.isfinite(high)
    outlines = [
        (np.concatenate([x[run], x[run][::-1]]), np.concatenate([low[run], high[run][::-1]]))
        for run in _runs(known)
    ]
    return Area(outlines, colour, opacity, label=label)


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Round dots, with bars of ``half`` up and down where given; NaN draws none."""

    x: FloatArray
    y: FloatArray
    colour: str
    size_pt: float
    half: FloatArray | None = None
    opacity: float = 1.0
    label: str = ""

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """See `Mark`."""
        if self.half is None:
            return self.x, self.y
        return self.x, np.concatenate([self.y - self.half, self.y + self.half])

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """See `Mark`."""
        known = np.isfinite(self.x) & np.isfinite(self.y)
        # A stroke of no length with round ends is a dot; all of them are one path.
        places = to_page(self.x[known], self.y[known])
        steps = _steps(thinned_dots(places, max(units(self.size_pt) // _CELLS_OF_DOT, 1)))
        path = _repeated("m%s %sh0", steps)
        opacity = f' stroke-opacity="{self.opacity:g}"' if self.opacity < 1 else ""
        dots = f'<path {_stroke(self.colour, self.size_pt)} stroke-linecap="round"{opacity} d="{path}"/>'
        if self.half is None:
            return dots
        x, y, half = self.x[known], self.y[known], self.half[known]
        from_, to = to_page(x, y - half), to_page(x, y + half)
        bars = _repeated("M%s %sV%s", np.concatenate([from_, to[:, 1:]], axis=1))
        return f'<path {_stroke(self.colour, 0.8)} d="{bars}"/>{dots}'

    def swatch(self, x: int, y: int, width: int) -> str:
        """See `Mark`."""
        middle, long, radius = x + width // 2, units(4.0), units(max(0.75 * self.size_pt, 1.6))
        bar = f'<path {_stroke(self.colour, 0.8)} d="M{middle} {y - long}v{2 * long}"/>'
        dot = f'<circle cx="{middle}" cy="{y}" r="{radius}" fill="{self.colour}"/>'
        return dot if self.half is None else bar + dot


@dataclass(frozen=True, slots=True, eq=False)
class Signs:
    """Crosses or upright strokes."""

    x: FloatArray
    y: FloatArray
    colour: str
    sign: Literal["x", "|"] = "x"
    size_pt: float = 5.0
    label: str = ""

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """See `Mark`."""
        return self.x, self.y

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """See `Mark`."""
        places: list[list[int]] = to_page(self.x, self.y).tolist()
        return self._svg(places)

    def swatch(self, x: int, y: int, width: int) -> str:
        """See `Mark`."""
        return self._svg([[x + width // 2, y]])

    def _svg(self, places: list[list[int]]) -> str:
        r = units(self.size_pt / 2)
        cross = f"m{-r} {-r}l{2 * r} {2 * r}m0 {-2 * r}l{-2 * r} {2 * r}"
        one = cross if self.sign == "x" else f"m0 {-r}v{2 * r}"
        path = "".join(f"M{u} {v}{one}" for u, v in places)
        return f'<path fill="none" {_stroke(self.colour, 1.0)} d="{path}"/>'


@dataclass(frozen=True, slots=True, eq=False)
class Spans:
    """Intervals of x, shape (n, 2), shaded over the panel's whole height."""

    intervals: FloatArray
    colour: str
    label: str = ""

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """See `Mark`."""
        return self.intervals.ravel(), _NOWHERE

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """See `Mark`."""
        x = to_page(self.intervals.ravel(), np.full(self.intervals.size, np.nan))[:, 0]
        pairs: list[list[int]] = x.reshape(-1, 2).tolist()
        path = "".join(f"M{x0} {top}H{x1}V{bottom}H{x0}z" for x0, x1 in pairs)
        return f'<path fill="{self.colour}" d="{path}"/>'

    def swatch(self, x: int, y: int, width: int) -> str:
        """See `Mark`."""
        half = units(3.2)
        return f'<path fill="{self.colour}" d="M{x} {y - half}h{width}v{2 * half}h{-width}z"/>'


@dataclass(frozen=True, slots=True, eq=False)
class Instants:
    """Values of x, marked over the panel's whole height."""

    x: FloatArray
    colour: str
    width_pt: float = 0.8
    dashes_pt: tuple[float, float] | None = None
    opacity: float = 1.0
    label: str = ""

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """See `Mark`."""
        return self.x, _NOWHERE

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """See `Mark`."""
        at: list[int] = to_page(self.x, np.full(len(self.x), np.nan))[:, 0].tolist()
        return f'<path {self._style()} d="{"".join(f"M{x} {top}V{bottom}" for x in at)}"/>'

    def swatch(self, x: int, y: int, width: int) -> str:
        """See `Mark`."""
        return f'<path {self._style()} d="M{x} {y}h{width}"/>'

    def _style(self) -> str:
        style = _stroke(self.colour, self.width_pt)
        if self.dashes_pt is not None:
            style += f' stroke-dasharray="{units(self.dashes_pt[0])} {units(self.dashes_pt[1])}"'
        return style + (f' stroke-opacity="{self.opacity:g}"' if self.opacity < 1 else "")


@dataclass(frozen=True, slots=True, eq=False)
class Arrows:
    """Arrows from (x, y) over (dx, dy), in values of the axes."""

    x: FloatArray
    y: FloatArray
    dx: FloatArray
    dy: FloatArray
    colour: str
    width_pt: float = 1.4
    label: str = ""

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """See `Mark`."""
        return self.x, self.y

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """See `Mark`."""
        ends = to_page(self.x + self.dx, self.y + self.dy)
        along = (ends - to_page(self.x, self.y)).astype(float)
        length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1.0)
        head = along * np.minimum(units(3.5 * self.width_pt) / length, 1.0)[:, None]
        side = np.stack([-head[:, 1], head[:, 0]], axis=1) / 2.2
        path = "".join(
            f"M{x:.0f} {y:.0f}L{u:.0f} {v:.0f}M{u - hx - sx:.0f} {v - hy - sy:.0f}"
            f"L{u:.0f} {v:.0f}L{u - hx + sx:.0f} {v - hy + sy:.0f}"
            for (x, y), (u, v), (hx, hy), (sx, sy) in zip(
                (ends - along).tolist(), ends.tolist(), head.tolist(), side.tolist(), strict=True
            )
        )
        return f'<path fill="none" {_stroke(self.colour, self.width_pt)} d="{path}"/>'

    def swatch(self, x: int, y: int, width: int) -> str:
        """See `Mark`."""
        return f'<path {_stroke(self.colour, self.width_pt)} d="M{x} {y}h{width}"/>'


@dataclass(frozen=True, slots=True, eq=False)
class Words:
    """Words beside a place: above it, or below where the panel ends."""

    x: float
    y: float
    words: str
    colour: str
    right_pt: float = 9.0
    up_pt: float = 7.0
    label: str = ""

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """See `Mark`."""
        return _NOWHERE, _NOWHERE

    def svg(self, to_page: ToPage, top: int, bottom: int) -> str:
        """See `Mark`."""
        u, v = to_page(np.array([self.x]), np.array([self.y]))[0].tolist()
        above = v - units(self.up_pt)
        is_cut = above - units(_WORDS_PT) < top
        v = v + units(self.up_pt + _WORDS_PT) if is_cut else above
        return text(u + units(self.right_pt), v, self.words, colour=self.colour, size_pt=_WORDS_PT, bold=True)

    def swatch(self, x: int, y: int, width: int) -> str:
        """See `Mark`."""
        return ""


def text(
    x: int,
    y: int,
    words: str,
    *,
    colour: str,
    size_pt: float = 8.5,
    anchor: Literal["start", "middle", "end"] = "start",
    bold: bool = False,
    upwards: bool = False,
) -> str:
    """Return words on the page, their base line at (x, y)."""
    style = f'font-size="{units(size_pt)}" text-anchor="{anchor}"' + (' font-weight="bold"' if bold else "")
    turn = f' transform="rotate(-90 {x} {y})"' if upwards else ""
    return f'<text x="{x}" y="{y}" fill="{colour}" {style}{turn}>{escape(words)}</text>'


def polyline(points: IntArray) -> str:
    """Return a path through points of the page, relative, without repeated ones."""
    if len(points) == 0:
        return ""
    steps = np.diff(points, axis=0)
    steps = steps[(steps[:, 0] != 0) | (steps[:, 1] != 0)]  # `any` along so short an axis is slow
    u, v = points[0].tolist()
    return f"M{u} {v}l0 0" if not len(steps) else f"M{u} {v}l{_repeated('%s %s ', steps)}"


def _steps(points: IntArray) -> IntArray:
    return np.diff(points, axis=0, prepend=np.zeros((1, 2), dtype=np.int64))


def _repeated(pattern: str, rows: IntArray) -> str:
    """Return a pattern filled in with each row; at once, as there may be ten thousands."""
    between = pattern.split("%s")
    parts = np.empty((len(rows), len(between) + rows.shape[1]), dtype=_TEXT)
    parts[:, ::2] = between
    is_large = (rows < -_N_WRITTEN) | (rows >= _N_WRITTEN)
    numbers = _WRITTEN[np.where(is_large, 0, rows)]
    numbers[is_large] = rows[is_large].astype(_TEXT)
    parts[:, 1::2] = numbers
    return parts.tobytes().translate(None, b"\0").decode("ascii")


def _runs(known: BoolArray) -> list[slice]:
    """Return where a mask is true without a break."""
    edges = np.flatnonzero(np.diff(known.astype(np.int8), prepend=0, append=0))
    return [slice(a, b) for a, b in edges.reshape(-1, 2).tolist()]


def _stroke(colour: str, width_pt: float) -> str:
    return f'stroke="{colour}" stroke-width="{units(width_pt)}"'
