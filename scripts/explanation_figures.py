"""Draw the figures of the explanations and of the assembly's tutorial, as light SVG.

    python scripts/explanation_figures.py docs/figures

Each is computed from the formulas of its page, or by the very functions that it explains, with seeded noise: what a
figure shows is simulated unless it is geometry. Names of the figures: those of the functions below.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Polygon, Rectangle
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))

from brick_shakes import EPOCH_NS, LEVER_ARM_MM, simulate_shake  # noqa: E402 (the tests' support is no package)

from bricktrack_common.arrays import FloatArray  # noqa: E402
from bricktrack_common.camera_model import IMX219_1080P  # noqa: E402
from bricktrack_host.evaluation.paper_brick import paper_brick  # noqa: E402
from bricktrack_host.fusion.estimate import fuse  # noqa: E402
from bricktrack_host.tracking.led_model.led_profile import outline_moments  # noqa: E402

BLUE, RED, GREEN, AMBER, GREY = "#1f5f8b", "#c8553d", "#588157", "#b7791f", "#6b7280"
PLANE_A_MM, PLANE_B_MM = 101.117, 161.111
FOCAL_PX = 2700.0  # about that of the 1080p mode, whose 1920 px see 38.9 degrees
DEPTH_MM = 134.0
LINE_US = IMX219_1080P.line_time_ns / 1000
PERIOD_MS = 1000 / 30.0058


def canvas(width: float = 7.6, height: float = 3.2, n: int = 1) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = [figure.add_subplot(1, n, i + 1) for i in range(n)]
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.93", lw=0.6)
        axes.set_axisbelow(True)
    return figure, panels


def timing_rows() -> Figure:
    """Draw two frames: when each row is exposed, what the stamp is, and when an LED is seen."""
    figure, (axes,) = canvas()
    rows = np.array([0, 1079])
    exposure_ms = 4.0
    for k in range(2):
        read_ms = k * PERIOD_MS + rows * LINE_US / 1000
        corners = [
            *zip(read_ms - exposure_ms, rows, strict=True),
            *zip(read_ms[::-1], rows[::-1], strict=True),
        ]
        axes.add_patch(Polygon(corners, facecolor="#dbe7f0", edgecolor=BLUE, lw=0.8))
        axes.plot(read_ms - exposure_ms / 2, rows, color=BLUE, lw=1.4, ls="--")
        axes.plot(read_ms[0], 0, "v", color=RED, ms=7, clip_on=False)
        led_row = 300 if k == 0 else 820
        at = k * PERIOD_MS + led_row * LINE_US / 1000 - exposure_ms / 2
        axes.plot(at, led_row, "o", color=AMBER, ms=7)
        axes.annotate("an LED, at its own t(v)", (at, led_row), (at + 3.5, led_row - 40), fontsize=9, va="center",
                      arrowprops={"arrowstyle": "-", "color": GREY, "lw": 0.7})  # fmt: skip
    axes.annotate(
        "SensorTimestamp", (0, 0), (2.5, -70), fontsize=9, color=RED, annotation_clip=False, va="center"
    )
    axes.annotate("middle of the exposure", (8.3, 545), (12.5, 560), fontsize=9, color=BLUE, va="center")
    axes.set(xlabel="ms after the first stamp", ylabel="sensor row", xlim=(-6, 58), ylim=(1079, -110))
    axes.set_yticks([0, 540, 1079])
    return figure


def timing_sample_age() -> Figure:
    """Draw how old the newest inertial sample is when it is read, with two clocks that differ by 0.2 %."""
    figure, (axes,) = canvas(height=2.4)
    read_ms = np.arange(0.0, 15_000.0, 10.0)
    sensor_ms = 10.0 * 1.002
    age = (read_ms - 3.0) % sensor_ms
    breaks = np.flatnonzero(np.diff(age) > 5.0)
    for first, last in zip([0, *(breaks + 1)], [*breaks, len(age) - 1], strict=True):
        axes.plot(read_ms[[first, last]] / 1000, age[[first, last]], color=BLUE, lw=1.6)
    for i in breaks:
        axes.axvline(read_ms[i] / 1000, color=GREY, lw=0.6, ls=":")
    axes.set(xlabel="s", ylabel="age when read, ms", xlim=(0, 15), ylim=(0, 10.5))
    return figure


def irt_ray() -> Figure:
    """Draw a pixel, its points on both planes, and the ray through them (a side view)."""
    figure, (axes,) = canvas(height=3.0)
    axes.grid(visible=False)
    for z, name in ((PLANE_A_MM, "plane A, z = a"), (PLANE_B_MM, "plane B, z = b")):
        axes.plot([z, z], [-34, 48], color=GREY, lw=1.2)
        axes.text(z, 50, name, ha="center", fontsize=9, color=GREY)
        axes.plot(np.full(9, z), np.arange(-32, 33, 8.0), "_", color="0.7", ms=7)
    m = 134.0
    for slope, words, colour in ((-0.10, "0", BLUE), (0.21, "t", RED)):
        axes.plot([0, 185], [0, 185 * slope], color=colour, lw=1.2)
        for z, letter in ((PLANE_A_MM, "A"), (PLANE_B_MM, "B")):
            axes.plot(z, z * slope, "o", color=colour, ms=5)
            axes.text(z + 1.5, z * slope + 2.5, f"${letter}_{words}$", fontsize=10, color=colour)
    eps = 11.0
    axes.plot(m, m * -0.10, "*", color=BLUE, ms=13)
    axes.text(m - 3, m * -0.10 - 8, "LED 0, at depth m", fontsize=9, color=BLUE, ha="center")
    axes.plot(m + eps, (m + eps) * 0.21, "*", color=RED, ms=13)
    axes.text(m + eps - 3, (m + eps) * 0.21 + 4, "LED t", fontsize=9, color=RED, ha="right")
    axes.plot([m, m], [m * -0.10, m * 0.21], color=GREY, lw=0.9, ls="--")
    axes.annotate("", (m + eps, -24), (m, -24), arrowprops={"arrowstyle": "<->", "color": GREY})
    axes.text(m + eps / 2, -31, r"$\varepsilon_t$", ha="center", fontsize=11)
    axes.plot([m + eps, m + eps], [-24, (m + eps) * 0.21], color=GREY, lw=0.6, ls=":")
    axes.plot(0, 0, "s", color="0.2", ms=9)
    axes.text(0, 6, "camera", ha="center", fontsize=9)
    axes.set(xlabel="z, mm", ylabel="x, mm", xlim=(-12, 188), ylim=(-37, 56))
    return figure


def prsoi_iterations() -> Figure:
    """Draw the error of the pose by round, for the sign as corrected and as printed; exact rays, 200 orientations."""
    brick = paper_brick()
    draw = np.random.default_rng(7)
    G = brick.led_positions_mm[1:] - brick.led_positions_mm[0]
    H = np.linalg.pinv(G)
    a, b = PLANE_A_MM, PLANE_B_MM
    figure, panels = canvas(n=2, height=3.0)
    errors: dict[float, list[tuple[FloatArray, FloatArray]]] = {1.0: [], -1.0: []}
    for _ in range(200):
        R = Rotation.from_rotvec(np.deg2rad(draw.uniform(-25, 25, 3))).as_matrix()
        t = np.array([0.0, 0.0, DEPTH_MM]) - R @ brick.led_positions_mm.mean(axis=0)
        at = brick.led_positions_mm @ R.T + t
        slopes = at[:, :2] / at[:, 2:]
        A, B = slopes * a, slopes * b
        for sign, kept in errors.items():
            kept.append(_prsoi(A, B, G, H, sign, R, t))
    for sign, colour, words in ((1.0, BLUE, "k = + i × j"), (-1.0, RED, "k = − i × j, as printed")):
        mm = np.array([e[0] for e in errors[sign]])
        deg = np.array([e[1] for e in errors[sign]])
        for axes, values in zip(panels, (mm, deg), strict=True):
            low, middle, high = np.percentile(values, (5, 50, 95), axis=0)
            rounds = np.arange(1, values.shape[1] + 1)
            axes.fill_between(rounds, low, high, color=colour, alpha=0.15, lw=0)
            axes.semilogy(rounds, middle, color=colour, marker="o", ms=3, label=words)
    panels[0].set(xlabel="round", ylabel="position error, mm", ylim=(1e-4, 30))
    panels[1].set(xlabel="round", ylabel="rotation error, deg", ylim=(1e-4, 200))
    panels[0].legend(frameon=False, fontsize=9, loc="lower left")
    for axes in panels:
        axes.set_xticks([1, 4, 8, 12, 16])
    return figure


def _prsoi(
    A: FloatArray,
    B: FloatArray,
    G: FloatArray,
    H: FloatArray,
    sign: float,
    R_true: FloatArray,
    t_true: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Iterate the page's formulas for 16 rounds; return the errors of position (mm) and rotation (deg)."""
    a, b = PLANE_A_MM, PLANE_B_MM
    dA, dB = A[1:] - A[0], B[1:] - B[0]
    kappa = float((dA * dB).sum() / (dA * dA).sum())
    eps, m = np.zeros(len(G)), 0.5 * (a + b)
    mm, deg = [], []
    for _ in range(16):
        X = dA + (B[1:] - A[1:]) * (eps / ((b - m) + (m - a) * kappa))[:, None]
        row_i, row_j = (H @ X).T
        s = np.sqrt(np.linalg.norm(row_i) * np.linalg.norm(row_j))
        m = ((b - a) / s - b + a * kappa) / (kappa - 1)
        i, j = row_i / s, row_j / s
        k = sign * np.cross(i, j)
        eps = G @ k
        U, _, Vt = np.linalg.svd(
            np.array([i, j, sign * k])
        )  # [i; j; i x j]: no reflection, whatever the sign
        R = U @ Vt
        t = np.array([*(A[0] + (B[0] - A[0]) * (m - a) / (b - a)), m])
        mm.append(np.linalg.norm(t - t_true))
        deg.append(np.rad2deg(np.arccos(np.clip((np.trace(R.T @ R_true) - 1) / 2, -1, 1))))
    return np.maximum(mm, 1e-7), np.maximum(deg, 1e-7)


