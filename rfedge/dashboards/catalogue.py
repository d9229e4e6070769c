"""The dashboards of fleet, vehicle and server, and the list of all."""

from __future__ import annotations

from rfedge.dashboards.catalogue_link import CODEC, LINK
from rfedge.dashboards.grafana import Dashboard, Panel, PanelKind, Query, Unit, share_of, stages_of

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
            PanelKind.NUMBER,
        ),
        Panel(
            "Age of the twin",
            "Seconds since the capture of the newest picture, of the vehicle where it is oldest.",
            Unit.SECONDS,
            (Query(f"rfedge_twin_age_seconds{{{SERVER}}}", "{{instance}} {{vehicle}}"),),
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
            (
                Query(
                    "8 * sum by (instance) (rate(rfedge_server_received_bytes_total"
                    f"{{{SERVER}}}[$__rate_interval]))"
                ),
            ),
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
            PanelKind.TABLE,
        ),
        Panel(
            "Fields in use",
            "Radiance fields that servers hold open and agents code against.",
            Unit.COUNT,
            (
                Query("count by (job, field, kind) (rfedge_server_field_info)", ""),
                Query("count by (job, field, kind) (rfedge_agent_field_info)", ""),
            ),
            PanelKind.TABLE,
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
            PanelKind.NUMBER,
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
            PanelKind.NUMBER,
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
                    f"histogram_quantile({share}, sum by (instance, le) (rate("
                    "rfedge_agent_capture_to_ack_seconds_bucket"
                    "{instance=~'$instance'}[$__rate_interval])))",
                    f"{{{{instance}}}} p{round(100 * share)}",
                )
                for share in (0.5, 0.99)
            ),
        ),
        Panel(
            "Acknowledged within 150 ms",
            "Of all pictures captured, dropped and lost ones included; wanted: 99 %.",
            Unit.SHARE,
            (
                Query(
                    share_of(
                        "sum by (instance) (rate(rfedge_agent_capture_to_ack_seconds_bucket"
                        "{le='0.15', instance=~'$instance'}[$__rate_interval]))",
                        "sum by (instance) (rate(rfedge_agent_frames_total"
                        "{instance=~'$instance'}[$__rate_interval]))",
                    )
                ),
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
            "Pose in the field",
            "Share of frames that were tracked; the others are coded without the field. Only with "
            "--localise.",
            Unit.SHARE,
            (
                Query(
                    "sum by (instance) (rate(rfedge_agent_pose_frames_total"
                    "{instance=~'$instance', state='tracking'}[$__rate_interval])) / "
                    "sum by (instance) (rate(rfedge_agent_pose_frames_total"
                    "{instance=~'$instance'}[$__rate_interval]))"
                ),
            ),
        ),
        Panel(
            "Correction of the pose",
            "Metres between the pose found and what the sensors said. Only with --localise.",
            Unit.COUNT,
            (Query("rfedge_agent_pose_correction_metres{instance=~'$instance'}"),),
        ),
        Panel(
            "Poses of the vehicle's sensors",
            "Fixes a second that are used, and problems a second by reason. Only with --pose-feed.",
            Unit.COUNT,
            (
                Query(
                    "sum(rate(rfedge_agent_pose_feed_fixes_total"
                    "{instance=~'$instance'}[$__rate_interval]))",
                    "used",
                ),
                Query(
                    "sum by (reason) (rate(rfedge_agent_pose_feed_problems_total"
                    "{instance=~'$instance'}[$__rate_interval]))",
                    "{{reason}}",
                ),
            ),
        ),
        Panel(
            "Time offset of the pose feed",
            "Seconds to add to the feed's times to get the camera's; 0 until the motion tells.",
            Unit.SECONDS,
            (Query("rfedge_agent_pose_feed_offset_seconds{instance=~'$instance'}"),),
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
            "Budgets",
            "Share of what may be held that is held: by all, and by the identity that holds most.",
            Unit.SHARE,
            tuple(
                Query(
                    f"sum by (resource) (rfedge_server_{held}{{{SERVER}}}) "
                    f"/ (sum by (resource) (rfedge_server_{budget}{{{SERVER}}}) > 0)",
                    f"{whose}: {{{{resource}}}}",
                )
                for held, budget, whose in (
                    ("held", "budget", "all"),
                    ("most_held", "identity_budget", "one"),
                )
            ),
        ),
        Panel(
            "Refused",
            "Calls, streams and frames a second that a limit refused; all zero where all is well.",
            Unit.PER_S,
            (
                Query(
                    f"sum by (limit) (rate(rfedge_server_limited_total{{{SERVER}}}"
                    "[$__rate_interval]))",
                    "{{limit}}",
                ),
            ),
        ),
        Panel(
            "Consumers",
            "Who watches the twin now.",
            Unit.COUNT,
            (Query(f"rfedge_twin_consumers{{{SERVER}}}"),),
            PanelKind.NUMBER,
        ),
        Panel(
            "Consumers by end",
            "left is normal; slow took nothing for long, idle asked nothing; refused: too many.",
            Unit.COUNT,
            (
                Query(
                    f"sum by (reason) (increase(rfedge_twin_consumers_ended_total{{{SERVER}}}"
                    "[$__range]))",
                    "{{reason}}",
                ),
            ),
            PanelKind.NUMBER,
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
            "NATS",
            "1 while pictures are published over NATS; 0 without --nats, or while it is away.",
            Unit.COUNT,
            (Query(f"rfedge_twin_nats_connected{{{SERVER}}}"),),
            PanelKind.NUMBER,
        ),
        Panel(
            "Pictures to NATS",
            "Published, by encoding, and dropped because NATS was too slow, too small or away.",
            Unit.PER_S,
            (
                Query(
                    f"sum by (encoding) (rate(rfedge_twin_nats_published_total{{{SERVER}}}"
                    "[$__rate_interval]))",
                    "{{encoding}}",
                ),
                Query(
                    f"sum(rate(rfedge_twin_nats_dropped_total{{{SERVER}}}[$__rate_interval]))",
                    "dropped",
                ),
            ),
        ),
        Panel(
            "Notices to vehicles",
            "What vehicles that take notices are told: objects ahead, other maps, other lights.",
            Unit.PER_S,
            (
                Query(
                    f"sum by (kind) (rate(rfedge_twin_notices_total{{{SERVER}}}"
                    "[$__rate_interval]))",
                    "{{kind}}",
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
            PanelKind.NUMBER,
        ),
        Panel(
            "Lights of the tiles",
            "Fields of other lights that each tile publishes, and the passes they come from.",
            Unit.COUNT,
            (
                Query(f"rfedge_server_tile_lights{{{SERVER}}}", "{{instance}} {{tile}}"),
                Query(f"rfedge_server_tile_passes{{{SERVER}}}", "{{instance}} {{tile}} passes"),
            ),
        ),
        Panel(
            "Bytes a picture by tile",
            "Coded bytes of a picture, by the tile of its field: after a new version they must not "
            "rise.",
            Unit.BYTES,
            (
                Query(
                    "sum by (instance, tile) (rate(rfedge_server_tile_payload_bytes_total"
                    f"{{{SERVER}}}[$__rate_interval])) / (sum by (instance, tile) (rate("
                    f"rfedge_server_tile_pictures_total{{{SERVER}}}[$__rate_interval])) > 0)",
                    "{{instance}} {{tile}}",
                ),
            ),
        ),
        Panel(
            "Saved by learning",
            "Share of bits that each tile's last learnt field saved on frames held back.",
            Unit.SHARE,
            (Query(f"rfedge_server_tile_saved_ratio{{{SERVER}}}", "{{instance}} {{tile}}"),),
        ),
        Panel(
            "Since the last update",
            "How long ago the learning process published a field of each tile.",
            Unit.SECONDS,
            (
                Query(
                    f"time() - rfedge_server_tile_learnt_timestamp_seconds{{{SERVER}}}",
                    "{{instance}} {{tile}}",
                ),
            ),
        ),
        Panel(
            "Updates withdrawn",
            "Learnt fields that made somebody's bits more and were rolled back.",
            Unit.COUNT,
            (Query(f"rfedge_server_tile_withdrawals_total{{{SERVER}}}", "{{instance}} {{tile}}"),),
        ),
    ),
)

DASHBOARDS = (FLEET, VEHICLE, CAPACITY, LINK, CODEC)
