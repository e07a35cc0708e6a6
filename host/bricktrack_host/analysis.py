"""Results in Python: what a notebook calls to load a run or a test, and gets NumPy arrays and Arrow tables.

    from bricktrack_host import analysis

    run = analysis.load_run("runs/b2_9f31c2_0007_shake")
    motion = run.motion("edges")                      # at the laboratory's samples
    motion.displacement_mm[:, 0]                      # x, mm, from rest, brick axes
    spectrum = analysis.spectrum(motion)

    test = analysis.load_test("tests/shake-12")
    test.components("brick-7")["C"].rotation_deg      # seen from the base

    campaign = analysis.open_campaign("campaign")     # all tests, for queries
    campaign.head(5)

What the numbers mean is told by `MotionHistory`, and for tables by the metadata of each column.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.dataset
from numpy.typing import ArrayLike

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.assemblies.combined_summary import TestSummary, read_components, read_test
from bricktrack_host.assemblies.motion_history import (
    HistoryError,
    MotionHistory,
    component_histories,
    run_history,
)
from bricktrack_host.datasets.campaign_dataset import open_dataset
from bricktrack_host.quality import LedFlag, PoseFlag, describe
from bricktrack_host.results.daq_table import join_samples, read_daq_csv
from bricktrack_host.results.export import read_run_table
from bricktrack_host.results.result_store import RunResult, read_result, results_of
from bricktrack_host.results.result_tables import FusedKind
from bricktrack_host.results.run_summary import KeyFigures, key_figures, verdict
from bricktrack_host.results.spectra import Spectrum, amplitude_spectrum

__all__ = [
    "CombinedRuns",
    "HistoryError",
    "LedFlag",
    "MotionHistory",
    "PoseFlag",
    "Run",
    "Spectrum",
    "describe",
    "flag_names",
    "join_daq",
    "load_run",
    "load_test",
    "open_campaign",
    "spectrum",
]

Instants = Literal["slots", "frames", "edges", "optical"]
Table = Literal["samples", "fused", "optical", "leds", "imu", "edges"]
_FUSED: dict[Instants, FusedKind | None] = {
    "slots": "imu",
    "frames": "frame",
    "edges": "edge",
    "optical": None,
}


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A processed run.

    Attributes
    ----------
    folder : Path
        Of its results.
    result : RunResult
        Everything that processing gave: poses in the camera frame, LEDs, inertial samples, alignment.
    """

    folder: Path
    result: RunResult

    @property
    def run_id(self) -> str:
        """Return the run's name."""
        return self.result.manifest.run_id

    @property
    def simulated(self) -> bool:
        """Return whether the run was simulated."""
        return self.result.manifest.simulated

    @property
    def figures(self) -> KeyFigures:
        """Return the run in a few numbers: dropouts, impacts, peaks, residuals."""
        return key_figures(self.result)

    @property
    def problems(self) -> list[str]:
        """Return what is wrong with the run, in words, the gravest first: read them before the numbers."""
        return verdict(self.result, self.figures)[1]

    def motion(self, at: Instants = "slots", *, point_mm: ArrayLike = (0.0, 0.0, 0.0)) -> MotionHistory:
        """Return displacement and rotation from rest.

        Parameters
        ----------
        at : "slots", "frames", "edges" or "optical"
            Fused motion at inertial slots, at frames, or at the edges of the square wave, which are the
            laboratory's samples; or the poses of the camera alone.
        point_mm : array_like, shape (3,), mm, the layout's axes, at rest
            Whose displacement is wanted; by default that of the first LED.

        Raises
        ------
        HistoryError
            If the run has no rest pose, or no motion at such instants.
        """
        if at not in _FUSED:
            raise HistoryError(f"motion at {at!r}; there is motion at {', '.join(_FUSED)}")
        return run_history(self.result, _FUSED[at], point_mm=point_mm)

    def table(self, name: Table = "samples") -> "pa.Table":
        """Return one of the run's tables, units and meanings in its schema's metadata.

        Raises
        ------
        RunFormatError
            If the run has no such table.
        """
        return read_run_table(self.folder, name)


@dataclass(frozen=True, slots=True, eq=False)
class CombinedRuns:
    """All units of one shake, as ``bricktrack combine`` left them.

    Attributes
    ----------
    folder : Path
    summary : TestSummary
        Units, their agreement on the samples, peaks, loops and problems.
    """

    folder: Path
    summary: TestSummary

    @property
    def assemblies(self) -> list[str]:
        """Return the names of the test's assemblies."""
        return [entry.name for entry in self.summary.assemblies]

    @property
    def problems(self) -> list[str]:
        """Return what is wrong with the test, in words."""
        return list(self.summary.problems)

    def components(self, assembly: str) -> dict[str, MotionHistory]:
        """Return the motion of each component from rest, seen from the base, by name.

        Raises
        ------
        RunFormatError
            If there is no such assembly, or it has no motion.
        """
        return component_histories(self.table(assembly))

    def table(self, assembly: str) -> "pa.Table":
        """Return an assembly's table, one row for each component and sample.

        Raises
        ------
        RunFormatError
            If there is no such assembly, or it has no motion.
        """
        return read_components(self.folder, assembly)


