"""The command line ``bricktrack``."""

import gc
import os
import sys

# Threads of OpenBLAS cost more than they give for the small matrices of poses and filters, and slow them many
# times over on a machine with other work. NumPy reads this once, when it is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Modules that are loaded make hundreds of thousands of objects, all to stay: looking for garbage among them
# after every 700, as Python does unasked, takes 0.2 s of a run's processing. After every 10,000: 0.08 s, and
# no more memory.
gc.set_threshold(10_000)

try:
    from bricktrack_host.cli.main import app, main
except KeyboardInterrupt:  # Ctrl-C while this loads
    sys.exit(130)

__all__ = ["app", "main"]