def dome_shift() -> Figure:
    """Draw where the centroid of an LED's outline is, against the angle that it is seen at."""
    figure, (axes, shapes) = canvas(n=2, height=3.0)
    psi = np.deg2rad(np.linspace(0, 80, 81))
    for collar, colour in ((0.0, RED), (0.7, BLUE), (2.0, GREEN)):
        shift = outline_moments(np.cos(psi), radius_mm=3.0, collar_mm=collar, distance_mm=1e6)[1]
        axes.plot(np.rad2deg(psi), shift, color=colour, label=f"collar {collar:g} mm")
    axes.plot(
        np.rad2deg(psi),
        3.0 * 3 / 8 * np.sin(psi),
        color=GREY,
        ls="--",
        label="centre of the\nhemisphere's volume",
    )
    axes.axhline(0.0, color="0.5", lw=0.8)
    axes.set(
        xlabel="angle to the LED's axis, deg", ylabel="centroid less sphere's centre, mm", ylim=(-0.4, 1.55)
    )
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    shapes.set_aspect("equal")
    shapes.set_axis_off()
    angle = np.deg2rad(59)
    half = np.linspace(-np.pi / 2, np.pi / 2, 90)
    for i, (collar, colour) in enumerate(((0.0, RED), (0.7, BLUE), (2.0, GREEN))):
        behind = collar * np.sin(angle)
        front = np.column_stack([3 * np.cos(half), 3 * np.sin(half)])
        back = np.column_stack([-behind - 3 * np.cos(angle) * np.cos(half), 3 * np.sin(half)])[::-1]
        outline = np.vstack([front, back]) + np.array([8.0 * i, 0.0])
        shapes.add_patch(Polygon(outline, facecolor=colour, alpha=0.25, edgecolor=colour, lw=1.2))
        shift = float(outline_moments(np.cos(angle), radius_mm=3.0, collar_mm=collar, distance_mm=1e6)[1])
        shapes.plot(8.0 * i, 0, "+", color="0.2", ms=9)
        shapes.plot(8.0 * i + shift, 0, "o", color=colour, ms=5)
        shapes.text(8.0 * i, -4.4, f"{shift:+.2f} mm", ha="center", fontsize=9, color=colour)
    shapes.set(xlim=(-5, 20), ylim=(-6, 5), title="outlines at 59 degrees")
    shapes.title.set_fontsize(9)
    return figure