def load_run(folder: str | Path) -> Run:
    """Return a processed run.

    Parameters
    ----------
    folder : str or Path
        The run's folder, or that of its results.

    Raises
    ------
    RunFormatError
        If it holds no results, of this version.
    """
    results = results_of(Path(folder))
    return Run(results, read_result(results))


def load_test(folder: str | Path) -> CombinedRuns:
    """Return a combined test.

    Raises
    ------
    RunFormatError
        If the folder holds none, of this version.
    """
    return CombinedRuns(Path(folder), read_test(Path(folder)))


def open_campaign(folder: str | Path, *, earlier: bool = False) -> "pa.dataset.Dataset":
    """Return the dataset that ``bricktrack dataset add`` has filled, for queries.

    Parameters
    ----------
    folder : str or Path
    earlier : bool
        The rows whose place others took, in place of those that hold now.

    Raises
    ------
    RunFormatError
        If the folder holds no dataset, or one of a newer version.
    """
    return open_dataset(Path(folder), earlier=earlier)


def spectrum(motion: MotionHistory) -> Spectrum:
    """Return the amplitude spectral density of a motion where it was measured.

    Parameters
    ----------
    motion : MotionHistory

    Returns
    -------
    Spectrum
        ``density`` has six columns: displacement x, y, z, mm/sqrt(Hz), and rotation x, y, z, deg/sqrt(Hz).

    Raises
    ------
    SpectrumError
        If fewer than 64 samples were measured.
    """
    rows = motion.measured
    values = np.concatenate([motion.displacement_mm, motion.rotation_deg], axis=1)
    return amplitude_spectrum(motion.t_s[rows], values[rows])


def join_daq(
    motion: MotionHistory | Mapping[str, MotionHistory],
    csv: str | Path,
    *,
    sample_column: str | None = None,
    first_sample: int = 0,
) -> "pa.Table":
    """Return the rows of a data acquisition's CSV file with the motion of the same sample behind each.

    Parameters
    ----------
    motion : MotionHistory, or mapping of name to MotionHistory
        At edges, or of components. Of several, each column's name begins with that of its motion.
    csv : str or Path
        One header line, then one row a sample.
    sample_column : str, optional
        Column with the sample numbers; without it rows are counted.
    first_sample : int
        What the laboratory calls the sample of the first rising edge.

    Returns
    -------
    pyarrow.Table
        Column ``sample``, the channels, then ``dx_mm`` to ``dz_mm``, ``drot_x_deg`` to ``drot_z_deg``, their
        standard deviations ``sd_...`` and ``flags``; null where a sample has no motion.

    Raises
    ------
    RunFormatError
        If the file is no such table, or shares no sample or shares a name with the motion.
    HistoryError
        If the motion is not at whole samples.
    """
    joined = read_daq_csv(Path(csv), sample_column=sample_column, first_sample=first_sample)
    several = {"": motion} if isinstance(motion, MotionHistory) else {f"{k}_": m for k, m in motion.items()}
    for prefix, one in several.items():
        joined = join_samples(_sample_table(one, prefix), joined, number="number")
    return joined


def _sample_table(motion: MotionHistory, prefix: str) -> "pa.Table":
    number = np.rint(motion.sample)
    if not np.array_equal(number, motion.sample):
        raise HistoryError(f"{motion.name}: not at the laboratory's samples; take motion('edges')")
    columns: dict[str, FloatArray | IntArray] = {"number": number.astype(np.int64)}
    for name, values in (
        ("d{}_mm", motion.displacement_mm),
        ("drot_{}_deg", motion.rotation_deg),
        ("sd_d{}_mm", motion.displacement_sd_mm),
        ("sd_drot_{}_deg", motion.rotation_sd_deg),
    ):
        columns |= {prefix + name.format(c): values[:, i] for i, c in enumerate("xyz")}
    columns[f"{prefix}flags"] = motion.flags
    return pa.table({name: pa.array(np.ascontiguousarray(column)) for name, column in columns.items()})


def flag_names(flags: ArrayLike) -> list[str]:
    """Return the names of the `PoseFlag` bits of each sample, as ``"dropout, impact"``.

    Examples
    --------
    >>> flag_names([0, 128, 384])
    ['', 'dropout', 'dropout, impact']
    """
    return [describe(int(value)) for value in np.asarray(flags, dtype=np.int64)]
