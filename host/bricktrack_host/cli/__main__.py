"""Runs the command line as ``python -m bricktrack_host.cli``."""

from bricktrack_host.cli.main import main

main()
