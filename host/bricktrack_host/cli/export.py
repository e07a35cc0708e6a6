"""``bricktrack export``: results as other programs want them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import out

if TYPE_CHECKING:
    import pyarrow

Choice = Literal["samples", "fused", "optical", "leds", "imu", "edges"]


def export(
    source: Annotated[
        Path, typer.Argument(metavar="RUN|TEST", help="A processed run, its results, or a combined test.")
    ],
    form: Annotated[
        Literal["csv", "mat", "parquet"], typer.Option("--format", help="What to write.")
    ] = "mat",
    table: Annotated[
        Choice,
        typer.Option("--table", help="Of a run; 'samples' is the fused motion at the laboratory's samples."),
    ] = "samples",
    assembly: Annotated[
        str | None,
        typer.Option("--assembly", help="Of a test that has more than one.", show_default=False),
    ] = None,
    component: Annotated[
        str | None, typer.Option("--component", help="Of an assembly: this one only.", show_default=False)
    ] = None,
    daq: Annotated[
        Path | None,
        typer.Option(
            "--daq",
            help="CSV of the data acquisition; its rows get the motion of the same sample.",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    sample_column: Annotated[
        str | None,
        typer.Option(help="Column of that file with the sample's number. \\[default: rows are counted]"),
    ] = None,
    first_sample: Annotated[
        int, typer.Option(help="What the data acquisition calls the sample of the first rising edge.")
    ] = 0,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File to write. \\[default: here, named for what it holds]"),
    ] = None,
) -> None:
    """Write results for MATLAB, a spreadsheet or another program, with the laboratory's channels if given.

    For example:

        bricktrack export runs/b2_9f31c2_0007_shake

        bricktrack export runs/b2_9f31c2_0007_shake --format csv --daq shake.csv --sample-column Sample

        bricktrack export tests/shake-12 --assembly brick-7 --component B --daq shake.csv
    """
    import pyarrow.compute

    from bricktrack_host.assemblies.combined_summary import TEST_SUMMARY_NAME, read_components, read_test
    from bricktrack_host.results.daq_table import join_samples, read_daq_csv
    from bricktrack_host.results.export import read_run_table, write_table
    from bricktrack_host.results.result_store import results_of

    if (source / TEST_SUMMARY_NAME).is_file():
        names = [entry.name for entry in read_test(source).assemblies]
        if assembly is None and len(names) != 1:
            raise ConfigError(f"{source}: which --assembly? There are {', '.join(names) or 'none'}")
        chosen = assembly or names[0]
        motion, number, stem = read_components(source, chosen), "sample", f"{source.resolve().name}_{chosen}"
        there = [str(name) for name in motion.column("component").unique().to_pylist()]
        if component is not None and component not in there:
            raise ConfigError(f"{chosen}: no component {component!r}; there are {', '.join(there)}")
        if component is None and daq is not None and len(there) > 1:
            raise ConfigError(f"{chosen}: with --daq, which --component? There are {', '.join(there)}")
        if component is not None:
            motion = motion.filter(pyarrow.compute.field("component") == component)
            stem += f"_{component}"
    else:
        if assembly is not None or component is not None:
            raise ConfigError(f"{source} is a run; --assembly and --component are for tests")
        motion, number = read_run_table(results_of(source), table), "edge_index"
        stem = f"{_run_of(motion)}_{table}"
        if daq is not None and table != "samples":
            raise ConfigError(f"--daq needs one row a sample: leave out --table {table}")
    if daq is not None:
        channels = read_daq_csv(daq, sample_column=sample_column, first_sample=first_sample)
        motion = join_samples(motion, channels, number=number)
        stem += "_with_daq"
    path = output or Path(f"{stem}.{form}")
    write_table(motion, path, form)
    out.print(f"{motion.num_rows} rows, {motion.num_columns} columns: {path}", markup=False, soft_wrap=True)


def _run_of(motion: "pyarrow.Table") -> str:
    return str((motion.schema.metadata or {}).get(b"bricktrack.run_id", b"run").decode())
