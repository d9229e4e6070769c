"""The fenced blocks of a documentation page, and the commands in them."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


@dataclass(frozen=True)
class Page:
    """A page of docs, by its file's name."""

    name: str

    @property
    def text(self) -> str:
        """Return the page."""
        return (DOCS / self.name).read_text(encoding="utf-8")

    def blocks(self, language: str) -> list[str]:
        """Return the blocks that are marked with a language, without the fences."""
        return re.findall(rf"^```{language}\n(.*?)^```", self.text, re.MULTILINE | re.DOTALL)

    def commands(self, language: str) -> Iterator[list[str]]:
        """Return the arguments of each line of ``rfedge`` in those blocks."""
        for block in self.blocks(language):
            for line in block.splitlines():
                if line.startswith("rfedge "):
                    yield shlex.split(line, comments=True)[1:]
