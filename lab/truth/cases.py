"""Runs cases on the product that Python finds, so that another revision's can be measured too.

``python -m lab.truth.cases [--comma FOLDER] [NAME ...]`` prints a line of JSON for each case whose
name contains one of the names. A case that cannot be run has ``not_run``, the reason.
"""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lab.truth import cameras, gnss

Case = tuple[str, Callable[[], dict[str, Any]]]


def cases(comma: Path | None) -> Iterator[Case]:
    """Yield every case by its name."""
    for camera in cameras.CASES:
        yield camera.name, partial(cameras.run_camera, camera)
    yield cameras.RIG, cameras.run_rig
    for served in cameras.SERVED_CASES:
        yield served.name, partial(cameras.run_served, served)
    for receiver in gnss.CASES:
        yield receiver.name, partial(gnss.run_sentences, receiver)
    for receiver in gnss.GPSD_CASES:
        yield receiver.name, partial(gnss.run_gpsd, receiver)
    for drive in gnss.DRIVES:
        yield drive.name, partial(gnss.run_drive, drive, comma)


def run_cases(wanted: Sequence[str], comma: Path | None) -> Iterator[dict[str, Any]]:
    """Run the cases whose names contain one of ``wanted``, or all; yield their rows."""
    for name, run in cases(comma):
        if wanted and not any(each in name for each in wanted):
            continue
        try:
            yield {"case": name, **run()}
        except Exception as error:  # an older revision may lack anything
            yield {"case": name, "not_run": f"{type(error).__name__}: {error}"[:300]}


def main() -> None:
    """Print the rows."""
    parser = ArgumentParser(prog="lab.truth.cases")
    parser.add_argument("--comma", type=Path)
    parser.add_argument("names", nargs="*")
    asked = parser.parse_args()
    for row in run_cases(asked.names, asked.comma):
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
