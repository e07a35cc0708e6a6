"""The control page with many units: first paint, how soon a change is seen, and what it costs the host.

Light units (simulated: the real server, service and run store, no sensors) in a few processes, the page as people
start it in one more, and a real headless Chromium that looks at it. Times are the browser's own for the first
paint; for a change they run from just before the unit is told, by another program, to when the tile has its new
state in the document.

    python scripts/bench_dashboard.py --units 400 --pictures /tmp/pages
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))

from light_fleet import LightFleet, write_fleet_file  # noqa: E402 (the tests' support is no package)

from bricktrack_host.transfer.unit_client import UnitClient  # noqa: E402

SIZES = {"desktop": (1440, 900), "tablet": (1024, 768), "tablet-upright": (820, 1180)}


def processor_s(pid: int) -> float:
    """Return the processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """Return a process's resident size."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--units", type=int, default=400)
    parser.add_argument("--changes", type=int, default=20, help="that are timed")
    parser.add_argument("--seconds", type=float, default=15.0, help="over which the cost is taken")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the page")
    options = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("no Chromium here (Debian: apt install chromium)")
    names = [f"u-{i:04d}" for i in range(options.units)]
    folder = Path(tempfile.mkdtemp(prefix="bench-dashboard-"))
    with LightFleet(folder / "cards", names) as fleet:
        file = write_fleet_file(folder / "fleet.toml", {n: fleet.ports[n] for n in names})
        command = [sys.executable, "-m", "bricktrack_host.cli", "dashboard", "--fleet", str(file)]
        page = subprocess.Popen([*command, "--port", "0"], stdout=subprocess.PIPE, text=True)
        try:
            line = page.stdout.readline() if page.stdout else ""
            if "http" not in line:
                sys.exit("the page did not start; see above")
            look(line.split()[-1], page.pid, fleet, names, chromium, options)
        finally:
            page.terminate()
            page.wait(timeout=20)
    shutil.rmtree(folder)


def look(
    url: str, pid: int, fleet: LightFleet, names: list[str], chromium: str, options: argparse.Namespace
) -> None:
    with sync_playwright() as p:
        browser = p.chromium.launch(
            executable_path=chromium, args=["--no-sandbox"] if os.geteuid() == 0 else []
        )
        for visit in ("first", "second"):
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            start = time.perf_counter()
            page.goto(url, wait_until="commit")
            page.locator("#plan .unit").last.wait_for(timeout=60_000)
            plan_s = time.perf_counter() - start
            page.locator(".ag-row").first.wait_for(timeout=60_000)
            table_s = time.perf_counter() - start
            paints = page.evaluate("performance.getEntriesByType('paint').map(e => [e.name, e.startTime])")
            told = ", ".join(f"{name} {ms / 1000:.2f} s" for name, ms in paints)
            print(f"{visit} visit: {told}; plan there after {plan_s:.2f} s, table after {table_s:.2f} s")
            if visit == "first":
                page.close()
        page.wait_for_function(
            "n => document.querySelectorAll('.unit[data-state=idle]').length === n", arg=len(names)
        )
        used, began = processor_s(pid), time.perf_counter()
        time.sleep(options.seconds)
        share = (processor_s(pid) - used) / (time.perf_counter() - began)
        print(
            f"{len(names)} units (simulated), one browser: {share:.0%} of one core, {memory_mb(pid):.0f} MB"
        )
        seen = []
        for name in names[:: max(len(names) // options.changes, 1)][: options.changes]:
            with UnitClient(f"tcp://127.0.0.1:{fleet.ports[name]}") as client:
                client.hello()
                start = time.perf_counter()
                client.arm("bench")
            page.locator(f'.unit[data-unit="{name}"][data-state="armed"]').wait_for()
            seen.append(time.perf_counter() - start)
        seen.sort()
        print(
            f"a change is seen after {seen[len(seen) // 2]:.2f} s (median), {seen[-1]:.2f} s (worst of {len(seen)})"
        )
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            for name, (width, height) in SIZES.items():
                page.set_viewport_size({"width": width, "height": height})
                page.wait_for_timeout(500)
                page.screenshot(path=options.pictures / f"{name}.png")
        browser.close()


if __name__ == "__main__":
    main()
