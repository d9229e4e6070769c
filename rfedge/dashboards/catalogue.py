"""The dashboards: those of fleet and vehicle, and the list of all."""

from __future__ import annotations

from rfedge.dashboards.catalogue_link import CODEC, LINK
from rfedge.dashboards.catalogue_server import CAPACITY
from rfedge.dashboards.grafana import Dashboard, Look, Panel, Query, Unit, stages_of

__all__ = ["DASHBOARDS"]

SERVER = "instance=~'$instance'"

FLEET = Dashboard(
    "rfedge-fleet",
    "rfedge: fleet",
    "All vehicles of all servers: are they there, is what is seen of them fresh, what is lost.",
    "mec-server",
    (
        Panel(
            "Streams",
            "Vehicles that stream now, by server.",
            Unit.COUNT,
            (Query(f"rfedge_server_sessions{{{SERVER}}}"),),
            Look.NUMBER,
        ),
        Panel(
            "Age of the twin",
            "Seconds since the capture of the newest picture, of the vehicle where it is oldest.",
            Unit.SECONDS,
            (Query(f"rfedge_twin_age_seconds{{{SERVER}}}"),),
        ),
        Panel(
            "Frames by result",
            "Frames a second that became pictures (acked) or were refused (nacked).",
            Unit.PER_S,
            (
                Query(
                    f"sum by (result) (instance:rfedge_server_frames:rate1m{{{SERVER}}})",
                    "{{result}}",
                ),
            ),
            stacked=True,
        ),
        Panel(
            "Refused frames by reason",
            "Zero but for faults: a reason that stays names what is wrong.",
            Unit.PER_S,
            (
                Query(
                    "sum by (reason) (rate(rfedge_server_frames_total"
                    f"{{{SERVER}, result='nacked'}}[$__rate_interval]))",
                    "{{reason}}",
                ),
            ),
        ),
        Panel(
            "Capture to picture",
            "Half and 99 in 100 pictures are there within this time; budget 100 ms.",
            Unit.SECONDS,
            tuple(
                Query(
                    f"histogram_quantile({share}, sum by (le) (rate("
                    "rfedge_server_capture_to_picture_seconds_bucket"
                    f"{{{SERVER}}}[$__rate_interval])))",
                    f"p{round(100 * share)}",
                )
                for share in (0.5, 0.99)
            ),
        ),
        Panel(
            "In time",
            "Share of pictures within 100 ms of their capture; wanted: 99 %.",
            Unit.SHARE,
            (Query(f"instance:rfedge_server_in_time:ratio1m{{{SERVER}}}"),),
        ),
        Panel(
            "Bytes received",
            "Coded frames of all vehicles: pose, header, and P slice.",
            Unit.BITS_PER_S,
            (Query(f"8 * rate(rfedge_server_received_bytes_total{{{SERVER}}}[$__rate_interval])"),),
        ),
        Panel(
            "Delivered",
            "Of what vehicles captured, the share that became a picture; the rest was dropped, "
            "lost or refused.",
            Unit.SHARE,
            (Query("instance:rfedge_agent_delivered:ratio1m"),),
        ),
        Panel(
            "What is running",
            "Versions and renderer contracts; two contracts in one fleet do not understand each "
            "other.",
            Unit.COUNT,
            (Query("count by (job, version, renderer_contract) (rfedge_build_info)", ""),),
            Look.TABLE,
        ),
        Panel(
            "Fields in use",
            "Radiance fields that servers hold open and agents code against.",
            Unit.COUNT,
            (
                Query("count by (job, field, kind) (rfedge_server_field_info)", ""),
                Query("count by (job, field, kind) (rfedge_agent_field_info)", ""),
            ),
            Look.TABLE,
        ),
    ),
)

VEHICLE = Dashboard(
    "rfedge-vehicle",
    "rfedge: one vehicle",
    "From camera to Ack, as the vehicle sees it; choose one above.",
    "cav-agent",
    (
        Panel(
            "Connected",
            "1 while a server has welcomed the vehicle.",
            Unit.COUNT,
            (Query("rfedge_agent_connected{instance=~'$instance'}"),),
            Look.NUMBER,
        ),
        Panel(
            "Connections lost",
            "Streams that ended before the drive did, in the time shown.",
            Unit.COUNT,
            (
                Query(
                    "increase(rfedge_agent_connections_lost_total{instance=~'$instance'}[$__range])"
                ),
            ),
            Look.NUMBER,
        ),
        Panel(
            "Pictures by end",
            "Captured pictures a second: acked, or dropped before coding, lost, refused.",
            Unit.PER_S,
            (
                Query(
                    "sum by (result, reason) (rate(rfedge_agent_frames_total"
                    "{instance=~'$instance'}[$__rate_interval]))",
                    "{{result}} {{reason}}",
                ),
            ),
            stacked=True,
        ),
        Panel(
            "Capture to Ack",
            "Half and 99 in 100 pictures are answered within this time.",
            Unit.SECONDS,
            tuple(
                Query(
                    f"histogram_quantile({share}, sum by (le) (rate("
                    "rfedge_agent_capture_to_ack_seconds_bucket"
                    "{instance=~'$instance'}[$__rate_interval])))",
                    f"p{round(100 * share)}",
                )
                for share in (0.5, 0.99)
            ),
        ),
        Panel(
            "Where the time goes",
            "Mean time of a frame by stage; link is from sending to Ack without the server.",
            Unit.SECONDS,
            (Query(stages_of("rfedge_agent_stage_seconds"), "{{stage}}"),),
            stacked=True,
        ),
        Panel(
            "Bytes sent",
            "Coded frames, and what of them is P slice.",
            Unit.BITS_PER_S,
            (
                Query(
                    "8 * rate(rfedge_agent_sent_bytes_total{instance=~'$instance'}"
                    "[$__rate_interval])",
                    "{{instance}} all",
                ),
                Query(
                    "8 * sum by (instance) (rate(rfedge_agent_payload_bytes_total"
                    "{instance=~'$instance'}[$__rate_interval]))",
                    "{{instance}} P slices",
                ),
            ),
        ),
        Panel(
            "Memory",
            "Resident memory of the agent; flat after the field is loaded.",
            Unit.BYTES,
            (Query("process_resident_memory_bytes{job='cav-agent', instance=~'$instance'}"),),
        ),
        Panel(
            "Processor",
            "Cores the agent keeps busy.",
            Unit.COUNT,
            (
                Query(
                    "rate(process_cpu_seconds_total{job='cav-agent', instance=~'$instance'}"
                    "[$__rate_interval])"
                ),
            ),
        ),
    ),
)

DASHBOARDS = (FLEET, VEHICLE, CAPACITY, LINK, CODEC)
