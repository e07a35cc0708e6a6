"""For all tests: small matrices are not spread over threads, which slows them many times on a busy machine."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy reads it once, when it is loaded
