"""What there is to add to a dataset: all units of a combined test, or a run by itself."""

from pathlib import Path

import pyarrow as pa
import pyarrow.compute

from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_host.assemblies.combined_summary import AssemblyEntry, UnitEntry, read_components, read_test
from bricktrack_host.datasets.motion_rows import ComponentRows, UnitSource
from bricktrack_host.results.result_store import read_provenance, read_result, results_of


def sources_of_test(folder: Path, *, name: str | None = None) -> list[UnitSource]:
    """Return the units of a combined test, each with the components that it is the last to see.

    Parameters
    ----------
    folder : Path
        As ``bricktrack combine`` wrote it.
    name : str, optional
        What the dataset shall call the test, if not its own name.

    Raises
    ------
    RunFormatError
        If it cannot be read, or a run was processed again since: its assembly is of other numbers then.
    """
    summary = read_test(folder)
    tables = {e.name: read_components(folder, e.name) for e in summary.assemblies if e.table is not None}
    sources = []
    for unit in summary.units:
        results = _results_of(folder, unit)
        entries = [entry for entry in summary.assemblies if unit.unit in _units_of(entry)]
        named = [(entry.name, _components(entry, unit.unit, tables)) for entry in entries]
        for i, (assembly, components) in enumerate(named or [(None, [])]):
            sources.append(
                UnitSource(
                    test=name or summary.name,
                    unit=unit.unit,
                    assembly=assembly,
                    results=results,
                    slip_samples=unit.slip_samples,
                    sample_agreement=unit.edges,
                    with_camera_rows=i == 0,
                    components=components,
                )
            )
    return sources


def source_of_run(run: Path, *, name: str | None = None) -> UnitSource:
    """Return a run that is added without the others of its test; ``name`` is the test's, if not its label.

    Raises
    ------
    RunFormatError
        If it is not processed.
    ConfigError
        If nothing says which test it is of.
    """
    results = results_of(run)
    manifest = read_result(results).manifest
    test = name or manifest.label
    if not test:
        raise ConfigError(f"{run}: the run has no label that names its test. Name it with --test")
    return UnitSource(test=test, unit=manifest.unit, assembly=None, results=results)


def _units_of(entry: AssemblyEntry) -> set[str]:
    return {unit for chain in entry.chains.values() for unit in chain} | {
        str(loop["unit"]) for loop in entry.loops
    }


def _components(entry: AssemblyEntry, unit: str, tables: dict[str, "pa.Table"]) -> list[ComponentRows]:
    return [
        ComponentRows(
            component,
            entry.base,
            tuple(chain),
            tables[entry.name].filter(pyarrow.compute.field("component") == component),
        )
        for component, chain in entry.chains.items()
        if chain[-1] == unit
    ]


def _results_of(folder: Path, unit: UnitEntry) -> Path:
    if unit.results is None:
        raise RunFormatError(
            f"{folder}: it does not say where {unit.unit}'s results are. Combine the test again"
        )
    results = (folder / unit.results).resolve()
    if not results.is_dir():
        raise RunFormatError(
            f"{folder}: {unit.unit}'s results are no longer at {results}. Put them there, or combine again"
        )
    if read_provenance(results) != unit.provenance:
        raise RunFormatError(
            f"{folder}: {unit.unit} was processed again since the test was combined. Combine the test again"
        )
    return results
