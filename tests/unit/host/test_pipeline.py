"""What the pipeline loads before pictures are decoded, and that the rest can be loaded by its names."""

import importlib.util
import subprocess
import sys

from bricktrack_host.pipeline import LOADED_MEANWHILE


def test_scipy_and_the_fusion_are_not_loaded_before_pictures_are_decoded():
    code = (
        "import sys, bricktrack_host.pipeline; "
        "print([m for m in ('scipy.special', 'scipy.interpolate', 'bricktrack_host.fusion', 'jinja2') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_is_loaded_meanwhile_is_there():
    assert all(importlib.util.find_spec(name) for name in LOADED_MEANWHILE)
