"""``bricktrack align``: how the clocks of camera and IMU lie to each other, by the motion that both saw."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from bricktrack_common.errors import BricktrackError, ConfigError
from bricktrack_host.cli._console import err, out, print_json, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import JsonOption

# What computes is imported by the command that runs it: SciPy, PyArrow and numba take a second to load.
if TYPE_CHECKING:
    from bricktrack_common.arrays import FloatArray, IntArray
    from bricktrack_host.fusion.alignment_report import AlignmentReport
    from bricktrack_host.fusion.mount import Mount
    from bricktrack_host.tracks import ImuTrack, OpticalTrack

_STAMPS_SD_S = 5e-3  # one clock stamps both, and the lags in the sensors are a few ms
_PLOTS = (".png", ".pdf", ".svg")


def align(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="RUN", help="Processed runs, or their results folders.", show_default=False),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            "--poses",
            help="Poses from elsewhere: CSV with t_ns, q_w .. q_z, x_mm .. z_mm.",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    imu: Annotated[
        Path | None,
        typer.Option(
            "--imu",
            help="Their inertial samples in the body's axes: CSV with t_ns, ax_mps2 .., gx_dps ..",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    layout: Annotated[
        Path | None,
        typer.Option(
            "--layout",
            "-l",
            help="Layout file of the brick; with its IMU's place the lag of the accelerometer is found too.",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    within: Annotated[
        float, typer.Option("--within", min=0.02, max=30.0, help="Seconds by which the clocks may differ.")
    ] = 0.25,
    stamps_sd_ms: Annotated[
        float | None,
        typer.Option(
            "--stamps-sd",
            min=0.01,
            help="How well the stamps are believed, ms. \\[default: 5 of a unit's own runs, else --within]",
            show_default=False,
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", "-p", help="Picture to write: .png, .pdf or .svg.", show_default=False),
    ] = None,
    mount: Annotated[
        bool,
        typer.Option("--mount", help="Refine the IMU's axes and place in the brick too; needs --layout."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Say by how much camera and IMU differ in time, how sure that is, and whether their stamps agree.

    Works on processed runs, and on poses and inertial samples from CSV files, which need no common clock.
    Frame stamps that slip by whole periods from some frame on are found, and mended for what is said.
    Exits with 1 if they do, if the motion tells no offset, or one that the stamps do not allow.

    For example:

        bricktrack align runs/b2_9f31c2_0007_shake --layout brick.toml --plot clocks.png

        bricktrack align --poses optical.csv --imu imu.csv --within 2 --json
    """
    sources = _sources(runs or [], poses, imu)
    if plot is not None and plot.suffix.lower() not in _PLOTS:
        raise ConfigError(f"--plot {plot}: expected a file that ends in {', '.join(_PLOTS)}")
    if plot is not None and len(sources) > 1:
        raise ConfigError(f"--plot is for one recording; {len(sources)} were given")
    lever_arm_mm = _lever_arm(layout)
    if mount and lever_arm_mm is None:
        raise ConfigError("--mount refines what a layout file says: name it with --layout")
    rows: list[dict[str, object]] = []
    failed = 0
    for run in sources:
        try:
            with err.status(f"{run or poses}: comparing both motions", spinner="dots"), _without_log():
                report, simulated = _report(
                    run, poses, imu, lever_arm_mm, within, stamps_sd_ms, with_mount=mount
                )
                chip = _chip_figures(run, layout, report) if mount else {}
        except BricktrackError as e:
            if len(sources) == 1:
                raise
            say_error(f"{run}: {e}")
            failed += 1
            continue
        name = run.name if run is not None else f"{poses} and {imu}"
        figures = report.figures() | chip
        rows.append({"recording": name, "simulated": simulated, **figures})
        failed += not figures["trusted"] or figures["stamps_agree"] is False
        if not json:
            _say(name + (" (simulated)" if simulated else ""), report, chip, within)
        if plot is not None:
            from bricktrack_host.reporting.alignment_plot import save_alignment_plot

            save_alignment_plot(report, plot, title=name + (" (simulated)" if simulated else ""))
            if not json:
                out.print(f"plot: {plot}", markup=False, soft_wrap=True)
    if json:
        print_json({"ok": not failed, "recordings": rows})
    if failed:
        raise typer.Exit(EXIT_ERROR)


@contextmanager
def _without_log() -> Iterator[None]:
    """Keep to itself what the fusion logs of the clocks: all of that is said below, once and in order."""
    log = logging.getLogger("bricktrack_host.fusion")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(before)