def rolling_shutter() -> Figure:
    """Draw the paper's LEDs in one frame of a brick that moves sideways at 0.25 m/s, against one instant."""
    figure, (axes,) = canvas(width=6.4, height=3.8)
    brick = paper_brick()
    p = centred(brick.led_positions_mm)
    uv = p[:, :2] * FOCAL_PX / (DEPTH_MM + p[:, 2:]) * [1, 1] + [960, 540]
    delay_s = (uv[:, 1] - 540) * LINE_US * 1e-6
    seen = uv + np.column_stack([250.0 * delay_s * FOCAL_PX / (DEPTH_MM + p[:, 2]), np.zeros(len(p))])
    axes.add_patch(Rectangle((0, 0), 1919, 1079, fill=False, edgecolor="0.6"))
    axes.plot(*uv.T, "o", ms=13, mfc="none", mec=GREY, label="where the LEDs are at the centre row's instant")
    axes.plot(*seen.T, "o", ms=11, color=BLUE, alpha=0.8, label="where the picture shows them")
    for one, other, name in zip(uv, seen, brick.led_names, strict=True):
        axes.annotate("", other, one, arrowprops={"arrowstyle": "->", "color": RED, "lw": 1.2})
        axes.text(max(one[0], other[0]) + 30, one[1], name, fontsize=9, va="center")
    axes.set(xlabel="u, px", ylabel="v, px", xlim=(-20, 1940), ylim=(1100, -20), aspect="equal")
    axes.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return figure


