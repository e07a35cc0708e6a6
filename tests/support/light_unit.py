"""A whole unit that needs next to no processor: the real daemon on a camera without pictures, as a program.

``python light_unit.py STORAGE`` arms itself, is triggered by a wave of its own soon after, records for half a
second, saves and arms itself again, until it is ended. Its video has the size that a real one has.
With ``--idle`` it only serves what is on its card; with ``--port N`` on this port; with ``--keys FOLDER`` it
wants to know who asks; with ``--black-box FOLDER`` it keeps a copy of the run under way there.
"""

import argparse
import logging
import subprocess
import sys
import threading
import time
from pathlib import Path

from device_fakes import FakeBusOpener, FakeCamera, FakeRig

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.key_files import (
    PUBLIC_SUFFIX,
    KeyPair,
    make_key_pair,
    write_public_key,
    write_secret_key,
)
from bricktrack_device.config import (
    DeviceConfig,
    ImuTable,
    RecordingTable,
    SamplerTable,
    ServerTable,
    StorageTable,
    TriggerTable,
    UnitTable,
)
from bricktrack_device.daemon import Daemon
from bricktrack_device.network.unit_keys import CLIENTS_NAME, UNIT_KEY_NAME
from bricktrack_device.sim.sim_pins import make_factory

PICTURE_BYTES = 50_000  # 12 Mbit/s at 30 pictures a second
DURATION_S = 0.5
WAVE_HZ = 100.0


def light_config(
    storage: Path,
    *,
    auto_arm: bool = True,
    port: int = 0,
    keys: Path | None = None,
    black_box: Path | None = None,
) -> DeviceConfig:
    """Return what such a unit is told."""
    return DeviceConfig(
        unit=UnitTable(name="light"),
        storage=StorageTable(folder=str(storage), margin_mb=1, black_box=str(black_box or "")),
        server=ServerTable(port=port, keys=str(keys or "")),
        trigger=TriggerTable(nominal_hz=WAVE_HZ),
        recording=RecordingTable(
            duration_s=DURATION_S, pre_roll_s=0.1, post_roll_s=0.1, auto_arm=auto_arm, label="light"
        ),
        imu=[ImuTable(name="brick", bus="a")],
        sampler=SamplerTable(priority=0, lock_memory=False),
    )


class SelfDrivenRig(FakeRig):
    """A fake rig whose wave begins by itself 0.1 s after arming and lasts longer than the run."""

    def __init__(self) -> None:
        super().__init__(camera=FakeCamera(n_bytes=PICTURE_BYTES), buses={"a": FakeBusOpener(fail_every=40)})
        self.factory = make_factory()

    def on_armed(self, t_armed_ns: int) -> None:
        super().on_armed(t_armed_ns)
        threading.Thread(target=self._drive, args=(t_armed_ns + 100_000_000,), daemon=True).start()

    def _drive(self, first_ns: int) -> None:
        """Drive the line on a grid; as in a kernel, the stamps are right however late this thread is."""
        pin = self.factory.pin("GPIO17")
        for k in range(round(1.5 * DURATION_S * 2 * WAVE_HZ)):
            t_ns = first_ns + round(k * 0.5e9 / WAVE_HZ)
            time.sleep(max(0.0, (t_ns - monotonic_ns()) * 1e-9))
            pin.drive_at(k % 2 == 0, t_ns * 1e-9)


class LightUnit:
    """Such a unit, idle, in its own process; it can be killed and started again on the same port."""

    def __init__(self, storage: Path, *, keys: Path | None = None) -> None:
        self._storage = storage
        self._keys = ["--keys", str(keys)] if keys else []
        self._process: subprocess.Popen[str] | None = None
        self.port = 0

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def start(self) -> None:
        command = [
            sys.executable,
            __file__,
            str(self._storage),
            "--idle",
            "--port",
            str(self.port),
            *self._keys,
        ]
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        seen = []
        for line in self._process.stderr or ():
            seen.append(line)
            if " port " in line:
                self.port = int(line.split(" port ")[1].split(";")[0])
                return
        raise RuntimeError("the unit ended: " + "".join(seen))

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def __enter__(self) -> "LightUnit":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


def make_keys(folder: Path) -> tuple[KeyPair, KeyPair]:
    """Make a unit's folder of keys, which lets one host in; return the unit's pair and the host's."""
    unit, own = make_key_pair(), make_key_pair()
    (folder / CLIENTS_NAME).mkdir(parents=True)
    write_secret_key(folder / UNIT_KEY_NAME, unit, what="a unit")
    write_public_key(folder / CLIENTS_NAME / f"host{PUBLIC_SUFFIX}", own.public, what="a host")
    return unit, own


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("storage", type=Path)
    parser.add_argument("--idle", action="store_true")
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--keys", type=Path)
    parser.add_argument("--black-box", type=Path)
    options = parser.parse_args()
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s")
    config = light_config(
        options.storage,
        auto_arm=not options.idle,
        port=options.port,
        keys=options.keys,
        black_box=options.black_box,
    )
    Daemon(config, SelfDrivenRig()).run()
