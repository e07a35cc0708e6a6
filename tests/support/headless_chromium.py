"""The Chromium of this machine, without a window; tests that need it skip where there is none."""

import contextlib
import os
import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Error, sync_playwright

_CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

needs_chromium = pytest.mark.skipif(
    _CHROMIUM is None, reason="no Chromium here (Debian: apt install chromium)"
)


@contextlib.contextmanager
def headless_chromium() -> Iterator[Browser]:
    """Start Chromium, and end it after the block."""
    with sync_playwright() as p:
        as_root = ["--no-sandbox"] if os.geteuid() == 0 else []
        try:
            chromium = p.chromium.launch(executable_path=_CHROMIUM, args=as_root)
        except Error as e:
            pytest.skip(f"{_CHROMIUM} does not start: {e.message.splitlines()[0]}")
        yield chromium
        chromium.close()