def fusion_dropout() -> Figure:
    """Draw a simulated shake whose view is blocked for half a second: cubic through the frames, and the smoother."""
    figure, (motion, error) = canvas(n=2, height=3.3)
    hidden = (2.5, 3.0)
    shake = simulate_shake(
        21, duration_s=6.0, offset_s=0.004, skew=2e-5, acc_lag_s=-0.0034, dropouts=(hidden,),
        position_sd_mm=0.02, rotation_sd_deg=0.02,
    )  # fmt: skip
    t_ns = np.arange(EPOCH_NS + 2_000_000_000, EPOCH_NS + 3_600_000_000, 5_000_000)
    track = fuse(shake.optical, shake.imu, lever_arm_mm=LEVER_ARM_MM, output_t_ns=t_ns).track
    _, true = shake.truth(t_ns)
    at = (t_ns - EPOCH_NS) * 1e-9
    seen = np.isfinite(shake.optical.t_camera_brick_mm).all(axis=1)
    frames_s = (shake.optical.t_ns[seen] - EPOCH_NS) * 1e-9
    frames_mm = shake.optical.t_camera_brick_mm[seen]
    cubic = CubicSpline(frames_s, frames_mm)(at)
    sd = np.sqrt(track.covariance[:, 3, 3])
    near = (frames_s > at[0]) & (frames_s < at[-1])
    middle = true[:, 0].mean()
    motion.plot(at, true[:, 0] - middle, color="0.75", lw=3.5, label="truth")
    motion.plot(at, cubic[:, 0] - middle, color=RED, lw=1.1, label="cubic through the frames")
    motion.plot(
        at, track.t_camera_brick_mm[:, 0] - middle, color=BLUE, lw=1.1, label="camera and IMU, smoothed"
    )
    motion.plot(frames_s[near], frames_mm[near, 0] - middle, ".", color="0.2", ms=4, label="frames")
    span = 1.15 * np.abs(true[:, 0] - middle).max()
    motion.set(xlabel="s", ylabel="x, mm", ylim=(-span, span))
    error.fill_between(at, -2 * sd, 2 * sd, color=BLUE, alpha=0.18, lw=0, label="± 2 stated deviations")
    error.plot(at, track.t_camera_brick_mm[:, 0] - true[:, 0], color=BLUE, lw=1.1, label="its error")
    error.set(xlabel="s", ylabel="error in x, mm")
    figure.legend(frameon=False, fontsize=8, loc="outside lower center", ncols=3)
    for axes in (motion, error):
        axes.axvspan(*hidden, color="0.92", lw=0, zorder=0)
    return figure


def centred(p_mm: FloatArray) -> FloatArray:
    """Return points less the middle of the box around them."""
    return p_mm - 0.5 * (p_mm.min(axis=0) + p_mm.max(axis=0))


