"""The committed figures page is what the committed result files say."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from lab.pages.results import (
    HEADLINE_BEGINS,
    HEADLINE_ENDS,
    HEADLINE_RESULTS,
    SECTIONS,
    main,
    results_page,
    with_headline,
    write_figures,
)
from rfcore.errors import InvalidInput
from rfedge.evaluate.ladder.page import ladder_page
from rfedge.results import Provenance, make_result, read_result, write_result

ROOT = Path(__file__).parents[2]
HOST = {"cpu": "C", "cores": 2, "isa": "avx2"}
MADE = Provenance("rfedge bench codec", "abc123", False, HOST, {})
ANY_ROW = {"attacks", "bench", "ladder", "faults", "stability"}
"""Kinds that the page shows whatever their rows hold, or only counts."""
RIG = {"link_bps": 1e6, "crf": 23.0, "rate_hz": 2.0, "max_delay_ms": 500.0}
CODEC_ROW = {"width": 64, "sender_ms": {"render": 1.25, "total": 3.0}, "reference_ms": None}
RUN = {
    "views": 120,
    "width": 640,
    "height": 360,
    "held_out": {"psnr_db": 28.517, "ssim": None},
    "seconds": 299.6,
    "iterations": 5000,
    "primitives": 250_000,
    "bytes": 5_040_000,
}


def page_of(folder: Path, kind: str, **content: Any) -> str:
    write_result(folder / f"{kind}.json", make_result(kind, MADE, content))
    return results_page(folder)


# --- what is committed


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """Files of each committed result's figures, the drawings left out: these depend on the version
    of matplotlib, and take long."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Figure, "savefig", lambda *_args, **_options: None)
        return write_figures(ROOT / "results", tmp_path_factory.mktemp("figures"))


def test_the_page_is_generated_from_the_result_files(drawn: dict[str, list[Path]]) -> None:
    page = (ROOT / "docs" / "results.md").read_text()
    assert page == results_page(ROOT / "results", drawn), "run `make figures`"


def test_every_figure_that_the_page_shows_is_committed() -> None:
    shown = re.findall(r"!\[[^]]*\]\((.*?)\)", (ROOT / "docs" / "results.md").read_text())
    assert len(shown) >= 15
    for name in shown:
        assert (ROOT / "docs" / name).is_file(), name


def test_the_readmes_headline_is_generated_from_the_result_file() -> None:
    readme = (ROOT / "README.md").read_text()
    told = (read_result(ROOT / "results" / f"{name}.json", "compare") for name in HEADLINE_RESULTS)
    assert readme == with_headline(readme, *told), "run `make figures`"
    table = readme.partition(HEADLINE_BEGINS)[2].partition(HEADLINE_ENDS)[0]
    assert "kitti-loop, 10 Hz" in table
    assert "best of all rivals" in table


def test_a_page_without_a_place_for_the_headline_is_refused() -> None:
    with pytest.raises(InvalidInput, match="it lacks"):
        with_headline("# A page\n", {"rows": []}, {"rows": []})


def test_the_ladders_page_is_generated_from_the_result_files() -> None:
    result = read_result(ROOT / "results" / "ladder.json", "ladder")
    runs = {p.stem: read_result(p, "training") for p in sorted(ROOT.glob("results/train/*.json"))}
    assert (ROOT / "docs" / "ladder.md").read_text() == ladder_page(result, runs)


def test_the_numbers_beside_the_figures_are_those_of_the_result_files(
    drawn: dict[str, list[Path]],
) -> None:
    numbers = [path for files in drawn.values() for path in files if path.suffix == ".csv"]
    assert len(numbers) >= 15
    for path in numbers:
        committed = ROOT / "docs" / "figures" / path.name
        assert committed.read_text() == path.read_text(), "run `make figures`"


def test_every_committed_result_has_its_section() -> None:
    page = results_page(ROOT / "results")
    for path in ROOT.glob("lab/results/*.json"):
        result = json.loads(path.read_text())
        assert f"## {path.stem}\n\n`{result['command']}` at `{result['revision']}`" in page


# --- what the page says


def test_a_bench_result_becomes_a_table_with_its_provenance(tmp_path: Path) -> None:
    page = page_of(tmp_path, "bench", case="codec", rows=[CODEC_ROW])
    assert "| width | sender_ms.render | sender_ms.total | reference_ms |" in page
    assert "| 64 | 1.25 | 3.00 | not run |" in page
    assert "`rfedge bench codec` at `abc123`; C, 2 cores, avx2." in page


