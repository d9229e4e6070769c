"""The server's conversation: every frame gets one answer, and only bad manners end it."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from mec_server.config import SessionLimits
from mec_server.session import (
    MAX_UNUSABLE,
    DecodeJob,
    OpenJob,
    PrepareJob,
    ServerSession,
    SessionState,
)
from rfcore.errors import (
    AccessDenied,
    CodecError,
    InvalidInput,
    LimitExceeded,
    PacketRejected,
    ProtocolError,
    RejectReason,
    UnknownField,
)
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.head import FrameRefused
from rfcore.wire.messages import (
    Ack,
    Credit,
    DrainNotice,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    RendererContract,
    ServerMessage,
    StageTimes,
    Welcome,
)
from rfcore.wire.tls import PeerIdentity, Role, identity_uri

FIELD, OTHER = "ab" * 32, "cd" * 32
MakeFrame = Callable[..., Frame]


class ReferenceDecoder:
    """Accepts what the codec would: frames in order, undamaged, and nothing else reaches it."""

    def __init__(self) -> None:
        self.position: dict[str, tuple[int, int]] = {}

    def run(self, session: ServerSession, now: float) -> None:
        """Do all the work the session has."""
        while jobs := session.jobs_to_start(now):
            for job in jobs:
                assert isinstance(job, DecodeJob)
                try:
                    self.decode(job.frame)
                    session.decoded(job, DIGEST, StageTimes(render_ns=5), now)
                except PacketRejected as error:
                    session.rejected(job, error, now)

    def decode(self, frame: Frame) -> None:
        packet = frame.packet
        position = self.position.get(frame.camera_id, (0, -1))
        assert (packet.epoch, packet.sequence) > position, "the session hands them out in order"
        self.position[frame.camera_id] = (packet.epoch, packet.sequence)


DIGEST = b"digest"


def answers(messages: list[ServerMessage]) -> list[tuple[str, int]]:
    """Shorten acks to ("ack", sequence) and nacks to (reason, sequence)."""
    short = []
    for message in messages:
        if isinstance(message, Ack):
            short.append(("ack", message.address.sequence))
        elif isinstance(message, Nack):
            sequences = range(message.address.sequence, message.address.sequence + message.count)
            short.extend((str(message.reason), sequence) for sequence in sequences)
    return short


def deliver(session: ServerSession, frames: list[Frame | FrameRefused]) -> list[tuple[str, int]]:
    """Feed frames one at a time, or what their reader refused; return all answers."""
    decoder = ReferenceDecoder()
    told: list[ServerMessage] = []
    for frame in frames:
        if isinstance(frame, Frame):
            session.receive(frame, 1.0)
        else:
            session.refuse(frame, 1.0)
        decoder.run(session, 1.0)
        told += session.messages_to_send(1.0)
    return answers(told)


# --- greeting


def test_hello_is_answered_with_welcome_and_credit_for_every_camera(hello: Hello) -> None:
    session = ServerSession("s-1", [FIELD], now=0.0)
    session.receive(hello, 0.0)
    (job,) = session.jobs_to_start(0.0)
    assert job == OpenJob(hello, exact=True)
    session.opened(job, 0.1)
    assert session.messages_to_send(0.1) == [
        Welcome("s-1", exact=True),
        Credit("front", 2),
        Credit("rear", 2),
    ]
    assert session.messages_to_send(0.1) == [], "each message is handed out once"


def test_a_name_that_the_certificate_does_not_bear_learns_nothing_else(hello: Hello) -> None:
    stranger = PeerIdentity((identity_uri(Role.VEHICLE, "stranger"),))
    session = ServerSession("s-1", [OTHER], now=0.0, identity=stranger)
    session.receive(hello, 0.0)
    assert session.closed is not None
    assert isinstance(session.closed.error, AccessDenied)
    assert session.jobs_to_start(0.0) == []
    assert session.messages_to_send(0.0) == [], "not even which fields are held"


def test_the_name_of_the_certificate_is_welcome(hello: Hello) -> None:
    identity = PeerIdentity((identity_uri(Role.VEHICLE, hello.vehicle_id),))
    session = ServerSession("s-1", [FIELD], now=0.0, identity=identity)
    session.receive(hello, 0.0)
    assert len(session.jobs_to_start(0.0)) == 1


def test_an_unknown_field_is_refused_with_both_ids_named(hello: Hello) -> None:
    session = ServerSession("s-1", [OTHER], now=0.0)
    session.receive(hello, 0.0)
    assert session.closed is not None
    assert isinstance(session.closed.error, UnknownField)
    assert FIELD in str(session.closed.error)
    assert OTHER in str(session.closed.error)
    assert session.messages_to_send(0.0) == [FieldNotice((OTHER,))]


@pytest.mark.parametrize(
    ("contract", "exact"),
    [
        (RendererContract(RENDERER_CONTRACT, exact=True), True),
        (RendererContract(RENDERER_CONTRACT, exact=False), False),
        (RendererContract("splats-cuda-9", exact=True), False),
    ],
)
def test_only_the_same_exact_contract_is_exact(
    hello: Hello, contract: RendererContract, exact: bool
) -> None:
    session = ServerSession("s-1", [FIELD], now=0.0)
    session.receive(replace(hello, renderer=contract), 0.0)
    (job,) = session.jobs_to_start(0.0)
    assert isinstance(job, OpenJob)
    assert job.exact == exact


def test_a_bad_hello_leaves_room_for_another(hello: Hello) -> None:
    session = ServerSession("s-1", [FIELD], now=0.0)
    session.refuse(InvalidInput("hello.cameras[0].codec.width_px", "640 px, but ..."), 0.0)
    session.receive(hello, 0.0)
    (job,) = session.jobs_to_start(0.0)
    assert isinstance(job, OpenJob)
    session.open_failed(InvalidInput("codec.sps", "is of another size"), 0.0)
    told = session.messages_to_send(0.0)
    assert [str(m.problem) for m in told if isinstance(m, Nack)] == [
        "hello.cameras[0].codec.width_px: 640 px, but ...",
        "codec.sps: is of another size",
    ]
    assert session.state is SessionState.AWAITING_HELLO
    session.receive(hello, 0.0)
    assert len(session.jobs_to_start(0.0)) == 1


def test_a_server_that_cannot_open_what_it_holds_says_so(hello: Hello) -> None:
    session = ServerSession("s-1", [FIELD], now=0.0)
    session.receive(hello, 0.0)
    session.jobs_to_start(0.0)
    session.open_failed(CodecError("no decoder"), 0.0)
    assert session.closed is not None
    assert str(session.closed.error) == "no decoder"


def test_a_frame_before_hello_and_a_second_hello_end_the_stream(
    session: ServerSession, hello: Hello, make_frame: MakeFrame
) -> None:
    early = ServerSession("s-2", [FIELD], now=0.0)
    early.receive(make_frame(0), 0.0)
    session.receive(hello, 0.0)
    for each in (early, session):
        assert each.closed is not None
        assert isinstance(each.closed.error, ProtocolError)


# --- frames


def test_frames_in_order_are_acknowledged_one_by_one(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    assert deliver(session, [make_frame(i) for i in range(5)]) == [("ack", i) for i in range(5)]


@pytest.mark.parametrize(
    ("arrived", "expected"),
    [
        pytest.param([0, 2], "ack 0, gap 1, ack 2", id="lost"),
        pytest.param([0, 4, 5], "ack 0, gap 1, gap 2, gap 3, ack 4, ack 5", id="three lost"),
        pytest.param([2], "gap 0, gap 1, ack 2", id="the first two lost"),
        pytest.param([0, 1, 1, 2], "ack 0, ack 1, stale 1, ack 2", id="duplicated"),
        pytest.param([0, 2, 1, 3], "ack 0, gap 1, ack 2, stale 1, ack 3", id="reordered"),
        pytest.param([0, -1, 2], "ack 0, crc 1, ack 2", id="flipped"),
        pytest.param([0, -1, -2, 4], "ack 0, crc 1, crc 2, gap 3, ack 4", id="flipped and lost"),
        pytest.param([0, -2, 3], "ack 0, crc 2, gap 1, ack 3", id="lost and flipped"),
        pytest.param([0, 70, 1], "ack 0, invalid 70, ack 1", id="a gap too wide to be one"),
    ],
)
def test_the_next_packet_is_right_again(
    session: ServerSession, make_frame: MakeFrame, arrived: list[int], expected: str
) -> None:
    """A negative number is a packet whose bits were flipped on the way."""
    frames = []
    for number in arrived:
        frame = make_frame(abs(number))
        broken = FrameRefused(RejectReason.CRC_MISMATCH, "flipped", frame.address)
        frames.append(broken if number < 0 else frame)
    names = {
        "ack": "ack",
        "gap": "sequence_gap",
        "stale": "stale_sequence",
        "crc": "crc_mismatch",
        "invalid": "invalid_argument",
    }
    words = [answer.split() for answer in expected.split(", ")]
    assert deliver(session, frames) == [(names[name], int(number)) for name, number in words]
    assert session.closed is None


def test_a_new_epoch_starts_afresh_and_the_old_one_is_over(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    frames = [make_frame(0), make_frame(1), make_frame(0, epoch=1), make_frame(2), make_frame(1, 1)]
    assert deliver(session, frames) == [
        ("ack", 0), ("ack", 1), ("ack", 0), ("stale_epoch", 2), ("ack", 1),
    ]  # fmt: skip


def test_a_stream_of_nothing_but_frames_refused_unrendered_is_ended(session, make_frame):
    deliver(session, [make_frame(0)])
    deliver(session, [make_frame(0)] * (MAX_UNUSABLE - 1))
    deliver(session, [make_frame(1)])
    assert session.closed is None, "a frame that could be used begins the count again"
    address = FrameAddress("front", 0, 2)
    for _ in range(MAX_UNUSABLE):
        session.refuse(FrameRefused(RejectReason.CRC_MISMATCH, "flipped", address), 1.0)
        session.messages_to_send(1.0)
    assert session.closed is not None
    assert isinstance(session.closed.error, LimitExceeded)


def test_a_nack_tells_the_last_good_sequence_and_the_present_epoch(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    deliver(session, [make_frame(0, epoch=3), make_frame(1, epoch=3)])
    session.receive(make_frame(2, epoch=1), 1.0)
    ReferenceDecoder().run(session, 1.0)
    session.receive(make_frame(0, epoch=3), 1.0)
    assert session.jobs_to_start(1.0) == [], "a stale frame costs no decoding"
    nacks = [m for m in session.messages_to_send(1.0) if isinstance(m, Nack)]
    assert [(n.current_epoch, n.last_good_sequence) for n in nacks] == [(3, None), (3, 1)]


def test_a_refused_value_is_a_nack_naming_the_field_and_the_session_lives_on(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    reason = RejectReason.INVALID_ARGUMENT
    problem = "frame.pose.x in steps: 2000000001 is outside -2e+09..2e+09"
    session.refuse(FrameRefused(reason, problem, FrameAddress("front", 0, 0)), 1.0)
    nack, credit = session.messages_to_send(1.0)
    assert isinstance(nack, Nack)
    assert nack.reason is RejectReason.INVALID_ARGUMENT
    assert nack.problem == problem
    assert credit == Credit("front", 3)
    assert deliver(session, [make_frame(1)]) == [("ack", 1)], "0 was answered, it is no gap"


def test_an_unreadable_message_starves_no_camera(session: ServerSession) -> None:
    session.refuse(InvalidInput("message", "3 bytes are not a StreamRequest"), 1.0)
    nack, *credits_ = session.messages_to_send(1.0)
    assert isinstance(nack, Nack)
    assert nack.address.camera_id == ""
    assert credits_ == [Credit("front", 3), Credit("rear", 3)]


# --- credits, order, work


def test_frames_beyond_the_window_are_refused_as_overload(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    for sequence in range(4):
        session.receive(make_frame(sequence), 1.0)
    assert answers(session.messages_to_send(1.0)) == [("overloaded", 2), ("overloaded", 3)]


def test_one_frame_of_a_camera_is_in_work_at_a_time_and_cameras_do_not_wait_for_each_other(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    for camera in ("front", "rear"):
        for sequence in range(2):
            session.receive(make_frame(sequence, camera_id=camera), 1.0)
    jobs = [job for job in session.jobs_to_start(1.0) if isinstance(job, DecodeJob)]
    assert [job.frame.address for job in jobs] == [
        FrameAddress("front", 0, 0),
        FrameAddress("rear", 0, 0),
    ]
    assert session.jobs_to_start(1.0) == []
    session.decoded(jobs[1], DIGEST, StageTimes(), 1.5)
    (after,) = session.jobs_to_start(1.5)
    assert isinstance(after, DecodeJob)
    assert after.frame.address == FrameAddress("rear", 0, 1)


def test_an_ack_says_where_the_time_went(session: ServerSession, make_frame: MakeFrame) -> None:
    session.receive(make_frame(0), 1.0)
    (job,) = session.jobs_to_start(1.25)
    assert isinstance(job, DecodeJob)
    session.decoded(job, DIGEST, StageTimes(render_ns=7, decode_ns=9), 2.0)
    ack = session.messages_to_send(2.0)[0]
    assert isinstance(ack, Ack)
    assert ack.times == StageTimes(250_000_000, 7, 0, 9, 1_000_000_000)


# --- time and end


def test_a_vehicle_that_says_nothing_is_let_go() -> None:
    session = ServerSession("s-1", [FIELD], now=100.0)
    assert session.get_timer() == 105.0
    session.handle_timer(104.9)
    assert session.closed is None
    session.handle_timer(105.0)
    assert session.closed is not None
    assert "no Hello within 5 s" in str(session.closed.error)


def test_an_idle_stream_is_closed_but_not_while_a_frame_is_in_work(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    session.receive(make_frame(0), 50.0)
    (job,) = session.jobs_to_start(50.0)
    assert isinstance(job, DecodeJob)
    session.handle_timer(110.0)
    assert session.closed is None
    session.decoded(job, DIGEST, StageTimes(), 111.0)
    session.handle_timer(171.0)
    assert session.closed is not None
    assert session.closed.error is None, "it has broken no rule"


def test_a_vehicle_is_silent_since_its_last_message_unless_it_waits_for_an_answer(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    assert session.silent_s(7.0) == 7.0
    session.receive(make_frame(0), 8.0)
    assert session.silent_s(20.0) == 0.0
    ReferenceDecoder().run(session, 20.0)
    assert session.silent_s(20.0) == 12.0
    session.refuse(InvalidInput("message", "not a message"), 21.0)
    assert session.silent_s(21.5) == 0.5


def test_draining_finishes_what_was_taken_and_takes_no_more(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    session.receive(make_frame(0), 1.0)
    session.receive(make_frame(1), 1.0)
    session.drain()
    assert session.closed is None
    session.receive(make_frame(2), 1.0)
    ReferenceDecoder().run(session, 1.0)
    told = answers(session.messages_to_send(1.0))
    assert told == [("overloaded", 2), ("ack", 0), ("ack", 1)]
    assert session.closed is not None
    assert session.closed.error is None


def test_a_vehicle_that_is_sent_away_is_told_once_and_goes_on_being_served(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    session.announce_drain()
    session.announce_drain()
    assert session.messages_to_send(1.0) == [DrainNotice()]
    session.receive(make_frame(0), 1.0)
    ReferenceDecoder().run(session, 1.0)
    assert answers(session.messages_to_send(1.0)) == [("ack", 0)]


def test_who_is_being_welcomed_is_sent_away_after_its_welcome(hello: Hello) -> None:
    session = ServerSession("s-1", [FIELD], now=0.0)
    session.receive(hello, 0.0)
    (job,) = session.jobs_to_start(0.0)
    session.announce_drain()
    assert session.messages_to_send(0.0) == []
    assert isinstance(job, OpenJob)
    session.opened(job, 0.0)
    told = [type(message) for message in session.messages_to_send(0.0)]
    assert told[0] is Welcome
    assert told.count(DrainNotice) == 1


def test_draining_an_idle_session_closes_it_at_once(session: ServerSession) -> None:
    session.drain()
    assert session.closed is not None


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"hello_s": 0.0}, "limits.hello_s"),
        ({"idle_s": float("nan")}, "limits.idle_s: nan"),
        ({"window_frames": 0}, "limits.window_frames: 0"),
    ],
)
def test_bad_limits_are_refused_by_name(change: dict[str, float], named: str) -> None:
    with pytest.raises(InvalidInput, match=named):
        SessionLimits(**change)  # type: ignore[arg-type]


# --- poses ahead of their frames


def test_a_pose_is_prepared_before_its_frame_which_waits_for_it(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    frame = make_frame(0)
    session.receive(frame.ahead, 1.0)
    (job,) = session.poses_to_prepare()
    assert job == PrepareJob(frame.ahead, FIELD)
    assert session.poses_to_prepare() == []
    session.receive(frame, 1.1)
    assert session.jobs_to_start(1.1) == [], "one piece of work a camera"
    session.prepared(job)
    (decoding,) = session.jobs_to_start(1.2)
    assert isinstance(decoding, DecodeJob)
    session.decoded(decoding, DIGEST, StageTimes(ahead_ns=7), 1.3)
    (ack, credit) = session.messages_to_send(1.3)
    assert isinstance(ack, Ack)
    assert ack.times.ahead_ns == 7
    assert credit == Credit("front", 3), "a pose takes no credit and has no answer"


def test_a_pose_whose_frame_is_here_or_replaced_is_not_prepared(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    session.receive(make_frame(0).ahead, 1.0)
    session.receive(make_frame(0), 1.0)
    (running,) = session.jobs_to_start(1.0)
    assert session.poses_to_prepare() == []
    session.receive(make_frame(1).ahead, 1.0)
    session.receive(make_frame(2).ahead, 1.0)
    assert session.poses_to_prepare() == [], "a frame is being decoded"
    assert isinstance(running, DecodeJob)
    session.decoded(running, DIGEST, StageTimes(), 1.1)
    (job,) = session.poses_to_prepare()
    assert job.ahead == make_frame(2).ahead


def test_a_pose_of_an_old_frame_is_not_prepared(
    session: ServerSession, make_frame: MakeFrame
) -> None:
    assert deliver(session, [make_frame(3, epoch=2)])[-1] == ("ack", 3)
    for stale in (make_frame(3, epoch=2), make_frame(9, epoch=1), make_frame(99, epoch=2)):
        session.receive(stale.ahead, 1.0)
        assert session.poses_to_prepare() == []


def test_a_pose_before_welcome_or_while_draining_is_of_no_use(
    hello: Hello, session: ServerSession, make_frame: MakeFrame
) -> None:
    opening = ServerSession("s-1", [FIELD], now=0.0)
    opening.receive(hello, 0.0)
    opening.receive(make_frame(0).ahead, 0.0)
    session.receive(make_frame(0), 1.0)
    session.jobs_to_start(1.0)
    session.drain()
    session.receive(make_frame(1).ahead, 1.0)
    for quiet in (opening, session):
        assert quiet.poses_to_prepare() == []
        assert quiet.messages_to_send(1.0) == []
        assert quiet.closed is None


def test_poses_that_are_refused_have_no_answer_and_too_many_end_the_stream(
    session: ServerSession,
) -> None:
    for _ in range(MAX_UNUSABLE):
        assert session.closed is None
        session.refuse_ahead()
    assert session.messages_to_send(1.0) == []
    assert session.closed is not None
    assert isinstance(session.closed.error, LimitExceeded)
