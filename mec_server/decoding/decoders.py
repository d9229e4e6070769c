"""Where this server decodes: in itself, in processes of their own, or in sandboxes around those.

FFmpeg has been broken by crafted streams before, and will be again. Packets from other machines
are therefore decoded where a crash costs one frame and a decoder taken over can reach nothing
(``rfcore.confinement``): AUTO takes bubblewrap where it works, else Landlock, and nothing less. It
decodes in the server only when no other machine can reach it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Protocol

import structlog

from mec_server.config import DecoderKind
from mec_server.decoding.pool import DecoderPool
from mec_server.decoding.process import DecoderLost, LossCause, WaitContext
from mec_server.ledger.peer_log import LogLimiter, PeerLog
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.h264.splice import PictureDecoder
from rfcore.confinement.confine import Confinement
from rfcore.confinement.start import ConfinedProgram, check_not_root
from rfcore.errors import BackendUnavailable, RfedgeError

__all__ = ["DecoderSettings", "Decoders", "OpenDecoder", "decoder_program"]

log = structlog.get_logger()

CONFINEMENTS = {
    DecoderKind.CHILD: Confinement.LIMITS,
    DecoderKind.LANDLOCK: Confinement.LANDLOCK,
    DecoderKind.BUBBLEWRAP: Confinement.BUBBLEWRAP,
}
BEST_FIRST = (DecoderKind.BUBBLEWRAP, DecoderKind.LANDLOCK)
"""What AUTO tries."""


def decoder_program(kind: DecoderKind) -> ConfinedProgram:
    """Return the program of a decoder process of ``kind``."""
    return ConfinedProgram("mec_server.decoding.child", CONFINEMENTS[kind], _environment())


def _environment() -> Mapping[str, str]:
    """Return the environment variables of a decoder process."""
    inherited = ("PYTHONPATH", "LD_LIBRARY_PATH")
    own = {"OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    return own | {name: os.environ[name] for name in inherited if name in os.environ}


class OpenDecoder(Protocol):
    """Opens decoders."""

    def __call__(self, size_px: tuple[int, int]) -> PictureDecoder:
        """Return a decoder for pictures of ``size_px``; raise ``CodecError`` if there is none."""


@dataclass(frozen=True)
class DecoderSettings:
    """Which kind of decoder; ``reachable``: whether packets may come from other machines, which
    decides what AUTO means; ``as_root``: whether root may decode in a sandbox."""

    kind: DecoderKind
    reachable: bool = True
    as_root: bool = False


class Decoders:
    """Opens decoders of one kind; ``start``, then ``open``, then ``close``.

    ``kind`` is the kind in force, never AUTO once started. ``count_loss`` is called for each
    decoder process that dies in use, on any thread; ``start_failed`` with what a spare process
    could not be started for; ``limiter``: of lines about decoders that are lost; ``waiting``: see
    ``DecoderPool``.
    """

    def __init__(
        self,
        settings: DecoderSettings,
        count_loss: Callable[[LossCause], None],
        start_failed: Callable[[Exception], None],
        limiter: LogLimiter,
        waiting: WaitContext = nullcontext,
    ) -> None:
        self.kind = settings.kind
        if self.kind is DecoderKind.AUTO and not settings.reachable:
            self.kind = DecoderKind.IN_PROCESS
            log.warning(
                "decoding in the server's own process",
                reason="--decoder auto, and only this machine can reach the server",
                remedy="--decoder bubblewrap or landlock, if programs here are not to be trusted",
            )
        self._as_root = settings.as_root
        self._count_loss = count_loss
        self._start_failed = start_failed
        self._waiting = waiting
        self._lines = PeerLog(log, limiter, "decoders", time.monotonic)
        self._pool: DecoderPool | None = None

    def start(self) -> None:
        """Start a first spare process; raise ``BackendUnavailable`` if that fails."""
        if self.kind in (DecoderKind.AUTO, *BEST_FIRST):
            check_not_root(self._as_root)
        if self.kind is DecoderKind.AUTO:
            self._start_best()
        elif self.kind is not DecoderKind.IN_PROCESS:
            self._pool = self._pool_of(self.kind)
        log.info("decoding", decoder=str(self.kind))

    def open(self, size_px: tuple[int, int]) -> PictureDecoder:
        """Return a decoder for pictures of ``size_px``."""
        return H264Decoder(size_px) if self._pool is None else self._pool.open(size_px)

    def close(self) -> None:
        """Start no more processes."""
        if self._pool is not None:
            self._pool.close()

    def _start_best(self) -> None:
        problems = []
        for kind in BEST_FIRST:
            try:
                self._pool, self.kind = self._pool_of(kind), kind
            except RfedgeError as error:
                problems.append(str(error))
                continue
            if problems:
                log.warning("decoding in a lesser sandbox", decoder=str(kind), problem=problems[0])
            return
        raise BackendUnavailable(
            f"no sandbox for decoders works here: {'; '.join(problems)}. To decode without one, "
            "and to trust every sender, ask for it: --decoder child"
        )

    def _pool_of(self, kind: DecoderKind) -> DecoderPool:
        pool = DecoderPool(decoder_program(kind), self._lost, self._start_failed, self._waiting)
        try:
            pool.wait_until_ready()
        except RfedgeError as error:
            pool.close()
            raise BackendUnavailable(f"decoder {kind}: {error}") from error
        return pool

    def _lost(self, lost: DecoderLost) -> None:
        self._count_loss(lost.cause)
        self._lines.error("decoder lost", reason=str(lost.cause), pid=lost.pid, problem=str(lost))
