"""The learning process publishes updates, withholds some, and takes some back."""

import errno
import os
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from prometheus_client import CollectorRegistry
from structlog.testing import capture_logs

from mec_server.learner import RESTART_S, Learner
from mec_server.metrics import ServerMetrics
from mec_server.tile_history import LEARNING, Learnt, TileHistory, read_histories
from mec_server.tile_learning import WATCH_EVERY_MS, LearningRounds
from rfcore.errors import InvalidInput
from rfcore.field import FieldStore, SplatField, save_field
from rfcore.update.passes import Pass, without_outliers
from rfcore.update.run import Update, UpdateSettings, learn_from
from rfcore.update.splats import Progress
from rfcore.wire.settings import LogForm
from rfcore.wire.tile_manifest import MANIFEST, Ground, VersionLabel, publish
from rfcore.wire.tiles import Tile, TileLight
from tests.update.conftest import NOW, NOW_MS, pasted, sometimes


def elsewhere(drive: Pass) -> Pass:
    """The same pictures with poses 2 m off."""

    def moved(number: int) -> Any:
        picture = drive.pictures[number]
        pose = picture.camera.world_from_cam
        x, y, z = pose.translation_m
        wrong = replace(pose, translation_m=(x + 2.0, y, z))
        return replace(picture, camera=replace(picture.camera, world_from_cam=wrong))

    return Pass(drive.identity, tuple(moved(number) for number in range(len(drive.pictures))))


def test_two_vehicles_teach_a_light_once(at_dusk):
    rounds = at_dusk.rounds()
    rounds.run()
    west = at_dusk.west()
    (light,) = west.tile("west").lights
    assert (light.name, light.passes, light.base_field_id) == ("h17", 2, at_dusk.noon_id)
    assert light.time_of_day_h == pytest.approx(17.98, abs=0.01)
    (learnt,) = read_histories(at_dusk.recordings)["west"].learnt
    assert learnt.field_id == light.field_id
    assert learnt.saved_percent > 10
    rounds.run()
    at_dusk.rounds().run()
    assert at_dusk.west() == west


def test_fewer_vehicles_than_asked_for_teach_nothing(street, dusk, make_pass):
    for shift_m in (0.0, 0.15, 0.3):
        street.record(make_pass(dusk, "a", shift_m))
    street.rounds().run()
    assert len(street.west().field_ids) == 1
    assert "west" not in read_histories(street.recordings)


@pytest.mark.usefixtures("learnt_before")
@pytest.mark.parametrize("poison", ["poses", "pictures"])
def test_poisoned_passes_are_dropped_and_make_no_identity(street, dusk, make_pass, poison):
    """With one honest vehicle nothing is learnt; with two, what the two saw."""
    street.record(make_pass(dusk, "a"))
    if poison == "poses":
        street.record(elsewhere(make_pass(dusk, "liar")))
    else:
        street.record(make_pass(dusk, "liar", paint=pasted))
    street.rounds().run()
    assert len(street.west().field_ids) == 1
    street.record(make_pass(dusk, "b", 0.15))
    street.record(make_pass(dusk, "b", 0.3))
    street.rounds().run()
    (light,) = street.west().tile("west").lights
    (learnt,) = read_histories(street.recordings)["west"].learnt
    assert light.passes == learnt.passes == 3
    assert learnt.identities == 2


def test_single_frames_that_nobody_confirms_are_dropped(noon, make_pass):
    drives = [make_pass(noon, "a", paint=sometimes), make_pass(noon, "b", 0.05)]
    kept = without_outliers(noon, drives)
    assert [len(drive.pictures) for drive in kept] == [10, 12]
    assert {p.name for p in kept[0].pictures}.isdisjoint({"3.png", "7.png"})


def test_what_another_vehicle_saw_too_is_no_outlier(noon, make_pass):
    """A new front on the wall, nothing like the field, seen by two; then by one alone."""
    front = pasted(0, np.zeros((64, 96, 3), np.uint8))
    drives = [make_pass(noon, name, paint=lambda _, __: front) for name in "ab"]
    assert len(without_outliers(noon, drives)) == 2
    assert without_outliers(noon, drives[:1]) == []


