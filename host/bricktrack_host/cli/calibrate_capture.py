"""``bricktrack calibrate capture``: pictures of a dot target at known depths, checked at once."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bricktrack_common.camera_model import IMX219_1080P, SensorMode
from bricktrack_common.errors import CalibrationError, ConfigError
from bricktrack_common.typed_data import load_toml
from bricktrack_host.cli._console import err, out
from bricktrack_host.cli._units import AddressOption, FleetOption, TimeoutOption, choose_units
from bricktrack_host.transfer.contact import Contact

# With OpenCV and SciPy behind it: not for `--help`.
if TYPE_CHECKING:
    from bricktrack_host.calibration.capture_file import Capture
    from bricktrack_host.calibration.dots.dot_detection import GreyImage
    from bricktrack_host.calibration.dots.picture_check import PictureCheck
    from bricktrack_host.calibration.dots.plane_pictures import PlanePicture

_WHITE_LUMA = 235.0


@dataclass(frozen=True, slots=True)
class _Taken:
    """Pictures of one place of the target, and where they come from."""

    pictures: "list[GreyImage]"
    unit: str | None
    source: str
    mode_name: str | None = None
    white_grey: float = 255.0
    exposure_us: int | None = None
    analogue_gain: float | None = None
    simulated: bool = False


def capture(
    folder: Annotated[Path, typer.Argument(help="Folder of the pictures; made, or added to.")],
    at_mm: Annotated[float, typer.Option("--at-mm", help="Depth of the target's plane, mm.")],
    board: Annotated[
        Path | None,
        typer.Option(help="Target file, as `bricktrack target` wrote it; needed for the first picture."),
    ] = None,
    average: Annotated[int, typer.Option(min=1, max=256, help="Pictures to average, from a unit.")] = 8,
    image: Annotated[
        list[Path] | None,
        typer.Option(help="Take this picture file, not a unit's camera; given again, their mean."),
    ] = None,
    add: Annotated[
        bool,
        typer.Option("--add", help="The target was shifted: keep the pictures of this depth, add this one."),
    ] = False,
    sensor_mode: Annotated[
        Path | None,
        typer.Option(help="TOML file with the sensor mode; by default the IMX219's 1920 x 1080 crop."),
    ] = None,
    origin_near: Annotated[
        tuple[float, float] | None,
        typer.Option(help="A pixel near the origin, for a plain target.", metavar="U V"),
    ] = None,
    origin_dot: Annotated[
        bool, typer.Option(help="That origin is the nearest dot, not the target's centre.")
    ] = False,
    unit: Annotated[
        str | None, typer.Option("--unit", "-u", help="The unit of the fleet; with --image its name only.")
    ] = None,
    fleet: FleetOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 5.0,
) -> None:
    """Take a picture of a dot target, average it, and say at once whether it is good enough.

    Run it once for each depth; `calibrate fit --captured FOLDER` does the rest. Beside each picture a
    ..._seen.png shows the dots that were found. A picture of the same depth takes the place of the last one.

    For example:

        bricktrack calibrate capture pictures-b1 --unit b1 --board target.toml --at-mm 101.117

        bricktrack calibrate capture pictures-b1 --unit b1 --at-mm 161.111

        bricktrack calibrate capture pictures-b1 --unit b1 --at-mm 161.111 --add

        bricktrack calibrate capture old --unit b1 --board target.toml --at-mm 101.117 --image near.png
    """
    from bricktrack_host.calibration.capture_file import CapturedPicture, save_capture
    from bricktrack_host.calibration.dots.averaging import mean_picture
    from bricktrack_host.calibration.dots.picture_check import check_picture

    if not 0 < at_mm < 1e5:
        raise ConfigError(f"--at-mm {at_mm:g}: expected the depth of the target's plane in mm, over 0")
    if image and (fleet is not None or address):
        raise ConfigError("--image given together with a unit's address or fleet; give one of them")
    before = _begun(folder, board)
    taken = (
        _from_files(image, unit) if image else _from_unit(fleet, unit, address, n=average, timeout_s=timeout)
    )
    mode = _mode(taken, before, sensor_mode)
    session = _session(before, board, taken, mode, origin_near=origin_near, origin_dot=origin_dot)
    mean = mean_picture(taken.pictures)
    n_kept = sum(p.z_mm == at_mm for p in session.picture) if add else 0
    name = f"z{at_mm:g}mm" + (f"_{n_kept + 1}" if n_kept else "") + ".png"
    # Refused pictures do not take the place of good ones.
    path = _save(folder, f"refused_{name}", mean)
    found = _observe(path, at_mm, session)
    check = check_picture(found, white_grey=taken.white_grey)
    moved = _moved_px(taken.pictures, session)
    path = path.rename(folder / name)
    seen = _save_seen(folder / f"{path.stem}_seen.png", mean, found)
    new = CapturedPicture(
        z_mm=at_mm,
        file=name,
        sha256=found.sha256,
        n_averaged=len(taken.pictures),
        taken_utc=datetime.now(UTC),
        white_grey=taken.white_grey,
        exposure_us=taken.exposure_us,
        analogue_gain=taken.analogue_gain,
        source=taken.source,
    )
    session = session.with_picture(new, beside=add)
    save_capture(folder, session)
    _report(check, moved, session, at_mm=at_mm, path=path, seen=seen)


def _begun(folder: Path, board: Path | None) -> "Capture | None":
    """Return what the folder holds already; refuse another target than its own."""
    from bricktrack_host.calibration.capture_file import CAPTURE_FILE, load_capture
    from bricktrack_host.calibration.target.printed_target import load_target

    if not (folder / CAPTURE_FILE).exists():
        if board is None:
            raise ConfigError(
                f"{folder}: no pictures yet; say with --board which target it is, as `bricktrack target` "
                "wrote it"
            )
        return None
    before = load_capture(folder)
    if board is not None and load_target(board) != before.target:
        raise ConfigError(f"{board}: another target than that of {folder / CAPTURE_FILE}; take a new folder")
    return before


def _from_files(files: list[Path], unit: str | None) -> _Taken:
    from bricktrack_host.calibration.dots.plane_pictures import read_grey

    return _Taken([read_grey(f)[0] for f in files], unit, ", ".join(f.name for f in files))


def _from_unit(
    fleet: Path | None, unit: str | None, address: list[str] | None, *, n: int, timeout_s: float
) -> _Taken:
    """Take stills, the LEDs dark, one after the other."""
    from bricktrack_host.cli._progress import counting_bar

    chosen = choose_units(fleet, [unit] if unit else None, address, timeout_s=timeout_s)
    if len(chosen.units) != 1:
        raise ConfigError(f"{len(chosen.units)} units chosen; a target is before one camera: name it with -u")
    with chosen.dialer.reach(chosen.units[0]) as contact, counting_bar("pictures", n) as progress:
        return _stills(contact, n, progress)


def _stills(contact: Contact, n: int, progress: Callable[[int, int], None]) -> _Taken:
    from bricktrack_host.aiming import decode_grey

    pictures: list[GreyImage] = []
    for i in range(n):
        image, data = contact.client.still(encoding="png", lit=False)
        pictures.append(decode_grey(data, source=contact.hello.unit))
        progress(i + 1, n)
    return _Taken(
        pictures,
        contact.hello.unit,
        image.model,
        mode_name=image.mode,
        white_grey=_WHITE_LUMA,
        exposure_us=image.exposure_us,
        analogue_gain=image.analogue_gain,
        simulated=image.simulated,
    )


def _mode(taken: _Taken, before: "Capture | None", sensor_mode: Path | None) -> SensorMode:
    """Return the sensor mode of the pictures: as given, as before, or the IMX219's crop."""
    height, width = taken.pictures[0].shape
    mode = before.sensor_mode if before else IMX219_1080P
    if sensor_mode is not None:
        given = load_toml(sensor_mode, SensorMode)
        if before and not given.matches(mode):
            raise ConfigError(
                f"{sensor_mode}: another mode than that of the pictures taken; take a new folder"
            )
        mode = given
    if (mode.width, mode.height) != (width, height) or taken.mode_name not in (None, mode.name):
        called = f" in mode {taken.mode_name!r}" if taken.mode_name else ""
        raise ConfigError(
            f"pictures of {width} x {height} px{called}; mode {mode.name!r} delivers {mode.width} x "
            f"{mode.height}. Describe the mode in a file and give it with --sensor-mode"
        )
    return mode


