"""The flow model of a city: from vehicles in cells to rates, bytes, cores and ages of pictures.

Every step is taken as steady, and vehicles as a flow: numbers need not be whole. A frame takes what
the tables of ``rfedge size`` say (``costs_of``). Each step goes through two limits:

* A vehicle codes one picture at a time and has as many on their way as it has credits for
  (``Costs.own_hz``). The vehicles of a cell share its uplink; where that carries less than they
  ask for, credits hold every vehicle to its part (``mec_server.camera_queue``).
* A server lets vehicles in as ``mec_server.ledger.promises`` does: first come, first served, each
  taken to need what it uses and a quarter more, until what is left of ``max_load`` of its cores is
  below the lowest rate. Those beyond it are refused; the rest is shared by those inside.

Ages are distributions, sampled at fixed points (``AGE_SAMPLES``). A frame of N others of one period
waits longer than x of their services with the probability rho exp(-2 x (x / N + theta / 2) / (1 +
c^2)). The first term: what arrives from N periodic sources in a period is a Brownian bridge, whose
crossing of a line is exact (Doob 1949; for queues of periodic sources Roberts, Mocci and Virtamo,
Broadband Network Teletraffic, 1996, ch. 15). There theta is 2 (1 / rho - 1); that of M/D/1, to
which it tends with the load, is taken, which is right for light loads too. rho is the share of time
that there is a queue, c^2 the variance of sizes over their squared mean, as in M/G/1. With W
workers the queue is that of one W times as fast, and in place of rho stands the chance that all are
busy: Halfin and Whitt 1981, with the spread of the number that periodic sources keep busy. A
saturated uplink holds as many frames as credits allow (Denning and Buzen 1978: a closed loop).
Where a vehicle waits for credit or its coder, the newest picture has waited up to a period.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lab.city.city import City, Floats
from lab.city.traffic import TrafficBlock
from mec_server.config import SessionLimits
from mec_server.ledger.promises import HEADROOM
from rfcore.codec.packet import RECONSTRUCTION_DIGEST_BYTES
from rfcore.errors import InvalidInput
from rfcore.wire.convert_answers import AnswerWriter
from rfcore.wire.messages import Ack, Credit, FrameAddress, StageTimes
from rfedge.sizing.estimate import estimate, nearest_cell
from rfedge.sizing.tables import SizingTables

FIRST_FRAME_RATIO = 1.2
"""Bytes of a frame that is predicted from the render alone, as the first at another server is, over
those of one that has the frame before: 9040 to 7606 bytes a message, 24 frames of the sample drive
at 640x360, 10 Hz, CRF 23."""

AGE_SAMPLES = 512
WINDOW_FRAMES = SessionLimits().window_frames
LARGEST_ID = 1 << 20
LEAST_VEHICLES = 1e-9
"""Fewer at a server, of a mean, are nobody."""


@dataclass(frozen=True)
class Costs:
    """The costs of a vehicle's frames.

    ``frame_bytes``: of one camera's, on the link; ``frame_ratios``: sizes over their mean;
    ``sender_s`` and ``server_s``: processor time of either end a frame; ``unexplained_s``: what
    else delays frames, as values that are equally likely.
    """

    cameras: int
    hz: float
    frame_bytes: float
    frame_ratios: tuple[float, ...]
    sender_s: float
    server_s: float
    propagation_s: float
    answer_bytes: float
    first_frame_ratio: float = FIRST_FRAME_RATIO
    unexplained_s: tuple[float, ...] = (0.0,)

    @property
    def bits_per_hz(self) -> float:
        """Bits of one vehicle for a picture a second of each of its cameras."""
        return 8 * self.cameras * self.frame_bytes

    @property
    def cores_per_hz(self) -> float:
        """Cores of its server for the same pictures."""
        return self.cameras * self.server_s

    @property
    def path_s(self) -> float:
        """Time from the beginning of coding to the answer with nobody else there, without the
        uplink."""
        return self.sender_s + self.server_s + 2 * self.propagation_s

    @property
    def own_hz(self) -> float:
        """The most that coder and credits permit a vehicle, whatever the others do."""
        if self.path_s <= 0:
            return self.hz
        credits_hz = WINDOW_FRAMES / self.path_s
        return min(credits_hz, 1 / self.sender_s if self.sender_s > 0 else credits_hz)

    @property
    def size_variance(self) -> float:
        """Variance of frames' sizes over the square of their mean."""
        return float(np.var(self.frame_ratios) / np.mean(self.frame_ratios) ** 2)


