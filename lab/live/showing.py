"""The twin with a browser: how old pictures are when shown, and what it costs the ingest.

Headless Chromium shows the twin's page, which measures. WebGL is done by the CPU (SwiftShader), at
low priority: a browser is on another machine than the server, and is to take little of its time
here.

Who talks to the server: agents as processes of their own, consumers of the twin as threads.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.live.report import AgeRow, IngestRow
from lab.twin_reader import reading
from rfcore.errors import BackendUnavailable, RfedgeError
from rfcore.extras import needs
from rfcore.field import load_field
from rfcore.wire.twin import TwinPicture
from rfedge.loadtest.drive import drive_prerecorded
from rfedge.loadtest.plan import Load, Mode
from rfedge.loadtest.prerecorded import prerecorded_drive
from rfedge.processes import Service, command_of, service

with needs("loadtest"):
    import psutil
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service as Driver

STOP_S = 20.0


@contextmanager
def agent(name: str, arguments: Sequence[str], work: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``cav-agent`` until the block ends; its log is NAME.log.

    Raises ``RfedgeError`` if it has ended by then, or does not end within 20 s of SIGTERM.
    """
    log_path = work / f"{name}.log"
    with log_path.open("wb") as log:
        command = [*command_of("cav-agent"), *arguments, "--vehicle", name]
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    try:
        yield process
        if process.poll() is not None:
            raise RfedgeError(f"{name} ended early; see {log_path}")
    finally:
        process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise RfedgeError(f"{name} did not end; see {log_path}") from None


class PictureAges:
    """Notes the age of every picture when a consumer has it, in milliseconds."""

    def __init__(self) -> None:
        self.ages_ms: list[float] = []

    def take(self, picture: TwinPicture) -> None:
        """Note the age of a picture."""
        self.ages_ms.append((time.time_ns() - picture.capture_time_ns) / 1e6)


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
class PageMeasurement:
    """Measurements of a page: ages of pictures when shown, and the time of its street's last
    drawing."""

    ages_ms: tuple[float, ...]
    drawing_ms: float


class Page:
    """The twin's page in a browser."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self._driver = driver

    def await_shown(self, cameras: int) -> None:
        """Wait until the splats stay drawn and ``cameras`` cameras are on the wall."""
        end_s = time.monotonic() + LOADED_S
        drawing_s = time.monotonic()
        while (now_s := time.monotonic()) - drawing_s < SETTLED_S:
            if now_s > end_s:
                raise RfedgeError(f"the page did not show {cameras} cameras in {LOADED_S:g} s")
            if not self._driver.execute_script(LOADED, cameras):
                drawing_s = time.monotonic()
            time.sleep(POLL_S)

    def watch(self, seconds: float) -> PageMeasurement:
        """Return the page's figures over the next ``seconds``."""
        take = "const t = window.twin; const a = t.state.ages; t.state.ages = [];"
        self._driver.execute_script(take)
        time.sleep(seconds)
        ages_ms = self._driver.execute_script(take + " return a")
        drawing_ms = self._driver.execute_script("return window.twin.street.drawingMs")
        return PageMeasurement(tuple(map(float, ages_ms)), float(drawing_ms))


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


INGEST_VEHICLES = 4
MOST_CONSUMERS = 64
WARM_UP_S = 5.0


class TwinBed:
    """Field, drive and folder of a measurement."""

    def __init__(self, field: Path, drive: Path, work: Path, hz: float, seconds: float) -> None:
        self.field, self.drive, self.work = field, drive, work
        self.hz, self.seconds = hz, seconds
        work.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def server(self) -> Iterator[Service]:
        """Run a server that refuses no consumer."""
        command = [*command_of("mec-server"), "--fields", str(self.field.parent)]
        command += ["--listen", "127.0.0.1:0", "--max-load", "0"]
        for option in ("--identity-consumers", "--max-consumers"):
            command += [option, str(MOST_CONSUMERS)]
        with service("mec-server", command, self.work) as running:
            yield running

    @contextmanager
    def twin(self, server: str) -> Iterator[str]:
        """Run the page of a server; yield its address."""
        command = [*command_of("rfedge"), "twin", server, "--http", "127.0.0.1:0"]
        command += ["--fields", str(self.work / "fields")]
        with service("twin", command, self.work) as running:
            yield running.address

    @contextmanager
    def vehicles(self, server: str, count: int) -> Iterator[None]:
        """Run agents that drive again and again."""
        arguments = ["--server", server, "--drive", str(self.drive), "--loop"]
        arguments += ["--fields", str(self.field.parent), "--effort", "fast"]
        arguments += ["--rate", str(self.hz)]
        with ExitStack() as stack:
            for number in range(1, count + 1):
                stack.enter_context(agent(f"cav-{number}", arguments, self.work))
            yield


def measure_age(bed: TwinBed, cameras: int) -> AgeRow:
    """Return how old the pictures of ``cameras`` vehicles are when a browser shows them."""
    with (
        bed.server() as server,
        bed.twin(server.address) as url,
        bed.vehicles(server.address, cameras),
        opened(url) as page,
    ):
        page.await_shown(cameras)
        time.sleep(WARM_UP_S)
        seen = page.watch(bed.seconds)
    median_ms, p99_ms = percentiles(seen.ages_ms)
    return AgeRow(
        cameras, bed.hz, bed.seconds, len(seen.ages_ms), median_ms, p99_ms, seen.drawing_ms
    )


def measure_ingest(bed: TwinBed, rounds: int, consumers: int) -> IngestRow:
    """Return the server's latency without and with consumers and a browser, in turn."""
    alone_ms: list[float] = []
    watched_ms: list[float] = []
    with bed.server() as server:
        for _ in range(rounds):
            alone_ms += ingest_latencies_ms(bed, server)
            with (
                bed.twin(server.address) as url,
                opened(url),
                reading(server.address, lambda _: None, consumers),
            ):
                watched_ms += ingest_latencies_ms(bed, server)
    return IngestRow(
        INGEST_VEHICLES,
        bed.hz,
        rounds,
        consumers,
        len(alone_ms),
        len(watched_ms),
        *percentiles(alone_ms),
        *percentiles(watched_ms),
    )


def ingest_latencies_ms(bed: TwinBed, server: Service) -> list[float]:
    """Return how long the server took for each frame of prerecorded vehicles."""
    folder = prerecorded_drive(bed.drive, load_field(bed.field), bed.work / "cache")
    load = Load(Mode.FULL, INGEST_VEHICLES, bed.hz, duration_s=bed.seconds, warm_up_s=WARM_UP_S)
    addresses = [server.address] * load.vehicles
    pids = {"server": server.process.pid}
    measured = drive_prerecorded(load, addresses, pids, bed.work, folder)
    return [ms for vehicle in measured.vehicles for ms in vehicle.latency_ms]


def percentiles(values_ms: Sequence[float]) -> tuple[float | None, float | None]:
    """Return median and 99th percentile; None of nothing."""
    if not values_ms:
        return None, None
    return float(np.percentile(values_ms, 50)), float(np.percentile(values_ms, 99))
