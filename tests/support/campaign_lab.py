"""Datasets of an invented laboratory, and its test combined again (simulated)."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
from small_lab import BRICK, UNITS

from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.datasets.campaign_dataset import add_units, open_dataset
from bricktrack_host.datasets.test_sources import sources_of_test


def combine(folder: Path, name: str = "shake-12") -> None:
    """Combine the runs of a lab, again perhaps."""
    results = {unit: folder / unit / "results" for unit in UNITS}
    combine_test(name, results, [BRICK], folder / name)


def make_campaign(lab: Path, root: Path, *, slip_samples: int = 0) -> Path:
    """Write a dataset of a lab's test; with a slip, of units that missed so many edges; return its folder."""
    sources = sources_of_test(lab / "shake-12")
    if slip_samples:
        sources = [replace(s, slip_samples=slip_samples, sample_agreement="corrected") for s in sources]
    add_units(root, sources, whole_tests=True)
    return root


def files_of(root: Path) -> Mapping[str, bytes]:
    """Return the contents of all files of a folder, by their paths in it."""
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def rows_of(root: Path, *, earlier: bool = False) -> pa.Table:
    """Return all rows of a dataset."""
    return open_dataset(root, earlier=earlier).to_table()
