"""From a captured picture to a packet: convert, render, encode. Runs on the encoder's thread.

A vehicle's camera hands its picture over in memory. Here it comes from a dataset, so it is loaded
before any timing of the sender starts. The encoder's state is a value. Its numbering starts afresh
whenever the session asks for another epoch; the frames it made last are kept, so that the session
can say from which one to go on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from cav_agent.deadline import FixedRung, Rungs
from cav_agent.frames import Capture, EncodedFrame, EncodeJob, RigPose
from cav_agent.lights import TileLights
from cav_agent.rig_poses import RigPoses, TrackedRig
from rfcore.camera import Camera, Intrinsics, Pose, camera_on_rig
from rfcore.codec.h264.config import CodecConfig, LightChange
from rfcore.codec.h264.header import StreamHeader
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice, without_field
from rfcore.codec.sender.ladder import Rung
from rfcore.codec.sender.rate import RateModel, RateTarget
from rfcore.codec.state import KEPT_FRAMES, EncoderState, Past
from rfcore.errors import InvalidInput
from rfcore.field import Quality, Renderer, render_field_view
from rfcore.image import I420, Rgb
from rfcore.localise.estimate import PoseEstimate
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView, PosedPicture
from rfcore.wire.checks import MAX_PAYLOAD_BYTES

__all__ = ["CameraPoses", "OnRig", "Pipeline", "PipelineOptions", "Tracking"]

ClockNs = Callable[[], int]


class CameraPoses(Protocol):
    """Says where the camera is (``cav_agent.pose_feed``, ``cav_agent.live``)."""

    def camera(self, capture: Capture) -> Camera:
        """Return a picture's camera, its pose rounded as it is sent; raise ``RfedgeError``."""


class Tracking(Protocol):
    """Finds the camera in the field (``cav_agent.tracking``)."""

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> PoseEstimate:
        """Return what is known of a picture's pose."""


@dataclass(frozen=True)
class OnRig:
    """A camera's place on a rig, and what says where that is.

    ``reference``: of the camera by whose pictures the rig is found in the field, who finds it.
    """

    camera_from_rig: Pose
    poses: RigPoses
    reference: TrackedRig | None = None


@dataclass(frozen=True)
class Placed:
    """What the field shows where a picture was taken; ``view`` ``None``: its camera is lost."""

    view: FieldView | None
    fix: PoseEstimate | None = None
    world_from_rig: RigPose | None = None


@dataclass(frozen=True)
class PipelineOptions:
    """How frames are coded beyond the codec's configuration."""

    limit_bytes: int = MAX_PAYLOAD_BYTES
    """A larger slice is coded again at a higher CRF, as long as there is one."""
    rungs: Rungs | None = None
    """Says on which rung each frame is coded; ``None``: the effort, with every reference."""
    qp_map: QpMap | None = None
    """Applies to every frame."""
    feed: CameraPoses | None = None
    """Says where the camera is; ``None``: the drive's own poses."""
    tracking: Tracking | None = None
    """Finds each frame's pose in the field; ``None``: it is coded at the measured one."""
    on_rig: OnRig | None = None
    """Of a rig's camera; then the two above are not used."""
    threads: int = 1
    """The encoder's; the renderer has its own."""
    lights: TileLights | None = None
    """Fields of other lights, of which the nearest is coded against; ``tracking`` renders them,
    too."""
    check_decode: bool = False
    """Decode every slice on the vehicle, too, to see that it is what its coder promised."""
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
        self._rungs = options.rungs or FixedRung(Rung(effort=config.effort))
        self._encoder = DeltaEncoder(
            config, clock_ns, options.threads, check_decode=options.check_decode
        )
        self._state: EncoderState | None = None
        self._rate = RateModel()
        self._pasts: dict[tuple[int, int] | None, Past] = {}

    @property
    def header(self) -> StreamHeader:
        """What the server needs before the first packet."""
        return self._encoder.header

    def encode(self, job: EncodeJob) -> EncodedFrame:
        """Return the packet of ``job``'s picture.

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
        placed = self._placed(job, frame, rung)
        field_id = "" if self._lights is None else self._lights.named_id
        stage_s["render" if placed.fix is None else "track"] = watch.lap_s()
        state = self._state_for(job)
        choice = self._choice(job, rung)
        if placed.view is None:
            choice = without_field(choice, state)
        view = placed.view or FieldView.nothing(picture.camera.intrinsics)
        encoded = self._encoder.encode(state, frame, view, choice)
        self._remember(encoded)
        stage_s |= {stage: ns / 1e9 for stage, ns in encoded.stage_ns.items()}
        pose = view.camera.world_from_cam
        made = EncodedFrame(
            packet=encoded.packet,
            stage_s=stage_s,
            tries=encoded.tries,
            rung=rung,
            crf=encoded.crf,
            pose=pose,
            read_s=read_s,
            fix=placed.fix,
            waited_s=waited_s,
            field_id=field_id,
            world_from_rig=placed.world_from_rig,
        )
        self._rungs.coded(
            made.sender_s,
            self._clock_ns() / 1e9,
            job.capture.instant,
            in_field=placed.view is not None and rung is self._rungs.current,
        )
        return made

    def _drawable(self, rung: Rung) -> Rung:
        """Return the rung, at a lower level of detail while only a part of the field is here."""
        if self._lights is None:
            return rung
        quality = self._lights.drawable(rung.quality)
        return rung if quality == rung.quality else replace(rung, quality=quality)

    def _placed(self, job: EncodeJob, frame: I420, rung: Rung) -> Placed:
        """Return what the field shows at the pose to send, and how that was found, if it was."""
        options, picture = self._options, job.capture.picture
        if options.on_rig is not None:
            return self._placed_on_rig(job.capture, frame, rung, options.on_rig)
        if options.tracking is not None:
            fix = options.tracking.locate(job.capture, frame, rung)
            return Placed(self._in_its_light(frame, fix.view, rung.quality), fix)
        camera = picture.camera if options.feed is None else options.feed.camera(job.capture)
        return Placed(self._view(frame, camera, rung.quality))

    def _placed_on_rig(self, capture: Capture, frame: I420, rung: Rung, on_rig: OnRig) -> Placed:
        """Render at the pose that the rig's gives the camera: the very one its receiver finds."""
        fix = None
        if on_rig.reference is not None:
            fix = on_rig.reference.locate(capture, frame, rung)
        sent = on_rig.poses.at(capture)
        if sent.world_from_rig is None:
            return Placed(None, fix, sent)
        pose = camera_on_rig(sent.world_from_rig, on_rig.camera_from_rig)
        camera = Camera(capture.picture.camera.intrinsics, pose)
        return Placed(self._view(frame, camera, rung.quality), fix, sent)

    def _view(self, frame: I420, camera: Camera, quality: Quality) -> FieldView:
        """Return what the field shows, of its lights the one that the frame was taken in."""
        if self._lights is not None:
            return self._lights.view(frame, camera, quality)
        return render_field_view(self._renderer, camera, quality)

    def _in_its_light(
        self, frame: I420, view: FieldView | None, quality: Quality
    ) -> FieldView | None:
        """Return the view of a camera that was found, or what a light that fits it better shows."""
        if view is None or self._lights is None:
            return view
        return self._lights.fitting(frame, view, quality)

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
