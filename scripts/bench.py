"""Run every benchmark, one after the other, and print what each prints.

Ratios are measured side by side inside each one, because machines are noisy; absolute times are of this machine
and this hour. Benchmarks on the shared samples take their folder from ``BRICKTRACK_SAMPLES`` and say so where it
is not set. Names on the command line choose some: ``python scripts/bench.py process fusion``.
"""

import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent


def main() -> int:
    wanted = sys.argv[1:]
    scripts = sorted(HERE.glob("bench_*.py"))
    unknown = [w for w in wanted if not (HERE / f"bench_{w}.py").exists()]
    if unknown:
        names = ", ".join(s.stem.removeprefix("bench_") for s in scripts)
        print(f"no benchmark called {', '.join(unknown)}; there are: {names}", file=sys.stderr)
        return 2
    failed = []
    for script in scripts:
        name = script.stem.removeprefix("bench_")
        if wanted and name not in wanted:
            continue
        print(f"\n===== {name}: {script.relative_to(HERE.parent)}", flush=True)
        start = time.perf_counter()
        if subprocess.run([sys.executable, str(script)], check=False).returncode:
            failed.append(name)
        print(f"----- {name}: {time.perf_counter() - start:.0f} s", flush=True)
    if failed:
        print(f"\nfailed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
