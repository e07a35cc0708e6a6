"""The figures of a calibration's report: residuals on the planes, coverage, uncertainty, comparison."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.tri import LinearTriInterpolator, Triangulation

from bricktrack_common.arrays import FloatArray
from bricktrack_common.camera_model import SensorMode
from bricktrack_host.calibration.calibration_comparison import CalibrationComparison
from bricktrack_host.calibration.dots.picture_region import ConvexRegion
from bricktrack_host.calibration.rays.dot_data import Planes
from bricktrack_host.calibration.rays.pixel_polynomials import picture_grid
from bricktrack_host.calibration.rays.ray_uncertainty import CHI_95, UncertainRays
from bricktrack_host.reporting.figure_layout import panel_row, picture_axes
from bricktrack_host.reporting.page_measures import WIDTH_IN
from bricktrack_host.reporting.plots import FUSED, IMPACT, INK, OPTICAL, TRUTH

COLOURS = "viridis"
_COLOUR_BAR_IN = 0.78
TYPICAL_ARROW, LONGEST_ARROW = 0.7, 8.0
"""Of a residual as great as the median, in dot distances, and of the greatest at most."""
LONGEST_MOVE_PX = 120
LONGEST_SIDE = 4.0
"""Triangles between dots with a longer side, in dot distances, span a gap: nothing is drawn in them."""


def residual_contour_figure(planes: Planes, residual_mm: Sequence[FloatArray]) -> Figure:
    """Return contours of the residual over each plane, with the dots (source paper, figure 8)."""
    fig, axes = _plane_panels(planes)
    sizes = [1e3 * np.hypot(*r.T) for r in residual_mm]
    levels = _levels(np.concatenate(sizes))
    for ax, (z_mm, seen), size in zip(axes, planes, sizes, strict=True):
        filled = ax.tricontourf(_triangles(seen.xy_mm), size, levels=levels, cmap=COLOURS, extend="max")
        ax.plot(*seen.xy_mm.T, ".", ms=1.6, mew=0, color="white")
        ax.set_title(f"z = {z_mm:g} mm: mean {size.mean():.1f}, max {size.max():.1f} µm")
        _plane_labels(ax)
    _colour_bar(fig, filled, "residual, µm", form="%.1f")
    return fig


def residual_arrow_figure(planes: Planes, residual_mm: Sequence[FloatArray]) -> Figure:
    """Return the residuals of each plane as arrows: a pattern in them is a misfit, none is noise."""
    fig, axes = _plane_panels(planes)
    sizes = np.concatenate([np.hypot(*r.T) for r in residual_mm])
    one_mm = max(float(np.median(sizes)) / TYPICAL_ARROW, float(sizes.max()) / LONGEST_ARROW, 1e-9)
    for ax, (z_mm, seen), r in zip(axes, planes, residual_mm, strict=True):
        step = _spacing(seen.xy_mm)
        ax.quiver(*seen.xy_mm.T, *r.T, angles="xy", scale_units="xy", scale=one_mm / step, width=0.0016,
                  color=OPTICAL)  # fmt: skip
        ax.update_datalim(seen.xy_mm + r * step / one_mm)
        ax.autoscale_view()
        ax.set_title(f"z = {z_mm:g} mm: an arrow of one dot distance is {1e3 * one_mm:.1f} µm")
        _plane_labels(ax)
    return fig


def residual_surface_figure(planes: Planes, residual_mm: Sequence[FloatArray]) -> Figure:
    """Return the residual over each plane as a surface (source paper, figure 9)."""
    fig = Figure(figsize=(WIDTH_IN, 3.9))
    sizes = [1e3 * np.hypot(*r.T) for r in residual_mm]
    top = max(float(s.max()) for s in sizes)
    for k, ((z_mm, seen), size) in enumerate(zip(planes, sizes, strict=True)):
        ax = fig.add_subplot(1, len(planes), k + 1, projection="3d")
        low, high = seen.xy_mm.min(axis=0), seen.xy_mm.max(axis=0)
        x, y = np.meshgrid(np.linspace(low[0], high[0], 49), np.linspace(low[1], high[1], 29))
        height = LinearTriInterpolator(_triangles(seen.xy_mm), size)(x, y).filled(np.nan)
        ax.plot_surface(
            x, y, height, cmap=COLOURS, vmin=0, vmax=top, rcount=29, ccount=49, linewidth=0.15,
            edgecolor=INK, antialiased=True,
        )  # fmt: skip
        ax.set(zlim=(0, top), xlabel="x, mm", ylabel="y, mm", zlabel="residual, µm")
        ax.locator_params(axis="z", nbins=5)
        ax.zaxis.labelpad = -1
        ax.set_box_aspect((1.75, 1.0, 0.62), zoom=1.12)
        ax.view_init(elev=32, azim=-62)
        ax.set_title(f"z = {z_mm:g} mm", y=0.98)
    fig.subplots_adjust(left=0.0, right=0.94, bottom=0.04, top=0.97, wspace=0.04)
    return fig


def left_out_figure(planes: Planes, errors_mm: Sequence[FloatArray]) -> Figure:
    """Return the error at each dot as predicted without its neighbourhood."""
    fig, axes = _plane_panels(planes)
    sizes = [1e3 * np.hypot(*e.T) for e in errors_mm]
    top = float(np.quantile(np.concatenate(sizes), 0.99))
    for ax, (z_mm, seen), size in zip(axes, planes, sizes, strict=True):
        x, y = seen.xy_mm.T
        shown = ax.scatter(x, y, c=size, s=9, cmap=COLOURS, vmin=0, vmax=max(top, 1e-6), linewidths=0)
        rms = np.sqrt(np.mean(size**2))
        ax.set_title(f"z = {z_mm:g} mm: rms {rms:.1f}, max {size.max():.1f} µm")
        _plane_labels(ax)
    _colour_bar(fig, shown, "error when left out, µm", form="%.1f")
    return fig


def coverage_figure(
    mode: SensorMode,
    planes: Planes,
    covered: Sequence[ConvexRegion],
    leds: ConvexRegion | None,
) -> Figure:
    """Return where dots were in the picture, what they surround, what is extrapolated, and the LEDs."""
    fig, ax = picture_axes(mode.width, mode.height, below_in=0.25)
    ax.set_facecolor("#f6e3df")
    for k, region in enumerate(covered):
        ax.add_patch(Polygon(region.vertices_px, closed=True, fc="#dce8dd", ec=TRUTH, lw=0.9, zorder=0,
                             label="surrounded by dots" if k == 0 else None))  # fmt: skip
    ax.add_patch(Polygon(np.zeros((3, 2)), fc="#f6e3df", ec="none", label="extrapolated"))
    for (z_mm, seen), colour in zip(planes, (INK, OPTICAL, FUSED, IMPACT) * len(planes), strict=False):
        ax.plot(*seen.uv_px.T, ".", ms=2.6, mew=0, color=colour, label=f"dots, z = {z_mm:.1f} mm")
    if leds is not None:
        ax.add_patch(Polygon(leds.vertices_px, closed=True, fc="none", ec=FUSED, lw=1.8, ls=(0, (5, 2)),
                             label="LEDs", zorder=4))  # fmt: skip
    ax.grid(visible=False)
    fig.legend(
        loc="lower center", ncols=5, markerscale=3, borderaxespad=0.1, columnspacing=1.0, handletextpad=0.4
    )
    return fig


def uncertainty_figure(
    model: UncertainRays,
    mode: SensorMode,
    depths_mm: Sequence[float],
    covered: Sequence[ConvexRegion],
    leds: ConvexRegion | None,
) -> Figure:
    """Return the half-axis of the rays' 95 % ellipse over the picture, at each depth."""
    columns, rows = 65, 37
    uv = picture_grid(mode, columns, rows)
    u, v = uv[:columns, 0], uv[::columns, 1]
    box_in = (WIDTH_IN - 0.9 - _COLOUR_BAR_IN - 0.5 * (len(depths_mm) - 1)) / len(depths_mm)
    height_in = box_in * mode.height / mode.width + 0.7
    fig, axes = panel_row(
        len(depths_mm), height_in=height_in, width_in=WIDTH_IN - _COLOUR_BAR_IN, labelled_columns=False
    )
    maps = [1e3 * CHI_95 * _longest_axis(model.point_covariance_mm2(uv, z)) for z in depths_mm]
    # Corners without dots are worse by orders of magnitude: steps that grow show them and the middle.
    every = np.concatenate(maps)
    low = max(float(every.min()), 1e-3)
    levels = np.geomspace(low, max(float(np.quantile(every, 0.97)), 1.5 * low), 13)
    for ax, z_mm, size in zip(axes, depths_mm, maps, strict=True):
        filled = ax.contourf(u, v, size.reshape(rows, columns), levels=levels, cmap=COLOURS, extend="both",
                              norm=LogNorm(levels[0], levels[-1]))  # fmt: skip
        for region in covered:
            ax.add_patch(Polygon(region.vertices_px, closed=True, fc="none", ec="white", lw=0.9))
        if leds is not None:
            ax.add_patch(
                Polygon(leds.vertices_px, closed=True, fc="none", ec="white", lw=1.4, ls=(0, (5, 2)))
            )
            inside = leds.contains(uv)
            words = f"; LEDs up to {size[inside].max():.1f} µm" if inside.any() else ""
        else:
            words = f"; median {np.median(size):.2g} µm"
        ax.set_title(f"z = {z_mm:.1f} mm{words}")
        ax.set(xlim=(-0.5, mode.width - 0.5), ylim=(mode.height - 0.5, -0.5), xlabel="u, px")
        ax.grid(visible=False)
    axes[0].set_ylabel("v, px")
    _colour_bar(fig, filled, "95 % half-axis, µm", form="%.2g")
    return fig


