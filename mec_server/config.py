"""The edge server's configuration; parsed once, in ``__main__``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from tyro.conf import Suppress, arg

from rfcore.errors import InvalidInput
from rfcore.update.run import LearnAs
from rfcore.wire.nats import NatsServers
from rfcore.wire.settings import (
    OPTIONS_FILE,
    LogForm,
    MetricsSettings,
    RenderSettings,
    TransportSettings,
)
from rfcore.wire.values import MAX_RATE_HZ, check_name, check_range


class DecoderKind(StrEnum):
    """The process that decodes packets (``rfcore.confinement``). AUTO decodes in the server if only
    this machine can reach it, otherwise under bubblewrap where that works, otherwise under
    Landlock."""

    AUTO = "auto"
    IN_PROCESS = "in-process"
    CHILD = "child"
    LANDLOCK = "landlock"
    BUBBLEWRAP = "bubblewrap"


@dataclass(frozen=True)
class SessionLimits:
    """Deadlines and the window of one session.

    ``window_frames``: frames of one camera in flight or being decoded; two keep the link busy while
    one is decoded, more would only add delay. ``stalled_s``: a peer that took no answer for this
    long is disconnected.
    """

    hello_s: float = 5.0
    idle_s: float = 60.0
    stalled_s: float = 10.0
    window_frames: int = 2

    def __post_init__(self) -> None:
        for name in ("hello_s", "idle_s", "stalled_s"):
            if not getattr(self, name) > 0:
                raise InvalidInput(f"limits.{name}", f"{getattr(self, name)} must be above 0 s")
        check_range("limits.window_frames", self.window_frames, 1, 64)


@dataclass(frozen=True)
class IdentityBudget:
    """The most that one identity (certificate) may use over all its connections: far above the
    needs of a correct one, far below what would starve the others."""

    share: Annotated[float, arg(name="identity-share")] = 0.5
    """Share of the server's budgets, and of the workers' time when others want it, that one
    identity may have, whatever the limits below are."""
    streams: Annotated[int, arg(name="identity-streams")] = 8
    """Streams of frames."""
    decoders: Annotated[int, arg(name="identity-decoders")] = 40
    """Decoders (processes) of all its cameras: a rig of 18 on two streams, as during a handover;
    a camera above 1920x1088 counts as several."""
    fetches: Annotated[int, arg(name="identity-fetches")] = 2
    """Fields it may be fetching."""
    watches: Annotated[int, arg(name="identity-consumers")] = 4
    """Consumers of the twin."""
    rpcs: Annotated[int, arg(name="identity-rpcs")] = 32
    """Calls in progress, of any kind."""
    calls_per_s: Annotated[float, arg(name="identity-calls-per-s")] = 50.0
    """Calls that it may begin in a second."""
    messages_per_s: Annotated[float, arg(name="identity-messages-per-s")] = 1200.0
    """Messages that it may send on its streams in a second, parsable or not."""
    bytes_per_s: Annotated[float, arg(name="identity-bytes-per-s")] = 32e6
    """Bytes that these messages may have in a second."""
    rejected_workers: Annotated[float, arg(name="identity-rejected-workers")] = 0.2
    """Workers that its rejected frames may keep busy while others want them. A correct vehicle
    whose packets are lost uses a quarter of it."""

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise InvalidInput("identity-share", f"{self.share:g} is outside 0..1")
        if not 0 < self.rejected_workers <= 256:
            raise InvalidInput(
                "identity-rejected-workers", f"{self.rejected_workers:g} is outside 0..256"
            )
        for name in ("streams", "decoders", "fetches", "watches", "rpcs"):
            check_range(f"identity.{name}", getattr(self, name), 1, 100_000)
        for name in ("calls_per_s", "messages_per_s", "bytes_per_s"):
            check_range(f"identity.{name}", getattr(self, name), 1, 1e12)


@dataclass(frozen=True)
class ServerBudget:
    """The most that all identities together may use."""

    streams: Annotated[int, arg(name="max-streams")] = 256
    """Streams of vehicles that may be open at once."""
    decoders: Annotated[int, arg(name="max-decoders")] = 0
    """Decoders that may be open at once. 0: as many as fit into memory, 48 MiB each."""
    fetches: Annotated[int, arg(name="max-fetches")] = 16
    """Fields that may be sent at once."""
    watches: Annotated[int, arg(name="max-consumers")] = 8
    """Consumers that may watch at once."""
    rpcs: Annotated[int, arg(name="max-rpcs")] = 512
    """Calls of any kind that may be in progress."""
    calls_per_s: Annotated[float, arg(name="max-calls-per-s")] = 1000.0
    """Calls that may begin in a second."""
    messages_per_s: Annotated[float, arg(name="max-messages-per-s")] = 20_000.0
    """Messages that vehicles may send in a second."""
    bytes_per_s: Annotated[float, arg(name="max-bytes-per-s")] = 1e9
    """Bytes that these messages may have in a second."""

    def __post_init__(self) -> None:
        for name in ("streams", "fetches", "rpcs"):
            check_range(f"max-{name}", getattr(self, name), 1, 100_000)
        for name in ("decoders", "watches"):
            check_range(f"max-{name}", getattr(self, name), 0, 100_000)
        for name in ("calls_per_s", "messages_per_s", "bytes_per_s"):
            check_range(f"max-{name}", getattr(self, name), 1, 1e12)


@dataclass(frozen=True)
class AdmissionLimits:
    """The workers' time that is promised to vehicles (``mec_server.ledger.promises``)."""

    load: Annotated[float, arg(name="max-load")] = 0.8
    """Share of the workers' time that vehicles are promised; beyond it they get a lower rate, or
    are asked to come again. 0: every vehicle is let in."""
    lowest_hz: Annotated[float, arg(name="lowest-rate")] = 2.0
    """Lowest rate in pictures per second; a vehicle for which only less is left is refused."""
    render_deadline_s: Annotated[float, arg(name="render-deadline")] = 5.0
    """Seconds from a frame's arrival to the expected end of its decoding; one that would take
    longer is refused unrendered. After 5 s its vehicle has given it up."""
    retry_s: Annotated[float, Suppress] = 5.0

    def __post_init__(self) -> None:
        check_range("max-load", self.load, 0, 1)
        if not 0 < self.lowest_hz <= MAX_RATE_HZ:
            raise InvalidInput("lowest-rate", f"{self.lowest_hz:g} is outside 0..{MAX_RATE_HZ:g}")
        if not self.render_deadline_s > 0:
            raise InvalidInput("render-deadline", f"{self.render_deadline_s:g} must be above 0 s")
        if not self.retry_s > 0:
            raise InvalidInput("retry_s", f"{self.retry_s:g} must be above 0 s")


