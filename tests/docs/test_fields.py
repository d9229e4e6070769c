"""The commands of docs/how-to/fields.md and docs/how-to/training.md are commands, and their options
exist."""

import re

import pytest

from docs.pages import Page
from rfedge.arguments import IMPORTED, SAMPLES
from rfedge.cli import parse
from rfedge.cli.train import Train

FIELDS, TRAINING = Page("how-to/fields.md"), Page("how-to/training.md").text


@pytest.mark.parametrize("command", list(FIELDS.commands("sh")), ids=" ".join)
def test_every_command_of_the_page_is_one(command: list[str]) -> None:
    assert parse(command) is not None


def test_the_page_shows_what_can_be_done_with_a_field() -> None:
    assert len(list(FIELDS.commands("sh"))) == 7


def test_the_page_says_where_names_are_looked_up() -> None:
    for folder in (IMPORTED, SAMPLES):
        assert f"`{folder}/NAME.rff`" in FIELDS.text


def test_every_option_in_the_table_of_training_is_one_of_the_verb() -> None:
    table = TRAINING[: TRAINING.index("## ")]
    options = set(re.findall(r"`(--[a-z-]+)", table))
    assert {"--iterations", "--holdout", "--plain"} <= options
    known = {f"--{name.replace('_', '-')}" for name in Train.__dataclass_fields__}
    assert options <= known
