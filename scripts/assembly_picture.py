"""Draw how the parts of the tutorial's brick moved, and how far that is from the truth (simulated).

python scripts/assembly_picture.py lab/tests/shake-12 lab/truth.csv docs/images/assembly-motion.png
"""

import csv
import sys
from pathlib import Path

import motion_and_error
import numpy as np
from matplotlib.figure import Figure

from bricktrack_host import analysis

COLOURS = {"B": "#1f5f8b", "C": "#c8553d"}


def main() -> None:
    folder, truth, output = (Path(a) for a in sys.argv[1:4])
    with truth.open() as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(9.0, 4.8), layout="constrained")
    motion, error = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1))
    for name, part in analysis.load_test(folder).components("brick-7").items():
        true = {
            int(r["sample"]): [float(r[f"d{a}_mm"]) for a in "xyz"] for r in rows if r["component"] == name
        }
        known = part.measured & np.isin(part.sample, list(true))
        at = part.t_s[known]
        less = part.displacement_mm[known] - [true[int(n)] for n in part.sample[known]]
        motion.plot(at, part.displacement_mm[known, 0], color=COLOURS[name], lw=1.4, label=f"{name} from A")
        error.plot(at, 1000 * less[:, 0], color=COLOURS[name], lw=1.0)
        rms_um = 1000 * np.sqrt(np.mean(less**2, axis=0))
        print(f"{name}: rms of the error {rms_um.round(1).tolist()} um along x, y, z (simulated)")
    motion.set_ylabel("x from rest, mm")
    motion.legend(loc="upper right", frameon=False, fontsize=9)
    motion.set_title("motion of the parts of a brick, seen from its base (simulated)", fontsize=10)
    motion_and_error.save(figure, motion, error, output)


if __name__ == "__main__":
    main()
