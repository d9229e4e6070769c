"""Decoding in other processes: the same pictures and errors, and a death costs one picture."""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import structlog

from mec_server.config import DecoderKind, ServerConfig
from mec_server.decoding import decoders as decoder_kinds
from mec_server.decoding import process
from mec_server.decoding.child import LIMITS
from mec_server.decoding.decoders import ChildDecoder, DecoderPool, Decoders, decoder_program
from mec_server.decoding.process import DecoderLost, DecoderProcess, ForkServer, LossCause
from mec_server.server import EdgeServer
from rfcore.codec.h264.ffmpeg import EncoderOptions, H264Decoder, PictureKind, encode_pictures
from rfcore.confinement import start
from rfcore.confinement.confine import Confinement
from rfcore.confinement.start import ConfinedProgram
from rfcore.errors import BackendUnavailable, CodecError, RfedgeError
from rfcore.image import I420

SIZE_PX = (96, 64)


def clip(size_px: tuple[int, int], count: int) -> list[bytes]:
    rng = np.random.default_rng(3)
    width, height = size_px
    half = (height // 2, width // 2)
    pictures = [
        I420(*(rng.integers(16, 235, s, np.uint8) for s in ((height, width), half, half)))
        for _ in range(count)
    ]
    options = EncoderOptions(size_px, "ultrafast", 40.0, {"keyint": "infinite"})
    return encode_pictures(options, [(picture, PictureKind.CHOSEN) for picture in pictures])


@pytest.fixture(scope="module")
def units() -> list[bytes]:
    return clip(SIZE_PX, 4)


def unexpected(error: Exception) -> None:
    """Take the failure of a spare, where none may fail."""
    raise AssertionError(f"a spare process could not be started: {error}")


KINDS = [
    DecoderKind.CHILD,
    DecoderKind.LANDLOCK,
    pytest.param(DecoderKind.BUBBLEWRAP, marks=pytest.mark.slow),
]
"""The last one takes a program that ``make test-slow`` installs."""


@pytest.fixture(scope="module", params=KINDS)
def pool(request: pytest.FixtureRequest) -> Iterator[DecoderPool]:
    """Processes with limits, and those that are confined."""
    made = DecoderPool(decoder_program(request.param), lambda lost: LOST.append(lost), unexpected)
    made.wait_until_ready()
    yield made
    made.close()


LOST: list[DecoderLost] = []


@pytest.fixture
def decoder(pool: DecoderPool) -> Iterator[ChildDecoder]:
    LOST.clear()
    opened = pool.open(SIZE_PX)
    yield opened
    opened.close()


def process_of(decoder: ChildDecoder) -> int:
    """Return the process that decodes."""
    assert decoder._process is not None
    return decoder._process.pid


def test_pictures_are_those_of_a_decoder_in_this_process(
    decoder: ChildDecoder, units: Sequence[bytes]
) -> None:
    here = H264Decoder(SIZE_PX)
    for unit in units[:-1]:
        assert decoder.decode(unit).digest() == here.decode(unit).digest()


def test_what_is_fed_is_decoded_with_what_comes_next_however_much_it_is(
    decoder: ChildDecoder, units: Sequence[bytes]
) -> None:
    here = H264Decoder(SIZE_PX)
    for unit in [*units[:3]] * 10:  # more than one request holds
        decoder.feed(unit)
        here.feed(unit)
    assert decoder.decode(units[3]).digest() == here.decode(units[3]).digest()
    decoder.feed(b"\x00\x00\x00\x01\x65garbage")
    with pytest.raises(CodecError):
        decoder.decode(units[0])
    decoder.reset()
    assert decoder.decode(units[0]).digest() == H264Decoder(SIZE_PX).decode(units[0]).digest()


def test_what_does_not_fit_into_the_memory_is_handed_over_before(
    decoder: ChildDecoder, units: Sequence[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    here = H264Decoder(SIZE_PX)
    monkeypatch.setattr(decoder_kinds, "INPUT_BYTES", max(map(len, units)) + 1)
    for unit in units[:3]:
        decoder.feed(unit)
        here.feed(unit)
    assert decoder.decode(units[3]).digest() == here.decode(units[3]).digest()
    with pytest.raises(CodecError, match="exceeds"):
        decoder.feed(bytes(max(map(len, units)) + 2))


def test_what_ffmpeg_refuses_is_the_same_error_and_the_process_lives_on(
    decoder: ChildDecoder, units: Sequence[bytes]
) -> None:
    for bad in (b"", b"\x00\x00\x00\x01\x65garbage", clip((192, 128), 1)[0]):
        with pytest.raises(CodecError) as there:
            decoder.decode(bad)
        with pytest.raises(CodecError) as here:
            H264Decoder(SIZE_PX).decode(bad)
        assert str(there.value) == str(here.value)
        decoder.reset()
    decoder.decode(units[0])
    assert LOST == []


def test_a_killed_process_costs_one_picture(decoder: ChildDecoder, units: Sequence[bytes]) -> None:
    expected = decoder.decode(units[0]).digest()
    os.kill(process_of(decoder), signal.SIGKILL)
    with pytest.raises(DecoderLost, match="was killed by SIGKILL"):
        decoder.decode(units[1])
    decoder.reset()
    assert decoder.decode(units[0]).digest() == expected
    assert [lost.cause for lost in LOST] == [LossCause.SIGNAL]


def test_nothing_is_forked_where_a_decoder_was_lost_since_it_was_looked_at(
    pool: DecoderPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    retired: list[ForkServer] = []

    def forked_too_late(forks: ForkServer) -> DecoderProcess:
        if not retired:
            retired.append(forks)
            forks.retire()
        return DecoderProcess(forks)

    with monkeypatch.context() as late:
        late.setattr(decoder_kinds, "DecoderProcess", forked_too_late)
        taken = [pool.take(), pool.take()]
    try:
        assert all(one.is_alive for one in taken)
        assert taken[1].forks is not retired[0]
        assert taken[1].forks.is_usable
    finally:
        for one in taken:
            one.close()


def test_a_process_that_hangs_is_killed(
    decoder: ChildDecoder, units: Sequence[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    hung = process_of(decoder)
    os.kill(hung, signal.SIGSTOP)
    with monkeypatch.context() as patience:
        patience.setattr(process, "ANSWER_S", 0.05)
        with pytest.raises(DecoderLost, match="did not answer"):
            decoder.decode(units[0])
    decoder.decode(units[0])
    assert [lost.cause for lost in LOST] == [LossCause.TIMEOUT]
    while Path(f"/proc/{hung}/exe").exists():
        os.sched_yield()


def test_a_process_has_the_limits_it_is_said_to_have(
    decoder: ChildDecoder, units: Sequence[bytes]
) -> None:
    decoder.decode(units[0])
    lines = Path(f"/proc/{process_of(decoder)}/limits").read_text().splitlines()
    limits = {line[:26].strip(): line[26:].split()[:2] for line in lines}
    assert limits["Max address space"] == [str(LIMITS.address_space_bytes)] * 2
    assert limits["Max open files"] == ["16", "16"]
    for nothing in ("Max file size", "Max processes", "Max core file size"):
        assert limits[nothing] == ["0", "0"]
    assert int(limits["Max cpu time"][0]) < 60, "moves along with what was used"


def test_a_process_ends_when_its_decoder_is_closed(pool: DecoderPool) -> None:
    decoder = pool.open(SIZE_PX)
    pid = process_of(decoder)
    decoder.close()
    while Path(f"/proc/{pid}/exe").exists():  # the kernel ends a sandbox after its front
        os.sched_yield()
    with pytest.raises(CodecError, match="its stream is over"):
        decoder.decode(b"\x00\x00\x00\x01\x65")


@pytest.mark.slow
def test_bubblewrap_shows_no_network_no_process_and_no_file_of_ours(
    units: Sequence[bytes], tmp_path: Path
) -> None:
    ours = tmp_path / "ours"
    ours.write_text("seen")
    program = decoder_program(DecoderKind.BUBBLEWRAP)
    pool = DecoderPool(program, lambda _: None, unexpected)
    decoder = pool.open(SIZE_PX)
    try:
        decoder.decode(units[0])
        proc = Path(f"/proc/{process_of(decoder)}")
        for namespace in ("net", "pid", "ipc", "mnt", "uts"):
            there, here = (p / "ns" / namespace for p in (proc, Path("/proc/self")))
            assert there.readlink() != here.readlink(), namespace
        root = proc / "root"
        assert not (root / "etc/passwd").exists()
        for file in (ours, Path(__file__)):
            assert not (root / str(file).lstrip("/")).exists()
        mounts = (proc / "mounts").read_text().splitlines()
        writable = [m.split()[1] for m in mounts if "rw" in m.split()[3].split(",")]
        assert writable == []
        assert not (root / "proc").exists()
    finally:
        decoder.close()
        pool.close()


@pytest.fixture
def decoders() -> Callable[..., Decoders]:
    """Make decoders; tests may run as root."""

    def make(kind: DecoderKind, reachable: bool = True, as_root: bool = True) -> Decoders:
        return Decoders(kind, reachable=reachable, as_root=as_root, start_failed=unexpected)

    return make


def started_kind(decoders: Decoders) -> DecoderKind:
    decoders.start()
    decoders.close()
    return decoders.kind


@pytest.mark.slow
def test_auto_decodes_in_the_server_only_where_no_other_machine_can_reach_it(decoders: Any) -> None:
    with structlog.testing.capture_logs() as lines:
        assert decoders(DecoderKind.AUTO, False).kind is DecoderKind.IN_PROCESS
    (warning,) = (line for line in lines if line["log_level"] == "warning")
    assert warning["event"] == "decoding in the server's own process"
    assert started_kind(decoders(DecoderKind.AUTO)) is DecoderKind.BUBBLEWRAP


def test_auto_without_bubblewrap_takes_landlock_and_says_so(
    decoders: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start.shutil, "which", lambda _: None)
    with structlog.testing.capture_logs() as logs:
        assert started_kind(decoders(DecoderKind.AUTO)) is DecoderKind.LANDLOCK
    (warning,) = [line for line in logs if line["log_level"] == "warning"]
    assert warning["decoder"] == "landlock"
    assert "bwrap is not on PATH" in warning["problem"]
    assert {"event": "decoding", "decoder": "landlock", "log_level": "info"} in logs


def test_auto_never_decodes_without_a_sandbox(
    decoders: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start.shutil, "which", lambda _: None)
    monkeypatch.setitem(decoder_kinds.CONFINEMENTS, DecoderKind.LANDLOCK, "no-such-confinement")
    with pytest.raises(BackendUnavailable, match=r"no sandbox .* ask for it: --decoder child"):
        decoders(DecoderKind.AUTO).start()


def test_a_sandbox_that_was_asked_for_and_cannot_be_had_is_an_error(
    decoders: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start.shutil, "which", lambda _: None)
    with pytest.raises(BackendUnavailable, match=r"bwrap is not on PATH; install bubblewrap"):
        decoders(DecoderKind.BUBBLEWRAP).start()
    monkeypatch.setattr(start.shutil, "which", lambda _: "/bin/false")
    with pytest.raises(BackendUnavailable, match=r"^decoder bubblewrap: .* ended with status 1"):
        decoders(DecoderKind.BUBBLEWRAP).start()


@pytest.mark.parametrize("kind", [DecoderKind.AUTO, DecoderKind.LANDLOCK, DecoderKind.BUBBLEWRAP])
def test_root_decodes_in_a_sandbox_only_when_told(
    kind: DecoderKind, decoders: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start.os, "geteuid", lambda: 0)
    with pytest.raises(BackendUnavailable, match="give --sandbox-as-root"):
        decoders(kind, as_root=False).start()


def ends_at_once(module: str = "rfcore.no_such_module") -> ConfinedProgram:
    return ConfinedProgram(module, Confinement.LIMITS, {})


def test_a_process_that_cannot_start_says_why() -> None:
    pool = DecoderPool(ends_at_once(), lambda _: None, unexpected)
    with pytest.raises(RfedgeError, match=r"ended with status 1 at its start: .*no_such_module"):
        pool.wait_until_ready()
    pool.close()


def test_a_spare_that_cannot_be_started_is_reported_though_nobody_waits_for_it() -> None:
    failures: list[Exception] = []
    pool = DecoderPool(ends_at_once(), lambda _: None, failures.append)
    with pytest.raises(RfedgeError, match="no_such_module"):
        pool.take()
    pool.close()
    assert failures
    assert all("no_such_module" in str(error) for error in failures)


async def test_the_kind_in_force_is_in_the_metrics(tmp_path: Path) -> None:
    landlock = {"decoder": DecoderKind.LANDLOCK, "sandbox_as_root": True}
    server = EdgeServer(ServerConfig(tmp_path, "127.0.0.1:0", **landlock))
    await server.start()
    try:
        values = {
            kind: server.registry.get_sample_value("rfedge_server_decoder", {"kind": kind})
            for kind in DecoderKind
        }
        assert values.pop(DecoderKind.LANDLOCK) == 1
        assert values.pop(DecoderKind.AUTO) is None
        assert set(values.values()) == {0.0}
    finally:
        await server.stop()


CONFINED = {"NoNewPrivs": "1", "Seccomp": "2", "CapEff": "0000000000000000"}


@pytest.mark.parametrize(
    "kind",
    [DecoderKind.LANDLOCK, pytest.param(DecoderKind.BUBBLEWRAP, marks=pytest.mark.slow)],
)
def test_the_kernel_says_that_a_decoder_is_confined(kind: DecoderKind) -> None:
    pool = DecoderPool(decoder_program(kind), lambda _: None, unexpected)
    process = pool.take()
    try:
        lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
        status = {name: value.strip() for name, _, value in (x.partition(":") for x in lines)}
        assert {name: status[name] for name in CONFINED} == CONFINED
    finally:
        process.close()
        pool.close()
