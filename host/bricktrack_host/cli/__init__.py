"""The command line ``bricktrack``."""

from bricktrack_host.cli.main import app, main

__all__ = ["app", "main"]
