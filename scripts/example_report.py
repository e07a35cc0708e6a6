"""Write the results and the report of an invented run, to see what they look like without a unit or a video.

Everything in it is simulated, by formulas that share nothing with the processing: a brick that shakes, strikes
once, and is hidden from the camera for a third of a second.

Run as ``python scripts/example_report.py FOLDER``.
"""

import sys
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.clocks import ClockTriplet
from bricktrack_common.imu_records import ImuDescription, ImuFlag
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_common.run_manifest import (
    CameraSection,
    ClocksSection,
    QualitySection,
    RunManifest,
    TriggerSection,
)
from bricktrack_host.evaluation.paper_brick import paper_brick
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.reporting.page_picture import page_picture
from bricktrack_host.reporting.plots import CalibrationPicture, FrameOverlay
from bricktrack_host.reporting.report import ReportExtras, write_report
from bricktrack_host.results.daq_clock import fit_edges
from bricktrack_host.results.rest_pose import tare
from bricktrack_host.results.result_store import Provenance, RunResult, write_results
from bricktrack_host.results.true_motion import TrueMotion
from bricktrack_host.results.truth import compare_with_truth
from bricktrack_host.tracks import FusedTrack, ImuTrack, LedObservations, OpticalTrack

BRICK = paper_brick()
T0_NS = 5_118_514_105_508
PERIOD_NS = 33_326_871
DURATION_S = 15.0
IMPACT_S = 6.23
DROPOUT_S = (8.4, 8.75)
SD_MM = np.array([0.03, 0.02, 0.09])
SD_RAD = np.deg2rad([0.05, 0.07, 0.03])


