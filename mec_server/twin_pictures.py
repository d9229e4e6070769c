"""Pictures of the twin as consumers want them: each is encoded once, for however many.

Runs on one thread of its own, so that consumers cost vehicles no worker.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from weakref import WeakKeyDictionary

from mec_server.twin import TwinView
from rfcore.image import I420, jpeg_bytes, png_bytes
from rfcore.native.yuv import rgb_from_i420
from rfcore.wire.twin import PictureEncoding

__all__ = ["TwinPictures", "encoded"]


class TwinPictures:
    """Encodes views; what was encoded is kept as long as its view."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, "twin")
        self._done: WeakKeyDictionary[TwinView, dict[PictureEncoding, asyncio.Future[bytes]]] = (
            WeakKeyDictionary()
        )

    async def bytes_of(self, view: TwinView, encoding: PictureEncoding) -> bytes:
        """Return the picture of ``view``."""
        done = self._done.setdefault(view, {})
        if encoding not in done:
            loop = asyncio.get_running_loop()
            done[encoding] = loop.run_in_executor(self._executor, encoded, view.picture, encoding)
        return await asyncio.shield(done[encoding])

    def close(self) -> None:
        """Stop the thread."""
        self._executor.shutdown(cancel_futures=True)


def encoded(picture: I420, encoding: PictureEncoding) -> bytes:
    """Return ``picture`` as bytes: see ``PictureEncoding`` in twin.proto."""
    match encoding:
        case PictureEncoding.NONE:
            return b""
        case PictureEncoding.I420:
            return picture.packed()
        case PictureEncoding.JPEG:
            return jpeg_bytes(rgb_from_i420(picture))
        case PictureEncoding.PNG:
            return png_bytes(rgb_from_i420(picture))
