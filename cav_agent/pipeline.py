"""Turns a captured picture into a packet: convert, render, encode. Runs on the encoder's thread.

A vehicle's camera delivers its picture in memory. A dataset's picture is loaded before any timing
of the sender starts. The encoder's state is a value. Its numbering starts afresh with each epoch
that the session begins; the last frames are kept, so that the session can choose which one to
predict from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from cav_agent.camera_poses import CameraLocation, CameraPoses, DatasetPoses, KnownPoses
from cav_agent.deadline import FixedRung, Rungs
from cav_agent.frames import Capture, EncodedFrame, EncodeJob
from cav_agent.lights import TileLights
from rfcore.camera import Intrinsics
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig, LightChange
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.references import KEPT_FRAMES, RENDER_ONLY, EncoderState, Past
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice, without_field
from rfcore.codec.sender.ladder import Rung
from rfcore.codec.sender.rate import RateModel, RateTarget
from rfcore.errors import InvalidInput
from rfcore.field import Quality, Renderer, render_field_view
from rfcore.image import I420, Rgb
from rfcore.metrics import mean_squared_error
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView, PosedPicture
from rfcore.wire.messages import FrameAddress, PoseAhead
from rfcore.wire.values import MAX_PAYLOAD_BYTES

ClockNs = Callable[[], int]


@dataclass(frozen=True)
class PipelineOptions:
    """Options of coding beyond the codec's configuration."""

    limit_bytes: int = MAX_PAYLOAD_BYTES
    """A larger slice is coded again at a higher CRF, as long as there is one."""
    rungs: Rungs | None = None
    """Says on which rung each frame is coded; ``None``: the effort, with every reference."""
    qp_map: QpMap | None = None
    """Applies to every frame."""
    poses: CameraPoses | None = None
    """Says where the camera is; ``None``: the drive's own poses."""
    threads: int = 1
    """The encoder's; the renderer has its own."""
    lights: TileLights | None = None
    """Fields of other lights, of which the nearest is coded against."""
    check_decode: bool = False
    """Decode every slice on the vehicle, too, to check what its coder promised."""
    light: LightChange = LightChange.AUTO
    """Whether the render's light may be changed before it is predicted from."""


class Stopwatch:
    """Splits time into laps."""

    def __init__(self, clock_ns: ClockNs) -> None:
        self._clock_ns = clock_ns
        self._lap_began_ns = clock_ns()

    def lap_s(self) -> float:
        """Return the seconds since the last lap ended, and begin another."""
        began_ns, self._lap_began_ns = self._lap_began_ns, self._clock_ns()
        return (self._lap_began_ns - began_ns) / 1e9


