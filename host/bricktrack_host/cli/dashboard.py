"""``bricktrack dashboard``: the control page."""

import os
from pathlib import Path
from typing import Annotated

import typer

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import err, out
from bricktrack_host.cli._units import (
    AddressOption,
    FleetOption,
    TimeoutOption,
    UnitOption,
    choose_units,
    fleet_path,
)

PASSWORD_VARIABLE = "BRICKTRACK_DASHBOARD_PASSWORD"


def dashboard(
    host: Annotated[
        str, typer.Option("--host", help="Address to serve; another than this machine's own asks for more.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0 takes a free one.")] = 8383,
    password_file: Annotated[
        Path | None,
        typer.Option(
            "--password-file",
            help=f"File with the page's password. \\[default: ${PASSWORD_VARIABLE}, if set]",
            show_default=False,
        ),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="TLS certificate, PEM.", show_default=False)
    ] = None,
    private_key: Annotated[
        Path | None, typer.Option("--private-key", help="Its private key, PEM.", show_default=False)
    ] = None,
    every: Annotated[
        float, typer.Option("--every", min=0.1, max=60, help="Seconds between two looks at a unit.")
    ] = 0.6,
    fleet: FleetOption = None,
    unit: UnitOption = None,
    address: AddressOption = None,
    timeout: TimeoutOption = 3.0,
) -> None:
    """Serve a page that shows all units, checks and aims them, arms and disarms them, and pulls their runs.

    Only this machine can open it, unless --host says otherwise; then it needs a password and TLS.

    For example:

        bricktrack dashboard

        bricktrack dashboard --fleet lab/fleet.toml --port 9000

        bricktrack dashboard --host 0.0.0.0 --password-file pw --certificate c.pem --private-key k.pem
    """
    try:
        from bricktrack_host.dashboard.server import Site, serve
    except ModuleNotFoundError as e:
        if e.name is None or e.name.partition(".")[0] not in ("nicegui", "fastapi", "uvicorn", "starlette"):
            raise
        raise ConfigError(
            f"the control page needs {e.name}, which is not here. Run: pip install 'bricktrack[dashboard]'"
        ) from e
    site = Site(host, port, _password(password_file), certificate, private_key)
    site.check()
    chosen = choose_units(fleet, unit, address, timeout_s=timeout)
    lab = None if chosen.fleet is None else fleet_path(fleet).resolve().parent

    def ready(url: str) -> None:
        out.print(f"control page: {url}", markup=False, soft_wrap=True)
        err.print("Ctrl-C ends it; the units stay as they are", style="dim")

    serve(
        site, chosen.units, chosen.dialer, fleet=chosen.fleet, lab=lab, every_s=every,
        on_ready=ready,
    )  # fmt: skip


def _password(file: Path | None) -> str:
    if file is None:
        return os.environ.get(PASSWORD_VARIABLE, "")
    try:
        password = file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"--password-file {file}: cannot be read ({e}). Give a text file") from e
    if not password:
        raise ConfigError(f"--password-file {file}: is empty; expected one line with the password")
    return password