def test_an_update_that_makes_bits_worse_is_withdrawn_within_50_frames(
    street, noon, dusk, make_pass
):
    street.rounds().run()
    street.record(make_pass(noon, "c"), street.publish_harm(dusk), times=4)
    with capture_logs() as lines:
        street.rounds().run()
    assert [line["event"] for line in lines] == ["update withdrawn"]
    assert lines[0]["vehicle"] == "c"
    assert street.west().tile("west").lights == ()
    history = read_histories(street.recordings)["west"]
    assert history.withdrawals == 1
    street.rounds().run()
    assert read_histories(street.recordings)["west"] == history


def test_a_harm_is_seen_while_another_update_is_tried(at_dusk, noon, dusk, make_pass, monkeypatch):
    """A vehicle meets the bad field when the trial of the next one has begun."""
    bad_id = at_dusk.publish_harm(dusk)
    now_ms, done = [NOW_MS], []

    def learn_and_tell(
        base: SplatField, passes: list[Pass], settings: UpdateSettings, progress: Progress
    ) -> Update:
        def tell(doing: str, step: int, steps: int) -> None:
            if doing == "trial" and step == 1:
                at_dusk.record(make_pass(noon, "c"), bad_id, times=4)
            now_ms[0] += WATCH_EVERY_MS + 1 if doing == "trial" else 0
            progress(doing, step, steps)
            done.append((doing, len(at_dusk.west().tile("west").lights)))

        return learn_from(base, passes, settings, tell)

    monkeypatch.setattr("mec_server.tile_learning.learn_from", learn_and_tell)
    with capture_logs() as lines:
        LearningRounds(at_dusk.job, lambda: now_ms[0]).run()
    assert lines[0]["event"] == "update withdrawn"
    assert done[-1] == ("trial", 0), "it was withdrawn before the trial was over"


