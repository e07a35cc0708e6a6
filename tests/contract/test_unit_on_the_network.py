"""What any running unit must do over the wire; on a real one with ``pytest tests/contract --rig tcp://HOST:PORT``.

A unit that serves its network wants keys: reach it through an SSH tunnel to its loopback address instead. The
square wave must be running, or start within a minute.
"""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from light_unit import LightUnit

from bricktrack_common.checksums import sha256_bytes
from bricktrack_host.transfer.unit_client import UnitClient

CHUNK_BYTES = 256 << 10
WAVE_COMES_WITHIN_S = 60.0


@pytest.fixture(params=["fake", pytest.param("hardware", marks=pytest.mark.hardware)])
def unit(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[UnitClient]:
    if request.param == "fake":
        with LightUnit(tmp_path) as light, UnitClient(light.address) as client:
            yield client
        return
    address = request.config.getoption("--rig")
    if address is None or "://" not in address:
        pytest.skip("needs a running unit: give it with --rig tcp://HOST:PORT")
    with UnitClient(address) as client:
        yield client


def wait_for(unit: UnitClient, state: str, within_s: float) -> bool:
    deadline = time.monotonic() + within_s
    while unit.status().state != state:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.1)
    return True


def test_it_says_who_it_is_and_that_its_self_test_passed(unit: UnitClient) -> None:
    hello, status = unit.hello(), unit.status()
    assert hello.unit == status.unit and hello.software.startswith("bricktrack ")
    assert abs(status.clocks.boottime_ns - status.clocks.monotonic_ns) < 1_000_000
    tested = {item.name: item.level for item in status.health if item.name.startswith("self-test: ")}
    assert {"self-test: trigger", "self-test: camera"} <= tested.keys()
    assert set(tested.values()) == {"ok"}, status.health


def test_a_run_comes_out_whole_and_its_bytes_are_those_of_its_hashes(unit: UnitClient) -> None:
    before = {run.run_id for run in unit.list_runs().runs}
    armed = unit.arm("contract", duration_s=1.0)
    assert armed.missing == [] and armed.run_id not in before
    if not wait_for(unit, "idle", WAVE_COMES_WITHIN_S):
        unit.disarm()
        pytest.fail(f"no run within {WAVE_COMES_WITHIN_S:g} s: is the square wave on?")
    (made,) = [run for run in unit.list_runs().runs if run.run_id not in before]
    assert (made.run_id, made.state, made.confirmed) == (armed.run_id, "complete", False)
    files = unit.describe_run(armed.run_id).files
    assert {"video.h264", "frames.msgpack", "edges.msgpack"} <= {f.name for f in files}
    for i, file in enumerate(files):
        ranges = [(at, min(CHUNK_BYTES, file.n_bytes - at)) for at in range(0, file.n_bytes, CHUNK_BYTES)]
        parts = {c.offset: c.data for c in unit.read_chunks(armed.run_id, i, ranges)}
        assert sha256_bytes(b"".join(parts[at] for at, _ in ranges)) == file.sha256