@dataclass(frozen=True)
class RecordSettings:
    """Recording of what vehicles send, as far as they allow it (`cav-agent --allow-recording`)."""

    folder: Annotated[Path | None, arg(name="record", metavar="FOLDER")] = None
    """Record pictures, poses and times as datasets: FOLDER/VEHICLE/CAMERA/PART
    (docs/how-to/data.md). Without it nothing is recorded."""
    max_gb: Annotated[float, arg(name="record-max-gb")] = 10.0
    """Size limit of all recordings in the folder, in 10^9 bytes; the tile and the vehicle with most
    lose their oldest parts first."""
    max_age_h: Annotated[float, arg(name="record-max-age-h")] = 72.0
    """Age at which a part is deleted, in hours."""

    def __post_init__(self) -> None:
        check_range("record-max-gb", self.max_gb, 0.01, 1e6)
        check_range("record-max-age-h", self.max_age_h, 0.01, 1e6)


@dataclass(frozen=True)
class LearnSettings:
    """Learning from recordings: other lights of the tiles, and changes of the street."""

    on: Annotated[bool, arg(name="learn")] = False
    """Learn from what is recorded (--record), in a process of its own while a processor is idle,
    and publish what makes bits fall into the folder of fields (docs/how-to/fields.md)."""
    learn_as: Annotated[LearnAs, arg(name="learn-as")] = LearnAs.COLOURS
    """Another light as colours (a layer on the tile's field), as delta (all parameters, as their
    difference to the tile's field) or as all (a field of its own)."""
    min_identities: Annotated[int, arg(name="learn-min-identities")] = 2
    """Least number of vehicles to learn from."""
    cpu_s_per_h: Annotated[float, arg(name="learn-cpu-s-per-h")] = 900.0
    """CPU time that learning about one tile may take in an hour, in seconds of one core."""
    max_gb: Annotated[float, arg(name="learn-max-gb")] = 1.0
    """Size limit of all learnt archives, in 10^9 bytes; the oldest that are not current are
    deleted."""
    max_age_h: Annotated[float, arg(name="learn-max-age-h")] = 24.0
    """Greatest age of recordings to learn from, in hours."""
    quiet_s: Annotated[float, arg(name="learn-quiet-s")] = 20.0
    """A pass is over, and is learnt from, after nothing was recorded of it for this many
    seconds."""

    def __post_init__(self) -> None:
        check_range("learn-min-identities", self.min_identities, 1, 1000)
        check_range("learn-cpu-s-per-h", self.cpu_s_per_h, 1.0, 3600.0)
        check_range("learn-max-gb", self.max_gb, 0.001, 1e6)
        check_range("learn-max-age-h", self.max_age_h, 0.01, 1e6)
        check_range("learn-quiet-s", self.quiet_s, 0.1, 3600.0)


