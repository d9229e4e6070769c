"""Where this server decodes: in itself, in processes of their own, or in sandboxes around those.

FFmpeg has been broken by crafted streams before, and will be again. Packets from other machines
are therefore decoded where a crash costs one frame: AUTO takes bubblewrap where it works, else
plain processes, and decodes in the server only when no other machine can reach it.

In a sandbox of bubblewrap there is no network, no other process, and no file but Python's and this
project's code, all read-only: no key, no field, no recording.
<https://github.com/containers/bubblewrap>
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Protocol

import structlog

import mec_server
import rfcore
from mec_server.config import DecoderKind
from mec_server.decoding.pool import DecoderPool
from mec_server.decoding.process import DecoderLost, LossCause, child_environment
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.h264.splice import PictureDecoder
from rfcore.errors import BackendUnavailable, RfedgeError

__all__ = ["Decoders", "OpenDecoder", "bubblewrap_command"]

log = structlog.get_logger()

SYSTEM = ("/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache")
"""What programs need of the system; read-only in a sandbox."""


def bubblewrap_command(environment: Mapping[str, str]) -> list[str]:
    """Return the command line that runs a command in a sandbox, to be put before it.

    Raises ``BackendUnavailable`` without bubblewrap.
    """
    program = shutil.which("bwrap")
    if program is None:
        raise BackendUnavailable(
            "decoder: bwrap is not on PATH; install bubblewrap, or give --decoder child"
        )
    command = [program, "--unshare-all", "--die-with-parent", "--new-session", "--clearenv"]
    for name, value in environment.items():
        command += ["--setenv", name, value]
    for path in _readable():
        command += ["--ro-bind", path, path]
    return [*command, "--proc", "/proc", "--dev", "/dev", "--remount-ro", "/", "--"]


def _readable() -> Iterable[str]:
    """Return the folders that our code is run from, each before those inside it."""
    installed = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    own = [path for package in (rfcore, mec_server) for path in package.__path__]
    found = {*SYSTEM, sys.prefix, sys.base_prefix, *installed, *own}
    return sorted(path for path in found if Path(path).exists())


class OpenDecoder(Protocol):
    """Opens decoders."""

    def __call__(self, size_px: tuple[int, int]) -> PictureDecoder:
        """Return a decoder for pictures of ``size_px``; raise ``CodecError`` if there is none."""


class Decoders:
    """Opens decoders of one kind; ``start``, then ``open``, then ``close``.

    ``reachable``: whether packets may come from other machines; it decides what AUTO means.
    ``count_loss`` is called for each decoder process that dies in use, on any thread.
    """

    def __init__(
        self,
        kind: DecoderKind,
        reachable: bool,
        count_loss: Callable[[LossCause], None],
        start_failed: Callable[[Exception], None],
    ) -> None:
        if kind is DecoderKind.AUTO and not reachable:
            kind = DecoderKind.IN_PROCESS
        self.kind = kind
        self._count_loss = count_loss
        self._start_failed = start_failed
        self._pool: DecoderPool | None = None

    def start(self) -> None:
        """Start a first spare process; raise ``RfedgeError`` if that fails."""
        if self.kind is DecoderKind.AUTO:
            self._start_best()
        elif self.kind is not DecoderKind.IN_PROCESS:
            self._pool = self._pool_of(self.kind)

    def open(self, size_px: tuple[int, int]) -> PictureDecoder:
        """Return a decoder for pictures of ``size_px``."""
        return H264Decoder(size_px) if self._pool is None else self._pool.open(size_px)

    def close(self) -> None:
        """Start no more processes."""
        if self._pool is not None:
            self._pool.close()

    def _start_best(self) -> None:
        self.kind = DecoderKind.BUBBLEWRAP
        try:
            self._pool = self._pool_of(self.kind)
        except RfedgeError as error:
            log.warning("decoding without a sandbox, in processes with limits", problem=str(error))
            self.kind = DecoderKind.CHILD
            self._pool = self._pool_of(self.kind)

    def _pool_of(self, kind: DecoderKind) -> DecoderPool:
        sandboxed = kind is DecoderKind.BUBBLEWRAP
        wrapper = bubblewrap_command(child_environment()) if sandboxed else ()
        pool = DecoderPool(wrapper, self._lost, self._start_failed)
        try:
            pool.wait_until_ready()
        except RfedgeError as error:
            pool.close()
            raise BackendUnavailable(f"decoder {kind}: {error}") from error
        return pool

    def _lost(self, lost: DecoderLost) -> None:
        self._count_loss(lost.cause)
        log.error("decoder lost", reason=str(lost.cause), pid=lost.pid, problem=str(lost))