def _session(
    before: "Capture | None",
    board: Path | None,
    taken: _Taken,
    mode: SensorMode,
    *,
    origin_near: tuple[float, float] | None,
    origin_dot: bool,
) -> "Capture":
    """Return the folder's record without the new picture."""
    import msgspec

    from bricktrack_host.calibration.capture_file import Capture
    from bricktrack_host.calibration.target.printed_target import load_target

    if before is not None:
        if taken.unit not in (None, before.unit):
            raise ConfigError(
                f"the pictures are of unit {taken.unit!r}, those taken before of {before.unit!r}; "
                "take a new folder"
            )
        if taken.simulated != before.simulated:
            raise ConfigError("simulated pictures and real ones do not mix; take a new folder")
        session = before
    elif taken.unit is None or board is None:
        raise ConfigError("--unit not given; a calibration belongs to one brick unit's camera")
    else:
        session = Capture(
            unit=taken.unit,
            target=load_target(board),
            sensor_mode=mode,
            picture=(),
            simulated=taken.simulated,
        )
    if origin_near is None:
        return session
    return msgspec.structs.replace(
        session, origin_near_px=origin_near, origin_at="dot" if origin_dot else "centre"
    )


def _observe(path: Path, z_mm: float, session: "Capture") -> "PlanePicture":
    from bricktrack_host.calibration.dots.plane_pictures import observe_pictures
    from bricktrack_host.cli._calibration_inputs import origin_of

    return observe_pictures(
        [(z_mm, path)], session.target, origin=origin_of(session), mode=session.sensor_mode
    )[0]


