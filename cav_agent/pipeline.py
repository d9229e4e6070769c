"""From a captured picture to a packet: convert, render, encode. Runs on the encoder's thread.

A vehicle's camera hands its picture over in memory. Here it comes from a dataset, so it is loaded
before any timing of the sender starts. The encoder's state is a value. Its numbering starts afresh
whenever the session asks for another epoch; the frames it made last are kept, so that the session
can say from which one to go on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from cav_agent.deadline import FixedRung, Rungs
from cav_agent.frames import EncodedFrame, EncodeJob
from rfcore.camera import Camera, Intrinsics
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.header import StreamHeader
from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.codec.sender.frame_costs import FrameCosts
from rfcore.codec.sender.ladder import Rung
from rfcore.codec.sender.pose_search import PoseSearch, Refined
from rfcore.codec.sender.rate import RateModel, RateTarget
from rfcore.codec.sender.steering import NO_STEERING, Steering
from rfcore.codec.state import KEPT_FRAMES, EncoderState, Past
from rfcore.errors import InvalidInput
from rfcore.field import Quality, Renderer, render_field_view
from rfcore.image import I420, Rgb
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import FieldView, PosedPicture
from rfcore.wire.checks import MAX_PAYLOAD_BYTES

__all__ = ["Pipeline", "PipelineOptions"]

ClockNs = Callable[[], int]


@dataclass(frozen=True)
class PipelineOptions:
    """How frames are coded beyond the codec's configuration."""

    limit_bytes: int = MAX_PAYLOAD_BYTES
    """A larger slice is coded again at a higher CRF, as long as there is one."""
    rungs: Rungs | None = None
    """Says on which rung each frame is coded; ``None``: the preset, with every reference."""
    steering: Steering = NO_STEERING
    """Applies to every frame."""
    threads: int = 1
    """The encoder's; the renderer has its own."""


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
        self._clock_ns = clock_ns
        self._options = options = options or PipelineOptions()
        self._rungs = options.rungs or FixedRung(Rung(preset=config.preset))
        self._encoder = DeltaEncoder(config, clock_ns, options.threads)
        self._state: EncoderState | None = None
        self._rate = RateModel()
        refine_ms = options.steering.refine_pose_ms
        self._search = None if refine_ms is None else PoseSearch(refine_ms, clock_ns)
        self._pasts: dict[tuple[int, int] | None, Past] = {}

    @property
    def header(self) -> StreamHeader:
        """What the server needs before the first packet."""
        return self._encoder.header

    def encode(self, job: EncodeJob) -> EncodedFrame:
        """Return the packet of ``job``'s picture.

        Raises ``DatasetError`` for a picture that cannot be read, ``InvalidInput`` for one of
        another size, ``CodecError`` when x264 fails.
        """
        watch = Stopwatch(self._clock_ns)
        picture = job.capture.picture
        rgb = self._read(picture)
        read_s = watch.lap_s()
        rung = self._rungs.current
        frame = i420_from_rgb(rgb)
        stage_s = {"convert": watch.lap_s()}
        view = render_field_view(self._renderer, picture.camera, rung.quality)
        stage_s["render"] = watch.lap_s()
        refined = Refined(view, FrameCosts(frame))
        if self._search is not None:
            refined = self._refined(self._search, frame, view, rung.quality)
            stage_s["refine"] = watch.lap_s()
        choice = self._choice(job, rung)
        state = self._state_for(job)
        encoded = self._encoder.encode(state, frame, refined.view, choice, refined.costs)
        self._remember(encoded)
        stage_s |= {stage: ns / 1e9 for stage, ns in encoded.stage_ns.items()}
        pose = refined.view.camera.world_from_cam
        made = EncodedFrame(encoded.packet, stage_s, encoded.tries, rung, encoded.crf, pose, read_s)
        self._rungs.coded(made.sender_s, self._clock_ns() / 1e9)
        return made

    def _refined(
        self, search: PoseSearch, frame: I420, measured: FieldView, quality: Quality
    ) -> Refined:
        """Return what the field shows at the pose to send."""
        crf = self._config.crf if self._rate.crf is None else self._rate.crf

        def render_at(camera: Camera) -> FieldView:
            return render_field_view(self._renderer, camera, quality)

        return search.refine(frame, measured, render_at, crf)

    def _choice(self, job: EncodeJob, rung: Rung) -> FrameChoice:
        budget, limit_bytes = job.budget, self._options.limit_bytes
        if budget is not None:
            limit_bytes = min(limit_bytes, budget.limit_bytes)
        return FrameChoice(
            references=None if rung.references else RENDER_ONLY,
            photometric=None if rung.photometric else (),
            max_references=max(1, rung.references),
            block_means=not job.exact,
            limit_bytes=limit_bytes,
            preset=rung.preset,
            fast_unsent=rung.fast_unsent,
            qp_map=self._options.steering.qp_map,
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