@dataclass(frozen=True)
class NatsSettings:
    """One twin of several servers over NATS (docs/how-to/servers.md)."""

    urls: Annotated[str | None, arg(name="nats", metavar="URL[,URL]")] = None
    """Servers of NATS, nats://HOST:PORT or tls://HOST:PORT: publish pictures of vehicles and where
    they are, and exchange fields with the other servers there."""
    name: Annotated[str, arg(name="nats-name", metavar="NAME")] = ""
    """Name of this server there; default: its host's name and its port."""
    login: Annotated[Path | None, arg(name="nats-login", metavar="FILE")] = None
    """File of one line, USER:PASSWORD or a token."""
    authority: Annotated[Path | None, arg(name="nats-ca", metavar="FILE.pem")] = None
    """Certificate of the authority that vouches for NATS."""
    certificate: Annotated[Path | None, arg(name="nats-cert", metavar="FILE.pem")] = None
    """Certificate by which NATS knows this server, as a client."""
    key: Annotated[Path | None, arg(name="nats-key", metavar="FILE.pem")] = None
    """Its private key."""

    def __post_init__(self) -> None:
        if self.name:
            check_name("nats-name", self.name)
        files = (self.name, self.login, self.authority, self.certificate, self.key)
        if self.urls is None and any(files):
            raise InvalidInput("nats", "the other --nats options are for nothing without it")

    def servers(self, allow_insecure: bool) -> NatsServers | None:
        """Return how NATS is reached, None without it; raise ``InvalidInput``."""
        if self.urls is None:
            return None
        return NatsServers(
            NatsServers.parse_urls(self.urls),
            self.login,
            self.authority,
            self.certificate,
            self.key,
            allow_insecure,
        )


MAX_DRAIN_HOLD_S = 600.0