def _moved_px(pictures: "list[GreyImage]", session: "Capture") -> float:
    """Return by how much the target moved from the first picture to the last."""
    from bricktrack_host.calibration.dots.averaging import shift_between_px
    from bricktrack_host.calibration.dots.plane_pictures import place_dots
    from bricktrack_host.cli._calibration_inputs import origin_of

    if len(pictures) < 2:
        return 0.0
    first, last = (
        place_dots(p, session.target, origin=origin_of(session))[1] for p in pictures[:: len(pictures) - 1]
    )
    return shift_between_px(first, last)


def _save(folder: Path, name: str, picture: "GreyImage") -> Path:
    import cv2

    path = folder / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    except OSError as e:
        raise CalibrationError(f"{path}: {e.strerror or e}") from e
    return path


def _save_seen(path: Path, picture: "GreyImage", found: "PlanePicture") -> Path:
    import cv2

    from bricktrack_host.calibration.dots.picture_check import drawn_over

    try:
        path.write_bytes(cv2.imencode(".png", drawn_over(picture, found))[1].tobytes())
    except OSError as e:
        raise CalibrationError(f"{path}: {e.strerror or e}") from e
    return path


def _report(
    check: "PictureCheck", moved_px: float, session: "Capture", *, at_mm: float, path: Path, seen: Path
) -> None:
    from rich.table import Table

    from bricktrack_host.calibration.dots.averaging import MAX_SHIFT_PX

    simulated = " (simulated)" if session.simulated else ""
    table = Table(title=f"Target at {at_mm:g} mm, unit {session.unit}{simulated}", show_header=False)
    for row in (
        ("dots with a place on the target", f"{check.n_placed} of {check.n_dots} found"),
        ("picture among the dots", f"{100 * check.covered:.0f} %"),
        ("blur of the rims", f"{check.blur_px:.1f} px, dots {2 * check.radius_px:.0f} px across"),
        (
            "light of the dots",
            f"{100 * check.light:.0f} % of full, {100 * check.contrast:.0f} % over the background",
        ),
        ("tilt", f"{check.pose.tilt_deg:.2f} ± {check.pose.tilt_sd_deg:.2f} degrees"),
        ("turn", f"{check.pose.turn_deg:.1f} degrees"),
    ):
        table.add_row(*row)
    out.print(table)
    words = list(check.warnings)
    if moved_px > MAX_SHIFT_PX:
        words.append(
            f"the target or the camera moved by {moved_px:.2f} px while the pictures were taken; again"
        )
    for word in words:
        err.print(f"Warning: {word}.", style="yellow", markup=False, soft_wrap=True)
    if not words:
        out.print("Good to calibrate from.", style="green")
    out.print(f"{path}; what was found: {seen}", markup=False, soft_wrap=True)
    depths = ", ".join(f"{p.z_mm:g} mm" for p in session.picture)
    n_depths = len({p.z_mm for p in session.picture})
    left = "a second depth is wanted" if n_depths < 2 else "`bricktrack calibrate fit --captured` can begin"
    out.print(f"Pictures so far: {depths}; {left}.", markup=False, soft_wrap=True)
