"""Makes the fakes importable, also in the processes that the samplers spawn (they inherit the path)."""

import sys
from pathlib import Path

_HELPERS = str(Path(__file__).parent / "helpers")
if _HELPERS not in sys.path:
    sys.path.insert(0, _HELPERS)
