"""All units of one shake together: edge trains compared, assemblies solved, tables and a summary on disk.

`docs/results-format.md` describes the files.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from bricktrack_common.errors import RunFormatError
from bricktrack_common.rotations import angles_xyz_from_matrix, rvec_from_matrix
from bricktrack_common.typed_data import dump_json
from bricktrack_host.assemblies.combined_summary import (
    TEST_SCHEMA,
    TEST_SUMMARY_NAME,
    TEST_VERSION,
    AssemblyEntry,
    TestSummary,
    UnitEntry,
    read_test,
)
from bricktrack_host.assemblies.component_motion import (
    AssemblyError,
    AssemblyMotion,
    LoopCheck,
    assembly_motion,
)
from bricktrack_host.durable_files import write_folder_whole
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.edge_comparison import EdgeComparison, compare_edges
from bricktrack_host.results.result_store import (
    Details,
    RunResult,
    content_id,
    read_result,
    software_version,
)
from bricktrack_host.results.run_summary import key_figures, verdict
from bricktrack_host.results.table_columns import (
    Column,
    Columns,
    covariance_column,
    flag_columns,
    make_table,
    vector_columns,
)
from bricktrack_host.transfer.assembly_config import AssemblyConfig

CONVENTIONS = {
    "brick axes": "of the whole brick as drawn, attached to the base component, mm; motion is from rest",
    "sample": "number of the rising edge of the square wave, the laboratory's sample, corrected for slips",
    "angles": "intrinsic XYZ, degrees: R = Rx(angle_x) @ Ry(angle_y) @ Rz(angle_z)",
    "covariance": "upper triangle, row by row, of the 6 x 6 covariance of [dtheta rad, dt mm] of the point: "
    "R_true = R Exp(dtheta); t_true = t + dt",
    "missing": "NaN, with a bit in flags that says why",
}


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    config: AssemblyConfig
    motion: AssemblyMotion | None
    problems: tuple[str, ...]


def combine_test(
    name: str,
    results: Mapping[str, Path],
    assemblies: Sequence[AssemblyConfig],
    folder: Path,
    *,
    progress: Callable[[str, int, int], None] | None = None,
    also: Callable[[Path], object] | None = None,
) -> TestSummary:
    """Compare the units of one shake, solve its assemblies, and write both to a folder, whole or not at all.

    An earlier combination that says something else is kept beside it, as ``<folder>_1``.
    Memory is that of the largest assembly's results, and of the inertial samples of all units.

    Parameters
    ----------
    name : str
        Of the test.
    results : mapping of unit to path
        Results folder of each unit's run.
    assemblies : sequence of AssemblyConfig
        Those that have none of the units are left out.
    folder : Path
    progress : callable, optional
        Called with what is being done, how many are done, and of how many.
    also : callable, optional
        Writes more files into the finished folder that it is given, before that takes its name.

    Raises
    ------
    RunFormatError
        If a results folder cannot be read, or results of simulated and real runs are mixed.
    StorageError
        If the folder cannot be written.
    """
    say = progress or (lambda _what, _done, _of: None)
    units: dict[str, RunResult] = {}
    quality: dict[str, tuple[list[str], Details]] = {}
    for i, (unit, path) in enumerate(results.items()):
        say("comparing edges", i, len(results))
        result = read_result(path)
        quality[unit] = _quality(result)
        units[unit] = replace(result, fused={})
    if len({result.manifest.simulated for result in units.values()}) > 1:
        raise RunFormatError(f"test {name!r}: some runs are simulated and some are not. Combine them apart")
    comparison = compare_edges(units)
    slips = {} if comparison is None else comparison.slips
    wanted = [a for a in assemblies if any(view.unit in results for view in a.view)]

    def write(partial: Path) -> None:
        entries = []
        for i, config in enumerate(wanted):
            say("solving assemblies", i, len(wanted))
            solved = _solve(config, results, slips)
            table_name = None
            if solved.motion is not None:
                table_name = f"{config.name}.parquet"
                table = component_table(config, solved.motion, _nominal_hz(units), _metadata(name, units))
                pa.parquet.write_table(table, partial / table_name, compression="zstd")
                pa.csv.write_csv(
                    table.drop_columns(["covariance"]),
                    partial / f"{config.name}.csv",
                    pa.csv.WriteOptions(quoting_style="needed"),
                )
            entries.append(_assembly_entry(solved, table_name))
        places = {unit: _seen_from(folder, path) for unit, path in results.items()}
        summary = _summary(name, units, comparison, entries, quality, places)
        (partial / TEST_SUMMARY_NAME).write_bytes(dump_json(summary))
        if also is not None:
            say("writing the report", 0, 1)
            also(partial)

    write_folder_whole(folder, write, marker=TEST_SUMMARY_NAME, keep_if=_says_other)
    return read_test(folder)


def _says_other(new: Path, old: Path) -> bool:
    return content_id(new, TEST_SUMMARY_NAME) != content_id(old, TEST_SUMMARY_NAME)


def component_table(
    config: AssemblyConfig, solved: AssemblyMotion, nominal_hz: float | None, metadata: dict[str, str]
) -> "pa.Table":
    """Return the table of an assembly: one row for each component and sample."""
    points = {component.name: component.point_mm for component in config.component}
    motions = [one.motion.about(points[one.component]) for one in solved.components]
    n, k = len(solved.sample), len(motions)
    R, t_mm, covariance, flags = (
        np.concatenate([getattr(motion, key) for motion in motions])
        for key in ("R", "t_mm", "covariance", "flags")
    )
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    lab_s = np.full(n, np.nan) if nominal_hz is None else solved.sample / nominal_hz
    columns: Columns = [
        (Column("component", "", "seen from the base"),
         pa.array([one.component for one in solved.components for _ in range(n)], type=pa.string())),
        (Column("sample", "1", "number of the laboratory's sample"), pa.array(np.tile(solved.sample, k))),
        (Column("lab_s", "s", "sample number over the wave's nominal frequency; NaN if that is not told"),
         pa.array(np.tile(lab_s, k))),
        *vector_columns("d{}_mm", "mm", "displacement of the component's point from rest, brick axes", t_mm),
        *vector_columns("drvec_{}_rad", "rad", "rotation vector from rest, brick axes", rvec_from_matrix(R)),
        *vector_columns("dangle_{}_deg", "deg", "intrinsic XYZ angle from rest, brick axes",
                        np.rad2deg(angles_xyz_from_matrix(R))),
        *vector_columns("sd_d{}_mm", "mm", "standard deviation of the displacement, brick axes", sd[:, 3:]),
        *vector_columns("sd_rot_{}_deg", "deg", "standard deviation of the rotation, component's axes",
                        np.rad2deg(sd[:, :3])),
        covariance_column(covariance),
        *flag_columns(flags),
    ]  # fmt: skip
    return make_table(
        columns, metadata | {"bricktrack.assembly": config.name, "bricktrack.base": config.base}
    )


def _solve(config: AssemblyConfig, results: Mapping[str, Path], slips: Mapping[str, int]) -> _Solved:
    here = {view.unit: read_result(results[view.unit]) for view in config.view if view.unit in results}
    try:
        motion = assembly_motion(config, here, slips=slips)
    except AssemblyError as e:
        return _Solved(config, None, (str(e),))
    return _Solved(config, motion if motion.components else None, motion.problems)


def _assembly_entry(solved: _Solved, table: str | None) -> AssemblyEntry:
    config, motion = solved.config, solved.motion
    points = {component.name: component.point_mm for component in config.component}
    peak_mm: dict[str, float] = {}
    peak_deg: dict[str, float] = {}
    for one in () if motion is None else motion.components:
        moved = one.motion.about(points[one.component])
        known = np.isfinite(moved.t_mm).all(axis=1) & (moved.flags & int(PoseFlag.EXTRAPOLATED) == 0)
        if known.any():
            peak_mm[one.component] = float(np.nanmax(np.linalg.norm(moved.t_mm[known], axis=1)))
            turn = np.linalg.norm(rvec_from_matrix(moved.R[known]), axis=1)
            peak_deg[one.component] = float(np.rad2deg(np.nanmax(turn)))
    return AssemblyEntry(
        name=config.name,
        kind=config.kind,
        base=config.base,
        chains={one.component: list(one.chain) for one in (motion.components if motion else ())},
        points_mm=points,
        peak_mm=peak_mm,
        peak_deg=peak_deg,
        loops=[_loop_entry(loop) for loop in (motion.loops if motion else ())],
        problems=list(solved.problems),
        table=table,
    )


def _loop_entry(loop: LoopCheck) -> dict[str, str | float | None]:
    figures = {
        "rms_mm": loop.rms_mm,
        "max_mm": loop.max_mm,
        "rms_deg": loop.rms_deg,
        "max_deg": loop.max_deg,
        "normalised": loop.normalised,
    }
    return {"unit": loop.unit} | {key: None if np.isnan(x) else x for key, x in figures.items()}


def _summary(
    name: str,
    units: Mapping[str, RunResult],
    comparison: EdgeComparison | None,
    assemblies: list[AssemblyEntry],
    quality: Mapping[str, tuple[list[str], Details]],
    places: Mapping[str, str],
) -> TestSummary:
    slips = {} if comparison is None else {slip.unit: slip for slip in comparison.units}
    entries = []
    for unit, result in units.items():
        slip = slips.get(unit)
        edges = "none" if result.edge_fit is None else "agrees" if slip is None else slip.state
        entries.append(
            UnitEntry(
                unit=unit,
                run_id=result.manifest.run_id,
                simulated=result.manifest.simulated,
                slip_samples=0 if slip is None else slip.samples,
                edges=edges,
                problems=quality[unit][0],
                provenance=result.provenance,
                witnesses=[
                    {"witness": t.witness, "samples": t.samples, "sd_samples": t.sd_samples}
                    for t in (slip.testimonies if slip else ())
                ],
                figures=quality[unit][1],
                results=places[unit],
            )
        )
    problems = [] if comparison is None else comparison.problems()
    problems += [f"{entry.name}: {problem}" for entry in assemblies for problem in entry.problems]
    return TestSummary(
        name=name,
        simulated=any(result.manifest.simulated for result in units.values()),
        nominal_hz=_nominal_hz(units),
        reference=None if comparison is None else comparison.reference,
        units=entries,
        assemblies=assemblies,
        problems=problems,
        conventions=CONVENTIONS,
        software_version=software_version(),
    )


def _quality(result: RunResult) -> tuple[list[str], Details]:
    """Return what is wrong with a run in words, and how good it is in numbers; `None` where not known."""
    f = key_figures(result)
    numbers: Details = {
        "frames": f.n_frames,
        "frames_dropped": f.n_frames_dropped,
        "poses": f.n_poses,
        "dropouts": len(f.dropouts_ns),
        "longest_dropout_s": float(np.diff(f.dropouts_ns).max()) / 1e9 if len(f.dropouts_ns) else 0.0,
        "impacts": len(f.impacts_ns),
        "residual_rms_px": f.residual_rms_px,
        "sd_mm": float(np.sqrt(np.sum(f.sd_mm**2))),
        "sd_deg": float(np.sqrt(np.sum(f.sd_deg**2))),
    }
    known: Details = {
        name: None if isinstance(value, float) and np.isnan(value) else value
        for name, value in numbers.items()
    }
    return verdict(result, f)[1], known


def _seen_from(folder: Path, results: Path) -> str:
    try:
        return Path(os.path.relpath(results.resolve(), folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return results.resolve().as_posix()


def _nominal_hz(units: Mapping[str, RunResult]) -> float | None:
    """Return the wave's frequency, if all units that were told agree on one."""
    told = {result.manifest.trigger.nominal_hz for result in units.values()} - {None}
    return told.pop() if len(told) == 1 else None


def _metadata(name: str, units: Mapping[str, RunResult]) -> dict[str, str]:
    simulated = any(result.manifest.simulated for result in units.values())
    return {f"bricktrack.{key.replace(' ', '_')}": words for key, words in CONVENTIONS.items()} | {
        "bricktrack.schema": TEST_SCHEMA,
        "bricktrack.version": str(TEST_VERSION),
        "bricktrack.test": name,
        "bricktrack.simulated": "true" if simulated else "false",
        "bricktrack.runs": msgspec.json.encode({u: r.manifest.run_id for u, r in units.items()}).decode(),
    }
