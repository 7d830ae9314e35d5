"""A real browser for tests of pages: headless chromium, without any network."""

import shutil
import subprocess
from pathlib import Path

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle",
    "--use-angle=swiftshader", "--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=4000",
    "--hide-scrollbars",
)  # fmt: skip


def chromium() -> str:
    """Its path; the test is skipped without it."""
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("chromium is not installed: apt-get install chromium")
    return found


def open_page(page: Path, *flags: str, link: str = "") -> str:
    """Open a page at a place in it; returns what the browser prints."""
    command = [
        chromium(),
        *_FLAGS,
        f"--user-data-dir={page.parent / 'profile'}",
        *flags,
        f"{page.as_uri()}{link}",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=90)
    return done.stdout
