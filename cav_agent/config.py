"""The agent's options and limits; parsed and checked once, in ``__main__``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from tyro.conf import Suppress, arg

from cav_agent.live.settings import LiveSettings
from cav_agent.pose_feed.sources import PoseFeedSettings
from rfcore.codec.h264.config import CRF_RANGE, CoderSettings
from rfcore.codec.h264.qp_map import MaskSettings
from rfcore.errors import InvalidInput
from rfcore.named_class import is_named_class
from rfcore.wire.settings import (
    OPTIONS_FILE,
    LogForm,
    MetricsSettings,
    RenderSettings,
    TransportSettings,
)
from rfcore.wire.values import check_field_id, check_name


@dataclass(frozen=True)
class AgentLimits:
    """Time limits in seconds, and how many pictures may wait for the encoder."""

    greeting_s: Annotated[float, Suppress] = 10.0
    """Longest time from Hello to Welcome."""
    answer_s: Annotated[float, Suppress] = 5.0
    """Longest time from encoding to Ack or Nack before the stream is given up; less once the
    server's usual time is known (``AnswerTimeout``)."""
    stall_s: Annotated[float, Suppress] = 1.0
    """Longest pause of a server beyond its usual time."""
    give_up_s: Annotated[float, arg(name="give-up-s")] = 0.0
    """Seconds without any server after which the drive ends with an error; 0: never."""
    drain_s: Annotated[float, Suppress] = 5.0
    """Longest time for the last frames, after ``stop`` and at the end of the drive."""
    slot_frames: Annotated[int, Suppress] = 1
    """Instants that may wait for the encoder."""

    def __post_init__(self) -> None:
        for name in ("greeting_s", "answer_s", "stall_s"):
            if not getattr(self, name) > 0:
                raise InvalidInput(f"limits.{name}", f"{getattr(self, name)} must be above 0 s")
        for name in ("give_up_s", "drain_s"):
            if not getattr(self, name) >= 0:
                raise InvalidInput(f"limits.{name}", f"{getattr(self, name)} must not be negative")
        if not 1 <= self.slot_frames <= 2:
            raise InvalidInput("limits.slot_frames", f"{self.slot_frames} is outside 1..2")


class PaceKind(StrEnum):
    """The rule by which the next picture is captured."""

    LOCKSTEP = "lockstep"
    REALTIME = "realtime"


@dataclass(frozen=True)
class AgentConfig:
    """Send a drive to an edge server, as differences to a radiance field that both hold."""

    server: str
    """HOST:PORT of mec-server (or of `rfedge link` in front of it)."""
    drive: Path | None = None
    """Dataset in time order: a transforms.json, or the folder of the only one."""
    fields: Path = Path("~/.cache/rfedge/fields")
    """Directory of field archives; a field the server has is fetched into it."""
    rig: Path | None = None
    """Instead of --drive: a rig file, several cameras in one session, each with its drive or source
    (docs/how-to/cameras.md)."""
    neighbours: tuple[str, ...] = ()
    """HOST:PORT of further servers along the drive: the vehicle is handed over from tile to tile,
    and to a neighbour whose tile covers it when a server is lost."""
    camera: str = "front"
    """Name of the camera on the wire."""
    rate: float = 10.0
    """Pictures per second in realtime pace."""
    loop: bool = False
    """Begin again after the last picture."""
    pace: PaceKind = PaceKind.REALTIME
    """realtime: capture at the rate, drop what the link cannot take. lockstep: capture the next
    picture when the previous was answered."""
    field: str | None = None
    """Field id (sha256), or MODULE:CLASS of a class of your own that renders it
    (docs/how-to/python.md); without it, what servers publish or the only field they have."""
    vehicle: str = "cav-1"
    """Name of the vehicle on the wire."""
    allow_recording: bool = False
    """Let servers keep the pictures on disk, if they record (`mec-server --record`)."""
    crf: float = 23.0
    """H.264 quality, 1 (best) to 51; 6 more double the quantiser's step."""
    coding: CoderSettings = CoderSettings()
    max_delay_ms: float | None = None
    """Longest time from capture to Ack; quality falls below --crf to keep it, and pictures are
    dropped when the lowest quality cannot. Without it every frame has --crf."""
    fetch_share: float = 0.5
    """Share of the link that fetching a field may take while pictures are sent, 0.05 to 1."""
    pose_with_frame: bool = False
    """Send poses with their frames alone. Otherwise they go ahead, so that the server renders while
    the vehicle codes, as long as that shows pictures sooner."""
    deadline_ms: float | None = None
    """Milliseconds a frame may take on this machine, from the picture to the packet: the best rung
    of the ladder that keeps it is used, a lower one under load, in place of the effort."""
    ladder: Path | None = None
    """The rungs with their times and rates, as `rfedge eval ladder` measured them; default: those
    that ship, measured on the sample street."""
    masking: MaskSettings = MaskSettings()
    notices: Path | None = None
    """Ask servers what others see ahead and what changed about the map, and hand it on: a Unix
    socket at this path that gives its readers a line of JSON for each notice
    (docs/how-to/twin.md)."""
    localise: bool = False
    """Find the camera's pose in the field, from what the feed or the dataset says of it, and code
    frames without the field while it is lost; needs the extra localise
    (docs/how-to/localise.md)."""
    feed: PoseFeedSettings = PoseFeedSettings()
    live: LiveSettings = LiveSettings()
    log: LogForm = LogForm.AUTO
    """console lines, json lines, or auto: console on a terminal."""
    config: Annotated[Path | None, OPTIONS_FILE] = None
    """Take options from this TOML file, too: KEY = VALUE, as rate = 5. The command line wins."""
    report: Path | None = None
    """File for one JSON line per picture."""
    render: RenderSettings = RenderSettings()
    metrics: MetricsSettings = MetricsSettings()
    transport: TransportSettings = TransportSettings()
    limits: AgentLimits = AgentLimits()

    def __post_init__(self) -> None:
        given = [self.drive, self.live.source, self.rig]
        if given.count(None) != 2:
            raise InvalidInput("drive", "give exactly one of --drive, --source and --rig")
        if self.live.source is not None and self.pace is not PaceKind.REALTIME:
            raise InvalidInput("pace", f"{self.pace}: a live camera does not wait, use realtime")
        if self.rig is not None and self.masking.mask is not None:
            raise InvalidInput("mask", "the masks of a rig stand in its file")
        check_name("camera", self.camera)
        check_name("vehicle", self.vehicle)
        if self.field is not None and not is_named_class(self.field):
            check_field_id("field", self.field)
        if not 0.01 <= self.rate <= 1000:
            raise InvalidInput("rate", f"{self.rate} Hz is outside 0.01..1000 Hz")
        if not CRF_RANGE[0] <= self.crf <= CRF_RANGE[1]:
            raise InvalidInput("crf", f"{self.crf} is outside {CRF_RANGE[0]:g}..{CRF_RANGE[1]:g}")
        if self.max_delay_ms is not None and not 10 <= self.max_delay_ms <= 60_000:
            raise InvalidInput("max_delay_ms", f"{self.max_delay_ms} ms is outside 10..60000 ms")
        if not 0.05 <= self.fetch_share <= 1:
            raise InvalidInput("fetch_share", f"{self.fetch_share} is outside 0.05..1")
        if self.deadline_ms is not None and not 1 <= self.deadline_ms <= 60_000:
            raise InvalidInput("deadline_ms", f"{self.deadline_ms} ms is outside 1..60000 ms")
