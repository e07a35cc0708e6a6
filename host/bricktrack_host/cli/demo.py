"""``bricktrack demo``: the whole chain on one machine, from a simulated shake to a report.

The unit is the real daemon, in a process of its own; all between it and the host goes through its socket.
"""

import shutil
import signal
import socket
import subprocess
import sys
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from bricktrack_common.errors import ConfigError, DeviceError, TransferError, UnitTimeoutError
from bricktrack_common.wire_messages import StatusReply
from bricktrack_host.cli import calibrate
from bricktrack_host.cli._console import err, out
from bricktrack_host.cli._processed import say_processed
from bricktrack_host.cli._stage_bar import stage_bar
from bricktrack_host.durable_files import require_writable
from bricktrack_host.transfer.fleet_config import load_fleet
from bricktrack_host.transfer.unit_client import UnitClient

UNIT = "demo-brick"
_START_S = 30.0  # the simulated sensor's reset and a cold encoder take a second each; slow machines some more
_SAVE_S = 60.0
_MARKER = ".bricktrack-demo"

_DAEMON_CONFIG = """\
# The unit of `bricktrack demo`: simulated sensors behind the real daemon.
backend = "sim"

[unit]
name = "{unit}"

[storage]
folder = "{storage}"
margin_mb = 16

[server]
port = {port}

[camera]
exposure_us = 2000

[trigger]
nominal_hz = 200.0

[recording]
duration_s = {duration_s}

[[imu]]
name = "brick"
bus = "sim"

[sim]
seed = {seed}
square_wave_hz = 200.0
# An opaque card passes between camera and LEDs.
dropouts = [[{dropout_s}, 0.4]]
"""

_FLEET = """\
# The laboratory of `bricktrack demo`: one simulated unit.
[[unit]]
name = "{unit}"
address = "tcp://127.0.0.1:{port}"
calibration = "calibration.json"
layout = "kit/layout.toml"
"""


def demo(
    folder: Annotated[
        Path, typer.Option("--folder", "-d", help="Where everything goes; an earlier demo there is replaced.")
    ] = Path("demo"),
    duration: Annotated[float, typer.Option(min=3, max=60, help="Seconds to record.")] = 15.0,
    seed: Annotated[int, typer.Option(help="Of the simulated world: another seed, another shake.")] = 1,
    open_report: Annotated[bool, typer.Option("--open", help="Open the report in a browser.")] = False,
) -> None:
    """Record a simulated brick with the real daemon, pull the run, process it, and compare it with the truth.

    For example:

        bricktrack demo

        bricktrack demo --folder /tmp/demo --seed 7 --open
    """
    from bricktrack_host.pipeline import process_run

    _prepare(folder)
    port = _free_port()
    config = folder / "bricktrackd.toml"
    config.write_text(
        _DAEMON_CONFIG.format(
            unit=UNIT,
            storage=(folder / "card").resolve(),
            port=port,
            duration_s=duration,
            seed=seed,
            dropout_s=round(0.55 * duration, 2),
        )
    )
    (folder / "fleet.toml").write_text(_FLEET.format(unit=UNIT, port=port))
    fleet = load_fleet(folder / "fleet.toml")
    unit = fleet.unit[0]

    _say("1. The unit's kit: its brick's layout, and two pictures of a dot target (simulated)")
    _run_daemon_command("sim-kit", str(folder / "kit"), "--config", str(config))
    _say("2. Calibrate the camera from the two pictures")
    calibrate.fit(folder / "calibration.json", UNIT, rig=folder / "kit" / "rig.toml")
    _say("3. Start the daemon, arm it, and shake the table (simulated)")
    with _daemon(config, folder / "bricktrackd.log") as process, UnitClient(unit.address) as client:
        run_id = _record(client, process, duration)
        _say("4. Pull the run over ZeroMQ")
        _pull(folder / "fleet.toml")
    _say("5. Process it")
    run = fleet.runs_path / run_id
    if unit.calibration_path is None or unit.layout_path is None:
        raise ConfigError(f"{folder / 'fleet.toml'} names no calibration or layout")
    with stage_bar(run_id) as bar:
        processed = process_run(run, calibration=unit.calibration_path, layout=unit.layout_path, progress=bar)
    say_processed(processed)
    if open_report:
        webbrowser.open(processed.report.resolve().as_uri())