def costs_of(city: City, tables: SizingTables) -> Costs:
    """Return the costs of the city's vehicles; raise ``InvalidInput`` beyond the tables."""
    demand, assumptions = city.vehicle.demand, city.assumptions
    ours = estimate(demand, tables, assumptions).estimates[0]
    frames_per_s = demand.cameras * demand.hz
    overhead = 1 + assumptions.overhead_percent / 100
    return Costs(
        cameras=demand.cameras,
        hz=demand.hz,
        frame_bytes=1e6 * ours.mbps / 8 / frames_per_s * city.vehicle.bytes_factor,
        frame_ratios=tuple(nearest_cell(tables.of(ours.codec), demand.wanted).frame_ratios),
        sender_s=ours.vehicle_cores / frames_per_s,
        server_s=ours.server_cores / frames_per_s,
        propagation_s=assumptions.propagation_ms / 1e3,
        answer_bytes=overhead * answer_bytes(),
    )


def answer_bytes() -> int:
    """Return the bytes of the messages that answer a frame: an Ack and a Credit."""
    times = StageTimes(*[10**7] * 6)
    ack = Ack(FrameAddress("front", 0, LARGEST_ID), times, bytes(RECONSTRUCTION_DIGEST_BYTES))
    return sum(map(len, AnswerWriter(["front"]).messages([ack, Credit("front", LARGEST_ID)])))


@dataclass(frozen=True, eq=False)
class Flow:
    """The flows of a block of T steps in C cells [T, C] and at S servers [T, S].

    ``served`` and ``rate_hz``: vehicles let in, and pictures a second of each of their cameras;
    ``link_limited``: whether the uplink limits the rate; ``held``: whether it is below what the
    server grants. ``*_bps``: carried, of vehicles on their way up and of answers and fields down;
    ``cores``: in use. ``*_share``: what is asked for, of what there is; above 1 not all of it can
    be had.
    """

    served: Floats
    rate_hz: Floats
    link_limited: Floats
    held: Floats
    uplink_bps: Floats
    downlink_bps: Floats
    cores: Floats
    uplink_share: Floats
    downlink_share: Floats
    load_share: Floats
    stream_share: Floats


def city_flow(city: City, costs: Costs, block: TrafficBlock) -> Flow:
    """Return the flow of a block of traffic."""
    cells, wanted_hz = city.cells, costs.hz
    entries_per_s = block.handovers_per_s + block.begun_per_s
    first_bps = entries_per_s * costs.bits_per_hz * (costs.first_frame_ratio - 1)
    free_bps = np.maximum(cells.uplink_bps - first_bps, 0.0)

    def carried_hz(vehicles: Floats) -> Floats:
        return free_bps / (costs.bits_per_hz * np.maximum(vehicles, 1.0))

    link_hz = np.minimum(carried_hz(block.vehicles), min(wanted_hz, costs.own_hz))
    share, granted_hz = _let_in(city, costs, block.vehicles, link_hz)
    served = block.vehicles * share[:, cells.server]
    granted_here_hz = granted_hz[:, cells.server]
    possible_hz = np.minimum(granted_here_hz, costs.own_hz)
    carried = carried_hz(served)
    rate_hz = np.minimum(possible_hz, carried)
    let_in_per_s = entries_per_s * share[:, cells.server]
    fetch_bits = 8 * city.tile.field_bytes * (1 - city.tile.known_share)
    fetched_bps = (1 + city.assumptions.overhead_percent / 100) * fetch_bits * let_in_per_s
    answers_bps = 8 * costs.answer_bytes * costs.cameras * served * rate_hz
    at_servers = city.at_server(block.vehicles)
    capacity = city.admission.limits.load * city.servers.cores
    return Flow(
        served=served,
        rate_hz=rate_hz,
        link_limited=(carried < possible_hz).astype(np.float64),
        held=(rate_hz < granted_here_hz).astype(np.float64),
        uplink_bps=np.minimum(
            served * rate_hz * costs.bits_per_hz + first_bps * share[:, cells.server],
            cells.uplink_bps,
        ),
        downlink_bps=fetched_bps + answers_bps,
        cores=city.at_server(served * rate_hz) * costs.cores_per_hz,
        uplink_share=(block.vehicles * wanted_hz * costs.bits_per_hz + first_bps)
        / cells.uplink_bps,
        downlink_share=(fetched_bps + answers_bps) / cells.downlink_bps,
        load_share=at_servers * wanted_hz * costs.cores_per_hz / capacity,
        stream_share=at_servers / city.admission.streams,
    )


