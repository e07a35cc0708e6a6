"""Run folders for tests: valid manifests around files of seeded bytes."""

import random
from pathlib import Path

from bricktrack_common.run_manifest import (
    MANIFEST_NAME,
    ClocksSection,
    QualitySection,
    RunManifest,
    TriggerSection,
    file_entry,
    write_manifest,
)


def make_run(runs: Path, run_id: str, sizes: dict[str, int], *, unit: str = "fake", seed: int = 1) -> Path:
    """Make a run whose files hold random bytes; such a run can be transferred but not processed."""
    folder = runs / run_id
    folder.mkdir(parents=True)
    draw = random.Random(f"{run_id}{seed}")
    for name, n_bytes in sizes.items():
        (folder / name).write_bytes(draw.randbytes(n_bytes))
    manifest = RunManifest(
        run_id=run_id, unit=unit, label="", state="complete", simulated=True, origin="bricktrackd", hardware={},
        software={}, camera=None, imus=[], trigger=TriggerSection(pin="GPIO17", t0_ns=None),
        clocks=ClocksSection(), window_ns=None, quality=QualitySection(), missing=[],
        files=[file_entry(folder / name) for name in sizes],
    )  # fmt: skip
    write_manifest(folder / MANIFEST_NAME, manifest)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Return a folder's files by name."""
    return {p.name: p.read_bytes() for p in folder.iterdir()}
