import shutil
from pathlib import Path

import pytest
from run_folders import make_run

from bricktrack_device.capture.retention import make_room
from bricktrack_device.config import DeviceConfig, RecordingTable, StorageTable
from bricktrack_device.storage.disk import Disk
from bricktrack_device.storage.run_store import RunStore

RUN_BYTES = 1_000_000
CARD_BYTES = 6_000_000
IDS = [f"u_abcdef_{n:04d}" for n in range(1, 6)]


class SmallCard(Disk):
    """A card of six megabytes."""

    def free_bytes(self, folder: Path) -> int:
        return CARD_BYTES - sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    made = RunStore(tmp_path, "u", disk=SmallCard())
    for run_id in IDS:
        make_run(made.runs, run_id, {"video.h264": RUN_BYTES})
    return made


def config(tmp_path: Path, *, delete_confirmed: bool = True) -> DeviceConfig:
    # Twice 1 s at 12 Mbit/s: three megabytes.
    return DeviceConfig(
        storage=StorageTable(folder=str(tmp_path), margin_mb=0, delete_confirmed=delete_confirmed),
        recording=RecordingTable(duration_s=1.0, pre_roll_s=0, post_roll_s=0),
    )


def confirm(store: RunStore, *run_ids: str) -> None:
    for run_id in run_ids:
        store.confirm(run_id, [f.sha256 for f in store.describe(run_id).files])


def left(store: RunStore) -> list[str]:
    return [r.run_id for r in store.list_runs()]


def test_the_oldest_confirmed_runs_go_and_no_more_than_needed(store: RunStore, tmp_path: Path) -> None:
    confirm(store, *IDS)
    # One of six is free; three are needed.
    assert make_room(config(tmp_path), store, 1.0) == IDS[:3]  # manifests and notes take a little, too
    assert left(store) == IDS[3:] and store.free_bytes() >= 3_000_000
    assert make_room(config(tmp_path), store, 1.0) == []


def test_what_no_host_has_confirmed_stays_however_full_the_card(store: RunStore, tmp_path: Path) -> None:
    confirm(store, IDS[1], IDS[3])
    assert make_room(config(tmp_path), store, 1.0) == [IDS[1], IDS[3]]
    assert left(store) == [IDS[0], IDS[2], IDS[4]] and store.free_bytes() < 3_000_000


def test_nothing_goes_unless_the_configuration_says_so(store: RunStore, tmp_path: Path) -> None:
    confirm(store, *IDS)
    assert make_room(config(tmp_path, delete_confirmed=False), store, 1.0) == []
    shutil.rmtree(store.runs / IDS[0])
    assert left(store)[-1] == IDS[4]
