"""``bricktrack still``: a picture from each unit, for aiming and focus, with the LEDs marked on it."""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bricktrack_common.brick_model import load_brick_model
from bricktrack_common.errors import BricktrackError, StorageError
from bricktrack_common.wire_messages import StillImage
from bricktrack_host.cli._acknowledged import ask_for, error_details
from bricktrack_host.cli._console import err, out, print_json, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import (
    AddressOption,
    ChosenUnits,
    FleetOption,
    JsonOption,
    TimeoutOption,
    UnitOption,
    choose_units,
)
from bricktrack_host.transfer.contact import Contact

# OpenCV takes a while to load, and `--help` needs none of it.
if TYPE_CHECKING:
    from bricktrack_host.aiming import Aim

_SIDES = ("left", "top", "right", "bottom")
_MANY_SATURATED = 0.5


@dataclass(frozen=True, slots=True)
class _Look:
    """One unit's still, measured and saved."""

    image: StillImage
    aim: "Aim"
    marked: Path
    as_it_came: Path


def still(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the pictures.")] = Path("stills"),
    dark: Annotated[
        bool, typer.Option("--dark", help="Leave the LEDs off, where the unit switches them.")
    ] = False,
    watch: Annotated[
        bool,
        typer.Option("--watch", "-w", help="Take one after the other until Ctrl-C, to turn the lens by."),
    ] = False,
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Take a picture with each unit, mark the LEDs that are found, and say how sharp they are.

    Saves NAME.png as the camera saw it and NAME_leds.png with the marks.

    The focus is the width of the LEDs' edges in pixels: the smaller, the sharper.

    Exits with 1 if a picture did not come, or shows another number of LEDs than the layout file has.

    For example:

        bricktrack still --unit b2

        bricktrack still --unit b2 --watch

        bricktrack still --address tcp://10.0.0.21:41733 -o aiming --json
    """
    chosen = choose_units(fleet, unit, address, timeout_s=timeout)
    if watch:
        _watch(chosen, output, dark=dark, as_json=as_json)
        return
    if not _take(chosen, output, dark=dark, as_json=as_json):
        raise typer.Exit(EXIT_ERROR)


def _watch(chosen: ChosenUnits, output: Path, *, dark: bool, as_json: bool) -> None:
    try:
        while True:
            _take(chosen, output, dark=dark, as_json=as_json, indent=False)
            time.sleep(0.2)  # a unit that refuses is not asked without pause
    except KeyboardInterrupt:
        raise typer.Exit from None


def _take(chosen: ChosenUnits, output: Path, *, dark: bool, as_json: bool, indent: bool = True) -> bool:
    """Take, measure, save and report one picture of each unit; tell whether all are as they should be."""
    pictures = ask_for(chosen, lambda c: _fetch(c, lit=not dark), doing="taking pictures of")
    all_good = True
    rows: list[dict[str, object]] = []
    for one, picture in zip(chosen.units, pictures, strict=True):
        row: dict[str, object] = {"name": one.name, "address": one.address}
        try:
            if isinstance(picture, BricktrackError):
                raise picture
            image, data, unit_name = picture
            look = _save(unit_name, image, data, output)
            n_expected = load_brick_model(one.layout_path).n_leds if one.layout_path else None
        except BricktrackError as e:
            say_error(f"{one.name}: {e}")
            rows.append(row | {"ok": False, **error_details(e)})
            all_good = False
            continue
        good = n_expected is None or look.aim.n_found == n_expected
        all_good = all_good and good
        rows.append(row | {"ok": good, "n_leds_expected": n_expected} | _for_scripts(look))
        if not as_json:
            _print(unit_name, look, n_expected)
    if as_json:
        print_json({"ok": all_good, "units": rows}, indent=indent)
    return all_good


def _fetch(contact: Contact, *, lit: bool) -> tuple[StillImage, bytes, str]:
    return *contact.client.still(encoding="png", lit=lit), contact.hello.unit


def _save(name: str, image: StillImage, data: bytes, folder: Path) -> _Look:
    from bricktrack_host.aiming import decode_grey, draw, look_at, save_png

    luma = decode_grey(data, source=name)
    aim = look_at(luma)
    plain_path, marked_path = folder / f"{name}.png", folder / f"{name}_leds.png"
    simulated = ", simulated" if image.simulated else ""
    title = (
        f"{name}: {aim.n_found} LEDs, edges {aim.focus_px:.1f} px, {image.exposure_us / 1000:g} ms{simulated}"
    )
    save_png(marked_path, draw(luma, aim, title=title))
    try:
        plain_path.write_bytes(data)
    except OSError as e:
        raise StorageError(f"{plain_path}: {e.strerror or e}. Choose another folder with -o") from e
    return _Look(image, aim, marked_path, plain_path)


def _print(name: str, look: _Look, n_expected: int | None) -> None:
    aim = look.aim
    count = f"{aim.n_found} LEDs" if n_expected is None else f"{aim.n_found} of {n_expected} LEDs"
    focus = "" if math.isnan(aim.focus_px) else f", edges {aim.focus_px:.1f} px wide (20 to 80 %)"
    out.print(f"{name}: {count}{focus}", markup=False)
    if len(aim.others):
        out.print(
            f"  {len(aim.others)} other lights: reflections, lamps, or LEDs that are covered", markup=False
        )
    if aim.margins_px is not None:
        room = ", ".join(f"{side} {px:.0f}" for side, px in zip(_SIDES, aim.margins_px, strict=True))
        out.print(f"  to the border: {room} px", markup=False)
    n_bright = int((aim.saturated > _MANY_SATURATED).sum())
    if n_bright:
        words = f"  {n_bright} LEDs are at full level: their edges look sharper than they are"
        err.print(words + ". Expose for less, or dim them", style="yellow", markup=False)
    if n_expected is not None and aim.n_found != n_expected:
        say_error(f"{name}: {aim.n_found} LEDs found; the layout has {n_expected} LEDs. See {look.marked}")
    image = look.image
    out.print(
        f"  {image.width_px} x {image.height_px}, {image.mode}, {image.exposure_us / 1000:g} ms, gain "
        f"{image.analogue_gain:.2f}{', simulated' if image.simulated else ''}: {look.marked}",
        markup=False,
        soft_wrap=True,
    )


def _for_scripts(look: _Look) -> dict[str, object]:
    aim, image = look.aim, look.image
    return {
        "n_leds": aim.n_found,
        "n_other_lights": len(aim.others),
        "edge_width_px": None if math.isnan(aim.focus_px) else round(aim.focus_px, 2),
        "leds": [
            {
                "u_px": round(float(aim.leds.uv_px[i, 0]), 2),
                "v_px": round(float(aim.leds.uv_px[i, 1]), 2),
                "edge_width_px": None if math.isnan(width) else round(float(width), 2),
                "saturated": round(float(aim.saturated[i]), 3),
                "flags": int(aim.leds.flags[i]),
            }
            for i, width in enumerate(aim.edge_width_px)
        ],
        "margins_px": None if aim.margins_px is None else dict(zip(_SIDES, aim.margins_px, strict=True)),
        "exposure_us": image.exposure_us,
        "analogue_gain": image.analogue_gain,
        "mode": image.mode,
        "lit": image.lit,
        "simulated": image.simulated,
        "picture": str(look.as_it_came),
        "marked_picture": str(look.marked),
    }
