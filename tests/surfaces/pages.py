"""A topology's page in a headless Chromium: served, opened, and its sliders moved.

Takes: a topology. Gives: `CHROMIUM`, `served`, `launched`, `Tab`; `MODEL`, `VERDICT`.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))),
    None,
)
MODEL = "Bokeh.documents[0].get_model_by_name"
READY = "document.documentElement.dataset.ready == 'yes'"
VERDICT = f"{MODEL}('verdict').text"


@contextmanager
def served(path: Path, *words: str) -> Iterator[str]:
    """Serve a topology and give its link; at the end Ctrl-C ends it, and it has nothing to complain of."""
    command = [sys.executable, "-m", "apc", "explore", str(path), "--no-browser", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=180)
        assert (process.returncode, err) == (0, "starting ...\nended\n"), (
            f"it ended with {process.returncode}: {err}"
        )
    finally:
        process.kill()
        process.wait()


@contextmanager
def launched() -> Iterator[Any]:
    """Start a browser; Playwright's Python package must be installed, and Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        root = hasattr(os, "geteuid") and os.geteuid() == 0  # whom Chromium's sandbox does not serve
        found = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"] if root else [])
        yield found
        found.close()


class Tab:
    """A page in the browser, and what it complained of and asked for."""

    def __init__(self, browser: Any, link: str) -> None:
        self.page = browser.new_page(viewport={"width": 1280, "height": 900})
        self.page.set_default_timeout(60_000)
        self.errors: list[str] = []
        self.hosts: set[str] = set()
        self.page.on("console", lambda one: self.errors.append(one.text) if one.type == "error" else None)
        self.page.on("pageerror", lambda one: self.errors.append(str(one)))
        self.page.on("request", lambda one: self.hosts.add(urlsplit(one.url).netloc))
        self.page.on("websocket", lambda one: self.hosts.add(urlsplit(one.url).netloc))
        self.page.goto(link)
        self.page.wait_for_function(READY)
        self.page.wait_for_function(f"!{VERDICT}.includes('Computing')")

    def press(self, label: str, key: str, times: int) -> str:
        """Press a key on a slider; return what the slider says then."""
        handle = self.page.get_by_role("slider", name=label, exact=True)
        for _ in range(times):
            handle.press(key)
        return str(handle.get_attribute("aria-valuetext"))

    def radius(self, expected: float) -> None:
        """Wait until the verdict has a spectral radius."""
        self.page.wait_for_function(f"{VERDICT}.includes('spectral radius {expected:.9g} ')")

    def check(self, link: str) -> None:
        """Check that nothing went wrong so far, and nobody else was asked for anything."""
        assert self.errors == []
        assert self.hosts == {urlsplit(link).netloc}

    def close(self, link: str) -> None:
        """Check it, and close it."""
        self.check(link)
        self.page.close()
