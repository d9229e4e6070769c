"""The channel to the server, and waiting for it without hiding why nobody answers."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import grpc

from rfcore.wire.address import Address, check_handshake
from rfcore.wire.conventions import CHANNEL_OPTIONS
from rfcore.wire.tls import TlsFiles

__all__ = ["ServerConnection"]

ASK_AFTER_S = 1.0
"""A server that can be had is connected to sooner; later, it is asked what it holds against us."""


@dataclass(frozen=True)
class ServerConnection:
    """Where the server is, and how to be let in."""

    address: Address
    tls: TlsFiles | None

    def open(self) -> grpc.aio.Channel:
        """Return a channel, encrypted if there are certificates."""
        if self.tls is None:
            return grpc.aio.insecure_channel(str(self.address), options=CHANNEL_OPTIONS)
        credentials = self.tls.channel_credentials()
        return grpc.aio.secure_channel(str(self.address), credentials, options=CHANNEL_OPTIONS)

    async def reached(self, channel: grpc.aio.Channel, within_s: float | None) -> None:
        """Wait until the channel is connected, for ever if ``within_s`` is None.

        Raises ``AccessDenied`` if the ends refuse each other, else ``TimeoutError``.
        """
        try:
            async with asyncio.timeout(within_s):
                await (channel.channel_ready() if self.tls is None else self._admitted(channel))
        except TimeoutError:
            await self._ask()
            raise

    async def _admitted(self, channel: grpc.aio.Channel) -> None:
        ready = asyncio.ensure_future(channel.channel_ready())
        try:
            while not (await asyncio.wait({ready}, timeout=ASK_AFTER_S))[0]:
                await self._ask()
            ready.result()
        finally:
            ready.cancel()
            await asyncio.gather(ready, return_exceptions=True)

    async def _ask(self) -> None:
        await asyncio.to_thread(check_handshake, self.address, self.tls)
