"""The page in a real browser: a server, two vehicles, headless Chromium (software WebGL)."""

import asyncio
import base64
import shutil
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service as Driver
from selenium.webdriver.common.keys import Keys

from rfcore.dataset import read_dataset
from rfcore.field import FieldMetadata, SplatField, load_field, save_field
from rfcore.field.importance import most_important_first, reordered, visible_area
from rfcore.image import rgb_from_bytes
from rfcore.metrics import ssim
from rfcore.vertical import Sight
from rfcore.wire.address import Address
from rfcore.wire.tiles import LearntLight, Tile, TileLight
from rfedge.processes import command_of, service
from rfedge.samples import sample_path
from rfedge.twin.comparing import Comparer
from rfedge.twin.scene import Board, PlacedField, TwinScene
from rfedge.twin.server_source import tile_rows
from rfedge.twin.web import TwinWeb, WebSettings
from wall_scene import seen, wall_field

pytestmark = [pytest.mark.slow, pytest.mark.sample]

FIELDS = sample_path("fields")
DRIVE = sample_path("street/transforms_drive_empty.json")
WITH_VEHICLES = sample_path("street/transforms_drive_vehicles.json")
SPLATS = 8_000
LOADED_S = 120.0
"""Software WebGL on a busy machine: the sample's splats take 10 s on an idle one."""
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--window-size=640,480",
)


@contextmanager
def browser() -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    options.page_load_strategy = "none"
    options.binary_location = program("chromium")
    for option in OPTIONS:
        options.add_argument(option)
    driver = webdriver.Chrome(service=Driver(program("chromedriver")), options=options)
    driver.set_script_timeout(120)
    try:
        yield driver
    finally:
        driver.quit()


def program(name: str) -> str:
    found = shutil.which(name)
    assert found is not None, f"{name} is missing; make test-system-packages installs it"
    return found


def until(
    holds: Callable[[], Any],
    timeout_s: float = 60.0,
    instead: Callable[[], str] = lambda: "did not come in time",
) -> Any:
    """Return the first true value; ``instead`` tells what there is when none came in time."""
    deadline_s = time.monotonic() + timeout_s
    while not (value := holds()):
        assert time.monotonic() < deadline_s, instead()
        time.sleep(0.1)
    return value


def few_splats(folder: Path) -> Path:
    """Return a folder with the sample's splats that are seen most: software WebGL takes seconds to
    draw all of them."""
    field = load_field(FIELDS / "street.rff")
    assert isinstance(field, SplatField)
    order = most_important_first(visible_area(field.gaussians))[:SPLATS]
    fields = folder / "few"
    fields.mkdir()
    few = SplatField(reordered(field.gaussians, order), field.metadata)
    save_field(few, fields / "street.rff")
    return fields


@contextmanager
def vehicle(
    name: str, address: str, folder: Path, drive: Path = DRIVE, fields: Path = FIELDS
) -> Iterator[None]:
    """An agent that drives the sample again and again at 2 Hz."""
    command = [*command_of("cav-agent"), "--server", address, "--vehicle", name, "--loop"]
    command += ["--drive", str(drive), "--fields", str(fields), "--rate", "2"]
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            yield
        finally:
            process.terminate()
            process.wait(20)


@contextmanager
def server(folder: Path, listen: str, fields: Path = FIELDS) -> Iterator[str]:
    command = [*command_of("mec-server"), "--fields", str(fields)]
    with service("mec-server", [*command, "--listen", listen], folder) as running:
        yield running.address


def sequences(page: webdriver.Chrome) -> dict[str, int]:
    script = (
        "return [...document.querySelectorAll('#wall figure')].map("
        "f => [f.dataset.camera, Number(f.querySelector('canvas').dataset.sequence)])"
    )
    return dict(page.execute_script(script))


@pytest.mark.timeout(600)
def test_two_vehicles_are_seen_and_seen_again_after_the_server_restarts(tmp_path: Path) -> None:
    fields = few_splats(tmp_path)
    with ExitStack() as stack:
        first = stack.enter_context(ExitStack())
        address = first.enter_context(server(tmp_path, "127.0.0.1:0", fields))
        twin = [*command_of("rfedge"), "twin", address, "--http", "127.0.0.1:0"]
        twin += ["--fields", str(tmp_path / "fields")]
        page_address = stack.enter_context(service("twin", twin, tmp_path)).address
        for name in ("cav-1", "cav-2"):
            stack.enter_context(vehicle(name, address, tmp_path, fields=fields))
        page = stack.enter_context(browser())
        page.get(page_address)

        until(lambda: page.execute_script("return !!window.twin?.street.loaded()"), LOADED_S)
        seen = until(lambda: len(found := sequences(page)) == 2 and found)
        assert seen.keys() == {"cav-1/front", "cav-2/front"}
        until(lambda: all(sequences(page)[name] > number for name, number in seen.items()))
        assert splats_look_like_the_field(page, fields / "street.rff") >= 0.7

        wall_and_slider_work(page)
        first.close()
        until(lambda: state(page) == "waiting")
        stack.enter_context(server(tmp_path, address, fields))
        until(lambda: state(page) == "connected")
        until(lambda: len(sequences(page)) == 2)


