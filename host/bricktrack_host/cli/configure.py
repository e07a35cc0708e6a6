"""``bricktrack configure``: values of the units' configuration, shown and changed from here."""

import tomllib
from typing import Annotated

import typer
from rich.table import Table

from bricktrack_common.errors import ConfigError
from bricktrack_common.wire_messages import Configured, ConfigValue
from bricktrack_host.cli._acknowledged import ask_for, report_answers
from bricktrack_host.cli._console import out, plain
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import (
    AddressOption,
    FleetOption,
    JsonOption,
    TimeoutOption,
    UnitOption,
    choose_units,
)


def configure(
    settings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="KEY=VALUE", help="What to change; without any, show what is.", show_default=False
        ),
    ] = None,
    reset: Annotated[
        list[str] | None,
        typer.Option(
            "--reset",
            help="Go back to what the unit's own file says; may be given again.",
            show_default=False,
        ),
    ] = None,
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Show or change how units are configured; changes survive their restarts.

    A unit takes all values or none, and only while it is idle.

    Values are written as in a TOML file; a word needs no quotes.

    Exits with 1 if a unit did not take them, and says which.

    For example:

        bricktrack configure --unit b2

        bricktrack configure camera.exposure_us=2000 recording.duration_s=20

        bricktrack configure camera.colour_gains=[1.8,1.4] recording.label=frame --unit 'c-*'

        bricktrack configure --reset camera.exposure_us
    """
    values = _values(settings or [], reset or [])
    chosen = choose_units(fleet, unit, address, timeout_s=timeout)
    answers = ask_for(
        chosen, lambda c: c.client.configure(values), doing="configuring" if values else "asking"
    )
    if not values and not as_json:
        for one, answer in zip(chosen.units, answers, strict=True):
            if isinstance(answer, Configured):
                out.print(_table(one.name, answer))
    good = report_answers(
        chosen.units,
        answers,
        done="configured" if values else "asked",
        words=lambda now: _changed_words(now, values),
        details=lambda now: {"values": now.values, "changed": now.changed},
        as_json=as_json,
        quiet=not values,
    )
    if not good:
        raise typer.Exit(EXIT_ERROR)


def _values(settings: list[str], reset: list[str]) -> dict[str, ConfigValue]:
    values: dict[str, ConfigValue] = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals or not key.strip() or not value.strip():
            raise ConfigError(f"{text!r}: expected KEY=VALUE, as camera.exposure_us=2000")
        if key.strip() in values:
            raise ConfigError(f"{key.strip()} is given twice")
        values[key.strip()] = _value(key.strip(), value.strip())
    for key in reset:
        if key in values:
            raise ConfigError(f"{key} is given a value and reset; leave one out")
        values[key] = None
    return values


def _value(key: str, text: str) -> ConfigValue:
    """Return a value as TOML has it; what is none is a word."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    if isinstance(value, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
        return [float(v) for v in value]
    if isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(f"{key}: {text} is no number, word, true, false or list of numbers")


def _table(name: str, answer: Configured) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", title=plain(name), title_justify="left")
    table.add_column("key")
    table.add_column("value")
    table.add_column("")
    for key, value in answer.values.items():
        shown = "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
        table.add_row(plain(key), plain(shown), "changed from here" if key in answer.changed else "")
    return table


def _changed_words(now: Configured, values: dict[str, ConfigValue]) -> str:
    return ", ".join(f"{key} = {now.values.get(key)}" for key in values)