def comparison_figure(comparison: CalibrationComparison, mode: SensorMode) -> Figure:
    """Return how rays moved since an earlier calibration, as they are and less the camera's motion."""
    box_in = (WIDTH_IN - 1.7) / 2
    fig, axes = panel_row(2, height_in=box_in * mode.height / mode.width + 0.7)
    every = np.s_[:: max(len(comparison.uv_px) // 500, 1)]
    for ax, moved, words in zip(
        axes, (comparison.moved_mm, comparison.left_mm), ("as they are", "less a motion of the camera"),
        strict=True,
    ):  # fmt: skip
        size = 1e3 * np.hypot(*moved.T)
        longest = max(float(size.max()), 1e-6)
        ax.quiver(*comparison.uv_px[every].T, *(1e3 * moved[every]).T, angles="xy", scale_units="xy",
                  scale=longest / LONGEST_MOVE_PX, width=0.0018, color=FUSED)  # fmt: skip
        ax.add_patch(Rectangle((-0.5, -0.5), mode.width, mode.height, fc="none", ec=INK, lw=0.6))
        ax.set_title(f"{words}: rms {np.sqrt(np.mean(size**2)):.1f}, longest arrow {longest:.1f} µm")
        beside = LONGEST_MOVE_PX + 0.5  # arrows begin up to the picture's border
        ax.set(xlim=(-beside, mode.width + beside), ylim=(mode.height + beside, -beside),
               xlabel="u, px", ylabel="v, px")  # fmt: skip
    return fig


def _plane_panels(planes: Planes) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each plane, room for a colour bar on the right."""
    n = len(planes)
    span = np.ptp(np.concatenate([seen.xy_mm for _, seen in planes]), axis=0)
    box_in = (WIDTH_IN - 0.9 - _COLOUR_BAR_IN - 0.82 * (n - 1)) / n
    height_in = float(np.clip(box_in * span[1] / max(span[0], 1e-9), 1.2, 6.0)) + 0.72
    return panel_row(n, height_in=height_in, width_in=WIDTH_IN - _COLOUR_BAR_IN)


def _plane_labels(ax: Axes) -> None:
    ax.set(xlabel="x, mm", ylabel="y, mm", aspect="equal", adjustable="datalim")
    ax.invert_yaxis()
    ax.grid(visible=False)


def _colour_bar(fig: Figure, shown: object, label: str, form: str | None = None) -> None:
    """Widen a figure to the right by a colour bar."""
    width_in, height_in = fig.get_size_inches()
    for ax in fig.axes:
        box = ax.get_position(original=True)
        ax.set_position((box.x0 * width_in / (width_in + _COLOUR_BAR_IN), box.y0,
                         box.width * width_in / (width_in + _COLOUR_BAR_IN), box.height))  # fmt: skip
    last = fig.axes[-1].get_position(original=True)
    fig.set_size_inches(width_in + _COLOUR_BAR_IN, height_in)
    bar = fig.add_axes((last.x1 + 0.1 / (width_in + _COLOUR_BAR_IN), last.y0, 0.012, last.height))
    fig.colorbar(shown, cax=bar, format=form).set_label(label)  # type: ignore[arg-type]


def _levels(values: FloatArray) -> FloatArray:
    return np.linspace(0, max(float(np.quantile(values, 0.995)), 1e-6), 11)


def _spacing(xy_mm: FloatArray) -> float:
    """Return the distance of neighbours in a grid of dots that fills its hull."""
    return float(np.sqrt(np.prod(np.ptp(xy_mm, axis=0)) / len(xy_mm)))


def _triangles(xy_mm: FloatArray) -> Triangulation:
    """Return triangles between dots, those over gaps masked."""
    triangles = Triangulation(*xy_mm.T)
    corners = xy_mm[triangles.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    triangles.set_mask(sides > LONGEST_SIDE * _spacing(xy_mm))
    return triangles


def _longest_axis(covariance: FloatArray) -> FloatArray:
    """Return the greater standard deviation along any direction, shape (n,), of 2 x 2 covariances."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(covariance)[:, 1]))
