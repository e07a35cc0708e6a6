"""Draw the README's picture from a processed sample: what the camera saw, what came out, how far from the truth.

python scripts/readme_picture.py RESULTS_FOLDER TRUTH OUTPUT.png
"""

import sys
from pathlib import Path

import cv2
import motion_and_error
import numpy as np
from matplotlib.figure import Figure

from bricktrack_host.quality import LedFlag
from bricktrack_host.reporting.report_pictures import PICTURES_NAME, load_pictures
from bricktrack_host.results.result_store import read_result
from bricktrack_host.results.true_motion import read_true_motion
from bricktrack_host.results.truth import compare_with_truth

COLOURS = ("#1f5f8b", "#c8553d", "#588157")


def main() -> None:
    folder, truth, output = (Path(a) for a in sys.argv[1:4])
    result = read_result(folder)
    comparison = compare_with_truth(result, read_true_motion(truth))
    overlay = load_pictures(folder / PICTURES_NAME)[0][1]
    photo = overlay.picture
    fused, t0 = result.fused["edge"], result.t0_ns
    if result.rest is None or t0 is None:
        sys.exit(f"{folder}: no rest pose or no trigger")

    figure = Figure(figsize=(11.5, 4.6), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.25))
    picture = left.add_subplot()
    image = cv2.imdecode(np.frombuffer(photo.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    extent = (-0.5, photo.width_px - 0.5, photo.height_px - 0.5, -0.5)
    picture.imshow(image, cmap="gray", vmin=0, vmax=255, extent=extent)
    picture.plot(*overlay.detected_uv_px.T, "+", color="#ffb703", ms=9, mew=1.4)
    picture.set_title("one frame, simulated, and the LEDs found in it", fontsize=10)
    picture.set_axis_off()

    motion, error = right.subplots(2, 1, sharex=True)
    seconds = (fused.t_ns - t0) / 1e9
    frames = (result.optical.t_ns - t0) / 1e9
    moved, seen = result.from_rest["edge"].t_mm, result.from_rest["optical"].t_mm
    for i, (name, colour) in enumerate(zip("xyz", COLOURS, strict=True)):
        motion.plot(seconds, moved[:, i], color=colour, lw=1.3, label=name)
        motion.plot(frames, seen[:, i], ".", color=colour, ms=4)
        error.plot(
            (comparison.series["fused"].t_ns - t0) / 1e9,
            1000 * comparison.series["fused"].error[:, i],
            color=colour,
            lw=1.0,
        )
    hidden = frames[
        (result.observations.led_flags[:, 0] & int(LedFlag.MISSING | LedFlag.PARTLY_COVERED)) != 0
    ]
    if hidden.size:
        for axes in (motion, error):
            axes.axvspan(hidden[0], hidden[-1], color="0.9", lw=0)
        motion.text(
            hidden.mean(), motion.get_ylim()[1], "m0 hidden", ha="center", va="top", fontsize=8, color="0.35"
        )
    motion.set_ylabel("from rest, mm")
    motion.set_title("fused at every edge of the square wave; dots: camera alone", fontsize=10)
    motion.legend(loc="lower left", ncols=3, frameon=False, fontsize=9)
    motion_and_error.save(figure, motion, error, output)


if __name__ == "__main__":
    main()