@pytest.mark.timeout(600)
def test_the_street_is_seen_from_anywhere_with_what_vehicles_see(tmp_path: Path) -> None:
    with ExitStack() as stack:
        address = stack.enter_context(server(tmp_path, "127.0.0.1:0"))
        twin = [*command_of("rfedge"), "twin", address, "--http", "127.0.0.1:0"]
        twin += ["--fields", str(tmp_path / "fields")]
        page_address = stack.enter_context(service("twin", twin, tmp_path)).address
        stack.enter_context(vehicle("cav-1", address, tmp_path, WITH_VEHICLES))
        page = stack.enter_context(browser())
        page.get(page_address)
        until(lambda: page.execute_script("return !!window.twin?.street.loaded()"), LOADED_S)
        page.execute_script(
            "window.twin.street.renderer.setAnimationLoop(null)"
        )  # takes seconds each, in which messages wait
        until(lambda: sequences(page))
        until(
            lambda: page.execute_script("return document.getElementById('things').innerText"),
            instead=lambda: told(page, tmp_path),
        )  # objects, or that none was seen in the last second: a busy machine finds few

        page.execute_script(LOOK_FROM_CAMERA)
        page.execute_script("document.getElementById('look').click()")
        until(
            lambda: "cav-1/front" in live_text(page) and "live" in live_text(page),
            LOADED_S,
            instead=lambda: told(page, tmp_path),
        )
        plain = page.execute_script(DRAWN)
        page.execute_script("document.getElementById('live-freshness').click()")
        until(lambda: page.execute_script(DRAWN) != plain)
        assert page.execute_script("return document.getElementById('live-legend').offsetHeight") > 0

        page.execute_script("window.twin.street.view.position.set(0, 0, 500)")
        until(lambda: "more than 5 m outside of the field" in live_text(page))
        escape = "document.dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))"
        page.execute_script(escape)
        assert page.execute_script("return document.getElementById('live').hidden")
        page.execute_script("document.getElementById('objects').click()")
        until(lambda: page.execute_script("return document.getElementById('things').hidden"))


LOOK_FROM_CAMERA = (
    "const {view, cameras} = window.twin.street, {group} = cameras.get('cav-1/front');"
    "view.position.copy(group.position); view.quaternion.copy(group.quaternion)"
)
DRAWN = "return document.getElementById('live-canvas').toDataURL()"


def live_text(page: webdriver.Chrome) -> str:
    return str(page.execute_script("return document.getElementById('live-state').textContent"))


def told(page: webdriver.Chrome, folder: Path) -> str:
    """Return what the page says of the view, its pictures, and the last words of all programs."""
    logs = [f"{log.name}: {log.read_text()[-1500:]}" for log in folder.glob("*.log")]
    return "\n".join([live_text(page), str(sequences(page)), state(page), *logs])


def state(page: webdriver.Chrome) -> str:
    script = "return document.getElementById('connection').dataset.state"
    return str(page.execute_script(script))


def splats_look_like_the_field(page: webdriver.Chrome, archive: Path) -> float:
    """Return the SSIM of what the page draws and our own render, from the drive's first camera."""
    camera = read_dataset(DRIVE).pictures[0].camera
    k, pose = camera.intrinsics, camera.world_from_cam
    page.execute_script(
        "window.twin.street.fix({translation_m: arguments[0], rotation_wxyz: arguments[1],"
        "intrinsics: arguments[2]})",
        pose.translation_m,
        pose.rotation,
        {"width_px": k.width_px, "height_px": k.height_px, "fx_px": k.fx_px, "fy_px": k.fy_px},
    )
    field = load_field(archive)
    own = (field.render_colour(camera).clip(0, 1) * 255).round().astype("uint8")

    def similarity() -> float:
        url = page.execute_script("return window.twin.street.png()")
        drawn = rgb_from_bytes(base64.b64decode(url.partition(",")[2]), "page")
        return ssim(drawn, own) if drawn.shape == own.shape else 0.0

    best = 0.0
    deadline_s = time.monotonic() + 60
    while best < 0.7 and time.monotonic() < deadline_s:  # splats are sorted beside the drawing
        best = max(best, similarity())
        time.sleep(0.2)
    page.execute_script("window.twin.street.fix(null)")
    return best


def wall_and_slider_work(page: webdriver.Chrome) -> None:
    """Open a camera from the wall; both ends of the slider show different pictures."""
    page.execute_script("document.querySelector('#wall figure').click()")
    quality = "return document.getElementById('inspect-quality').textContent"
    until(lambda: "dB" in page.execute_script(quality))
    show = (
        "const s = document.getElementById('inspect-slider'); s.value = arguments[0]; s.oninput();"
        "return document.getElementById('inspect-canvas').toDataURL()"
    )
    page.execute_script("document.querySelector('input[value=difference]').click()")
    reconstruction, difference = (page.execute_script(show, value) for value in (1, 0))
    assert reconstruction != difference
    page.execute_script("document.getElementById('inspect-close').click()")