def as_others_do(pid: int) -> None:
    """Let a process that works while a processor is idle work as others do: here none may be."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with suppress(ProcessLookupError):
            os.sched_setscheduler(int(thread.name), os.SCHED_OTHER, os.sched_param(0))


def test_a_process_withdraws_within_50_frames_what_makes_bits_worse(street, noon, dusk, make_pass):
    street.record(make_pass(noon, "c"), street.publish_harm(dusk), times=4)
    (file,) = street.recordings.glob("c/front/*/recording.jsonl")
    os.utime(file)
    assert len(file.read_text().splitlines()) - 1 <= 50
    learner = Learner(street.job, LogForm.JSON, lambda _: None)
    learner.start()
    assert learner.pid is not None
    try:
        while not read_histories(street.recordings)["west"].withdrawals:
            as_others_do(learner.pid)
            Event().wait(0.05)
    finally:
        learner.close()
    assert street.west().tile("west").lights == ()


@pytest.mark.usefixtures("learnt_before")
def test_an_update_that_helps_stays(at_dusk, dusk, make_pass):
    at_dusk.rounds().run()
    west = at_dusk.west()
    at_dusk.record(make_pass(dusk, "c", 0.05), west.tile("west").lights[0].field_id, times=4)
    at_dusk.rounds().run()
    assert at_dusk.west() == west
    assert read_histories(at_dusk.recordings)["west"].checked


class Killed(BaseException):
    """Ends a round at once, as SIGKILL would."""


@pytest.mark.usefixtures("learnt_before")
@pytest.mark.parametrize("step", ["learn_from", "save_field", "publish", "store", "manifest"])
def test_a_killed_round_publishes_nothing_half_and_the_next_does_the_work(
    at_dusk, monkeypatch, step
):
    target = {
        "store": "rfcore.wire.tile_manifest.FieldStore.add",
        "manifest": "rfcore.wire.tile_manifest.write_publication",
    }.get(step, f"mec_server.tile_learning.{step}")

    def killed(*_: object, **__: object) -> None:
        raise Killed

    before = (at_dusk.fields / MANIFEST).read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(target, killed)
        with pytest.raises(Killed):
            at_dusk.rounds().run()
    assert (at_dusk.fields / MANIFEST).read_bytes() == before
    assert all(FieldStore(at_dusk.fields).path(name) for name in FieldStore(at_dusk.fields).ids())
    at_dusk.rounds().run()
    assert len(at_dusk.west().tile("west").lights) == 1


@pytest.mark.usefixtures("learnt_before")
def test_a_full_disk_publishes_nothing_and_is_reported(at_dusk, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = (at_dusk.fields / MANIFEST).read_bytes()
    monkeypatch.setattr("rfcore.field.store.write_whole", full)
    with capture_logs() as lines:
        at_dusk.rounds().run()
    assert "No space left" in lines[-1]["problem"]
    assert (at_dusk.fields / MANIFEST).read_bytes() == before


@pytest.mark.usefixtures("learnt_before")
def test_learnt_fields_stay_within_their_bytes(at_dusk):
    with capture_logs() as lines:
        at_dusk.rounds(max_bytes=100).run()
    assert "learn-max-gb" in lines[-1]["problem"]
    assert len(at_dusk.west().field_ids) == 1


def test_spent_time_postpones_learning(at_dusk):
    with capture_logs() as lines:
        at_dusk.rounds(cpu_s_per_h=0.001).run()
    assert lines[-1]["event"] == "learning postponed"
    assert len(at_dusk.west().field_ids) == 1


def test_of_two_updates_at_once_one_is_published(at_dusk, monkeypatch, dusk, update, tmp_path):
    """Somebody publishes while this process learns: what was learnt was for another state."""
    other_id = save_field(dusk, tmp_path / "other.rff")

    def slowly(*_: Any) -> Update:
        label = VersionLabel("dusk", "", 2)
        publish(at_dusk.fields, "west", tmp_path / "other.rff", Ground(), NOW, label)
        return update

    monkeypatch.setattr("mec_server.tile_learning.learn_from", slowly)
    with capture_logs() as lines:
        at_dusk.rounds().run()
    assert "published by somebody else" in lines[-1]["problem"]
    assert [light.field_id for light in at_dusk.west().tile("west").lights] == [other_id]


def test_a_damaged_history_is_named(street):
    street.rounds().run()
    (street.recordings / LEARNING / "tiles.json").write_text("{")
    with pytest.raises(InvalidInput, match=r"tiles\.json is damaged"):
        street.rounds().run()


def test_a_killed_process_is_started_again_and_ends_with_its_server(street):
    now_s = [0.0]
    learner = Learner(street.job, LogForm.JSON, lambda _: None, lambda: now_s[0])
    learner.start()
    first = learner.pid
    assert first is not None
    os.kill(first, 9)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
    learner.look()
    assert learner.pid == first
    now_s[0] = RESTART_S
    learner.look()
    second = learner.pid
    assert second is not None
    assert (second != first, learner.restarts) == (True, 1)
    learner.close()
    with pytest.raises(ProcessLookupError):
        os.kill(second, 0)


def test_the_process_runs_while_a_processor_is_idle(street):
    learner = Learner(street.job, LogForm.JSON, lambda _: None)
    learner.start()
    try:
        assert learner.pid is not None
        deadline_s = time.monotonic() + 60
        while os.sched_getscheduler(learner.pid) != os.SCHED_IDLE:
            assert time.monotonic() < deadline_s, "it takes part as others do"
            Event().wait(0.05)
    finally:
        learner.close()


@pytest.mark.usefixtures("learnt_before")
@pytest.mark.parametrize(("max_age_s", "lights"), [(30.0, 0), (90.0, 1)])
def test_recordings_above_the_age_teach_nothing(at_dusk, max_age_s, lights):
    """They were added to a minute ago."""
    at_dusk.rounds(max_age_s=max_age_s).run()
    assert len(at_dusk.west().tile("west").lights) == lights


def test_what_was_learnt_is_shown(street):
    """The tile's lights are shown, and the last update, which was withdrawn at last."""
    registry = CollectorRegistry()
    metrics = ServerMetrics(registry)

    def shown(name: str) -> float | None:
        return registry.get_sample_value(f"rfedge_server_tile_{name}", {"tile": "west"})

    light = TileLight("h17", "ab" * 32, 2, street.noon_id, 3)
    metrics.show_tiles([Tile("west", street.noon_id, lights=(light,))])
    assert (shown("lights"), shown("passes")) == (1, 3)
    learnt = Learnt("ab" * 32, "h17", street.noon_id, 3, 20.0, NOW_MS)
    metrics.show_learnt({"west": TileHistory((learnt,))})
    assert shown("learnt_timestamp_seconds") == NOW_MS / 1e3
    assert (shown("saved_ratio"), shown("withdrawals_total")) == (0.2, 0)
    metrics.show_learnt({"west": TileHistory((replace(learnt, withdrawn=True),))})
    assert (shown("saved_ratio"), shown("withdrawals_total")) == (0, 1)
