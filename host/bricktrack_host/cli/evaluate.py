"""``bricktrack evaluate``: the source paper's evaluation, simulated or of a recorded sweep."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import out
from bricktrack_host.cli._progress import counting_bar
from bricktrack_host.cli._stage_bar import StageBar, stage_bar
from bricktrack_host.durable_files import storage_errors

if TYPE_CHECKING:
    from bricktrack_host.evaluation.scores import SweepScore


def evaluate(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="RUN", help="A processed run of a brick moved in known steps. Default: simulate."
        ),
    ] = None,
    positions: Annotated[
        Path | None,
        typer.Option(
            help="CSV of RUN's reference positions: start_s, end_s, x_mm, y_mm, z_mm\\[, rx_deg ...]."
        ),
    ] = None,
    align: Annotated[
        bool, typer.Option(help="Turn the stage's axes onto the camera's, as the displacements say.")
    ] = True,
    layout: Annotated[
        Path | None,
        typer.Option("--layout", "-l", help="Layout of the simulated brick. \\[default: the paper's]"),
    ] = None,
    images: Annotated[
        bool,
        typer.Option(
            "--images", help="Simulate whole pictures: domes, rolling shutter, noise, H.264. Minutes."
        ),
    ] = False,
    noise_px: Annotated[
        float,
        typer.Option(min=0.001, max=5.0, help="Noise of simulated centroids and dots, each of u and v."),
    ] = 0.05,
    seed: Annotated[
        list[int] | None,
        typer.Option(
            min=0, help="Of the simulated lens and noise; again for another lens. \\[default: 1 and 2]"
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the page and its pictures.")
    ] = Path("evaluation"),
    as_json: Annotated[bool, typer.Option("--json", help="Print figures as JSON, and nothing else.")] = False,
) -> None:
    """Measure known displacements and rotations, and print the errors beside the paper's and the bound.

    Without RUN, a brick is simulated along the paper's sweeps (its section 6.2) with points in place of
    pictures: from plane A to plane B in steps of 1 mm, from corner to corner, and rotations to 30 degrees
    about each axis; then orientations to 45 degrees are identified from nothing. Rays are calibrated from
    noisy dots of a lens that the product does not know. With --images the brick is filmed instead, moving
    on by 1 mm or 1 degree from picture to picture, and solved with and without dome model and row times.
    Each --seed is another lens; the table holds all of them. All figures are then simulated, and say so.

    For example:

        bricktrack evaluate

        bricktrack evaluate --images --seed 3 --seed 4

        bricktrack evaluate --noise-px 0.1 --seed 7 --json

        bricktrack evaluate runs/b2_9f31c2_0007_sweep --positions stage.csv
    """
    if (run is None) != (positions is None):
        raise ConfigError("a recorded sweep needs both RUN and --positions; a simulated one neither")
    with storage_errors(output, "Choose another folder with --output, or make room"):
        output.mkdir(parents=True, exist_ok=True)  # before work of minutes
    if run is not None and positions is not None:
        _recorded(run, positions, align=align, output=output, as_json=as_json)
    elif images:
        _filmed(_seeds(seed), output=output, as_json=as_json)
    else:
        _simulated(layout, noise_px=noise_px, seeds=_seeds(seed), output=output, as_json=as_json)


def _seeds(given: list[int] | None) -> list[int]:
    return sorted(set(given or [1, 2]))


def _lenses(seeds: list[int]) -> str:
    return f"lens {seeds[0]}" if len(seeds) == 1 else "lenses " + ", ".join(map(str, seeds))


def _simulated(
    layout: Path | None, *, noise_px: float, seeds: list[int], output: Path, as_json: bool
) -> None:
    from functools import reduce
    from operator import add

    from bricktrack_common.brick_model import load_brick_model
    from bricktrack_host.evaluation.paper_brick import paper_brick
    from bricktrack_host.evaluation.simulated_points import evaluate_points

    brick = paper_brick() if layout is None else load_brick_model(layout)
    found = []
    for seed in seeds:
        with counting_bar(f"sweeps and orientations, lens {seed}", 1) as progress:
            found.append(evaluate_points(brick, noise_px=noise_px, seed=seed, progress=progress))
    identity = reduce(add, (f.identity for f in found))
    line = f"Identity from nothing, {identity.n} simulated orientations within 45 degrees: {identity}."
    extra = {
        "simulated": True,
        "noise_px": noise_px,
        "seeds": seeds,
        "identity": dataclasses.asdict(identity),
    }
    title = f"Simulated sweeps, points with {noise_px:g} px of noise, {_lenses(seeds)}"
    _write_and_print(
        {f"lens {seed}": f.scores for seed, f in zip(seeds, found, strict=True)},
        title,
        extra,
        [line],
        output=output,
        as_json=as_json,
        with_bound=True,
    )


def _filmed(seeds: list[int], *, output: Path, as_json: bool) -> None:
    from bricktrack_host.evaluation import summary
    from bricktrack_host.evaluation.filmed_sweeps import evaluate_film
    from bricktrack_host.evaluation.scores import joined

    by_seed = {}
    for seed in seeds:
        with stage_bar(f"evaluation, unit {seed}") as bar:

            def stage(name: str, bar: StageBar = bar) -> Callable[[int, int], None]:
                bar.stage(name, None)

                def show(done: int, of: int) -> None:
                    if done <= 1:
                        bar.stage(name, of)
                    bar.advance_to(done)

                return show

            by_seed[seed] = evaluate_film(output / f"film_{seed}", seed=seed, stage=stage)
    chosen, *others = next(iter(by_seed.values()))
    every = {
        name: [joined(same) for same in zip(*(scores[name] for scores in by_seed.values()), strict=True)]
        for name in (chosen, *others)
    }
    lines = ["Filmed while moving on by 1 mm or 1 degree from picture to picture, 30 a second."]
    for name in others:
        mm, deg = summary.pooled(every[name])
        lines.append(f"{name}: {mm[0]:.4f}, {mm[1]:.4f}, {mm[2]:.4f} mm and {deg:.4f} deg over all sweeps.")
    extra = {
        "simulated": True,
        "seeds": seeds,
        "also": {name: summary.as_json(every[name])["all"] for name in others},
    }
    title = f"Simulated sweeps on film, {_lenses(seeds)}: {chosen}"
    scores = {f"lens {seed}": scores[chosen] for seed, scores in by_seed.items()}
    _write_and_print(scores, title, extra, lines, output=output, as_json=as_json, with_bound=False)


def _recorded(run: Path, positions: Path, *, align: bool, output: Path, as_json: bool) -> None:
    from bricktrack_host.evaluation.recorded import read_positions, score_recording
    from bricktrack_host.results.result_store import read_result, results_of

    reference = read_positions(positions)
    result = read_result(results_of(run))
    score = score_recording(result.optical, reference, name=positions.stem, align=align)
    title = f"Recorded sweep {positions.stem} of {result.manifest.run_id}"
    extra = {"simulated": result.manifest.simulated, "run": result.manifest.run_id, "aligned": align}
    lines = ["The stage's axes were turned onto the camera's; lengths were not scaled."] if align else []
    if result.manifest.simulated:
        title = f"Simulated: {title}"
    _write_and_print(
        {positions.stem: [score]}, title, extra, lines, output=output, as_json=as_json, with_bound=False
    )


def _write_and_print(
    by_camera: "dict[str, list[SweepScore]]",
    title: str,
    extra: dict[str, Any],
    lines: list[str],
    *,
    output: Path,
    as_json: bool,
    with_bound: bool,
) -> None:
    """Write the page and its pictures, and print the table or the JSON."""
    from bricktrack_host.evaluation import summary
    from bricktrack_host.evaluation.figures import errors_figure, write_page
    from bricktrack_host.evaluation.scores import joined

    scores = [joined(same) for same in zip(*by_camera.values(), strict=True)]
    rows = summary.summary_rows(scores, with_bound=with_bound)
    subtitle = (
        "Root mean squares after zeroing at the first step: displacement and rotation since then. NEES / 6: "
        "squared errors, nothing zeroed, over what the covariances say; 1 on average over many cameras."
    )
    band = " The band is twice the Cramér-Rao bound of the axis that it binds least." if with_bound else ""
    figures = [
        (errors_figure(own), f"{name[:1].upper()}{name[1:]}: errors along each sweep.{band}")
        for name, own in by_camera.items()
    ]
    written = write_page(
        output / "evaluation.html",
        title=title,
        subtitle=subtitle,
        tables=[{"title": "Errors", "columns": summary.COLUMNS, "rows": rows}],
        lines=lines,
        figures=figures,
    )
    if as_json:
        print(json.dumps({**extra, **summary.as_json(scores)}, indent=2))
        return
    table = Table(title=title)
    for k, name in enumerate(summary.COLUMNS):
        table.add_column(name, justify="left" if k == 0 else "right")
    for row in rows:
        table.add_row(*row, style="dim" if row[0].startswith("  ") else None)
    out.print(table)
    for line in lines:
        out.print(line, markup=False)
    for path in written:
        out.print(f"written: {path}", markup=False, soft_wrap=True)
