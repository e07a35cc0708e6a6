"""Which results are compared with which: runs, tests, or whole folders of runs, before and after."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bricktrack_common.errors import ConfigError, RunFormatError
from bricktrack_host.assemblies.combined_summary import (
    TEST_SUMMARY_NAME,
    earlier_tests,
    read_components,
    read_test,
)
from bricktrack_host.assemblies.motion_history import component_histories
from bricktrack_host.datasets.comparison import Alike, compare_components, compare_runs
from bricktrack_host.results.result_store import (
    SUMMARY_NAME,
    earlier_results,
    read_provenance,
    read_result,
    results_of,
)

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Everything that was compared.

    Attributes
    ----------
    title : str
    before, after : str
        Where the two sides are.
    simulated : bool
    pairs : list of Alike
    only_before, only_after : list of str
        Runs or components that one side has alone.
    """

    title: str
    before: str
    after: str
    simulated: bool
    pairs: list[Alike]
    only_before: list[str]
    only_after: list[str]


def compare(before: Path, after: Path | None = None, *, progress: Progress | None = None) -> Comparison:
    """Compare two processings.

    Parameters
    ----------
    before : Path
        A run, its results, a combined test, or a folder of runs. Without ``after`` what it holds now is
        compared with what its last processing, or combination, replaced.
    after : Path, optional
        Likewise; of the same kind.

    Raises
    ------
    ConfigError
        If there is nothing to compare.
    RunFormatError
        If results cannot be read, or two of them are of different recordings.
    """
    say = progress or (lambda _what, _done, _of: None)
    if after is None and (path := earlier_tests(before)):
        before, after = path[-1], before
    if after is None:
        sides = [(name, _last_replaced(now), now) for name, now in _runs_in(before).items()]
        runs = [(name, old, now) for name, old, now in sides if old is not None]
        if not runs:
            raise ConfigError(
                f"{before}: no earlier results are kept, so nothing was replaced. Name two to compare"
            )
        only_before, only_after = [], [name for name, old, _ in sides if old is None]
        title, places = before, ("what the last processing replaced", str(before))
        pairs = []
    else:
        old_runs, new_runs = _runs_as_combined(before), _runs_as_combined(after)
        if len(old_runs) == len(new_runs) == 1:  # results of one run, whatever their folders are called
            old_runs = dict.fromkeys(new_runs, next(iter(old_runs.values())))
        runs = [(name, old_runs[name], new_runs[name]) for name in new_runs if name in old_runs]
        only_before = [name for name in old_runs if name not in new_runs]
        only_after = [name for name in new_runs if name not in old_runs]
        title, places = after, (str(before), str(after))
        pairs = _components(before, after)
        if not runs and not pairs:
            raise ConfigError(f"{before} and {after} have no run in common")
    simulated, name_of_all = False, title.resolve().name
    for i, (name, old, now) in enumerate(runs):
        say("comparing", i, len(runs))
        results = read_result(old), read_result(now)
        simulated |= results[1].manifest.simulated
        pairs.append(compare_runs(*results, name=name))
        if len(runs) == 1 and len(pairs) == 1:
            name_of_all = results[1].manifest.run_id
    return Comparison(name_of_all, *places, simulated, pairs, only_before, only_after)


def _last_replaced(results: Path) -> Path | None:
    earlier = earlier_results(results)
    return earlier[-1] if earlier else None


def _runs_in(path: Path) -> dict[str, Path]:
    """Return results folders by name: of a test its units', of a folder its runs', of a run its own."""
    if (path / TEST_SUMMARY_NAME).is_file():
        return {
            unit.unit: (path / unit.results).resolve()
            for unit in read_test(path).units
            if unit.results is not None
        }
    results = results_of(path)
    if (results / SUMMARY_NAME).is_file():
        return {read_result(results).manifest.unit: results}
    if not path.is_dir():
        raise RunFormatError(f"{path}: no such folder")
    found = {
        child.name: results_of(child)
        for child in sorted(path.iterdir())
        if child.is_dir() and (results_of(child) / SUMMARY_NAME).is_file()
    }
    if not found:
        raise RunFormatError(f"{path}: no processed run, no results, and no combined test")
    return found


def _runs_as_combined(path: Path) -> dict[str, Path]:
    """Return results folders by name; of a test those that it was combined of, be they replaced since."""
    runs = _runs_in(path)
    if not (path / TEST_SUMMARY_NAME).is_file():
        return runs
    for unit in read_test(path).units:
        if unit.unit not in runs:
            continue
        kept = [runs[unit.unit], *reversed(earlier_results(runs[unit.unit]))]
        found = [results for results in kept if read_provenance(results) == unit.provenance]
        if not found:
            raise RunFormatError(
                f"{path}: the results of {unit.unit} that it was combined of are no longer at {kept[0]}. "
                "Combine the test again"
            )
        runs[unit.unit] = found[0]
    return runs


def _components(before: Path, after: Path) -> list[Alike]:
    if not all((path / TEST_SUMMARY_NAME).is_file() for path in (before, after)):
        return []
    pairs = []
    old, new = ({e.name: e for e in read_test(path).assemblies if e.table} for path in (before, after))
    for assembly in (name for name in new if name in old):
        motions = [component_histories(read_components(path, assembly)) for path in (before, after)]
        pairs += [
            compare_components(f"{assembly}: {component}", motions[0][component], motions[1][component])
            for component in motions[1]
            if component in motions[0]
        ]
    return pairs
