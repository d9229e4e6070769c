"""A source that is lost and comes back, in virtual time."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
import pytest

from cav_agent.live.reader import HEADER_BYTES, EndRecord, FrameRecord, Header, Record, record_of
from cav_agent.live.source import LONGEST_PAUSE_S, OPENING_S, Clocks, LiveSource, SourceProblem
from rfcore.errors import RfedgeError
from rfcore.wire.values import ClockKind

S = 1_000_000_000
BEGAN = 1_700_000_000 * S
SIZE_PX = (8, 6)


class World:
    """Virtual time, and readers made of scripts: (seconds to wait, record), silence at the end."""

    def __init__(self, *scripts: list[tuple[float, Record]]) -> None:
        self.now_s = 100.0
        self.opened: list[float] = []
        self.living = 0
        self.events: list[tuple[str, object]] = []
        self.counts: Counter[str] = Counter()
        self._scripts = deque(scripts)

    def unix_ns(self) -> int:
        return BEGAN + round((self.now_s - 100.0) * S)

    def wait(self, seconds: float) -> None:
        self.now_s += seconds

    def open(self) -> FakeReader:
        self.opened.append(self.now_s)
        self.living += 1
        return FakeReader(self, deque(self._scripts.popleft() if self._scripts else ()))

    def source_open(self, camera_id: str, clock: ClockKind) -> None:
        assert camera_id == "front"
        self.events.append(("open", clock))

    def source_lost(self, camera_id: str, problem: SourceProblem, text: str, begins: bool) -> None:
        assert (camera_id, bool(text)) == ("front", True)
        self.counts["lost"] += 1
        if begins:
            self.events.append(("lost", problem))

    def source_damaged(self, camera_id: str, count: int) -> None:
        assert camera_id == "front"
        assert count > 0
        self.counts["damaged"] += count

    def source_frames(self, taken: int, dropped: int) -> None:
        self.counts["taken"] += taken
        self.counts["dropped"] += dropped

    def source(self, **options: bool) -> LiveSource:
        clocks = Clocks(lambda: self.now_s, self.unix_ns, self.wait)
        return LiveSource(
            self.open, "front", SIZE_PX, self, timeout_s=5.0, clocks=clocks, **options
        )

    def run(self, source: LiveSource, until_s: float) -> None:
        while self.now_s < until_s and not source.is_over:
            source.step()
            self.now_s += 0.001


class FakeReader:
    """One opening of the source."""

    def __init__(self, world: World, script: deque[tuple[float, Record]]) -> None:
        self._world, self._script = world, script
        self._begun_s = world.now_s

    def read(self, timeout_s: float) -> Record | None:
        if not self._script or self._begun_s + self._script[0][0] > self._world.now_s + timeout_s:
            self._world.wait(timeout_s)
            return None
        after_s, record = self._script.popleft()
        self._world.now_s = max(self._world.now_s, self._begun_s + after_s)
        if isinstance(record, FrameRecord):
            times = (record.pts_ns, self._world.unix_ns(), record.sender_ns, record.dropped)
            return FrameRecord(record.rgb, *times)
        return record

    def close(self) -> None:
        self._world.living -= 1


def frame(pts_s: float, size_px: tuple[int, int] = SIZE_PX, dropped: int = 0) -> FrameRecord:
    rgb = np.full((size_px[1], size_px[0], 3), round(pts_s * 10) % 256, np.uint8)
    return FrameRecord(rgb, round(pts_s * S), 0, None, dropped)


def steady(seconds: float, begin_s: float = 0.0) -> list[tuple[float, Record]]:
    count = round(seconds * 10)
    return [(begin_s + i / 10, frame(i / 10)) for i in range(count)]


def test_a_camera_that_dies_is_opened_again_and_video_goes_on() -> None:
    world = World([*steady(2.0), (2.0, EndRecord("connection reset"))], [], steady(60.0))
    source = world.source()
    world.run(source, 130.0)
    assert world.events == [
        ("open", ClockKind.ARRIVAL),
        ("lost", SourceProblem.ENDED),
        ("open", ClockKind.ARRIVAL),
    ]
    assert world.counts["lost"] == 2, "each try is counted, the loss is told once"
    taken = source.take()
    assert taken is not None
    assert taken.time_ns > world.unix_ns() - S
    assert world.living == 1


def test_a_camera_that_hangs_is_killed_in_time() -> None:
    world = World(steady(1.0))
    source = world.source()
    world.run(source, 105.0)
    assert world.living == 1
    world.run(source, 107.0)
    assert ("lost", SourceProblem.SILENT) in world.events
    assert world.living <= 1


def test_one_that_never_answers_is_asked_ever_more_rarely_and_leaves_nothing_behind() -> None:
    world = World()
    source = world.source()
    world.run(source, 1000.0)
    pauses = np.diff(world.opened)
    assert len(world.opened) > 40
    assert pauses.max() <= LONGEST_PAUSE_S + OPENING_S + 1.0
    assert pauses[-1] > pauses[0]
    assert world.counts["lost"] == len(world.opened) - world.living
    assert world.living <= 1


def test_a_burst_leaves_the_newest_and_is_counted() -> None:
    burst: list[tuple[float, Record]] = [(1.0, frame(i / 10)) for i in range(10)]
    world = World(burst)
    source = world.source()
    world.run(source, 101.5)
    taken = source.take()
    assert taken is not None
    assert taken.rgb[0, 0, 0] == 9
    assert source.take() is None
    assert world.counts == {"taken": 10, "dropped": 9}


def test_frames_that_the_reader_dropped_are_counted_once() -> None:
    world = World([(0.1, frame(0.1, dropped=3)), (0.2, frame(0.2, dropped=5))])
    source = world.source()
    world.run(source, 100.05)
    source.take()
    world.run(source, 100.5)
    assert world.counts == {"taken": 2, "dropped": 5}


def test_time_stamps_that_go_back_do_not_stop_the_video() -> None:
    again = [(2.0 + after_s, record) for after_s, record in steady(3.0)]
    world = World([*steady(2.0), *again])
    source = world.source()
    times = []
    while world.now_s < 104.9:
        source.step()
        world.now_s += 0.001
        taken = source.take()
        if taken is not None:
            times.append(taken.time_ns)
    assert len(times) >= 49
    assert times == sorted(set(times))


def test_frames_of_another_size_are_refused() -> None:
    world = World([(0.1, frame(0.0, (10, 6)))])
    source = world.source()
    world.run(source, 100.3)
    assert world.events == [("lost", SourceProblem.WRONG_SIZE)]
    assert source.take() is None


@pytest.mark.parametrize("repeats", [False, True])
def test_a_file_ends_or_begins_again(repeats: bool) -> None:
    whole = EndRecord("the source ended", is_whole=True)
    world = World([*steady(1.0), (1.0, whole)], [*steady(1.0), (1.0, whole)])
    source = world.source(repeats=repeats)
    world.run(source, 103.0)
    assert source.is_over is not repeats
    assert world.counts["taken"] == (20 if repeats else 10)
    assert world.counts["lost"] == 0
    assert source.newest is not None, "the last frame is still to be coded"


def sent(record: FrameRecord) -> bytes:
    return record.header() + record.rgb.tobytes()


def test_records_survive_the_pipe() -> None:
    record = FrameRecord(frame(1.2).rgb, None, BEGAN, BEGAN - 5, 7)
    data = sent(record)
    back = record_of(Header.parsed(data[:HEADER_BYTES]), data[HEADER_BYTES:])
    assert isinstance(back, FrameRecord)
    assert np.array_equal(back.rgb, record.rgb)
    assert (back.pts_ns, back.sender_ns, back.dropped) == (None, BEGAN - 5, 7)
    text = EndRecord("gone: ü", is_whole=True).to_bytes()
    assert record_of(Header.parsed(text[:HEADER_BYTES]), text[HEADER_BYTES:]) == EndRecord(
        "gone: ü", is_whole=True
    )


@pytest.mark.parametrize("at", [0, 4, 8, 12, HEADER_BYTES - 8, HEADER_BYTES - 1])
def test_a_damaged_header_is_refused(at: int) -> None:
    data = bytearray(sent(frame(1.0))[:HEADER_BYTES])
    data[at] ^= 0x40
    with pytest.raises(RfedgeError, match="the camera's reader sent a record"):
        Header.parsed(bytes(data))