def _sources(runs: list[Path], poses: Path | None, imu: Path | None) -> list[Path | None]:
    """Return the runs; one None where files are given instead."""
    if runs and (poses or imu):
        raise ConfigError("runs were named, and --poses or --imu as well: give one or the other")
    if not runs and (poses is None or imu is None):
        raise ConfigError("nothing to align: name processed runs, or give --poses and --imu")
    return [*runs] or [None]


def _lever_arm(layout: Path | None) -> "FloatArray | None":
    from bricktrack_common.brick_model import load_brick_model

    if layout is None:
        return None
    lever_arm_mm = load_brick_model(layout).imu_lever_arm_mm
    if lever_arm_mm is None:
        raise ConfigError(f"{layout}: no [imu], so the place of the inertial sensor is not known")
    return lever_arm_mm


def _report(
    run: Path | None,
    poses: Path | None,
    imu: Path | None,
    lever_arm_mm: "FloatArray | None",
    within_s: float,
    stamps_sd_ms: float | None,
    *,
    with_mount: bool,
) -> "tuple[AlignmentReport, bool]":
    """Return the report, and whether the recording is a simulated one."""
    from bricktrack_host.fusion.alignment_report import report_alignment

    own_clock, simulated, stamps_ns = False, False, None
    if run is not None:
        optical, samples, stamps_ns, own_clock, simulated = _read_run(run)
    elif poses is not None and imu is not None:
        optical, samples = _read_files(poses, imu)
    sd_ms = stamps_sd_ms or 1e3 * (_STAMPS_SD_S if own_clock else within_s)
    report = report_alignment(
        optical, samples, lever_arm_mm=lever_arm_mm, prior_sd_ns=sd_ms * 1e6, max_offset_s=within_s,
        frame_stamps_ns=stamps_ns, with_mount=with_mount,
    )  # fmt: skip
    return report, simulated


def _read_run(run: Path) -> "tuple[OpticalTrack, ImuTrack, IntArray, bool, bool]":
    from bricktrack_host.results.result_store import read_result, results_of

    result = read_result(results_of(run))
    if result.imu is None:
        raise ConfigError(f"{run}: the run was processed without inertial samples: there is nothing to align")
    camera = result.provenance.settings.get("camera", "static")
    if camera != "static":
        raise ConfigError(
            f"{run}: its camera moves (camera = {camera!r}), and one IMU alone says nothing of its clock "
            "there. How the clocks lie is in the run's report, under 'Camera and inertial sensor'"
        )
    own_clock = result.manifest.origin == "bricktrackd"
    stamps_ns = result.observations.sensor_timestamp_ns
    return result.optical, result.imu, stamps_ns, own_clock, result.manifest.simulated


def _read_files(poses: Path, imu: Path) -> "tuple[OpticalTrack, ImuTrack]":
    import numpy as np

    from bricktrack_host.recordings.loose_files import read_imu_csv
    from bricktrack_host.recordings.pose_csv import read_poses_csv
    from bricktrack_host.tracks import ImuTrack

    samples = read_imu_csv(imu)
    track = ImuTrack(
        t_ns=samples.t_ns,
        acc_mps2=samples.acc_mps2,
        gyro_radps=np.deg2rad(samples.gyro_dps),
        flags=np.zeros(len(samples.t_ns), dtype=np.int64),
        acc_range_mps2=float("inf"),
    )
    # The fit takes the noise of the attitudes from themselves; these only say how rotation and shift compare.
    return read_poses_csv(poses, sd_deg=0.1, sd_mm=0.1), track


def _chip_figures(
    run: Path | None, layout: Path | None, report: "AlignmentReport"
) -> "dict[str, float | None]":
    """Return how the chip's own orientation agrees with the camera's; nothing of a run in a raw mode."""
    from bricktrack_common.brick_model import load_brick_model
    from bricktrack_common.run_folder import read_run
    from bricktrack_common.run_manifest import MANIFEST_NAME
    from bricktrack_host.fusion.mount import check_chip_orientation
    from bricktrack_host.results.result_store import read_result, results_of
    from bricktrack_host.stages.clocks import chip_orientation
    from bricktrack_host.stages.settings import ProcessSettings

    if run is None or layout is None or report.fused is None or not (run / MANIFEST_NAME).is_file():
        return {}
    result = read_result(results_of(run))
    chosen = result.provenance.settings.get("imu")
    settings = ProcessSettings(imu=chosen if isinstance(chosen, str) else None)
    chip = chip_orientation(read_run(run), load_brick_model(layout), settings)
    if chip is None:
        return {}
    check = check_chip_orientation(
        result.optical, chip.t_ns, chip.q_wxyz_gravity_imu, R_brick_imu=chip.R_brick_imu,
        alignment=report.alignment, gravity_camera_mps2=report.fused.gravity_camera_mps2,
    )  # fmt: skip
    return {
        "chip_orientation_off_rms_deg": check.rms_deg,
        "chip_orientation_off_max_deg": check.max_deg,
        "chip_gravity_off_deg": check.gravity_deg,
    }


