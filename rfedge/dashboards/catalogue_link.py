"""The dashboards of a link, as ``rfedge link`` sees it, and of the codec."""

from __future__ import annotations

from rfedge.dashboards.grafana import Dashboard, Panel, PanelKind, Query, Unit, share_of

__all__ = ["CODEC", "LINK"]

ANY = "{instance=~'$instance'}"


def _by_references(metric: str) -> str:
    return f"sum by (references) (rate({metric}{ANY}[$__rate_interval]))"


def _all(metric: str) -> str:
    return f"scalar(sum(rate({metric}{ANY}[$__rate_interval])))"


LINK = Dashboard(
    "rfedge-link",
    "rfedge: link",
    "What `rfedge link` lets through in each direction, and how true it is to its profile.",
    "link",
    (
        Panel(
            "Throughput",
            "Bytes on the wire, HTTP/2 and all, beside the rate of the profile.",
            Unit.BITS_PER_S,
            (
                Query(
                    f"8 * rate(rfedge_link_bytes_total{ANY}[$__rate_interval])",
                    "{{instance}} {{direction}}",
                ),
                Query(
                    f"8 * rfedge_link_rate_bytes_per_second{ANY}",
                    "{{instance}} {{direction}} rate",
                ),
            ),
        ),
        Panel(
            "Busy",
            "Share of the time the link transmits; at 1 it decides the frame rate.",
            Unit.SHARE,
            (
                Query(
                    f"rate(rfedge_link_busy_seconds_total{ANY}[$__rate_interval])",
                    "{{instance}} {{direction}}",
                ),
            ),
        ),
        Panel(
            "Time in the link",
            "99 in 100 segments are through within this time: queue, transmission and delay.",
            Unit.SECONDS,
            (
                Query(
                    "histogram_quantile(0.99, sum by (instance, direction, le) (rate("
                    f"rfedge_link_transit_seconds_bucket{ANY}[$__rate_interval])))",
                    "{{instance}} {{direction}}",
                ),
            ),
        ),
        Panel(
            "Held",
            "Bytes in the link: waiting, or under way.",
            Unit.BYTES,
            (Query(f"rfedge_link_held_bytes{ANY}", "{{instance}} {{direction}}"),),
        ),
        Panel(
            "Connections",
            "Open now, and cut by the profile in the time shown.",
            Unit.COUNT,
            (
                Query(f"rfedge_link_connections{ANY}", "{{instance}} open"),
                Query(
                    f"increase(rfedge_link_connections_cut_total{ANY}[$__range])",
                    "{{instance}} cut",
                ),
            ),
            PanelKind.NUMBER,
        ),
        Panel(
            "Latest release",
            "How late the latest release was: the emulation's own error, not the link's.",
            Unit.SECONDS,
            (Query(f"rfedge_link_lateness_max_seconds{ANY}", "{{instance}} {{direction}}"),),
        ),
    ),
)

CODEC = Dashboard(
    "rfedge-codec",
    "rfedge: codec",
    "Which reference pictures frames predict from, and what that costs in bits.",
    "mec-server",
    (
        Panel(
            "Bits by reference",
            "P slices, by the reference pictures they predict from.",
            Unit.BITS_PER_S,
            (
                Query(
                    f"8 * {_by_references('rfedge_server_payload_bytes_total')}", "{{references}}"
                ),
            ),
            stacked=True,
        ),
        Panel(
            "Share of frames each reference won",
            "Of the frames received, how many predict from which pictures.",
            Unit.SHARE,
            (
                Query(
                    f"{_by_references('rfedge_server_coded_frames_total')} "
                    f"/ {_all('rfedge_server_coded_frames_total')}",
                    "{{references}}",
                ),
            ),
            stacked=True,
        ),
        Panel(
            "Bytes a frame by reference",
            "Mean P slice; a reference that wins with many bytes wins where nothing is known.",
            Unit.BYTES,
            (
                Query(
                    share_of(
                        _by_references("rfedge_server_payload_bytes_total"),
                        _by_references("rfedge_server_coded_frames_total"),
                    ),
                    "{{references}}",
                ),
            ),
        ),
        Panel(
            "Header's share",
            "Of the bytes received, what is pose, digests and framing instead of picture.",
            Unit.SHARE,
            (
                Query(
                    "1 - sum by (instance) (rate(rfedge_server_payload_bytes_total"
                    f"{ANY}[$__rate_interval])) / (sum by (instance) (rate("
                    f"rfedge_server_received_bytes_total{ANY}[$__rate_interval])) > 0)"
                ),
            ),
        ),
        Panel(
            "Inexact frames",
            "Decoded against a render that differs from the vehicle's by rounding; 0 between exact "
            "renderers.",
            Unit.PER_S,
            (Query(f"rate(rfedge_server_inexact_frames_total{ANY}[$__rate_interval])"),),
        ),
        Panel(
            "Sent by vehicles, by reference",
            "P slices as the vehicles count them; more than received was lost or refused.",
            Unit.BITS_PER_S,
            (
                Query(
                    "8 * sum by (references) (rate(rfedge_agent_payload_bytes_total"
                    "[$__rate_interval]))",
                    "{{references}}",
                ),
            ),
            stacked=True,
        ),
    ),
)
