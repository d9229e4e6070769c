"""The page of ``rfedge localise --report``: errors over time, matches drawn, what was lost and why.

Matches are found anew for the pictures shown, between the picture and the render at the pose found
(at the start, where the camera was lost); those that agree with the pose are green.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose
from rfcore.extras import needs
from rfcore.field import FULL, Renderer
from rfcore.image import Rgb, rgb_from_colour
from rfcore.localise.localiser import LocaliserSettings, Lost, Obstacle
from rfcore.localise.matching import find_features, grey, lift_matches, match_features
from rfedge.localisation.searches import SearchOutcome, SearchSummary, pose_difference
from rfedge.report.charts import BLUE, GREY, RENDER, embedded, new_axes, svg
from rfedge.report.page import write_page
from rfedge.results import provenance

with needs("localise"):
    import cv2

WHY = {
    Obstacle.FEW_FEATURES: "the picture has too few features: dark, fog, or out of focus",
    Obstacle.FEW_INLIERS: "no pose explains enough of the matches between picture and render",
    Obstacle.IMPLAUSIBLE: "the pose found is too far from what was known",
    Obstacle.UNLIKE: "the render at the pose found does not resemble the picture",
}
LEAST_M, LEAST_DEG = 1e-4, 1e-4
"""Less is drawn as this: the axes are logarithmic."""
MOST_LINES = 60
GREEN, RED = (40, 200, 90), (230, 70, 60)


def write_localise_report(
    path: Path, field: Renderer, row: SearchSummary, tries: Sequence[SearchOutcome]
) -> None:
    """Write the page about the searches of one drive."""
    write_page(
        path,
        "localisation/report.html.j2",
        f"{row.localised_percent:.1f} % of {row.tries} pictures found their pose",
        asdict(provenance()),
        row=row,
        line=str(row),
        position_svg=_chart(tries, "position, m", 0, LEAST_M),
        rotation_svg=_chart(tries, "rotation, degrees", 1, LEAST_DEG),
        shown=[_shown(field, which, attempt) for which, attempt in _chosen(tries)],
        lost=_lost(tries),
    )


def _chart(tries: Sequence[SearchOutcome], label: str, which: int, least: float) -> str:
    """Return errors of start and of the pose found over time, or over the pictures' number."""
    times_s = [attempt.picture.time_ns / 1e9 for attempt in tries]
    timed = len(times_s) > 1 and all(np.diff(times_s) > 0)
    at = np.array(times_s) - times_s[0] if timed else np.arange(len(tries), dtype=float)
    truths = [attempt.picture.camera.world_from_cam for attempt in tries]
    started = [
        pose_difference(truth, attempt.start)[which]
        for truth, attempt in zip(truths, tries, strict=True)
    ]
    errors = [(attempt.error_m, attempt.error_deg)[which] for attempt in tries]
    figure, axes = new_axes()
    axes.semilogy(at, np.maximum(started, least), ".", color=GREY, label="start")
    right = [i for i, attempt in enumerate(tries) if attempt.right]
    wrong = [i for i, a in enumerate(tries) if not a.right and errors[i] is not None]
    for indices, colour, name in ((right, BLUE, "found"), (wrong, RENDER, "found, not accurate")):
        if indices:
            found = [max(errors[i] or 0.0, least) for i in indices]
            axes.semilogy(at[indices], found, "o", color=colour, markersize=4, label=name)
    lost = [i for i, attempt in enumerate(tries) if errors[i] is None]
    if lost:
        top = np.full(len(lost), max([*started, least]))
        axes.semilogy(at[lost], top, "x", color="#be185d", label="lost")
    axes.set_xlabel("seconds" if timed else "number of the search")
    axes.set_ylabel(f"error of the {label}")
    axes.legend(frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.2))
    return svg(figure)


def _chosen(tries: Sequence[SearchOutcome]) -> list[tuple[str, SearchOutcome]]:
    """Return the best, the median and the worst pose found, and the first picture lost."""
    found = sorted(
        (attempt for attempt in tries if attempt.error_m is not None),
        key=lambda attempt: attempt.error_m or 0.0,
    )
    chosen = []
    if found:
        places = {"best": 0, "median": len(found) // 2, "worst": len(found) - 1}
        chosen = [(f"The {name} pose", found[place]) for name, place in places.items()]
    lost = [attempt for attempt in tries if attempt.error_m is None]
    return [*chosen, *(("The first one lost", attempt) for attempt in lost[:1])]


def _shown(field: Renderer, title: str, attempt: SearchOutcome) -> dict[str, Any]:
    answer = attempt.answer
    if isinstance(answer, Lost):
        pose, note = attempt.start, f"lost: {WHY[answer.obstacle]}"
    else:
        pose = answer.world_from_cam
        note = (
            f"{attempt.error_m:.4f} m and {attempt.error_deg:.4f} degrees off; "
            f"{answer.solution.inliers} inliers, {answer.agreement:.0f} standard deviations of "
            f"chance, {answer.hypotheses} tried, {attempt.milliseconds:.0f} ms"
        )
    drawn, agree, count = _drawn(field, attempt, pose)
    caption = f"{attempt.picture.name} | render: {agree} of {count} matches agree with the pose"
    return {"title": title, "note": note, "pictures": embedded([(caption, drawn)])}


def _drawn(field: Renderer, attempt: SearchOutcome, pose: Pose) -> tuple[Rgb, int, int]:
    """Return picture and render beside each other with matches, how many agree, how many are."""
    settings, k = LocaliserSettings(), attempt.picture.camera.intrinsics
    camera = Camera(k, pose)
    view = field.render(camera, FULL)
    render = rgb_from_colour(view.colour)
    rgb = attempt.picture.read()
    seen, drawn = (find_features(grey(picture), settings.features) for picture in (rgb, render))
    pairs = match_features(seen, drawn, settings.ratio)
    matches = lift_matches(pairs, view, k, settings.least_confidence)
    z = matches.xyz_m[:, 2:]
    focal, centre = (k.fx_px, k.fy_px), (k.cx_px - 0.5, k.cy_px - 0.5)
    there_px = matches.xyz_m[:, :2] / z * focal + centre
    agrees = np.linalg.norm(there_px - matches.uv_px, axis=1) <= settings.inlier_px
    canvas = np.ascontiguousarray(np.concatenate([rgb, render], axis=1))
    for index in _spread(len(agrees)):
        colour = GREEN if agrees[index] else RED
        _line(canvas, matches.uv_px[index], there_px[index] + (k.width_px, 0), colour)
    return canvas, int(agrees.sum()), len(agrees)


def _spread(count: int) -> NDArray[np.int64]:
    """Return at most ``MOST_LINES`` indices, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_LINES)).astype(np.int64))


def _line(
    canvas: Rgb, a: NDArray[np.float64], b: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    ends = [(round(float(x)), round(float(y))) for x, y in (a, b)]
    cv2.line(canvas, ends[0], ends[1], colour, 1, cv2.LINE_AA)
    for end in ends:
        cv2.circle(canvas, end, 3, colour, 1, cv2.LINE_AA)


def _lost(tries: Sequence[SearchOutcome]) -> list[dict[str, Any]]:
    """Return the pictures that were lost, with their reason."""
    return [
        {
            "name": attempt.picture.name,
            "why": WHY[attempt.answer.obstacle],
            "hypotheses": attempt.answer.hypotheses,
            "milliseconds": attempt.milliseconds,
        }
        for attempt in tries
        if isinstance(attempt.answer, Lost)
    ]