def test_a_bench_without_rows_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"bench\.json has no rows"):
        page_of(tmp_path, "bench", case="codec", rows=[])


@pytest.mark.parametrize(
    ("kind", "rows", "text"),
    [
        ("ladder", {"rows": [{}] * 3}, "3 rungs: `docs/ladder.md`."),
        ("faults", {"rows": [{}] * 2}, "2 faults: `docs/reliability.md`."),
        ("stability", {"cases": [{}] * 4}, "4 cases: `docs/stability.md`."),
    ],
)
def test_results_with_a_page_of_their_own_are_counted_and_referred_to(
    tmp_path: Path, kind: str, rows: dict[str, Any], text: str
) -> None:
    assert page_of(tmp_path, kind, **rows).endswith(f"C, 2 cores, avx2.\n\n{text}\n")


def test_training_runs_share_a_table_and_name_their_commands(tmp_path: Path) -> None:
    made = Provenance("rfedge train street --minutes 5", "abc123", False, HOST, {})
    for name, run in (
        ("street", RUN),
        ("alley", {**RUN, "held_out": dict.fromkeys(("psnr_db", "ssim"))}),
    ):
        write_result(tmp_path / "train" / f"{name}.json", make_result("training", made, run))
    page = results_page(tmp_path)
    assert "| street | 120 | 640x360 | 28.52 | - | 300 | 5000 | 250000 | 5.0 |" in page
    assert "| alley | 120 | 640x360 | - | - | 300 | 5000 | 250000 | 5.0 |" in page
    assert "* street: `rfedge train street --minutes 5` at `abc123`" in page
    assert page.count("## training") == 1


def test_sections_stand_in_the_order_of_their_names(tmp_path: Path) -> None:
    for name in ("b", "a-2", "a"):
        result = make_result("bench", MADE, {"case": name, "rows": [CODEC_ROW]})
        write_result(tmp_path / f"{name}.json", result)
    page = results_page(tmp_path)
    titles = [line for line in page.splitlines() if line.startswith("## ")]
    assert titles == ["## a-2", "## a", "## b"], "as files sort"
    assert page == results_page(tmp_path)


# --- what is refused


def test_a_foreign_file_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(InvalidInput, match=r"notes\.json is no result file"):
        results_page(tmp_path)


def test_an_unknown_kind_is_refused_with_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(
        InvalidInput, match=r"speed\.json: kind 'speed' is none of adapt, attacks, bench"
    ):
        page_of(tmp_path, "speed", rows=[])


def test_an_empty_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="holds no result file"):
        results_page(tmp_path)


@pytest.mark.parametrize("kind", sorted(SECTIONS.keys() - ANY_ROW))
def test_rows_of_another_shape_are_refused_by_every_section(tmp_path: Path, kind: str) -> None:
    """A row that says nothing a section knows: each names what it lacks, none shows a blank."""
    content = {"rows": [{"colour": 1}], "needed": [{"colour": 1}], "disturbances": []}
    content |= {"frames": {"count": 1, "drive": "d"}, "equal_rate_kbps": 1.0, "quality_db": 33.0}
    content |= {"played_frames": 1, "requirement": {"share": 0.9, "frames_needed": 9}}
    content |= {"sequences": {"empty": {"colour": 1}}, "settings": RIG}
    content |= {"ages": [{"colour": 1}], "ingest": [], "sources": [], "sessions": []}
    with pytest.raises(InvalidInput, match=r"row 0 lacks .* and has unknown colour"):
        page_of(tmp_path, kind, **content)


def test_page_and_figures_are_written_together(tmp_path: Path) -> None:
    """From the command line, with one small result that has a figure."""
    results, docs = tmp_path / "results", tmp_path / "docs"
    loss = {"method": "ours", "rtt_ms": 20.0, "loss_percent": 1.0, "ssim": 0.9, "ssim_p5": 0.8}
    content = {"rows": [loss], "disturbances": [], "equal_rate_kbps": 100.0, "quality_db": 33.0}
    content |= {"frames": {"count": 4, "drive": "d@10=x.json"}}
    write_result(results / "robust.json", make_result("robust", MADE, content))
    docs.mkdir()
    main(results, docs)
    page = (docs / "results.md").read_text()
    assert page.startswith(results_page(results))
    assert page.endswith("\n![loss ssim](figures/loss_ssim.svg)\n")
    figures = {path.name for path in (docs / "figures").iterdir()}
    assert figures == {"loss_ssim.svg", "loss_ssim.csv"}