def _say(text: str) -> None:
    out.print(f"\n{text}", style="bold", markup=False)


def _prepare(folder: Path) -> None:
    """Make an empty folder, or replace an earlier demo; never touch anything else."""
    require_writable(folder, "Name another with --folder")
    if folder.exists() and any(folder.iterdir()):
        if not (folder / _MARKER).is_file():
            raise ConfigError(f"{folder} is not empty and holds no earlier demo; name another with --folder")
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _MARKER).touch()


def _free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port: int = s.getsockname()[1]
        return port


def _daemon_program() -> str:
    """Return the daemon's program: beside this Python, or on the path."""
    beside = Path(sys.executable).with_name("bricktrackd")
    found = str(beside) if beside.is_file() else shutil.which("bricktrackd")
    if found is None:
        raise ConfigError("bricktrackd is not installed here: pip install 'bricktrack[device,sim,host]'")
    return found


def _run_daemon_command(*arguments: str) -> None:
    done = subprocess.run([_daemon_program(), *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise DeviceError(f"bricktrackd {arguments[0]}: {done.stderr.strip() or f'exit {done.returncode}'}")


def _pull(fleet: Path) -> None:
    """Pull in a process of its own, as an operator would."""
    done = subprocess.run(
        [sys.executable, "-m", "bricktrack_host.cli", "pull", "--fleet", str(fleet)], check=False
    )
    if done.returncode:
        raise TransferError("the run did not come over; 'bricktrack pull' has said why")


@contextmanager
def _daemon(config: Path, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the daemon while the block runs; its own words go to a file."""
    with log.open("wb") as file:
        # A session of its own: Ctrl-C reaches this process first, which then ends the daemon in order.
        process = subprocess.Popen(
            [_daemon_program(), "run", "--config", str(config)],
            stdout=file,
            stderr=file,
            start_new_session=True,
        )
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _record(client: UnitClient, process: "subprocess.Popen[bytes]", duration_s: float) -> str:
    """Arm the unit and wait until its run is saved; return the run's id."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, transient=True) as progress:
        bar = progress.add_task("waiting for the daemon", total=None)
        _wait_for_hello(client, process)
        progress.update(bar, description="arming: camera, IMU and trigger")
        armed = client.arm("demo")
        for words in armed.missing:
            out.print(f"missing: {words}", style="yellow", markup=False)
        out.print(f"armed; the run will be {armed.run_id}", markup=False)
        start: float | None = None
        deadline = time.monotonic() + _START_S + duration_s + _SAVE_S
        while time.monotonic() < deadline:
            status = _alive(client, process)
            if status.state == "fault":
                raise DeviceError(f"the daemon reports a fault: {status.reason}")
            if status.state == "idle":
                out.print("saved on the unit's card", markup=False)
                return armed.run_id
            if status.state == "recording" and start is None:
                start = time.monotonic()
                progress.reset(bar, total=duration_s, description="recording")
            elif status.state == "recording" and start is not None:
                progress.update(bar, completed=min(time.monotonic() - start, duration_s))
            else:
                progress.update(bar, description=status.state)
            time.sleep(0.2)
    raise UnitTimeoutError("the daemon did not finish its run in time; its log is in the demo's folder")


def _wait_for_hello(client: UnitClient, process: "subprocess.Popen[bytes]") -> None:
    deadline = time.monotonic() + _START_S
    while True:
        if process.poll() is not None:
            raise DeviceError(
                f"the daemon ended with {process.returncode}; see bricktrackd.log in the demo's folder"
            )
        try:
            client.hello()
        except UnitTimeoutError:
            if time.monotonic() > deadline:
                raise
        else:
            return


def _alive(client: UnitClient, process: "subprocess.Popen[bytes]") -> StatusReply:
    if process.poll() is not None:
        raise DeviceError(
            f"the daemon ended with {process.returncode}; see bricktrackd.log in the demo's folder"
        )
    return client.status()
