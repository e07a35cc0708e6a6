"""Fit mrcal's splined model to dots, or ask one for rays: JSON in, JSON out. Run by a Python that has mrcal.

Planes' poses are given, the camera's own pose is free. A part of `bench_ray_models.py`, which starts it.
"""

import json
import sys
import tempfile
from pathlib import Path

import mrcal
import numpy as np

SPLINES = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=16_Ny=11_fov_x_deg=75"
PITCH_MM = 4.0


def fit(question):
    width, height = question["size"]
    planes = question["planes"]
    steps = [np.rint(2 * np.array(p["xy_mm"]) / PITCH_MM).astype(int) for p in planes]
    low = np.min([s.min(axis=0) for s in steps], axis=0)
    places = [(s - low) // 2 for s in steps]
    columns, rows = np.max([p.max(axis=0) for p in places], axis=0) + 1
    observations = np.full((len(planes), rows, columns, 3), -1.0)  # a negative weight: not seen
    for k, (plane, place) in enumerate(zip(planes, places, strict=True)):
        observations[k, place[:, 1], place[:, 0], :2] = plane["uv_px"]
        observations[k, place[:, 1], place[:, 0], 2] = 1.0
    corner = low * PITCH_MM / 2
    frames = np.array([[0, 0, 0, corner[0], corner[1], p["z_mm"]] for p in planes], dtype=float)
    n = mrcal.lensmodel_num_params(SPLINES)
    intrinsics = np.zeros((1, n))
    intrinsics[0, :4] = 1600.0, 1600.0, (width - 1) / 2, (height - 1) / 2
    problem = {
        "intrinsics": intrinsics,
        "extrinsics_rt_fromref": np.zeros((1, 6)) + 1e-6,
        "frames_rt_toref": frames,
        "points": None,
        "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": np.array(
            [[k, 0, 0] for k in range(len(planes))], dtype=np.int32
        ),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": SPLINES,
        "imagersizes": np.array([[width, height]], dtype=np.int32),
        "calibration_object_spacing": PITCH_MM,
        "do_optimize_intrinsics_core": False,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": False,
        "do_optimize_calobject_warp": False,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": True,
        "verbose": False,
    }
    mrcal.optimize(**problem)
    model = mrcal.cameramodel(
        intrinsics=(SPLINES, problem["intrinsics"][0]),
        imagersize=(width, height),
        extrinsics_rt_fromref=problem["extrinsics_rt_fromref"][0],
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "splined.cameramodel"
        model.write(str(path))
        return {"model": path.read_text()}


def unproject(question):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "splined.cameramodel"
        path.write_text(question["model"])
        model = mrcal.cameramodel(str(path))
    Rt = model.extrinsics_Rt_toref()
    seen = mrcal.unproject(np.array(question["uv_px"]), *model.intrinsics())
    return {"direction": (seen @ Rt[:3].T).tolist(), "centre_mm": Rt[3].tolist()}


if __name__ == "__main__":
    asked = json.load(sys.stdin)
    json.dump(fit(asked) if asked["do"] == "fit" else unproject(asked), sys.stdout)
