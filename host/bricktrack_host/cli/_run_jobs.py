"""A run to be processed, with what the options name, or else the fleet file for the run's unit."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from bricktrack_common.errors import ConfigError
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_host.cli._units import fleet_path
from bricktrack_host.transfer.camera_config import CameraMount
from bricktrack_host.transfer.fleet_config import UnitConfig, load_fleet

# What computes is imported where it is used: `--help` and the units' commands need none of it.
if TYPE_CHECKING:
    from bricktrack_host.many_runs.run_job import RunJob
    from bricktrack_host.pipeline import ProcessSettings


def run_job(
    run: Path,
    *,
    fleet_file: Path | None,
    calibration: Path | None = None,
    layout: Path | None = None,
    camera: CameraMount | None = None,
    settings: "ProcessSettings | None" = None,
    output: Path | None = None,
    truth: Path | None = None,
    feels: dict[str, Any] | None = None,
) -> "RunJob":
    """Return a run with what the options name, or else the fleet file for the run's unit.

    ``feels``: where to find what feels the camera's motion, see `choose_camera_sensor`.
    """
    from bricktrack_host.many_runs.run_job import RunJob
    from bricktrack_host.pipeline import ProcessSettings
    from bricktrack_host.stages.camera_sensor import choose_camera_sensor

    feels = feels or {}
    sensor = None
    if fleet_file is None and (feels.get("camera_run") or feels.get("table")):
        fleet_file = fleet_path(None)  # which says how that sensor sits
    if fleet_file is not None or calibration is None or layout is None:
        unit = _unit_of(run, fleet_file)
        calibration, layout = calibration or unit.calibration_path, layout or unit.layout_path
        if calibration is None or layout is None:
            raise ConfigError(
                f"{fleet_path(fleet_file)}: unit '{unit.name}' has no "
                f"{'calibration' if calibration is None else 'layout'}"
            )
        camera = camera or unit.camera
        if camera == unit.camera:
            sensor = choose_camera_sensor(run, unit, **feels)
    settings = msgspec.structs.replace(
        settings or ProcessSettings(), camera=camera or "static", camera_sensor=sensor
    )
    return RunJob(run, calibration, layout, settings, output=output, truth=truth)


def _unit_of(run: Path, fleet_file: Path | None) -> UnitConfig:
    unit = read_manifest(run / MANIFEST_NAME).unit
    path = fleet_path(fleet_file)
    if fleet_file is None and not path.exists():
        raise ConfigError(
            f"give --calibration and --layout, or a fleet file that names them for unit '{unit}'"
        )
    return load_fleet(path).select([unit])[0]
