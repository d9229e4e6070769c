"""The dashboard of a server's capacity, and of those who watch its twin."""

from __future__ import annotations

from rfedge.dashboards.grafana import Dashboard, Look, Panel, Query, Unit, stages_of

__all__ = ["CAPACITY"]

SERVER = "instance=~'$instance'"

CAPACITY = Dashboard(
    "rfedge-capacity",
    "rfedge: server capacity",
    "How much more a server can take, and what will break first.",
    "mec-server",
    (
        Panel(
            "Workers busy",
            "Share of the workers that render, splice and decode; above 90 % everybody is late.",
            Unit.SHARE,
            (Query(f"instance:rfedge_server_workers_busy:ratio1m{{{SERVER}}}"),),
        ),
        Panel(
            "Where the time goes",
            "Mean time of a frame by stage; queue grows first when workers are short.",
            Unit.SECONDS,
            (Query(stages_of("rfedge_server_stage_seconds"), "{{stage}}"),),
            stacked=True,
        ),
        Panel(
            "Arrival to Ack",
            "Half and 99 in 100 frames are answered within this time.",
            Unit.SECONDS,
            tuple(
                Query(
                    f"histogram_quantile({share}, sum by (le) (rate("
                    f"rfedge_server_frame_seconds_bucket{{{SERVER}}}[$__rate_interval])))",
                    f"p{round(100 * share)}",
                )
                for share in (0.5, 0.99)
            ),
        ),
        Panel(
            "Processor",
            "Cores the server keeps busy.",
            Unit.COUNT,
            (
                Query(
                    f"rate(process_cpu_seconds_total{{job='mec-server', {SERVER}}}"
                    "[$__rate_interval])"
                ),
            ),
        ),
        Panel(
            "Memory",
            "Resident memory; a slope that stays is a leak.",
            Unit.BYTES,
            (Query(f"process_resident_memory_bytes{{job='mec-server', {SERVER}}}"),),
        ),
        Panel(
            "Open files",
            "File descriptors as a share of what the process may have.",
            Unit.SHARE,
            (
                Query(
                    f"process_open_fds{{job='mec-server', {SERVER}}} "
                    f"/ process_max_fds{{job='mec-server', {SERVER}}}"
                ),
            ),
        ),
        Panel(
            "Consumers",
            "Who watches the twin now.",
            Unit.COUNT,
            (Query(f"rfedge_twin_consumers{{{SERVER}}}"),),
            Look.NUMBER,
        ),
        Panel(
            "Consumers by end",
            "left is normal; slow took nothing for long; refused came beyond the limit.",
            Unit.COUNT,
            (
                Query(
                    f"sum by (reason) (increase(rfedge_twin_consumers_ended_total{{{SERVER}}}"
                    "[$__range]))",
                    "{{reason}}",
                ),
            ),
            Look.NUMBER,
        ),
        Panel(
            "Pictures to consumers",
            "Handed over, by encoding, and missed because the consumer was too slow.",
            Unit.PER_S,
            (
                Query(
                    f"sum by (encoding) (rate(rfedge_twin_pictures_sent_total{{{SERVER}}}"
                    "[$__rate_interval]))",
                    "{{encoding}}",
                ),
                Query(
                    f"sum(rate(rfedge_twin_pictures_missed_total{{{SERVER}}}[$__rate_interval]))",
                    "missed",
                ),
            ),
        ),
        Panel(
            "Age at the consumer",
            "99 in 100 pictures are younger than this when they are handed to a consumer.",
            Unit.SECONDS,
            (
                Query(
                    "histogram_quantile(0.99, sum by (le) (rate(rfedge_twin_sent_age_seconds_bucket"
                    f"{{{SERVER}}}[$__rate_interval])))",
                    "p99",
                ),
            ),
        ),
        Panel(
            "Bytes to consumers",
            "What watching the twin costs.",
            Unit.BITS_PER_S,
            (Query(f"8 * rate(rfedge_twin_sent_bytes_total{{{SERVER}}}[$__rate_interval])"),),
        ),
        Panel(
            "Recording",
            "1 while pictures are recorded; 0 when none are asked for or the disk refused.",
            Unit.COUNT,
            (Query(f"rfedge_server_recording{{{SERVER}}}"),),
            Look.NUMBER,
        ),
    ),
)
