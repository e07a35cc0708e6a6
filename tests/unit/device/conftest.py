from collections.abc import Iterator
from pathlib import Path

import pytest
from device_fakes import FakeRig
from recorder_bench import Bench, MakeBench, config_for

from bricktrack_device.storage.disk import Disk


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[MakeBench]:
    made: list[Bench] = []

    def make(*, rig: FakeRig | None = None, disk: Disk | None = None, **changes: object) -> Bench:
        made.append(Bench(config_for(tmp_path, **changes), rig or FakeRig(), disk))
        return made[-1]

    yield make
    for b in made:
        b.recorder.stop()