@dataclass(frozen=True)
class ServerConfig:
    """Reconstruct what vehicles see, against the radiance fields held here."""

    fields: Path
    """Directory of field archives (.rff)."""
    listen: str = "127.0.0.1:50051"
    """HOST:PORT to accept vehicles on; port 0 takes a free one."""
    field: Annotated[tuple[str, ...], arg(metavar="MODULE:CLASS ...")] = ()
    """Fields that classes of your own render, beside those of --fields (docs/how-to/python.md)."""
    record: RecordSettings = RecordSettings()
    learn: LearnSettings = LearnSettings()
    nats: NatsSettings = NatsSettings()
    workers: int | None = None
    """Frames reconstructed at once; default: the number of processors, or of those that a
    container's limit grants."""
    decoder: DecoderKind = DecoderKind.AUTO
    """The process that decodes packets. bubblewrap: sandboxes, one for each camera. landlock:
    processes that give up files, network and most system calls. child: processes with limits only.
    in-process: the server. auto: in-process if only this machine can reach the server, else
    bubblewrap where it works, else landlock; never less."""
    sandbox_as_root: bool = False
    """Decode in a sandbox though the server runs as root; refused otherwise."""
    log: LogForm = LogForm.AUTO
    """console lines, json lines, or auto: console on a terminal."""
    config: Annotated[Path | None, OPTIONS_FILE] = None
    """Take options from this TOML file, too: KEY = VALUE, as record_max_gb = 5. The command line
    wins."""
    ready_file: Path | None = None
    """File that receives HOST:PORT once vehicles are accepted."""
    render: RenderSettings = RenderSettings()
    metrics: MetricsSettings = MetricsSettings()
    transport: TransportSettings = TransportSettings()
    no_notices: bool = False
    """Do not warn vehicles that ask (`cav-agent --notices`) of what others see ahead of them
    (docs/how-to/twin.md); warnings cost nothing while none asks."""
    access: Path | None = None
    """File that says what consumers may see and which certificates are revoked (TOML, see
    docs/how-to/operations.md); read again when it changes. Without it consumers see everything."""
    proxy_identity: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Proxies (certificates of spiffe://rfedge/proxy/NAME) whose x-forwarded-client-cert says which
    vehicle a call is of (docs/how-to/servers.md); from everybody else the header means nothing."""
    address_connections: int = 256
    """Connections that one address (for IPv6, one /64) may hold, whoever is behind it; newer ones
    are closed within a quarter of a second. 0: no limit."""
    identity_connections: int = 32
    """Connections that one certificate's identity may hold; newer ones are closed, and their
    address may open none for ten seconds. 0: no limit."""
    max_connection_age_s: float = 86_400.0
    """Age at which a connection is renewed, in seconds; its streams end half a minute later. 0:
    never."""
    drain_hold_s: float = 0.0
    """Seconds after the signal to stop for which health checks say NOT_SERVING before vehicles are
    asked to go to another server: long enough for a proxy to notice (docs/how-to/operations.md). 0:
    vehicles are not asked, and streams end with the frames that were taken."""
    server_budget: ServerBudget = ServerBudget()
    identity_budget: IdentityBudget = IdentityBudget()
    admission: AdmissionLimits = AdmissionLimits()
    drain_s: Annotated[float, Suppress] = 5.0
    limits: Annotated[SessionLimits, Suppress] = SessionLimits()

    def __post_init__(self) -> None:
        check_range("workers", 1 if self.workers is None else self.workers, 1, 256)
        check_range("address-connections", self.address_connections, 0, 65_536)
        check_range("identity-connections", self.identity_connections, 0, 65_536)
        if not (self.max_connection_age_s == 0 or 1 <= self.max_connection_age_s <= 1e6):
            raise InvalidInput(
                "max_connection_age_s", f"{self.max_connection_age_s:g} is neither 0 nor 1..1e6"
            )
        if self.learn.on and self.record.folder is None:
            raise InvalidInput("learn", "there is nothing to learn from; give --record FOLDER, too")
        for name in self.proxy_identity:
            check_name("proxy-identity", name)
        if self.proxy_identity and self.transport.tls() is None:
            raise InvalidInput(
                "proxy-identity", "without certificates no proxy is known; give --tls-cert, too"
            )
        self.nats.servers(self.transport.allow_insecure)
        if not self.fields.is_dir():
            raise InvalidInput("fields", f"{self.fields} is not a directory")
        check_range("drain_hold_s", self.drain_hold_s, 0, MAX_DRAIN_HOLD_S)
        if not self.drain_s >= 0:
            raise InvalidInput("drain_s", f"{self.drain_s} must not be negative")
