"""Headless Chromium on the twin's page, and what the page has measured.

WebGL is done by the CPU (SwiftShader), at low priority: a browser is on another machine than
the server, and is to take little of its time here.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rfcore.errors import BackendUnavailable, RfedgeError
from rfcore.extras import needs

with needs("loadtest"):
    import psutil
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service as Driver

__all__ = ["Page", "Seen", "opened"]

OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--window-size=1100,700",
)
LOW_PRIORITY = 10
"""A tenth of the time of what competes with it: at 19 it starves on a busy machine."""
LOADED_S = 300.0
POLL_S = 0.2
SETTLED_S = 15.0
"""Splats are sorted before they are drawn, and once more with fewer pixels if that took long."""
LOADED = (
    "return !!window.twin?.street.settled()"
    " && document.querySelectorAll('#wall figure').length >= arguments[0]"
)


@dataclass(frozen=True)
class Seen:
    """What a page showed: ages of pictures at their showing, and its street's last drawing."""

    ages_ms: tuple[float, ...]
    drawing_ms: float


class Page:
    """The twin's page in a browser."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self._driver = driver

    def await_shown(self, cameras: int) -> None:
        """Wait until the splats are drawn, and stay so, and so many cameras are on the wall."""
        end_s = time.monotonic() + LOADED_S
        drawing_s = time.monotonic()
        while (now_s := time.monotonic()) - drawing_s < SETTLED_S:
            if now_s > end_s:
                raise RfedgeError(f"the page did not show {cameras} cameras in {LOADED_S:g} s")
            if not self._driver.execute_script(LOADED, cameras):
                drawing_s = time.monotonic()
            time.sleep(POLL_S)

    def watch(self, seconds: float) -> Seen:
        """Return what is seen in the next ``seconds``."""
        take = "const t = window.twin; const a = t.state.ages; t.state.ages = [];"
        self._driver.execute_script(take)
        time.sleep(seconds)
        ages_ms = self._driver.execute_script(take + " return a")
        drawing_ms = self._driver.execute_script("return window.twin.street.drawingMs")
        return Seen(tuple(map(float, ages_ms)), float(drawing_ms))


@contextmanager
def opened(url: str) -> Iterator[Page]:
    """Open ``url`` until the block ends; raise ``BackendUnavailable`` without Chromium."""
    options = webdriver.ChromeOptions()
    options.page_load_strategy = "none"
    options.binary_location = _program("chromium")
    for option in OPTIONS:
        options.add_argument(option)
    driver = webdriver.Chrome(service=Driver(_program("chromedriver")), options=options)
    driver.set_script_timeout(LOADED_S)
    assert not isinstance(driver.command_executor, str)  # that is what was passed, here nothing
    driver.command_executor.client_config.timeout = int(LOADED_S)
    try:
        _lower(driver.service.process.pid)
        driver.get(url)
        yield Page(driver)
    finally:
        driver.quit()


def _program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        raise BackendUnavailable(f"{name} is missing; `make test-system-packages` installs it")
    return found


def _lower(pid: int) -> None:
    """Give low priority to a process and to those it has started, threads and all."""
    tree = psutil.Process(pid)
    for process in (tree, *tree.children(recursive=True)):
        for thread in process.threads():
            os.setpriority(os.PRIO_PROCESS, thread.id, LOW_PRIORITY)
