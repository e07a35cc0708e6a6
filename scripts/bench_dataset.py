"""How large a campaign's dataset gets, and how long it takes to fill, to list and to ask.

One invented run (simulated, 15.5 s, wave of 200 Hz) is added for real; its file then stands for all units of a
campaign, as links to it. Run as ``python scripts/bench_dataset.py [TESTS [UNITS]]``.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import duckdb
import pyarrow.parquet as pq
from example_report import example_result

from bricktrack_host.datasets.campaign_dataset import MOTION_FOLDER, add_units, list_units
from bricktrack_host.datasets.motion_rows import UnitSource
from bricktrack_host.results.result_store import write_results

LARGEST = """
SELECT assembly, max(sqrt(dx_mm**2 + dy_mm**2 + dz_mm**2)) AS largest_mm
FROM read_parquet('{}/*/*/motion.parquet', hive_types_autocast = false)
WHERE measured AND kind = 'edge' GROUP BY assembly ORDER BY largest_mm DESC
"""


def timed(what: str, work: Callable[[], object]) -> None:
    """Do some work and print how long it took."""
    start = time.perf_counter()
    work()
    print(f"{what}: {time.perf_counter() - start:.2f} s")


def main() -> None:
    """Measure, and print."""
    n_tests, n_units = (int(x) for x in (sys.argv[1:] + ["10", "400"][len(sys.argv) - 1 :]))
    duckdb.sql("SET threads = 1")
    with tempfile.TemporaryDirectory() as scratch:
        root, results = Path(scratch) / "campaign", Path(scratch) / "results"
        write_results(example_result(), results)
        source = UnitSource(test="first", unit="unit-01", assembly=None, results=results)
        timed("a run added", lambda: add_units(root, [source], whole_tests=False))
        timed("the same again", lambda: add_units(root, [source], whole_tests=False))
        file = next((root / MOTION_FOLDER).rglob("*.parquet"))
        n_rows = pq.read_metadata(file).num_rows
        print(f"a run: {n_rows} rows, {file.stat().st_size / 1e6:.2f} MB")
        for test in range(n_tests):
            for unit in range(n_units):
                place = root / MOTION_FOLDER / f"test=s-{test}" / f"assembly=b-{unit // 2}" / f"unit=u-{unit}"
                place.mkdir(parents=True)
                os.link(file, place / file.name)
        print(f"{n_tests} tests of {n_units} units: {n_tests * n_units * n_rows / 1e6:.1f} million rows")
        timed("listed", lambda: list_units(root))
        motion = root / MOTION_FOLDER
        timed("largest motion of each assembly in one test", lambda: ask(f"{motion}/test=s-0"))
        timed("largest motion of each assembly in all tests", lambda: ask(f"{motion}/*"))


def ask(place: str) -> None:
    """Find the largest motions, with one thread."""
    duckdb.sql(LARGEST.format(place)).fetchall()


if __name__ == "__main__":
    main()
