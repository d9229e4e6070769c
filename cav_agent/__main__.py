"""``cav-agent``: the vehicle's command."""

from __future__ import annotations

import asyncio
import signal
import sys
from pathlib import Path
from typing import Annotated, Literal

import structlog
import tyro

from cav_agent.config import AgentConfig, PaceKind
from cav_agent.vehicle import Vehicle
from rfcore.errors import RfedgeError
from rfcore.wire.logs import LogForm, configure_logs
from rfcore.wire.tls import TlsFiles

__all__ = ["main"]

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


def run(
    server: str,
    drive: Path,
    fields: Path = Path("~/.cache/rfedge/fields"),
    camera: str = "front",
    rate: float = 10.0,
    loop: Flag = False,
    pace: Literal["lockstep", "realtime"] = "realtime",
    field: str | None = None,
    vehicle: str = "cav-1",
    crf: float = 23.0,
    preset: str = "medium",
    threads: int = 1,
    isa: str | None = None,
    metrics_port: int | None = None,
    metrics_host: str = "127.0.0.1",
    metrics_per_vehicle: Flag = False,
    log: LogForm = LogForm.AUTO,
    report: Path | None = None,
    tls_cert: Path | None = None,
    tls_key: Path | None = None,
    tls_ca: Path | None = None,
    allow_insecure: Flag = False,
) -> AgentConfig:
    """Send a drive to an edge server, as differences to a radiance field that both hold.

    Args:
        server: HOST:PORT of mec-server (or of `rfedge link` in front of it).
        drive: Dataset in time order: a transforms.json, or the folder of the only one.
        fields: Directory of field archives; a field the server has is fetched into it.
        camera: Name of the camera on the wire.
        rate: Pictures per second in realtime pace.
        loop: Begin again after the last picture.
        pace: realtime: capture at the rate, drop what the link cannot take.
            lockstep: capture the next picture when the previous was answered.
        field: Field id (sha256); the server's only field without it.
        vehicle: Name of the vehicle on the wire.
        crf: H.264 quality, 1 (best) to 51; 23 is x264's default.
        preset: x264 preset, ultrafast to veryslow.
        threads: Threads per render; the pictures do not depend on it.
        isa: Instruction set to force (avx512, avx2, scalar); the best of this machine without it.
        metrics_port: Port for Prometheus; none are served without it.
        metrics_host: Address the metrics are served on.
        metrics_per_vehicle: Show the name of the vehicle in the metrics.
        log: console lines, json lines, or auto: console on a terminal.
        report: File for one JSON line per picture.
        tls_cert: Certificate of this vehicle (PEM); it names --vehicle.
        tls_key: Its private key.
        tls_ca: Certificate of the authority that vouches for the server.
        allow_insecure: Send plaintext to another machine.
    """
    return AgentConfig(
        server=server,
        drive=drive,
        fields=fields.expanduser(),
        camera=camera,
        rate=rate,
        loop=loop,
        pace=PaceKind(pace),
        field=field,
        vehicle=vehicle,
        crf=crf,
        preset=preset,
        threads=threads,
        isa=isa,
        metrics_port=metrics_port,
        metrics_host=metrics_host,
        metrics_per_vehicle=metrics_per_vehicle,
        log=log,
        report=report,
        tls=TlsFiles.of(tls_cert, tls_key, tls_ca),
        allow_insecure=allow_insecure,
    )


def main() -> None:
    """Parse the command line and drive; exit 2 with one line when it cannot be done."""
    try:
        config = tyro.cli(run, prog="cav-agent", config=(tyro.conf.EnumChoicesFromValues,))
        configure_logs(sys.stderr, config.log)
        asyncio.run(travel(config))
    except (RfedgeError, OSError) as error:
        print(f"cav-agent: {error}", file=sys.stderr)
        sys.exit(2)


async def travel(config: AgentConfig) -> None:
    """Drive to the end, or until told to stop."""
    vehicle = Vehicle(config)
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, vehicle.stop)
    counts = await vehicle.run()
    structlog.get_logger().info("drive ended", **counts)


if __name__ == "__main__":
    main()
