"""``docs/sizing.md`` is what the shipped tables say."""

from pathlib import Path

from lab.pages.sizing import COMMAND, EXAMPLE, sizing_page
from rfedge.cli import parse
from rfedge.results import read_result
from rfedge.sizing.tables import SHIPPED

PAGE = Path(__file__).parents[2] / "docs" / "sizing.md"


def test_the_page_is_that_of_the_tables_that_ship() -> None:
    assert PAGE.read_text() == sizing_page(read_result(SHIPPED)), "make figures"


def test_the_example_s_command_asks_what_its_answer_is_about() -> None:
    verb = parse(COMMAND.split()[1:])
    asked = (verb.cameras, verb.size, verb.hz, verb.db, verb.delay_ms, verb.share)
    shown = f"{EXAMPLE.width_px}x{EXAMPLE.height_px}"
    told = (EXAMPLE.cameras, shown, EXAMPLE.hz, EXAMPLE.psnr_db, EXAMPLE.delay_ms, EXAMPLE.share)
    assert asked == told