def _let_in(city: City, costs: Costs, vehicles: Floats, link_hz: Floats) -> tuple[Floats, Floats]:
    """Return the share of each server's vehicles that it lets in, and the rate it grants, [T, S].

    Whole vehicles: one that is left less than the lowest rate is refused, unless it is alone.
    """
    limits = city.admission.limits
    lowest_hz = min(limits.lowest_hz, costs.hz)
    needed_hz = np.clip(HEADROOM * link_hz, lowest_hz, costs.hz)
    there = city.at_server(vehicles)
    somebody = there > LEAST_VEHICLES
    needs = city.at_server(vehicles * needed_hz) / np.maximum(there, LEAST_VEHICLES)
    needs = np.where(somebody, needs, costs.hz) * costs.cores_per_hz
    capacity = limits.load * city.servers.cores
    whole = np.floor(capacity / needs + 1e-9)
    one_more = capacity - whole * needs >= lowest_hz * costs.cores_per_hz
    most = np.clip(whole + one_more, 1, city.admission.streams)
    admitted = np.minimum(there, most)
    granted_hz = capacity / (costs.cores_per_hz * np.maximum(admitted, 1.0))
    share = np.where(somebody, admitted / np.maximum(there, LEAST_VEHICLES), 1.0)
    return share, np.clip(granted_hz, lowest_hz, costs.hz)


def queue_wait(
    chance: Floats,
    others: Floats,
    load: Floats,
    size_variance: float,
    busy: Floats | None = None,
) -> Floats:
    """Return the wait, in mean services, that is not exceeded with probability ``chance``.

    ``others``: periodic sources beside the one that waits; ``load``: the share of the server's time
    that they take, up to 1; ``busy``: the chance to wait at all, ``load`` without one. See the
    module for the formula and its source.
    """
    load = np.clip(load, 1e-9, 1.0)
    busy = load if busy is None else busy
    log_odds = np.maximum(np.log(busy / (1 - chance)), 0.0) * (1 + size_variance) / 2
    slack = _decay(load) / 2
    sources = np.maximum(others, 1e-9)
    wait = sources / 2 * (np.sqrt(slack * slack + 4 * log_odds / sources) - slack)
    return np.minimum(wait, WINDOW_FRAMES * others)


def _decay(load: Floats) -> Floats:
    """Return theta > 0 with load (exp(theta) - 1) = theta: how fast waits of M/D/1 become rare."""
    theta = 2 * (1 / load - 1)
    for _ in range(30):
        theta = np.log1p(theta / load)
    return np.asarray(theta)


def _all_busy(workers: Floats, load: Floats, own_load: Floats, cameras: int) -> Floats:
    """Return the chance that all of W workers are busy; ``own_load``: of one, by one camera.

    Vehicles of several cameras come with as many frames at once, which spreads the number more.
    """
    spread = np.sqrt(cameras * np.clip(1 - own_load, 0.05, 1.0))
    beta = np.maximum(1 - load, 1e-6) * np.sqrt(workers) / spread
    below = np.vectorize(lambda x: math.erfc(-x / math.sqrt(2)) / 2)(beta)
    density = np.exp(-beta * beta / 2) / math.sqrt(2 * math.pi)
    return np.asarray(np.maximum(density / (density + beta * below), 1e-12))


