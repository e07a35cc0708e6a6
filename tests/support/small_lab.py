"""A laboratory of two units whose runs are invented (simulated), processed, and of one brick in three parts."""

from dataclasses import replace
from pathlib import Path

import example_report as example
import msgspec

from bricktrack_common.run_manifest import MANIFEST_NAME, write_manifest
from bricktrack_host.assemblies.combined_test import combine_test
from bricktrack_host.results.result_store import RunResult, write_results
from bricktrack_host.transfer.assembly_config import AssemblyConfig, Component, View

UNITS = ("b7-1", "b7-2")
BRICK = AssemblyConfig(
    name="brick-7",
    kind="TCB",
    base="A",
    component=[Component(name="A"), Component(name="B"), Component(name="C", point_mm=(0.0, 0.0, 60.0))],
    view=[
        View(unit="b7-1", camera_on="A", leds_on="B", position_brick_layout_mm=(10.0, 20.0, 30.0)),
        View(unit="b7-2", camera_on="B", leds_on="C", position_brick_layout_mm=(-10.0, 20.0, 30.0)),
    ],
)

FLEET = """
[[unit]]
name = "b7-1"
address = "tcp://127.0.0.1:1001"

[[unit]]
name = "b7-2"
address = "tcp://127.0.0.1:1002"

[[assembly]]
name = "brick-7"
kind = "TCB"
base = "A"

[[assembly.component]]
name = "A"

[[assembly.component]]
name = "B"

[[assembly.component]]
name = "C"
point_mm = [0.0, 0.0, 60.0]

[[assembly.view]]
unit = "b7-1"
camera_on = "A"
leds_on = "B"
position_brick_layout_mm = [10.0, 20.0, 30.0]

[[assembly.view]]
unit = "b7-2"
camera_on = "B"
leds_on = "C"
position_brick_layout_mm = [-10.0, 20.0, 30.0]
"""
"""The same brick in a fleet file."""


def invented_run(folder: Path, unit: str) -> RunResult:
    """Write the manifest and the results of one invented run to a folder."""
    blank: RunResult = example.example_result()
    manifest = msgspec.structs.replace(blank.manifest, unit=unit, run_id=f"{unit}_0001_shake")
    result = replace(blank, manifest=manifest)
    folder.mkdir(parents=True)
    write_manifest(folder / MANIFEST_NAME, manifest)
    write_results(result, folder / "results")
    return result


def invented_lab(folder: Path) -> None:
    """Write an invented run of every unit to a folder, and the test ``shake-12`` that combines them."""
    for unit in UNITS:
        invented_run(folder / unit, unit)
    results = {unit: folder / unit / "results" for unit in UNITS}
    combine_test("shake-12", results, [BRICK], folder / "shake-12")
