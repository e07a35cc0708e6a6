"""The command line ``bricktrack``."""

import os
import sys

# Threads of OpenBLAS cost more than they give for the small matrices of poses and filters, and slow them many
# times over on a machine with other work. NumPy reads this once, when it is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

try:
    from bricktrack_host.cli.main import app, main
except KeyboardInterrupt:  # Ctrl-C while this loads
    sys.exit(130)

__all__ = ["app", "main"]