@dataclass(frozen=True, eq=False)
class SharedLoad:
    """The load around frames of R cells, [R] each: their cell's vehicles, rate and uplink, whether
    it limits the rate and pictures are held back, and their server's vehicles, cores in use
    and cores."""

    vehicles: Floats
    rate_hz: Floats
    uplink_bps: Floats
    link_limited: Floats
    held: Floats
    server_vehicles: Floats
    server_busy: Floats
    server_cores: Floats


def age_samples_s(costs: Costs, shared: SharedLoad, seed: int) -> Floats:
    """Return ages of pictures at their reconstruction, [R, AGE_SAMPLES] of equal weight.

    The same points are taken for every cell, so that a cell with more of everything has no age that
    is less.
    """
    if not costs.unexplained_s:
        raise InvalidInput("unexplained_s", "is empty; give 0 s where nothing else delays frames")
    random = np.random.default_rng(seed)
    points = (np.arange(AGE_SAMPLES) + 0.5) / AGE_SAMPLES
    at_link, at_server, at_size, at_camera, at_hold, at_rest = (
        random.permutation(points)[None] for _ in range(6)
    )
    link = _LinkTimes(costs, shared)
    camera = np.ceil(at_camera * costs.cameras)
    ratio = np.quantile(costs.frame_ratios, at_size)
    own_s = link.frame_s * ratio * camera
    worker_s = _server_wait_s(costs, shared, at_server)
    turn_s = np.floor((camera - 1) / shared.server_cores[:, None]) * costs.server_s
    turn_s = np.maximum(turn_s - (camera - 1) * link.frame_s, 0.0)
    rest_s = np.quantile(costs.unexplained_s, at_rest)
    fixed_s = costs.sender_s + costs.propagation_s + costs.server_s
    held_s = shared.held[:, None] * at_hold / costs.hz
    waits_s = held_s + link.wait_s(at_link) + worker_s + turn_s
    return np.asarray(fixed_s + waits_s + own_s + rest_s)


class _LinkTimes:
    """Times on the uplink of each cell: columns [R, 1]."""

    def __init__(self, costs: Costs, shared: SharedLoad) -> None:
        self._costs = costs
        self._vehicles = shared.vehicles[:, None]
        self._rate_hz = shared.rate_hz[:, None]
        self._limited = shared.link_limited[:, None]
        self.frame_s = 8 * costs.frame_bytes / shared.uplink_bps[:, None]

    def wait_s(self, at_link: Floats) -> Floats:
        """Return waits behind other vehicles; in a saturated cell those that credits allow."""
        costs = self._costs
        instant_s = costs.cameras * self.frame_s
        others = np.maximum(self._vehicles - 1, 0.0)
        load = others * self._rate_hz * instant_s
        wait_s = instant_s * queue_wait(at_link, others, load, costs.size_variance)
        round_s = WINDOW_FRAMES * self._vehicles * instant_s
        full_s = np.maximum(round_s - costs.path_s - instant_s, wait_s)
        mixed = self._limited * full_s + (1 - self._limited) * wait_s
        return np.asarray(mixed)


def _server_wait_s(costs: Costs, shared: SharedLoad, chance: Floats) -> Floats:
    cores, vehicles = shared.server_cores[:, None], shared.server_vehicles[:, None]
    others = np.maximum(vehicles - 1, 0.0)
    load = shared.server_busy[:, None] / cores * others / np.maximum(vehicles, 1.0)
    own_load = shared.rate_hz[:, None] * costs.server_s
    busy = _all_busy(cores, load, own_load, costs.cameras)
    wait = queue_wait(chance, others, load, 0.0, busy)
    return np.asarray(wait * costs.cameras * costs.server_s / cores)
