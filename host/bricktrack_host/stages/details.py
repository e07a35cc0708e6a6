"""What the results say about themselves: how clocks were aligned, which calibration was used."""

import numpy as np

from bricktrack_host.calibration.calibration_file import Calibration, CentralRaysRecord
from bricktrack_host.fusion.estimate import FusionResult
from bricktrack_host.reporting.plots import CalibrationPicture
from bricktrack_host.results.result_store import Details
from bricktrack_host.stages.clocks import Inertial


def alignment_details(inertial: Inertial | None, fusion: FusionResult | None) -> Details:
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
        details |= {
            "smoothed_offset_ms": fusion.offset_ns / 1e6,
            "smoothed_offset_sd_ms": fusion.offset_sd_ns / 1e6,
            "smoothed_skew_ppm": fusion.skew * 1e6,
            "acc_lag_ms": fusion.acc_lag_ns / 1e6,
            "gyro_bias_dps": np.rad2deg(fusion.gyro_bias_radps).tolist(),
            "acc_bias_mps2": fusion.acc_bias_mps2.tolist(),
            "gravity_camera_mps2": fusion.gravity_camera_mps2.tolist(),
            "mean_nis": fusion.mean_nis,
        }
    return {k: v.item() if isinstance(v, np.generic) else v for k, v in details.items()}


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