def _say(name: str, report: "AlignmentReport", chip: "dict[str, float | None]", within_s: float) -> None:
    f = report.figures()
    table = Table(title=f"Clocks of {name}", title_justify="left", show_header=False, box=None)
    table.add_column(style="bold")
    table.add_column()

    def with_sd(value: str, sd: str, unit: str, digits: int) -> str:
        if f[value] is None:
            return "-"
        return f"{f[value]:.{digits}f} ± {f[sd]:.{digits}f} {unit}"

    is_told = f["source"] == "motion"
    offset = with_sd("offset_ms", "offset_sd_ms", "ms", 3) if is_told else "not told by the motion"
    table.add_row("IMU time less camera time", offset)
    if f["smoothed_offset_ms"] is not None:
        table.add_row("  with positions", with_sd("smoothed_offset_ms", "smoothed_offset_sd_ms", "ms", 3))
        table.add_row("accelerometer less gyro lag", with_sd("acc_lag_ms", "acc_lag_sd_ms", "ms", 2))
    if is_told:
        table.add_row("rate of the two clocks", with_sd("skew_ppm", "skew_sd_ppm", "ppm", 1))
    table.add_row("as the stamps have it", with_sd("stamps_offset_ms", "stamps_offset_sd_ms", "ms", 1))
    clock_ppm = f["sensor_clock_ppm"]
    if isinstance(clock_ppm, float):
        by = f"{abs(clock_ppm):.0f} ppm {'slow' if clock_ppm > 0 else 'fast'}"
        table.add_row("the sensor's own clock", f"{by}, {f['samples_not_read']} samples not read")
    if f["correlation"] is not None:
        table.add_row("correlation of angular speeds", f"{f['correlation']:.3f}")
    if report.mount is not None:
        _add_mount(table, report.mount)
    if chip:
        table.add_row(
            "the chip's own orientation",
            f"{chip['chip_orientation_off_rms_deg']:.2f} deg rms from the camera's, "
            f"{chip['chip_orientation_off_max_deg']:.2f} at most; its gravity "
            f"{chip['chip_gravity_off_deg']:.2f} deg from that of the run",
        )
    table.add_row("verdict", _verdict(report, within_s))
    out.print(table)
    if report.n_restamped:
        out.print(f"- {report.n_restamped} frame stamps were mended when the run was processed", markup=False)
    for problem in [*filter(None, [report.alignment.reason]), *report.problems]:
        out.print(f"- {problem}", markup=False)


def _verdict(report: "AlignmentReport", within_s: float) -> str:
    if report.slips is not None:
        return "the frame stamps slip; what stands above is of mended ones"
    if report.stamps_agree is None:
        return f"the motion tells no offset within {within_s:g} s (--within); the stamps are all there is"
    return "motion and stamps agree" if report.stamps_agree else "motion and stamps disagree"


def _add_mount(table: Table, mount: "Mount") -> None:
    import numpy as np

    def told(values: "FloatArray", sds: "FloatArray", unit: str) -> str:
        return (
            ", ".join(
                f"{v:.2f} ± {sd:.2f}" if np.isfinite(v) else "not told"
                for v, sd in zip(values.tolist(), sds.tolist(), strict=True)
            )
            + f" {unit}"
        )

    turn, turn_sd = np.rad2deg(mount.rvec_layout_rad), np.rad2deg(mount.rvec_sd_rad)
    table.add_row("IMU's axes against the layout's", told(turn, turn_sd, "deg about x, y, z of the brick"))
    table.add_row("IMU's place", told(mount.lever_arm_mm, mount.lever_arm_sd_mm, "mm from the first LED"))
    table.add_row(
        "gravity when quiet",
        f"{mount.gravity_mps2:.2f} m/s², {mount.gravity_off_deg:.1f} deg from that of the whole run",
    )