def uncertainty_parts() -> Figure:
    """Draw what each source does to x and z of one frame of the paper's brick, square before the camera.

    To first order: what a source moves in the picture, through the least-squares pose of all seven LEDs.
    """
    figure, (axes,) = canvas(height=3.2)
    brick = paper_brick()
    p = centred(brick.led_positions_mm)

    def picture(pose: FloatArray, shift_mm: FloatArray | float = 0.0) -> FloatArray:
        at = p @ Rotation.from_rotvec(pose[:3]).as_matrix().T + pose[3:] + [0, 0, DEPTH_MM] + shift_mm
        return np.asarray(at[:, :2] / at[:, 2:] * FOCAL_PX).ravel()

    step = 1e-5
    J = np.column_stack([(picture(step * e) - picture(-step * e)) / (2 * step) for e in np.eye(6)])
    sd_um_a_px = 1000 * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[[3, 5]]
    ahead = p + np.array([0.0, 0.0, DEPTH_MM])
    sight = -ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    # Of length sin psi: across the line of sight, towards where the dome points.
    across = brick.led_axes - (brick.led_axes * sight).sum(axis=1, keepdims=True) * sight

    def profile_um(share: float) -> FloatArray:
        moved = picture(np.zeros(6), share * brick.led_radii_mm[:, None] * across) - picture(np.zeros(6))
        return np.asarray(1000 * np.abs(np.linalg.lstsq(J, moved, rcond=None)[0])[[3, 5]])

    rows = [
        ("centroids, 0.05 px", 0.05 * sd_um_a_px),
        ("rays, 1 µm", 0.001 * FOCAL_PX / DEPTH_MM * sd_um_a_px),
        ("LED profile fitted, 0.005 r sin ψ", profile_um(0.005)),
        ("LED profile not fitted, 0.1 r sin ψ", profile_um(0.1)),
        ("target's scale, 0.1 % of 5 mm", (5.0, 5.0)),
        ("time, 0.2 ms at 0.3 m/s", (60.0, 60.0)),
        ("time, 1 ms at 0.3 m/s", (300.0, 300.0)),
    ]
    y = np.arange(len(rows))[::-1]
    axes.barh(y + 0.19, [um[0] for _, um in rows], 0.36, color=BLUE, label="x")
    axes.barh(y - 0.19, [um[1] for _, um in rows], 0.36, color=AMBER, label="z")
    axes.set_xscale("log")
    axes.set_yticks(y, [name for name, _ in rows], fontsize=9)
    axes.set_xlabel("µm")
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    axes.set_xlim(0.02, 1000)
    for name, um in rows:
        print(f"    {name}: x {um[0]:.2f}, z {um[1]:.2f} um")
    return figure


def assembly_views() -> Figure:
    """Draw a brick in three parts, and which unit sees which part from which."""
    figure, (axes,) = canvas(width=7.0, height=2.8)
    axes.set_axis_off()
    axes.set_aspect("equal")
    for name, x0, colour in (("A", 0.0, "#dde5ec"), ("B", 62.0, "#d7e6d5"), ("C", 124.0, "#f1dcd4")):
        axes.add_patch(Rectangle((x0, 0), 56, 60, facecolor=colour, edgecolor="0.4", lw=1.2))
        axes.text(x0 + 28, 30, name, ha="center", va="center", fontsize=22, color="0.25")
    for unit, start, end, y, colour in (
        ("b7-1", 46.0, 70.0, 12.0, BLUE),
        ("b7-2", 108.0, 132.0, 12.0, GREEN),
        ("b7-3", 46.0, 132.0, 50.0, RED),
    ):
        axes.add_patch(
            FancyArrowPatch((start, y), (end, y), arrowstyle="-|>", mutation_scale=13, color=colour, lw=1.8)
        )
        axes.add_patch(Rectangle((start - 7, y - 4), 7, 8, facecolor=colour, edgecolor="none"))
        for dy in (-5, 0, 5):
            axes.plot(end + 2.5, y + dy, "o", color="#ffb703", mec="0.3", mew=0.6, ms=6)
        axes.text((start + end) / 2, y + 3.5, unit, ha="center", fontsize=10, color=colour)
    axes.text(0, -10, "square: camera     dots: LEDs     base: A", fontsize=9, color=GREY)
    axes.set(xlim=(-3, 184), ylim=(-14, 63))
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (
    timing_rows, timing_sample_age, irt_ray, prsoi_iterations, dome_shift, rolling_shutter, fusion_dropout,
    uncertainty_parts, assembly_views,
)  # fmt: skip


def main() -> None:
    folder = Path(sys.argv[1])
    matplotlib.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "bricktrack", "font.size": 10,
                            "font.family": ["sans-serif"]}  # fmt: skip
    for draw in FIGURES:
        path = folder / f"{draw.__name__.replace('_', '-')}.svg"
        draw().savefig(path, metadata={"Date": None, "Creator": None}, facecolor="white")
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
