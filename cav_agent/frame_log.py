"""One JSON line per captured picture: what it cost and how it ended."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TextIO

from cav_agent.frames import FrameResult

__all__ = ["FrameLog", "log_line"]


class FrameLog:
    """Writes lines as pictures end; the file is complete up to the last line at any time."""

    def __init__(self, path: Path) -> None:
        self._file: TextIO = path.open("w", buffering=1)

    def ended(self, result: FrameResult) -> None:
        """Append one line."""
        self._file.write(json.dumps(log_line(result)) + "\n")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def log_line(result: FrameResult) -> dict[str, Any]:
    """Return the line of a picture; what it did not reach is null."""
    packet, server = result.packet, result.server
    stage_ms = {name: spent_s * 1e3 for name, spent_s in result.stage_s.items()}
    if server is not None:
        for stage in ("queue", "render", "splice", "decode", "total"):
            stage_ms[f"server_{stage}"] = getattr(server, f"{stage}_ns") / 1e6
    if result.link_s is not None:
        stage_ms["link"] = result.link_s * 1e3
    return {
        "name": result.capture.picture.name,
        "index": result.capture.index,
        "capture_time_ns": result.capture.capture_time_ns,
        "result": str(result.outcome),
        "reason": result.reason,
        "epoch": packet.epoch if packet else None,
        "sequence": packet.sequence if packet else None,
        "references": [r.name.lower() for r in packet.references] if packet else None,
        "payload_bytes": len(packet.payload) if packet else None,
        "tries": result.tries if packet else None,
        "rung": result.rung.name if result.rung else None,
        "crf": result.crf,
        "target_bytes": result.budget.target_bytes if result.budget else None,
        "packet_bytes": result.packet_bytes if packet else None,
        "render_digest": packet.render_digest.hex() if packet else None,
        "reconstruction_digest": packet.reconstruction_digest.hex() if packet else None,
        "server_digest": result.server_digest.hex() or None,
        "stage_ms": stage_ms,
        "latency_ms": None if result.latency_s is None else result.latency_s * 1e3,
    }