async def test_the_table_of_tiles_opens_by_keyboard() -> None:
    dusk = TileLight("h18", "b" * 64, 2, passes=2, time_of_day_h=18.5)
    learnt = LearntLight("west", "h18", "b" * 64, 2, 1_767_290_400_000, 0.53)
    board = Board()
    scene = TwinScene(board)
    scene.show_tiles(tile_rows([Tile("west", "a" * 64, lights=(dusk,))], [learnt]), 0.0)
    async with served(board, scene) as address:
        with browser() as page:
            await asyncio.to_thread(opens_by_keyboard, page, address)


@asynccontextmanager
async def served(board: Board, scene: TwinScene) -> AsyncIterator[str]:
    """Serve the page of a scene without a server; yield its address."""
    settings = WebSettings(Address("127.0.0.1", 0))
    web = TwinWeb(settings, board, scene, Comparer(scene, Mock(Executor)))
    try:
        yield await web.start()
    finally:
        await web.stop()


def opens_by_keyboard(page: webdriver.Chrome, address: str) -> None:
    """Reach the table with Tab alone, open it with Enter, and read its rows."""
    page.get(address)
    rows = "return [...document.querySelectorAll('#tiles tbody tr')].map((row) => row.innerText)"
    until(lambda: page.execute_script("return document.querySelectorAll('#tiles tr').length") == 3)
    is_reached = "return document.activeElement.parentElement?.id === 'tiles'"
    for _ in range(40):
        webdriver.ActionChains(page).send_keys(Keys.TAB).perform()
        if page.execute_script(is_reached):
            break
    assert page.execute_script(is_reached)
    assert page.execute_script("return document.getElementById('tiles').open") is False
    webdriver.ActionChains(page).send_keys(Keys.ENTER).perform()
    until(lambda: page.execute_script("return document.getElementById('tiles').open"))
    own, at_dusk = (row.split("\t") for row in page.execute_script(rows))
    assert own[:3] == ["west", "own", "1"]
    assert at_dusk[:4] == ["west", "h18, 18:30 UTC", "2", "2"]
    assert at_dusk[5] == "53 %"


async def test_the_page_starts_upright_at_a_training_camera_and_follows_without_a_click() -> None:
    """In a world with y down, as the cameras of ``wall_scene`` have it."""
    sight = Sight((1.0, 0.5, -2.0), (0.0, 0.0, 1.0))
    field = wall_field(0.5).described(FieldMetadata(up=(0.0, -1.0, 0.0), sights=(sight,)))
    board = Board()
    scene = TwinScene(board)
    scene.place(PlacedField.of(field, "wall"), 0.0)
    async with served(board, scene) as address:
        with browser() as page:
            await asyncio.to_thread(starts_upright, page, address, sight)
            scene.show(seen(field), 0.0)
            await asyncio.to_thread(follows_the_only_camera, page)
            for camera in ("left", "right"):
                scene.show(seen(field, key=("cav-1", camera)), 0.0)
            await asyncio.to_thread(until, lambda: len(sequences(page)) == 3)
            scene.leave(("cav-1", "front"), 0.0)
            await asyncio.to_thread(asks_which_camera_to_follow, page)


PLACE = "return window.twin?.street.loaded() && window.twin.street.view.position.toArray()"
UPWARD = (
    "const {view} = window.twin.street; return view.up.clone().set(0, 1, 0)"
    ".applyQuaternion(view.quaternion).toArray()"
)


def starts_upright(page: webdriver.Chrome, address: str, sight: Sight) -> None:
    page.get(address)
    assert until(lambda: page.execute_script(PLACE), LOADED_S) == pytest.approx(sight.eye_m)
    assert page.execute_script(UPWARD) == pytest.approx((0.0, -1.0, 0.0), abs=1e-6)


def follows_the_only_camera(page: webdriver.Chrome) -> None:
    selected = "return document.querySelector('#wall figure.selected')?.dataset.camera"
    assert until(lambda: page.execute_script(selected)) == "cav-1/front"
    page.execute_script("document.getElementById('follow').click()")
    until(lambda: page.execute_script(PLACE) == pytest.approx((0.0, 0.0, 0.0)))
    assert page.execute_script("return document.getElementById('whom').offsetHeight") == 0


def asks_which_camera_to_follow(page: webdriver.Chrome) -> None:
    """The one that was followed is gone, and two others are there."""
    until(lambda: sequences(page).keys() == {"cav-1/left", "cav-1/right"})
    until(lambda: page.execute_script("return document.getElementById('whom').offsetHeight"))
    page.execute_script("document.querySelector('#wall figure').click()")
    until(lambda: not page.execute_script("return document.getElementById('whom').offsetHeight"))
    page.execute_script("document.getElementById('overview').click()")
    assert not page.execute_script("return document.getElementById('follow').checked")
