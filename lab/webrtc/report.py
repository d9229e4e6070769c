"""The rows of the comparison with WebRTC, and the tables that show them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from lab.report import Report
from rfedge.report.tables import Column, Table
from rfedge.results import Result, rows_of

OURS = "rfedge"
EQUAL_DB = 0.1
"""A quality that is lower by no more counts as equal."""


@dataclass(frozen=True)
class WebrtcRow:
    """One sender over one link; None of what was not shown at all.

    ``bytes``: of the IP packets that the camera's side sent in the measured time, lost ones and all
    headers among them. ``step_bps``: the link's rate in the second half of it, if another.
    """

    peer: str
    rate_bps: float
    rtt_ms: float
    loss_percent: float
    p50_ms: float | None
    p95_ms: float | None
    p99_ms: float | None
    frozen_percent: float
    psnr_db: float | None
    bytes: int
    shown_hz: float
    seconds: float
    step_bps: float | None = None
    crf: float | None = None

    @property
    def link(self) -> tuple[float, float, float, float]:
        """What tells links apart."""
        return (self.rate_bps, self.step_bps or self.rate_bps, self.rtt_ms, self.loss_percent)

    @property
    def mbps(self) -> float:
        """The rate that was sent."""
        return 8e-6 * self.bytes / self.seconds

    @property
    def picture_bytes(self) -> float:
        """Bytes sent for each picture that was shown; infinite if none was."""
        shown = self.shown_hz * self.seconds
        return self.bytes / shown if shown else float("inf")


@dataclass(frozen=True)
class Pair:
    """A peer's row and ours of the same link that is compared with it."""

    peer: WebrtcRow
    ours: WebrtcRow

    @property
    def bytes_percent(self) -> float:
        """Our bytes for a picture shown, in percent of the peer's: who shows fewer saves none."""
        return 100 * self.ours.picture_bytes / self.peer.picture_bytes

    @property
    def is_equal(self) -> bool:
        """Whether our quality is at least the peer's."""
        return (self.ours.psnr_db or 0.0) >= (self.peer.psnr_db or 0.0) - EQUAL_DB

    @property
    def is_no_later(self) -> bool:
        """Whether our p99 is no higher; a peer that shows nothing is as late as can be."""
        return (self.ours.p99_ms or float("inf")) <= (self.peer.p99_ms or float("inf"))

    @property
    def is_no_more_frozen(self) -> bool:
        """Whether ours is frozen no longer."""
        return self.ours.frozen_percent <= self.peer.frozen_percent


def paired(rows: Sequence[WebrtcRow]) -> list[Pair]:
    """Return each peer's row with ours of the same link.

    Of ours that is the one with the fewest bytes for a picture at the peer's quality or better;
    where none is as good, the best one.
    """
    pairs = []
    for peer in (row for row in rows if row.peer != OURS):
        ours = [row for row in rows if row.peer == OURS and row.link == peer.link]
        equal = [row for row in ours if Pair(peer, row).is_equal]
        if equal:
            pairs.append(Pair(peer, min(equal, key=lambda row: row.picture_bytes)))
        elif ours:
            pairs.append(Pair(peer, max(ours, key=lambda row: row.psnr_db or 0.0)))
    return pairs


def webrtc_parts(result: Result) -> Iterator[Table | str]:
    """Yield how it was measured, who was better, and each link."""
    rows = rows_of(WebrtcRow, result["rows"])
    pairs = paired(rows)
    yield (
        f"The sample's camera, 640x360 at {result['hz']:g} Hz, there and back along the drive. "
        "Age is from the camera to the application that has the decoded picture, on one clock. "
        "Bytes are of the IP packets that the camera's side sent, lost ones and headers included, "
        "and compared for each picture that was shown; "
        f"our field ({result['field_bytes'] / 1e6:.2f} MB) was at both ends before. Frozen: gaps "
        "of at least three periods. Quality is the luma PSNR of what was shown against the "
        "camera's picture of the same number. Senders have one core, receivers another. "
        f"WebRTC is {' and '.join(result['engines'])}: wrtc is Chrome's engine, here without "
        "H.264; aiortc sends at least 0.5 Mbit/s of H.264 and 0.25 of VP8, whatever the link. "
        f"We send over the kernel's TCP ({result['tcp']}), with --max-delay-ms of the round trip "
        f"and {result['delay_ms']:g} ms, at the CRF that gives the peer's quality."
    )
    for name in dict.fromkeys(pair.peer.peer for pair in pairs):
        yield told(name, [pair for pair in pairs if pair.peer.peer == name])
    yield Table("At equal quality, peer / ours", PAIR, pairs)


def finding(result: Result) -> str:
    """Return who was better of us and the first peer, in a sentence."""
    pairs = paired(rows_of(WebrtcRow, result["rows"]))
    name = pairs[0].peer.peer
    return told(name, [pair for pair in pairs if pair.peer.peer == name])


def told(name: str, pairs: Sequence[Pair]) -> str:
    """Return who was better, in a sentence."""
    equal = [pair for pair in pairs if pair.is_equal]
    shares = sorted(pair.bytes_percent for pair in equal)
    share = (
        f"{shares[0]:.0f} to {shares[-1]:.0f} % of its bytes" if shares else "no figure of bytes"
    )
    half = sum(each <= 50 for each in shares)
    no_later = sum(pair.is_no_later for pair in pairs)
    return (
        f"Beside {name} on {len(pairs)} links: its quality reached in {len(equal)}, there with "
        f"{share}, at most half in {half}; p99 no higher in {no_later}, "
        f"frozen no longer in {sum(pair.is_no_more_frozen for pair in pairs)}."
    )


def link_name(row: WebrtcRow) -> str:
    """Return the link's rate or rates in Mbit/s."""
    step = "" if row.step_bps is None else f", then {row.step_bps / 1e6:g}"
    return f"{row.rate_bps / 1e6:g}{step}"


def _both(heading: str, name: str, form: str) -> Column:
    def cells(pair: Pair) -> str:
        values = (getattr(row, name) for row in (pair.peer, pair.ours))
        return " / ".join("-" if value is None else format(value, form) for value in values)

    return Column(heading, cells)


PAIR = [
    Column("link Mbit/s", lambda pair: link_name(pair.peer)),
    Column("RTT ms, loss %", lambda pair: (pair.peer.rtt_ms, pair.peer.loss_percent), "{:g}, {:g}"),
    Column("peer", lambda pair: pair.peer.peer),
    Column("our bytes %", lambda pair: pair.bytes_percent, ".0f"),
    _both("PSNR dB", "psnr_db", ".1f"),
    _both("shown Hz", "shown_hz", ".1f"),
    _both("p99 ms", "p99_ms", ".0f"),
    _both("frozen %", "frozen_percent", ".1f"),
]

REPORT = Report(
    "webrtc",
    "Live beside WebRTC",
    "The same camera, link and screen through WebRTC and through us: bytes at equal quality, ages "
    "and freezes.",
    webrtc_parts,
)
