"""The sender: codes frames as slices against pictures that both ends compute themselves.

States are values: ``encode`` takes one and returns the next, so an error leaves the caller's state
as it was. The encoder object holds only the configuration and a decoder that keeps nothing from one
frame to the next. One caller at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import (
    DEFAULT_REFERENCES,
    REFERENCE_FRAMES,
    CodecConfig,
    check_crf,
    check_effort,
)
from rfcore.codec.h264.qp_map import QpMap, check_qp_map
from rfcore.codec.h264.splice import SpliceDecoder, without_zeros
from rfcore.codec.packet import (
    RECONSTRUCTION_DIGEST_BYTES,
    RENDER_DIGEST_BYTES,
    DeltaPacket,
    block_mean_digest,
)
from rfcore.codec.photometric import Photometric, sent_light
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import (
    INTRA,
    EncoderState,
    Past,
    Reference,
    References,
    check_references,
    is_temporal,
)
from rfcore.codec.sender.picture_coder import CodedPicture, CodingRequest, picture_coder
from rfcore.codec.sender.rate import (
    FittedSlice,
    FrameCosts,
    RateModel,
    RateTarget,
    bits_curve,
    code_to_fit,
)
from rfcore.codec.sender.reference_choice import (
    choose_photometric,
    choose_references,
    light_differs,
    relighting_pays,
    sending_light_pays,
)
from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420
from rfcore.views import FieldView


@dataclass(frozen=True)
class FrameChoice:
    """The coding of one frame. Raises ``InvalidInput`` for choices that contradict each other
    or are out of range."""

    references: References | None = None
    """The pictures to predict from; ``None`` leaves them to the encoder."""
    crf: float | None = None
    """Replaces the configured CRF."""
    photometric: Photometric | None = None
    """The matrix that changes the render's light (``rfcore.codec.photometric``); ``None`` leaves
    the light to the encoder."""
    relight: bool | None = None
    """Map the render to the light of the earlier frame; ``None`` leaves that to the encoder if
    ``photometric`` does, too."""
    light: bytes = b""
    """With ``relight``: map the render to this light instead (``rfcore.codec.photometric``)."""
    pose_only: bool = False
    """Send no slice: the receiver shows the only reference."""
    max_references: int = DEFAULT_REFERENCES
    """Most references that the encoder may choose. With the usual three, it may choose one more
    under the light of the frame before. A stream of x264 never has more than three."""
    block_means: bool = False
    """Send the render's block means, by which a receiver whose renderer is not exact tells rounding
    from a wrong pose."""
    limit_bytes: int | None = None
    """A longer slice is coded again at higher CRFs (``rfcore.codec.sender.rate``); one that is too
    long even at the highest is returned all the same."""
    effort: str | None = None
    """Replaces the configured effort by another one of the same coder."""
    target: RateTarget | None = None
    """The size to aim at by a CRF that is predicted before coding and never below ``crf``."""
    qp_map: QpMap | None = None
    """Codes parts of the frame finer or coarser."""

    def __post_init__(self) -> None:
        if self.effort is not None:
            check_effort("effort", self.effort)
        if self.references is not None:
            check_references(self.references)
        if self.crf is not None:
            check_crf("crf", self.crf)
        if self.limit_bytes is not None and self.limit_bytes < 1:
            raise InvalidInput("limit_bytes", f"{self.limit_bytes} must be at least 1")
        if not 1 <= self.max_references <= REFERENCE_FRAMES:
            raise InvalidInput(
                "max_references", f"{self.max_references} is outside 1..{REFERENCE_FRAMES}"
            )
        if self.relight and self.photometric:
            raise InvalidInput("relight", "photometric already changes the render")
        if self.light and not self.relight:
            raise InvalidInput("light", "of a frame that is not to be relit")
        if self.pose_only and (self.references is None or len(self.references) != 1):
            raise InvalidInput("references", "a pose-only packet names exactly one reference")


LEFT_TO_THE_ENCODER = FrameChoice()


def without_field(choice: FrameChoice, state: EncoderState) -> FrameChoice:
    """Return the choice for a frame whose pose is unknown: it is predicted from the frame before,
    or coded as an intra picture if there is none.

    Its view is ``FieldView.nothing``. The next frame may use the field again.
    """
    references = INTRA if state.past is None else (Reference.PREVIOUS,)
    return replace(choice, references=references, photometric=(), relight=False)


@dataclass(frozen=True)
class Encoded:
    """A packet, the picture that the receiver will show, and the sender's next state.

    ``stage_ns`` has the times of "references" (warp, choice), "encode" (the slice) and
    "closed_loop" (digests, and decoding where that is needed). ``tries``: how many times the frame
    was coded to fit a limit. ``crf``: the CRF of the last try. ``rate``: the target's model,
    updated by this frame.
    """

    packet: DeltaPacket
    reconstruction: I420
    state: EncoderState
    stage_ns: Mapping[str, int]
    tries: int = 1
    crf: float = 0.0
    rate: RateModel | None = None


@dataclass(frozen=True, eq=False)
class _Plan:
    """The references chosen for a frame, and their ``pictures``."""

    prediction: Prediction
    references: References
    pictures: tuple[I420, ...]

    @property
    def needs_base(self) -> bool:
        """True if the receiver needs the earlier frame."""
        return self.prediction.learns_light or is_temporal(self.references)


class DeltaEncoder:
    """Codes frames one by one. Raises ``CodecError`` if x264 is chosen and cannot be used.

    ``threads`` make references and code. References and our coder's slices do not depend on their
    number; x264's slices may differ by a few bytes between one thread and more. ``check_decode``:
    decode the slices of our coder, too, and raise ``CodecError`` unless the picture is the promised
    one; x264's slices are always decoded.

    >>> import numpy as np
    >>> from rfcore.camera import Camera, Intrinsics, Pose
    >>> from rfcore.codec.decoder import DeltaDecoder
    >>> camera = Camera(Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0), Pose.identity())
    >>> render = I420.filled((64, 48), 100)  # normally of a field, by ``render_field_view``
    >>> view = FieldView(camera, render, np.ones((48, 64), np.float32))
    >>> frame = I420.filled((64, 48), 110)
    >>> encoder = DeltaEncoder(CodecConfig(64, 48, crf=23.0))
    >>> encoded = encoder.encode(encoder.start(epoch=1), frame, view)
    >>> decoder = DeltaDecoder(encoder.header)
    >>> decoded = decoder.decode(decoder.start(), encoded.packet, view)
    >>> decoded.frame.digest() == encoded.reconstruction.digest()
    True
    """

    def __init__(
        self,
        config: CodecConfig,
        clock_ns: Callable[[], int] = lambda: 0,
        threads: int = 1,
        *,
        check_decode: bool = False,
    ) -> None:
        if threads < 1:
            raise InvalidInput("threads", f"{threads} must be at least 1")
        self._config = config
        self._clock_ns = clock_ns
        self._threads = threads
        self._check_decode = check_decode
        self._coder = picture_coder(config, threads)
        self._splice = SpliceDecoder(self.header)

    @property
    def header(self) -> StreamHeader:
        """The stream header, which a receiver needs before the first packet."""
        return self._coder.header

    def start(self, epoch: int) -> EncoderState:
        """Return the state before the first packet of a (re)started stream."""
        return EncoderState(epoch)

    def encode(
        self,
        state: EncoderState,
        frame: I420,
        view: FieldView,
        choice: FrameChoice = LEFT_TO_THE_ENCODER,
        costs: FrameCosts | None = None,
    ) -> Encoded:
        """Code ``frame`` against ``view``, the field at its pose, and ``state.past``.

        ``costs``: those of this very frame, if some are known already. Raises ``InvalidInput`` for
        a frame or view that is not of the configured size, or references that cannot be computed,
        and ``CodecError`` if coding fails.
        """
        self._check(frame, view, choice)
        started_ns = self._clock_ns()
        costs = FrameCosts(frame) if costs is None else costs
        plan = self._plan(state, view, choice, costs)
        chosen_ns = self._clock_ns()
        made, rate = self._coded(costs, plan, choice)
        encoded_ns = self._clock_ns()
        reconstruction = self._reconstruction(plan.pictures, made.coded)
        digest = reconstruction.digest()
        past = plan.prediction.past_of(reconstruction, digest)
        packet = DeltaPacket(
            epoch=state.epoch,
            sequence=state.next_sequence,
            render_digest=view.render.digest()[:RENDER_DIGEST_BYTES],
            render_block_means=block_mean_digest(view.render) if choice.block_means else b"",
            reconstruction_digest=digest[:RECONSTRUCTION_DIGEST_BYTES],
            payload=made.coded.payload,
            references=plan.references,
            base_digest=_base_digest(state.past) if plan.needs_base else b"",
            photometric=plan.prediction.photometric,
            relit=plan.prediction.is_relit,
            light=plan.prediction.light,
        )
        stage_ns = {
            "references": chosen_ns - started_ns,
            "encode": encoded_ns - chosen_ns,
            "closed_loop": self._clock_ns() - encoded_ns,
        }
        following = EncoderState(state.epoch, state.next_sequence + 1, past)
        return Encoded(packet, reconstruction, following, stage_ns, made.tries, made.crf, rate)

    def _check(self, frame: I420, view: FieldView, choice: FrameChoice) -> None:
        for name, picture in (("frame", frame), ("render", view.render)):
            _require_size(name, picture, self._config)
        if choice.qp_map is not None:
            check_qp_map(choice.qp_map, self._config)

    def _plan(
        self, state: EncoderState, view: FieldView, choice: FrameChoice, costs: FrameCosts
    ) -> _Plan:
        """Return the plan for a frame: what ``choice`` says, and for the rest what costs least."""
        crf = self._first_crf(choice)
        prediction = self._under_light(state, view, choice, costs, crf)
        references = choice.references
        if references is None:
            most = self._config.reference_frames
            references = choose_references(costs, prediction, crf, choice.max_references, most)
        return _Plan(prediction, references, prediction.pictures(references))

    def _under_light(
        self,
        state: EncoderState,
        view: FieldView,
        choice: FrameChoice,
        costs: FrameCosts,
        crf: float,
    ) -> Prediction:
        """Return the prediction under the light of ``choice``, or under the one that costs
        least."""
        past = state.past
        if choice.relight:
            return Prediction.relit(view, past, self._threads, choice.light)
        if choice.photometric is not None or not light_differs(costs.frame, view.render):
            return Prediction.under_light(view, choice.photometric or (), past, self._threads)
        if past is not None and _may_learn_light(choice):
            relit = Prediction.relit(view, past, self._threads)
            if relighting_pays(costs, view.render, relit.render, crf):
                return relit
        photometric = choose_photometric(costs, view.render, crf)
        changed = Prediction.under_light(view, photometric, past, self._threads)
        if past is None and choice.relight is None:
            return self._under_sent_light(changed, view, costs, crf)
        return changed

    def _under_sent_light(
        self, changed: Prediction, view: FieldView, costs: FrameCosts, crf: float
    ) -> Prediction:
        """Return the prediction under a light to be sent, or ``changed`` if that is cheaper."""
        light = sent_light(costs.frame, view.render)
        if not light:
            return changed
        relit = Prediction.relit(view, None, self._threads, light)
        pays = sending_light_pays(costs, changed, relit, crf)
        return relit if pays else changed

    def _first_crf(self, choice: FrameChoice) -> float:
        """Return the CRF for choosing references: with a target, the last frame's at least."""
        lowest = self._config.crf if choice.crf is None else choice.crf
        if choice.target is None or choice.target.model.crf is None:
            return lowest
        return max(lowest, choice.target.model.crf)

    def _coded(
        self, costs: FrameCosts, plan: _Plan, choice: FrameChoice
    ) -> tuple[FittedSlice, RateModel | None]:
        """Return the slice at the chosen CRF, or at the one that the target needs."""
        lowest = self._config.crf if choice.crf is None else choice.crf
        target = choice.target
        if target is None or choice.pose_only:
            return self._fitted(plan.pictures, costs.frame, lowest, choice), None
        curve = bits_curve(costs, plan.pictures, lowest)
        crf = target.model.crf_for(target.size_bytes, curve, plan.references)
        made = self._fitted(plan.pictures, costs.frame, crf, choice)
        size_bytes = len(made.coded.payload)
        return made, target.model.after(made.crf, curve, plan.references, size_bytes)

    def _fitted(
        self, pictures: tuple[I420, ...], frame: I420, crf: float, choice: FrameChoice
    ) -> FittedSlice:
        if choice.pose_only:
            return FittedSlice(CodedPicture(b""), crf, 1)
        code = partial(self._slice, pictures, frame, choice)
        if choice.limit_bytes is None:
            return FittedSlice(code(crf), crf, 1)
        return code_to_fit(code, crf, choice.limit_bytes)

    def _slice(
        self, pictures: tuple[I420, ...], frame: I420, choice: FrameChoice, crf: float
    ) -> CodedPicture:
        request = CodingRequest(crf, choice.effort or self._config.effort, choice.qp_map)
        return self._coder.code(frame, pictures, request)

    def _reconstruction(self, pictures: tuple[I420, ...], coded: CodedPicture) -> I420:
        """Return the receiver's picture; decode only if the coder does not know it."""
        if not coded.payload:
            return without_zeros(pictures[0])
        promised = coded.reconstruction
        if promised is not None and not self._check_decode:
            return promised
        self._splice.predict_from(*pictures)
        decoded = self._splice.decode(coded.payload)
        if promised is not None and decoded.digest() != promised.digest():
            raise CodecError("a decoder makes another picture of the slice than its coder")
        return decoded


def _may_learn_light(choice: FrameChoice) -> bool:
    """Return whether the light may be learnt; not if the caller wants no earlier frame used."""
    return choice.relight is None and (choice.references is None or is_temporal(choice.references))


def _base_digest(past: Past | None) -> bytes:
    return b"" if past is None else past.digest[:RECONSTRUCTION_DIGEST_BYTES]


def _require_size(name: str, picture: I420, config: CodecConfig) -> None:
    if picture.size_px != config.size_px:
        raise InvalidInput(name, f"{picture.size_px} px where the stream has {config.size_px} px")
