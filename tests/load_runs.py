"""Runs of load tests that nobody had to drive."""

from dataclasses import replace

from rfedge.loadtest.plan import Load, Mode, Verdict
from rfedge.loadtest.run import LoadRow, Run


def row_of(**changes: object) -> LoadRow:
    row = LoadRow(
        mode="receiver",
        vehicles=8,
        hz=10.0,
        width=640,
        height=360,
        held=False,
        p50_ms=20.5,
        p99_ms=None,
        due=800,
        answered=790,
        on_time_percent=97.25,
        on_time_at_least_percent=96.1,
        fairness=0.9,
        limited_by="server's workers",
        broken=["97.25 % on time, below 99 %"],
        kind="prerecorded",
        cameras=1,
        payload_bytes=4123.4,
        link=None,
        duration_s=20.0,
        vehicle_ms=0.0,
        admission=False,
        refused=0,
        failed=0,
        reduced=0,
        nacked=0,
        server_cores=1.5,
        server_loop_cores=0.25,
        vehicles_cores=0.1,
        links_cores=0.0,
        others_cores=0.0,
        server_growth_mb=0.5,
        generator_lag_ms=1.0,
    )
    return replace(row, **changes)


def load_run(vehicles: int, *, held: bool, mode: Mode = Mode.RECEIVER, hz: float = 10.0) -> Run:
    broken = () if held else ("p99 130 ms above 100 ms",)
    verdict = Verdict(broken, 20.5, 130.0, 800, 790, 97.25, 96.1, 0.9, f"limit of {vehicles}")
    row = row_of(mode=str(mode), vehicles=vehicles, hz=hz, held=held, broken=broken, p99_ms=130.0)
    row = replace(row, limited_by=verdict.limited_by)
    latency_ms = [10.0 + k for k in range(20)]
    return Run(Load(mode, vehicles, hz), verdict, row, latency_ms, [4000, 4200], {})