def motion(t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation vectors, rad, and positions, mm, at times after the trigger."""
    begins = np.clip((t_s - 1.0) / 0.5, 0, 1) ** 2 * np.clip((14.0 - t_s) / 1.0, 0, 1)
    after = np.maximum(t_s - IMPACT_S, 0)
    ring = 0.8 * np.sin(2 * np.pi * 22 * after) * np.exp(-after / 0.06)
    sway = np.sin(2 * np.pi * 3.1 * t_s) + 0.4 * np.sin(2 * np.pi * 7.3 * t_s + 1)
    t_mm = np.stack(
        [
            -28.4 + begins * 2.6 * sway + ring,
            -23.5 + begins * 0.8 * np.sin(2 * np.pi * 6.2 * t_s) + 0.3 * ring,
            129.3 + begins * 1.4 * np.sin(2 * np.pi * 3.1 * t_s + 0.7),
        ],
        axis=-1,
    )
    rvec = np.stack(
        [
            -0.02 + begins * 0.010 * np.sin(2 * np.pi * 4.4 * t_s),
            0.014 + begins * 0.035 * np.sin(2 * np.pi * 3.1 * t_s + 0.3) + 0.01 * ring,
            -0.012 + begins * 0.012 * np.sin(2 * np.pi * 5.2 * t_s),
        ],
        axis=-1,
    )
    return rvec, t_mm


def true_motion_at(t_ns: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return rotation, position, angular rate (brick axes) and velocity, by differences over 20 us."""
    t_s = (t_ns - T0_NS) / 1e9
    rvec, t_mm = motion(t_s)
    (r0, p0), (r1, p1) = motion(t_s - 1e-5), motion(t_s + 1e-5)
    R = matrix_from_rvec(rvec)
    turn = rvec_from_matrix(np.swapaxes(matrix_from_rvec(r0), -1, -2) @ matrix_from_rvec(r1))
    return R, t_mm, turn / 2e-5, (p1 - p0) / 2e-5


def true_motion() -> TrueMotion:
    """Return the run's true motion every millisecond."""
    t_ns = T0_NS + np.arange(-700_000_000, 15_700_000_000, 1_000_000, dtype=np.int64)
    R, t_mm, omega, v = true_motion_at(t_ns)
    dropout = np.array([[T0_NS + int(s * 1e9) for s in DROPOUT_S]], dtype=np.int64)
    return TrueMotion(
        t_ns=t_ns,
        R_camera_brick=R,
        t_camera_brick_mm=t_mm,
        omega_brick_radps=omega,
        v_camera_mmps=v,
        dropouts_ns=dropout,
        is_continuous=True,
    )


def example_manifest() -> RunManifest:
    """Return a manifest as a simulated unit would write it."""
    real_ns = 1_790_000_000_000_000_000
    triplets = [
        ClockTriplet(monotonic_ns=T0_NS + d, boottime_ns=T0_NS + d, realtime_ns=real_ns + d)
        for d in (-9_000_000_000, 0, 15_200_000_000)
    ]
    return RunManifest(
        run_id="unit-01_b3f2a7_0004_example",
        unit="unit-01",
        label="example",
        state="complete",
        simulated=True,
        origin="bricktrackd",
        hardware={"model": "simulated"},
        software={"bricktrack": "0.1.0"},
        camera=CameraSection(
            model="imx219",
            mode=IMX219_1080P,
            exposure_us=4000,
            analogue_gain=1.0,
            colour_gains=(1.8, 1.6),
            frame_duration_us=33327,
            encoder="libx264",
            encoder_settings={"bitrate": 15_000_000},
        ),
        imus=[
            ImuDescription(
                name="brick",
                chip_id="00" * 16,
                bus="/dev/i2c-1",
                address=0x28,
                opr_mode=7,
                fusion=False,
                acc_range_g=16,
                period_ns=10_000_000,
                t0_ns=T0_NS - 500_003_123,
            )
        ],
        trigger=TriggerSection(pin="GPIO17", t0_ns=T0_NS, nominal_hz=200.0),
        clocks=ClocksSection(arm=triplets[0], trigger=triplets[1], end=triplets[2]),
        window_ns=(T0_NS - 500_000_000, T0_NS + 15_000_000_000),
        quality=QualitySection(frames=463, frames_dropped=2, imu_slots=1550, imu_gaps=3, edges=2999),
        missing=[],
        files=[],
    )


def _covariance(n: int, scale: FloatArray) -> FloatArray:
    base = np.diag(np.concatenate([SD_RAD, SD_MM]) ** 2)
    return np.asarray(base * (scale**2)[:, None, None] * np.ones((n, 1, 1)))


def _noisy(
    rng: np.random.Generator, R: FloatArray, t_mm: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray]:
    turn = rng.normal(size=t_mm.shape) * SD_RAD * scale[:, None]
    shift = rng.normal(size=t_mm.shape) * SD_MM * scale[:, None]
    return R @ matrix_from_rvec(turn), t_mm + shift


def example_result(seed: int = 1) -> RunResult:
    """Return the result of an invented run: seeded, simulated, with one impact and one dropout."""
    rng = np.random.default_rng(seed)
    manifest = example_manifest()
    n_leds = BRICK.n_leds
    stamps = T0_NS - 480_000_000 + np.arange(464, dtype=np.int64) * PERIOD_NS
    stamps = np.delete(stamps, [121, 122])
    n = len(stamps)
    t_ns = stamps + 8_198_438
    hidden = (t_ns > T0_NS + DROPOUT_S[0] * 1e9) & (t_ns < T0_NS + DROPOUT_S[1] * 1e9)
    part = np.abs(t_ns - T0_NS - DROPOUT_S[0] * 1e9) < 8e7

    R, t_mm, _, _ = true_motion_at(t_ns)
    p = np.einsum("nij,lj->nli", R, BRICK.led_positions_mm) + t_mm[:, None]
    uv = np.array([959.5, 539.5]) + 2714.0 * p[..., :2] / p[..., 2:]
    residual = rng.normal(0, 0.06, (n, n_leds, 2))
    led_flags = np.zeros((n, n_leds), dtype=np.int64)
    led_flags[part, 0] = int(LedFlag.PARTLY_COVERED)
    led_flags[hidden] = int(LedFlag.MISSING)
    led_flags[300, 6] = int(LedFlag.OUTLIER)
    residual[300, 6] = [0.9, -0.4]
    residual[(led_flags & int(LedFlag.PARTLY_COVERED | LedFlag.MISSING)) != 0] = np.nan
    uv_seen = uv + np.nan_to_num(residual)
    uv_seen[hidden] = np.nan
    flags = np.zeros(n, dtype=np.int64)
    flags[part] |= int(PoseFlag.LED_MISSING)
    flags[hidden] = int(PoseFlag.NO_POSE | PoseFlag.LED_MISSING)
    scale = np.ones(n)
    R_seen, t_seen = _noisy(rng, R, t_mm, scale)
    R_seen[hidden], t_seen[hidden] = np.nan, np.nan
    covariance = _covariance(n, scale)
    covariance[hidden] = np.nan
    optical = OpticalTrack(
        t_ns=t_ns,
        R_camera_brick=R_seen,
        t_camera_brick_mm=t_seen,
        covariance=covariance,
        flags=flags,
        residual_px=residual,
        led_t_ns=stamps[:, None] - 2_000_000 + np.rint(uv[..., 1] * 18903.5).astype(np.int64),
    )
    observations = LedObservations(
        sensor_timestamp_ns=stamps,
        exposure_ns=np.full(n, 4_000_000, dtype=np.int64),
        uv_px=uv_seen,
        cov_px2=np.broadcast_to(0.06**2 * np.eye(2), (n, n_leds, 2, 2)).copy(),
        area_px2=np.where(hidden[:, None], np.nan, 4200.0 + rng.normal(0, 30, (n, n_leds))),
        led_flags=led_flags,
        frame_flags=np.where(hidden, int(PoseFlag.LED_MISSING), 0).astype(np.int64),
    )

    n_slots = 1550
    due = manifest.imus[0].t0_ns + np.arange(n_slots, dtype=np.int64) * 10_000_000
    imu_ns = due + 900_000 + np.rint(rng.gamma(2, 60_000, n_slots)).astype(np.int64)
    R_imu, _, omega, _ = true_motion_at(imu_ns)
    step = 1_000_000
    v0, v1 = true_motion_at(imu_ns - step)[3], true_motion_at(imu_ns + step)[3]
    force = (v1 - v0) / 2e-3 / 1000 - np.array([0.0, 9.81, 0.0])
    imu_flags = np.zeros(n_slots, dtype=np.int64)
    imu_flags[[400, 401, 900]] = int(ImuFlag.GAP)
    acc = np.einsum("nji,nj->ni", R_imu, force) + rng.normal(0, 0.02, (n_slots, 3))
    gyro = omega + rng.normal(0, 0.0017, (n_slots, 3)) + np.array([-0.009, 0.006, 0.012])
    acc[imu_flags != 0], gyro[imu_flags != 0] = np.nan, np.nan
    imu = ImuTrack(imu_ns, acc, gyro, imu_flags, 16 * 9.80665)

    edges = T0_NS + np.rint(np.arange(3000) * 5_000_100.0 + rng.normal(0, 5000, 3000)).astype(np.int64)
    edges[0] = T0_NS
    edge_fit = fit_edges(np.delete(edges, 1234), 200.0)

    def fused_at(times_ns: IntArray) -> FusedTrack:
        R_true, t_true, omega_true, v_true = true_motion_at(times_ns)
        t_s = (times_ns - T0_NS) / 1e9
        inside = np.clip(
            np.minimum(t_s - DROPOUT_S[0], DROPOUT_S[1] - t_s) / (DROPOUT_S[1] - DROPOUT_S[0]), 0, None
        )
        spread = 0.4 + 12 * inside
        # Smoothed errors vary slowly: one value every 50 ms, joined by straight lines.
        knots = np.arange(-1.0, 16.5, 0.05)
        noise = np.stack([np.interp(t_s, knots, rng.normal(size=knots.size)) for _ in range(6)], axis=-1)
        turn, shift = noise[:, :3] * SD_RAD * spread[:, None], noise[:, 3:] * SD_MM * spread[:, None]
        found = np.where(inside > 0, int(PoseFlag.DROPOUT), 0).astype(np.int64)
        found[np.abs(t_s - IMPACT_S) < 0.015] |= int(PoseFlag.IMPACT)
        found[(times_ns < t_ns[0]) | (times_ns > t_ns[-1])] |= int(PoseFlag.EXTRAPOLATED)
        return FusedTrack(
            t_ns=times_ns,
            R_camera_brick=R_true @ matrix_from_rvec(turn),
            t_camera_brick_mm=t_true + shift,
            omega_brick_radps=omega_true,
            v_camera_mmps=v_true,
            covariance=_covariance(len(times_ns), spread),
            flags=found,
        )

    numbers = np.arange(edge_fit.last_index + 1, dtype=np.int64)
    return RunResult(
        manifest=manifest,
        led_names=BRICK.led_names,
        observations=observations,
        optical=optical,
        fused={
            "imu": fused_at(imu_ns),
            "frame": fused_at(t_ns),
            "edge": fused_at(edge_fit.time_of_index(numbers)),
        },
        edge_index=numbers,
        edge_fit=edge_fit,
        imu=imu,
        imu_camera_t_ns=imu.t_ns - 210_000,
        rest=tare(optical, imu),
        alignment={
            "method": "frame rotations against the integrated gyroscope",
            "imu_minus_camera_ms": 0.21,
            "imu_minus_camera_sd_ms": 0.05,
            "skew_ppm": 3.1,
        },
        calibration={"method": "central rays, order 7", "rms_um": 14.2, "camera": "unit-01", "date": ""},
        problems=("2 frames were dropped by the camera",),
        provenance=Provenance(
            manifest_sha256="0" * 64,
            calibration_sha256="1" * 64,
            layout_sha256="2" * 64,
            software_version="0.1.0",
            settings={"segmentation": "default", "rolling_shutter": True},
        ),
        timings_s={"decode": 9.4, "find LEDs": 3.2, "solve poses": 1.1, "fuse": 4.8},
    )


def example_extras(result: RunResult, seed: int = 2) -> ReportExtras:
    """Return invented pictures, calibration coverage and the comparison with the true motion."""
    rng = np.random.default_rng(seed)
    overlays = []
    row, column = np.mgrid[0:1080, 0:1920]
    for i in (10, 180, 330):
        image = 18 + 10 * rng.random((1080, 1920)) + 12 * column / 1920
        for u, v in result.observations.uv_px[i]:
            image += 235 * np.clip(37.5 - np.hypot(column - u, row - v), 0, 1)
        seen = result.observations.uv_px[i]
        overlays.append(
            FrameOverlay(
                title=f"frame {i}",
                picture=page_picture(np.clip(image, 0, 255).astype(np.uint8)),
                detected_uv_px=seen,
                predicted_uv_px=seen - np.nan_to_num(result.optical.residual_px[i]),
            )
        )
    u, v = np.meshgrid(np.arange(290.0, 1640, 68), np.arange(90.0, 1000, 68))
    dots = np.stack([u.ravel(), v.ravel()], axis=1)
    corners = np.array([[256.0, 56.0], [1664, 56], [1664, 1024], [256, 1024]])
    calibration = CalibrationPicture(
        width_px=1920,
        height_px=1080,
        covered_uv_px=[corners],
        dots_uv_px=dots,
        residual_um=rng.normal(0, 14, dots.shape),
    )
    return ReportExtras(
        overlays=overlays, calibration=calibration, truth=compare_with_truth(result, true_motion())
    )


def main() -> None:
    """Write results and report to the folder named on the command line."""
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    result = example_result()
    write_results(result, folder / "results")
    write_report(result, folder / "report.html", example_extras(result))
    print(folder / "report.html")


if __name__ == "__main__":
    main()