class Pipeline:
    """Codes the pictures of one camera against renders of one field; one caller at a time."""

    def __init__(
        self,
        renderer: Renderer,
        config: CodecConfig,
        clock_ns: ClockNs,
        options: PipelineOptions | None = None,
    ) -> None:
        self._renderer = renderer
        self._config = config
        self._lights = None if options is None else options.lights
        self._clock_ns = clock_ns
        self._options = options = options or PipelineOptions()
        self._poses = options.poses or KnownPoses(DatasetPoses())
        self._rungs = options.rungs or FixedRung(Rung(effort=config.effort))
        self._encoder = DeltaEncoder(
            config, clock_ns, options.threads, check_decode=options.check_decode
        )
        self._state: EncoderState | None = None
        self._rate = RateModel()
        self._pasts: dict[tuple[int, int] | None, Past] = {}

    @property
    def header(self) -> StreamHeader:
        """Return what the server needs before the first packet."""
        return self._encoder.header

    def encode(
        self, job: EncodeJob, announce: Callable[[PoseAhead], None] = lambda _: None
    ) -> EncodedFrame:
        """Return the packet of ``job``'s picture; call ``announce`` once its pose is known.

        Raises ``DatasetError`` for a picture that cannot be read, ``InvalidInput`` for one of
        another size, ``CodecError`` when coding fails, ``RfedgeError`` before a feed's first pose.
        """
        watch = Stopwatch(self._clock_ns)
        picture = job.capture.picture
        rgb = self._read(picture)
        read_s = watch.lap_s()
        rung = self._drawable(self._rungs.current)
        frame = i420_from_rgb(rgb)
        stage_s = {"convert": watch.lap_s()}
        waited_s, received_s = 0.0, job.capture.received_s
        if received_s is not None:  # a live camera's picture is undistorted here: part of the delay
            stage_s, read_s = {"read": read_s} | stage_s, 0.0
            waited_s = job.started_s - received_s
        location = self._poses.locate(job.capture, frame, rung)
        state = self._state_for(job)
        if location.pose is not None:
            announce(self._ahead(job.capture, location, rung.quality, state))
        shown = self._view(frame, location, rung.quality)
        field_id = self._field_id
        stage_s["render" if location.fix is None else "track"] = watch.lap_s()
        choice = self._choice(job, rung)
        if shown is None:
            choice = without_field(choice, state)
        view = shown or FieldView.nothing(picture.camera.intrinsics)
        encoded = self._encoder.encode(state, frame, view, choice)
        self._remember(encoded)
        stage_s |= {stage: ns / 1e9 for stage, ns in encoded.stage_ns.items()}
        made = EncodedFrame(
            packet=encoded.packet,
            stage_s=stage_s,
            pose=location.pose,
            pose_state=location.state,
            fix=location.fix,
            tries=encoded.tries,
            rung=rung,
            crf=encoded.crf,
            read_s=read_s,
            waited_s=waited_s,
            field_id=field_id,
            luma_mse=mean_squared_error(encoded.reconstruction.y, frame.y),
        )
        self._rungs.coded(
            made.sender_s,
            self._clock_ns() / 1e9,
            job.capture.instant,
            in_field=shown is not None and rung is self._rungs.current,
        )
        return made

    @property
    def _field_id(self) -> str:
        return "" if self._lights is None else self._lights.named_id

    def _ahead(
        self, capture: Capture, location: CameraLocation, quality: Quality, state: EncoderState
    ) -> PoseAhead:
        return PoseAhead(
            capture.camera_id,
            state.epoch,
            state.next_sequence,
            capture.capture_time_ns,
            location.pose,
            self._field_id,
            quality,
            capture.clock,
            location.state,
            capture.instant,
        )

    def encode_picture(
        self, picture: PosedPicture, epoch: int = 0, base: FrameAddress | None = None
    ) -> DeltaPacket:
        """Return the packet of a picture that belongs to no session, as for a load test."""
        capture = Capture("", 0, picture, 0.0, 0)
        return self.encode(EncodeJob(capture, epoch, 1, base)).packet

    def _drawable(self, rung: Rung) -> Rung:
        """Return the rung, at a lower level of detail while only a part of the field is here."""
        if self._lights is None:
            return rung
        quality = self._lights.drawable(rung.quality)
        return rung if quality == rung.quality else replace(rung, quality=quality)

    def _view(self, frame: I420, location: CameraLocation, quality: Quality) -> FieldView | None:
        """Return what the field shows in the light that the frame was taken in; None if lost."""
        lights, view = self._lights, location.view
        if view is not None:
            return view if lights is None else lights.fitting(frame, view, quality)
        if location.camera is None:
            return None
        if lights is not None:
            return lights.view(frame, location.camera, quality)
        return render_field_view(self._renderer, location.camera, quality)

    def _choice(self, job: EncodeJob, rung: Rung) -> FrameChoice:
        budget, limit_bytes = job.budget, self._options.limit_bytes
        if budget is not None:
            limit_bytes = min(limit_bytes, budget.limit_bytes)
        changes_light = rung.photometric and self._options.light is LightChange.AUTO
        return FrameChoice(
            references=None if rung.references else RENDER_ONLY,
            photometric=None if changes_light else (),
            max_references=max(1, rung.references),
            block_means=not job.exact,
            limit_bytes=limit_bytes,
            effort=rung.effort,
            qp_map=self._options.qp_map,
            target=None if budget is None else RateTarget(budget.target_bytes, self._rate),
        )

    def _state_for(self, job: EncodeJob) -> EncoderState:
        """Return the state to encode in; a base that is no longer kept counts as none."""
        state = self._state
        if state is None or state.epoch != job.epoch:
            state = self._encoder.start(job.epoch)
        base = None if job.base is None else (job.base.epoch, job.base.sequence)
        return replace(state, past=self._pasts.get(base))

    def _remember(self, encoded: Encoded) -> None:
        self._state = encoded.state
        self._rate = encoded.rate or self._rate
        made = encoded.state.past
        if made is not None:
            self._pasts[encoded.packet.epoch, encoded.packet.sequence] = made
        while len(self._pasts) > KEPT_FRAMES:
            del self._pasts[next(iter(self._pasts))]

    def _read(self, picture: PosedPicture) -> Rgb:
        k: Intrinsics = picture.camera.intrinsics
        if (k.width_px, k.height_px) != self._config.size_px:
            raise InvalidInput(
                picture.name,
                f"{k.width_px}x{k.height_px} px, the stream is coded at "
                f"{self._config.width_px}x{self._config.height_px} px",
            )
        return picture.read()
