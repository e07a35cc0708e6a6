"""What the results say about themselves: how clocks were aligned, which calibration was used."""

import numpy as np

from bricktrack_common.errors import TrackingError
from bricktrack_host.calibration.calibration_file import Calibration
from bricktrack_host.calibration.ray_records import CentralRaysRecord
from bricktrack_host.fusion.estimate import FusionResult
from bricktrack_host.fusion.mount import check_chip_orientation
from bricktrack_host.reporting.fusion_check import CHECK_PREFIX
from bricktrack_host.reporting.plots import CalibrationPicture
from bricktrack_host.results.result_store import Details
from bricktrack_host.stages.clocks import Inertial
from bricktrack_host.tracks import OpticalTrack


def alignment_details(
    inertial: Inertial | None, fusion: FusionResult | None, optical: OpticalTrack
) -> Details:
    """Return what the results say about the clocks, and what the fusion learned besides."""
    if inertial is None:
        return {"method": "none: no inertial samples were used"}
    if inertial.is_hint:
        return {"method": "none: the inertial samples only hint at turns and impacts"}
    alignment = inertial.alignment
    details: Details = {
        "method": "motion" if alignment.source == "data" else "stamps",
        "offset_ms": alignment.offset_ns / 1e6,
        "offset_sd_ms": alignment.offset_sd_ns / 1e6,
        "skew_ppm": alignment.skew * 1e6,
        "skew_sd_ppm": alignment.skew_sd * 1e6,
        "correlation": alignment.correlation,
        "trusted": alignment.is_trusted,
    }
    if inertial.camera_alignment is not None:
        own = inertial.camera_alignment.camera
        details |= {
            "camera_sensor": inertial.camera_alignment.motion.kind,
            "camera_sensor_offset_ms": own.offset_ns / 1e6,
            "camera_sensor_offset_sd_ms": own.offset_sd_ns / 1e6,
            "camera_sensor_method": "motion" if own.source == "data" else "stamps",
        }
    if fusion is not None:
        # Between two sensors gravity falls out; what is left in its place is the difference of their biases.
        is_still = inertial.camera is None
        gravity = "gravity_camera_mps2" if is_still else "acc_bias_less_camera_sensors_mps2"
        details |= {
            "smoothed_offset_ms": fusion.offset_ns / 1e6,
            "smoothed_offset_sd_ms": fusion.offset_sd_ns / 1e6,
            "smoothed_skew_ppm": fusion.skew * 1e6,
            "acc_lag_ms": fusion.acc_lag_ns / 1e6,
            "gyro_bias_dps": np.rad2deg(fusion.gyro_bias_radps).tolist(),
            "acc_bias_mps2": fusion.acc_bias_mps2.tolist(),
            gravity: fusion.gravity_camera_mps2.tolist(),
            "mean_nis": fusion.mean_nis,
        }
        details |= _chip_details(inertial, fusion, optical)
        if fusion.check is not None:
            details |= {
                f"{CHECK_PREFIX}agrees": fusion.check.agrees,
                f"{CHECK_PREFIX}apart_rms_mm": fusion.check.rms_mm,
                f"{CHECK_PREFIX}apart_max_mm": fusion.check.max_mm,
                f"{CHECK_PREFIX}apart_max_deg": fusion.check.max_deg,
                f"{CHECK_PREFIX}share_beyond": fusion.check.share_apart,
            }
    return {k: v.item() if isinstance(v, np.generic) else v for k, v in details.items()}


def _chip_details(inertial: Inertial, fusion: FusionResult, optical: OpticalTrack) -> Details:
    """Return how the chip's own orientation agrees with the camera's, where it gives one; camera at rest."""
    chip = inertial.chip
    if chip is None or inertial.camera is not None:
        return {}
    try:
        check = check_chip_orientation(
            optical, chip.t_ns, chip.q_wxyz_gravity_imu, R_brick_imu=chip.R_brick_imu,
            alignment=inertial.alignment, gravity_camera_mps2=fusion.gravity_camera_mps2,
        )  # fmt: skip
    except TrackingError as e:
        return {"chip_orientation": str(e)}
    return {
        "chip_orientation_off_rms_deg": check.rms_deg,
        "chip_orientation_off_max_deg": check.max_deg,
        "chip_gravity_off_deg": check.gravity_deg,
    }


def calibration_details(calibration: Calibration) -> Details:
    """Return what the results say about the calibration."""
    return {
        "method": calibration.method,
        "camera": calibration.unit,
        "date": calibration.created_utc.isoformat(timespec="seconds"),
        "sensor_mode": calibration.sensor_mode.name,
        "simulated": calibration.simulated,
    }


def calibration_picture(calibration: Calibration) -> CalibrationPicture:
    """Return where in the picture the calibration holds, for the report."""
    mode, rays = calibration.sensor_mode, calibration.rays
    if isinstance(rays, CentralRaysRecord):
        outlines = [rays.covered_px]
    else:
        outlines = [rays.covered_a_px, rays.covered_b_px]
    return CalibrationPicture(
        width_px=mode.width,
        height_px=mode.height,
        covered_uv_px=[np.array(outline) for outline in outlines],
        dots_uv_px=np.empty((0, 2)),
    )
