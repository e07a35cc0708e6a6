"""A fleet on one machine: how long the host takes to ask all, arm all and pull all, and in how much memory.

Light units (simulated: the real server, service and run store, no sensors) in a few processes; the host's own
command line in one more, timed as a person meets it, start of Python included, and again inside one process. After
the pull every file's hash is compared with that on the unit's card.

Memory is the host process's peak resident size, measured in its own process for a small and for the whole fleet:
it is bounded by the units that are served side by side, not by their number.

    python scripts/bench_fleet.py --units 400 --megabytes 1
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))

from light_fleet import LightFleet, write_fleet_file  # noqa: E402 (the tests' support is no package)

from bricktrack_common.checksums import sha256_file  # noqa: E402

# What the host process runs: a command, then its own peak memory on a line of its own; it may open as many files
# as a process may on an ordinary machine.
HOST = (
    "import resource, sys\n"
    "resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024))\n"
    "from bricktrack_host.cli import main\n"
    "try:\n"
    "    main()\n"
    "finally:\n"
    "    sys.stdout.flush()\n"
    "    print('PEAK', resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)\n"
)

PATIENT = ("--timeout", 30)  # the units share this machine, at low priority: other work may keep them waiting


def host(*arguments: object) -> tuple[float, float, dict]:
    """Run a command; return its seconds, its peak memory in MB, and what it printed as JSON."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", HOST, *map(str, arguments), "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    spent_s = time.perf_counter() - start
    if done.returncode:
        sys.exit(f"bricktrack {arguments[0]} ended with {done.returncode}:\n{done.stderr[-2000:]}")
    peak_kb = int(done.stderr.split("PEAK")[1].split()[0])
    return spent_s, peak_kb / 1024, json.loads(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--units", type=int, default=400)
    parser.add_argument("--megabytes", type=float, default=1.0, help="of each run's video")
    parser.add_argument("--processes", type=int, default=4, help="that the light units share")
    options = parser.parse_args()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, 65536)), hard))
    with tempfile.TemporaryDirectory(prefix="bench-fleet-") as name:
        measure(Path(name), options.units, round(options.megabytes * 1e6), options.processes)


def measure(folder: Path, n_units: int, n_bytes: int, n_processes: int) -> None:
    names = [f"u-{i:04d}" for i in range(n_units)]
    start = time.perf_counter()
    with LightFleet(folder / "cards", names, n_processes=n_processes) as fleet:
        print(f"{n_units} light units (simulated) up after {time.perf_counter() - start:.1f} s")
        file = write_fleet_file(folder / "fleet.toml", {n: fleet.ports[n] for n in names})
        alone_s, _, _ = host("status", "--fleet", file, "--unit", names[0])
        spent_s, peak_mb, told = host("status", "--fleet", file)
        n_answers = sum(u["answers"] for u in told["units"])
        print(
            f"status: {n_answers} answers in {spent_s:.2f} s (of one unit: {alone_s:.2f} s), peak {peak_mb:.0f} MB"
        )
        spent_s, peak_mb, told = host("arm", "--fleet", file, "--label", "bench")
        n_armed = sum(u["ok"] for u in told["units"])
        print(f"arm: {n_armed} acknowledged in {spent_s:.2f} s, peak {peak_mb:.0f} MB")
        start = time.perf_counter()
        fleet.trigger(n_bytes)
        print(f"the units recorded and saved (simulated) in {time.perf_counter() - start:.1f} s")
        few = [a for n in names[:16] for a in ("--unit", n)]
        few_s, few_mb, told = host("pull", "--fleet", file, *few, "-o", folder / "few", *PATIENT)
        print(f"pull of 16 units: {len(told['runs'])} runs in {few_s:.1f} s, peak {few_mb:.0f} MB")
        shutil.rmtree(folder / "few")
        spent_s, peak_mb, told = host("pull", "--fleet", file, "-o", folder / "runs", *PATIENT)
        total_mb = sum(r["n_bytes_fetched"] for r in told["runs"]) / 1e6
        print(
            f"pull of {n_units} units: {len(told['runs'])} runs, {total_mb:.0f} MB in {spent_s:.1f} s, "
            f"{total_mb / spent_s:.0f} MB/s, peak {peak_mb:.0f} MB"
        )
        n_same = sum(
            sha256_file(path)
            == sha256_file(folder / "cards" / run["unit"] / "runs" / run["run_id"] / path.name)
            for run in told["runs"]
            for path in Path(run["folder"]).iterdir()
        )
        print(f"{n_same} of {2 * n_units} files have the hash of those on the cards")
    if (n_answers, n_armed, len(told["runs"]), n_same) != (n_units, n_units, n_units, 2 * n_units):
        sys.exit("not all units answered, armed and gave their run whole")


if __name__ == "__main__":
    main()
