"""Run every benchmark, one after the other, and print what each prints.

Ratios are measured side by side inside each one, because machines are noisy; absolute times are of this machine
and this hour. Benchmarks on the shared samples take their folder from ``BRICKTRACK_SAMPLES`` and say so where it
is not set.

    python scripts/bench.py --list
    python scripts/bench.py process fusion
"""

import argparse
import ast
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent


def main() -> int:
    scripts = {s.stem.removeprefix("bench_"): s for s in sorted(HERE.glob("bench_*.py"))}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", nargs="*", help="default: all")
    parser.add_argument("--list", action="store_true", help="print what each one measures, and run none")
    args = parser.parse_args()
    unknown = [name for name in args.name if name not in scripts]
    if unknown:
        parser.error(f"no benchmark called {', '.join(unknown)}; there are: {', '.join(scripts)}")
    if args.list:
        for name, script in scripts.items():
            print(
                f"{name:15s} {(ast.get_docstring(ast.parse(script.read_text('utf-8'))) or '').splitlines()[0]}"
            )
        return 0
    took_s: dict[str, float] = {}
    failed = []
    for name in args.name or scripts:
        print(f"\n===== {name}: {scripts[name].relative_to(HERE.parent)}", flush=True)
        start = time.perf_counter()
        if subprocess.run([sys.executable, str(scripts[name])], check=False).returncode:
            failed.append(name)
        took_s[name] = time.perf_counter() - start
        print(f"----- {name}: {took_s[name]:.0f} s", flush=True)
    print(f"\n{sum(took_s.values()):.0f} s: " + ", ".join(f"{name} {s:.0f}" for name, s in took_s.items()))
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
