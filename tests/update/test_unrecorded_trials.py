"""A trial on a vehicle that is not recorded shows its losses, and keeps no picture."""

import asyncio
from collections.abc import AsyncIterator
from unittest.mock import Mock

import pytest
from structlog.testing import capture_logs

from mec_server.learner import MOST_PAUSE_S, Learner, UnrecordedTrials
from mec_server.tile_history import Learnt, TileHistory, read_histories
from mec_server.tile_learning import CHECK_EVERY, CHECK_FRAMES, BitsIncrease
from mec_server.twin.state import ReceivedPicture
from rfcore.field import SplatField
from rfcore.native.yuv import i420_from_rgb
from rfcore.update.passes import Pass
from rfcore.wire.settings import LogForm
from tests.update.conftest import NOW_MS, K

WAIT_S = 60


def seen(drive: Pass, field_id: str, number: int, at_s: float | None = None) -> ReceivedPicture:
    picture = drive.pictures[number % len(drive.pictures)]
    return ReceivedPicture(
        vehicle_id=drive.identity,
        session_id="s",
        frame=Mock(pose=picture.camera.world_from_cam, camera_id="front"),
        intrinsics=K,
        field_id=field_id,
        picture=i420_from_rgb(picture.read()),
        digest=b"",
        reconstructed_s=0.1 * number if at_s is None else at_s,
        latency_s=0.0,
    )


class Watched:
    """Trials of dusk, learnt in place of noon, and what they report."""

    def __init__(self, noon: SplatField, dusk: SplatField) -> None:
        fields = {noon.field_id: noon, dusk.field_id: dusk}
        self.reports: asyncio.Queue[BitsIncrease] = asyncio.Queue()
        self.failures: list[Exception] = []
        self.learnt = Learnt(dusk.field_id, "h17", noon.field_id, 2, 20.0, NOW_MS)
        self.trials = UnrecordedTrials(
            fields.__getitem__, self.failures.append, self.reports.put_nowait
        )
        self.trials.watch({"west": TileHistory((self.learnt,))})

    async def report(self) -> BitsIncrease:
        async with asyncio.timeout(WAIT_S):
            return await self.reports.get()


@pytest.fixture(autouse=True)
def trials_have_the_usual_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mec_server.learner.work_when_idle", lambda: None)


@pytest.fixture
async def watched(noon: SplatField, dusk: SplatField) -> AsyncIterator[Watched]:
    made = Watched(noon, dusk)
    yield made
    made.trials.close()
    assert made.failures == []


async def test_a_vehicle_that_is_not_recorded_says_how_many_bits_more_it_took(
    watched, noon, dusk, make_pass
):
    for light, low, high in ((noon, 5.0, 1e6), (dusk, -100.0, -5.0)):
        drive = make_pass(light, "c" if light is noon else "d")
        for number in range(CHECK_FRAMES):
            watched.trials.saw(seen(drive, dusk.field_id, number))
        harm = await watched.report()
        assert (harm.tile, harm.field_id, harm.vehicle) == ("west", dusk.field_id, drive.identity)
        assert low < harm.percent < high
        assert watched.trials._taken == []


async def test_its_turn_comes_again_after_so_many_frames(watched, noon, dusk, make_pass):
    drive, other = make_pass(noon, "c"), make_pass(noon, "d")
    for number in range(CHECK_FRAMES):
        watched.trials.saw(seen(drive, dusk.field_id, number))
    await watched.report()
    for number in range(CHECK_FRAMES, CHECK_EVERY - 1):
        watched.trials.saw(seen(drive, dusk.field_id, number))
        assert watched.trials._taken == []
    for number in range(CHECK_EVERY - 1, CHECK_EVERY + 3):
        watched.trials.saw(seen(drive, dusk.field_id, number))
        watched.trials.saw(seen(other, dusk.field_id, number))
    assert [view.vehicle_id for view in watched.trials._taken] == ["c"] * 4
    watched.trials.left("c")
    assert watched.trials._taken == []
    assert not any(key[0] == "c" for key, _ in watched.trials._rested)
    watched.trials.saw(seen(other, dusk.field_id, 28))
    paused_s = 2.8 + MOST_PAUSE_S + 0.1
    watched.trials.saw(seen(drive, dusk.field_id, 29, paused_s))
    assert [view.vehicle_id for view in watched.trials._taken] == ["c"]


async def test_nothing_is_taken_of_other_fields_or_lost_cameras_or_what_was_withdrawn(
    watched, noon, dusk, make_pass
):
    drive = make_pass(noon, "c")
    watched.trials.saw(seen(drive, noon.field_id, 0))
    lost = seen(drive, dusk.field_id, 0)
    lost.frame.pose = None
    watched.trials.saw(lost)
    watched.trials.watch({"west": TileHistory((Learnt("x", "", "y", 1, 9.0, 0, True),))})
    watched.trials.saw(seen(drive, dusk.field_id, 1))
    assert watched.trials._taken == []


@pytest.fixture
def published(street, dusk):
    return street.publish_harm(dusk)


def test_a_reported_harm_withdraws_what_it_names_if_it_is_large(street, published):
    rounds = street.rounds()
    for harm in (
        BitsIncrease("west", published, "c", 2.0),
        BitsIncrease("west", street.noon_id, "c", 50.0),
        BitsIncrease("east", published, "c", 50.0),
    ):
        rounds.report(harm)
        rounds.run()
        assert len(street.west().tile("west").lights) == 1
    with capture_logs() as lines:
        rounds.report(BitsIncrease("west", published, "c", 2.1))
        rounds.run()
    assert [(line["event"], line["vehicle"]) for line in lines] == [("update withdrawn", "c")]
    assert street.west().tile("west").lights == ()
    assert read_histories(street.recordings)["west"].withdrawals == 1


def test_the_process_takes_reports(street, published):
    learner = Learner(street.job, LogForm.JSON, lambda _: None)
    learner.report(BitsIncrease("west", published, "c", 50.0))
    learner.start()
    try:
        learner.report(BitsIncrease("west", published, "c", 50.0))
        assert learner._process.stdin is not None
        deadline_s = WAIT_S
        while street.west().tile("west").lights and deadline_s > 0:
            try:
                learner._process.wait(0.1)
            except Exception:
                deadline_s -= 0.1
        assert street.west().tile("west").lights == ()
    finally:
        learner.close()
