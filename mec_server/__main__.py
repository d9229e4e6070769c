"""``mec-server``: the edge server's command."""

from __future__ import annotations

import asyncio
import signal
import sys
from pathlib import Path
from typing import Annotated

import tyro

from mec_server.config import ConsumerLimits, DecoderKind, ServerConfig, VehicleQuota
from mec_server.server import EdgeServer
from rfcore.errors import RfedgeError
from rfcore.wire.logs import LogForm, configure_logs
from rfcore.wire.tls import TlsFiles

__all__ = ["main"]

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


def run(
    fields: Path,
    listen: str = "127.0.0.1:50051",
    save: Path | None = None,
    metrics_port: int | None = None,
    metrics_host: str = "127.0.0.1",
    metrics_per_vehicle: Flag = False,
    max_consumers: int = 8,
    max_streams: int = 256,
    vehicle_streams: int = 8,
    vehicle_frames_per_s: float = 500.0,
    vehicle_bytes_per_s: float = 32e6,
    log: LogForm = LogForm.AUTO,
    threads: int = 1,
    workers: int = 2,
    decoder: Annotated[DecoderKind, tyro.conf.EnumChoicesFromValues] = DecoderKind.AUTO,
    isa: str | None = None,
    ready_file: Path | None = None,
    tls_cert: Path | None = None,
    tls_key: Path | None = None,
    tls_ca: Path | None = None,
    allow_insecure: Flag = False,
) -> ServerConfig:
    """Reconstruct what vehicles see, against the radiance fields held here.

    Args:
        fields: Directory of field archives (.rff).
        listen: HOST:PORT to accept vehicles on; port 0 takes a free one.
        save: Directory for reconstructed pictures (PNG) and their index; none without it.
        metrics_port: Port for Prometheus; 0 takes a free one, none are served without it.
        metrics_host: Address the metrics are served on.
        metrics_per_vehicle: Tell vehicles apart in the metrics; each costs its own time series.
        max_consumers: How many may watch the twin at once (`rfedge watch`).
        max_streams: How many streams of vehicles may be open at once.
        vehicle_streams: How many of them one vehicle may have.
        vehicle_frames_per_s: How many frames it may send, over all its streams.
        vehicle_bytes_per_s: How many bytes these may have.
        log: console lines, json lines, or auto: console on a terminal.
        threads: Threads per render; the pictures do not depend on it.
        workers: Frames reconstructed at once.
        decoder: Where packets are decoded. in-process: in the server. child: in processes with
            limits, one a camera. bubblewrap: in sandboxes. auto: in-process if only this machine
            can reach the server, else bubblewrap where it works, else child.
        isa: Instruction set to force (avx512, avx2, scalar); the best of this machine without it.
        ready_file: File that receives HOST:PORT once vehicles are accepted.
        tls_cert: Certificate of this server (PEM); with the next two, plaintext is not taken.
        tls_key: Its private key.
        tls_ca: Certificate of the authority that vouches for vehicles and consumers.
        allow_insecure: Accept plaintext from other machines.
    """
    return ServerConfig(
        fields=fields,
        listen=listen,
        save=save,
        metrics_port=metrics_port,
        metrics_host=metrics_host,
        metrics_per_vehicle=metrics_per_vehicle,
        consumers=ConsumerLimits(max_consumers),
        max_streams=max_streams,
        quota=VehicleQuota(vehicle_streams, vehicle_frames_per_s, vehicle_bytes_per_s),
        log=log,
        threads=threads,
        workers=workers,
        decoder=decoder,
        isa=isa,
        ready_file=ready_file,
        tls=TlsFiles.of(tls_cert, tls_key, tls_ca),
        allow_insecure=allow_insecure,
    )


def main() -> None:
    """Parse the command line and serve until SIGTERM or SIGINT; exit 2 on a user's mistake."""
    try:
        config = tyro.cli(run, prog="mec-server", config=(tyro.conf.EnumChoicesFromValues,))
        configure_logs(sys.stderr, config.log)
        asyncio.run(serve(config))
    except (RfedgeError, OSError) as error:
        print(f"mec-server: {error}", file=sys.stderr)
        sys.exit(2)


async def serve(config: ServerConfig) -> None:
    """Serve until told to stop, then drain."""
    server = EdgeServer(config)
    stopped = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    await server.start()
    await stopped.wait()
    await server.stop()


if __name__ == "__main__":
    main()
