"""Serves the control page until it is told to end."""

import resource
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import uvicorn
import zmq
from fastapi import FastAPI
from fastapi.responses import FileResponse, PlainTextResponse, Response
from nicegui import ui

from bricktrack_common.errors import ConfigError
from bricktrack_host.dashboard.access import Door, check_access
from bricktrack_host.dashboard.fleet_watch import FleetWatch
from bricktrack_host.dashboard.last_test import REPORTS_PATH, served_report
from bricktrack_host.dashboard.orders import OrderDesk
from bricktrack_host.dashboard.page import ControlPage
from bricktrack_host.transfer.contact import Dialer
from bricktrack_host.transfer.fleet_config import Fleet, UnitConfig

_MOST_FILES = 16_384  # a unit takes about two while it is watched, and more while it is connected to


@dataclass(frozen=True, slots=True)
class Site:
    """Where the page is served, and to whom.

    Attributes
    ----------
    port : int
        0 takes a free one.
    password : str
        ``""`` for none, which is allowed on this machine only.
    certificate, private_key : Path or None
        TLS, both or none.
    """

    host: str = "127.0.0.1"
    port: int = 8383
    password: str = ""
    certificate: Path | None = None
    private_key: Path | None = None

    @property
    def has_tls(self) -> bool:
        """Whether the page is encrypted."""
        return self.certificate is not None

    def check(self) -> None:
        """Make sure that this is safe and can be served.

        Raises
        ------
        ConfigError
            If others could reach it without password and TLS, or a file of TLS is missing.
        """
        if (self.certificate is None) != (self.private_key is None):
            raise ConfigError("--certificate and --private-key belong together; give both")
        for option, path in (("--certificate", self.certificate), ("--private-key", self.private_key)):
            if path is not None and not path.is_file():
                raise ConfigError(f"{option} {path}: no such file; expected a PEM file")
        check_access(self.host, password=self.password, has_tls=self.has_tls)


def serve(
    site: Site,
    units: list[UnitConfig],
    dialer: Dialer,
    *,
    fleet: Fleet | None,
    lab: Path | None,
    every_s: float,
    on_ready: Callable[[str], None],
) -> None:
    """Watch the units and serve the page until Ctrl-C.

    Parameters
    ----------
    lab : Path or None
        Folder of the fleet file, with tests and runs; `None` without one.
    on_ready : callable
        Hears the page's address once it can be opened.

    Raises
    ------
    ConfigError
        If the site is not safe, or its port is taken.
    """
    site.check()
    allow_many_connections()
    with FleetWatch(units, dialer, every_s=every_s) as watch:
        desk = OrderDesk(units, dialer, fleet.runs_path if fleet is not None else None)
        app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

        @app.get(REPORTS_PATH + "{path:path}")
        def report(path: str) -> Response:
            file = served_report(lab, path) if lab is not None else None
            if file is None:
                return PlainTextResponse("There is no such report here.\n", status_code=404)
            return FileResponse(file, media_type="text/html")

        def root() -> None:
            ControlPage(units, watch, desk, lab)

        ui.run_with(app, root=root, title="bricktrack", tailwind=False, show_welcome_message=False)
        config = uvicorn.Config(
            Door(app, password=site.password, has_tls=site.has_tls),
            host=site.host,
            port=site.port,
            log_level="warning",
            ssl_certfile=site.certificate,
            ssl_keyfile=site.private_key,
        )
        _Server(config, site, on_ready).run()


class _Server(uvicorn.Server):
    """A server that tells where it is, and what is wrong where it cannot be."""

    def __init__(self, config: uvicorn.Config, site: Site, on_ready: Callable[[str], None]) -> None:
        super().__init__(config)
        self._site, self._on_ready = site, on_ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen; raise `ConfigError` where that cannot be done."""
        try:
            await super().startup(sockets)
        except SystemExit as e:  # how uvicorn says that it cannot bind
            raise ConfigError(
                f"{self._site.host}:{self._site.port}: cannot be served; another program may have the port. "
                "Choose another with --port"
            ) from e
        port = self.servers[0].sockets[0].getsockname()[1]
        host = f"[{self._site.host}]" if ":" in self._site.host else self._site.host
        self._on_ready(f"{'https' if self._site.has_tls else 'http'}://{host}:{port}")


def allow_many_connections() -> None:
    """Let this process hold more than the usual thousand sockets and files: each unit takes some of both.

    Takes effect for the process's own ZeroMQ context as long as that has no socket yet.
    """
    zmq.Context.instance().set(zmq.MAX_SOCKETS, _MOST_FILES)
    if sys.platform == "win32":
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MOST_FILES if hard == resource.RLIM_INFINITY else min(_MOST_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
