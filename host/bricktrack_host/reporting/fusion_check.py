"""How far the motion fused LED by LED is from that fused pose by pose: the chart, and the words."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.reporting.chart import Chart, panel_grid
from bricktrack_host.reporting.chart_marks import band
from bricktrack_host.reporting.plots import FUSED, LED_COLOURS, TimeAxis, line, mark_events
from bricktrack_host.reporting.thinning import thinned_band
from bricktrack_host.results.result_store import Details, RunResult
from bricktrack_host.results.run_summary import KeyFigures
from bricktrack_host.tracks import FusedTrack

CHECK_PREFIX = "pose_level_"
"""Names of the figures of the check begin so, among what the results say of the fusion."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoFusions:
    """How far two fusions of one motion are apart, at the same n instants in any order.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,), camera time
    shift_mm : ndarray, shape (n, 3), mm, camera axes
    turn_rad : ndarray, shape (n, 3), rad, brick axes
    allowed_sd : ndarray, shape (n, 6), of ``[dtheta rad, dt mm]``
        By the covariances of both, as `fusion.cross_check` has it.
    """

    t_ns: IntArray
    shift_mm: FloatArray
    turn_rad: FloatArray
    allowed_sd: FloatArray

    @classmethod
    def of(cls, by_leds: FusedTrack, by_poses: FusedTrack) -> "TwoFusions":
        """Return how far two tracks of the same instants are apart."""
        turn = np.swapaxes(by_poses.R_camera_brick, 1, 2) @ by_leds.R_camera_brick
        variances = (np.diagonal(one.covariance, axis1=1, axis2=2) for one in (by_leds, by_poses))
        return cls(
            by_leds.t_ns,
            by_leds.t_camera_brick_mm - by_poses.t_camera_brick_mm,
            rvec_from_matrix(turn),
            np.asarray(np.sqrt(sum(variances))),
        )


def fusion_check_chart(result: RunResult, figures: KeyFigures, two: TwoFusions) -> Chart:
    """Return the difference of both motions over time, in the band that both covariances allow."""
    order = np.argsort(two.t_ns, kind="stable")
    t_ns, shift_mm, sd = two.t_ns[order], two.shift_mm[order], two.allowed_sd[order]
    turn_deg = np.rad2deg(two.turn_rad)
    axis = TimeAxis.of(result)
    chart = panel_grid(2, height_in=3.6, legend=True)
    for (panel,), values, allowed, words in zip(
        chart.panels,
        (shift_mm, turn_deg[order]),
        (sd[:, 3:], np.rad2deg(sd[:, :3])),
        ("apart, mm", "apart, deg"),
        strict=True,
    ):
        mark_events(panel, axis, result, figures)
        t_s, half = axis.s(t_ns), 1.96 * allowed.max(axis=1)
        panel.add(band(*thinned_band(t_s, -half, half), colour=FUSED, opacity=0.15, label="allowed, 95 %"))
        for i, colour in enumerate(LED_COLOURS[:3]):
            panel.add(line(t_s, values[:, i], colour=colour, width_pt=0.8, label="xyz"[i]))
        limit = _limit(values)
        panel.y_limits, panel.y_label = (-limit, limit), words
    panel.x_label = axis.label
    return chart


def fusion_check_words(alignment: Details) -> list[str]:
    """Return what the check found, in words; nothing where there was none."""
    names = ("agrees", "apart_rms_mm", "apart_max_mm", "apart_max_deg", "share_beyond")
    agrees, rms_mm, max_mm, max_deg, beyond = (alignment.get(CHECK_PREFIX + name) for name in names)
    if not all(isinstance(v, float | int) for v in (rms_mm, max_mm, max_deg, beyond)):
        return []
    verdict = "They agree" if agrees else "They do not agree: results of this run are to be doubted"
    return [
        "The results are fused LED by LED, each at its own row's instant. The same run is fused pose by pose "
        f"as well, by another way from the pictures on. {verdict}: {rms_mm:.3f} mm apart rms, "
        f"{max_mm:.3f} mm and {max_deg:.3f} deg at most, and in {100 * float(str(beyond)):.1f} % of the "
        "instants by more than their covariances allow one time in 1000."
    ]


def _limit(values: FloatArray) -> float:
    known = np.abs(values[np.isfinite(values)])
    return max(0.01, 1.25 * float(np.percentile(known, 99.8))) if known.size else 0.01
