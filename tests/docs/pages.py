"""The pages of the documentation, their fenced blocks, and the commands in them."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PROGRAMS = ("rfedge", "cav-agent", "mec-server", "streetgen", "rfedge-lab")


@dataclass(frozen=True)
class Page:
    """A Markdown file, by its path in ``docs``."""

    name: str

    @property
    def text(self) -> str:
        """Return the page."""
        return (DOCS / self.name).read_text(encoding="utf-8")

    def blocks(self, language: str) -> list[str]:
        """Return the blocks that are marked with a language, without the fences."""
        return re.findall(rf"^```{language}\n(.*?)^```", self.text, re.MULTILINE | re.DOTALL)

    def commands(self, *languages: str) -> Iterator[list[str]]:
        """Return the words of each line of those blocks that runs one of our programs."""
        for language in languages:
            for block in self.blocks(language):
                yield from commands(block)


def commands(block: str) -> Iterator[list[str]]:
    """Return the words of each line that runs one of our programs; ``\\`` joins lines."""
    for line in block.replace("\\\n", " ").splitlines():
        for part in re.split(r" [&|]+ |; | &$", line.removeprefix("$ ")):
            if part.split(" ")[0] in PROGRAMS:
                words = shlex.split(part.partition(" > ")[0], comments=True)
                yield [word for word in words if word != "&"]
