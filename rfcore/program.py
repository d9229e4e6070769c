"""Run a command-line program of the project: parse, work, report errors.

Options are the fields of frozen dataclasses, their docstrings are the ``--help``; a boolean is
false by default, and its text says what the flag does. A verb is such a class with a ``run``
method. Heavy imports happen when work begins, so that ``--help`` is immediate.
A user's mistake ends in one line on stderr and exit status 2, never in a traceback.
"""

from __future__ import annotations

import inspect
import io
import os
import re
import select
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from typing import Any, Protocol, get_args, get_type_hints

import tyro
from tyro.conf import (
    DisallowNone,
    EnumChoicesFromValues,
    FlagCreatePairsOff,
    OmitArgPrefixes,
    OmitSubcommandPrefixes,
    PositionalMetavarFromFieldName,
)

from rfcore.errors import RfedgeError

CONFIG = (
    OmitArgPrefixes,
    OmitSubcommandPrefixes,
    DisallowNone,
    EnumChoicesFromValues,
    FlagCreatePairsOff,
    PositionalMetavarFromFieldName,
)
"""Options are named as their fields, choices are written in lower case as in files and on the wire,
flags have one form, and help shows neither None nor PATH where a word says more."""


def working(what: str) -> AbstractContextManager[object]:
    """Say on standard error what takes long while the block lasts: soon, then ever more rarely."""
    from rfcore.wire.waits import waiting

    def say(what: str, since_s: float) -> None:
        sys.stderr.write(f"{what}: {since_s:.0f} s so far\n")
        sys.stderr.flush()

    return waiting(what, say)


SIGPIPE_STATUS = 141
"""Exit status that shells report for a program that SIGPIPE ended."""


class Verb(Protocol):
    """One command with its options."""

    def run(self) -> None:
        """Run the command."""


def parse_options(
    kind: Any, name: str, arguments: Sequence[str] | None = None, description: str | None = None
) -> Any:
    """Return the options of program ``name`` as a ``kind``, one class or a union of verbs.

    They come from ``arguments``, by default those of this process. Prints help, or what is wrong
    with them, and raises ``SystemExit``.
    """
    _wrap_help_as_paragraphs()
    words = list(sys.argv[1:] if arguments is None else arguments)
    words = _up_to_unknown_verb(kind, words)
    return tyro.cli(kind, prog=name, description=description, args=words, config=CONFIG)


def _up_to_unknown_verb(kind: Any, words: list[str]) -> list[str]:
    """Return the words up to a verb that there is not, so that a ``--help`` behind it is not
    answered with the help of what stands before."""
    for number, word in enumerate(words, 1):
        verbs = verbs_of(kind)
        if not verbs or word.startswith("-"):
            break
        if word not in verbs:
            return words[:number]
        kind = verbs[word]
    return words


def verbs_of(kind: Any) -> dict[str, Any]:
    """Return what can stand next: the verbs of a union, or of the union that is a class's field."""
    if is_dataclass(kind):
        hints = map(get_args, get_type_hints(kind, include_extras=True).values())
        return next(filter(None, (verbs_of(hint[0]) for hint in hints if hint)), {})
    pairs = [get_args(each) for each in get_args(kind)]
    return {pair[1].name: pair[0] for pair in pairs if len(pair) == 2 and is_dataclass(pair[0])}


def option_names(kind: Any) -> list[str]:
    """Return the options of a dataclass and of those in it, without dashes."""
    types, names = get_type_hints(kind, include_extras=True), []
    for field in fields(kind):
        inner, *notes = get_args(types[field.name]) or (types[field.name],)
        if is_dataclass(inner):
            names += option_names(inner)
        else:
            named = (note.name for note in notes if getattr(note, "name", None))
            names.append(next(named, field.name.replace("_", "-")))
    return names


def service_options(kind: Any, name: str) -> Any:
    """Return the options of service ``name``, of its command line and its ``--config`` file.

    Its logs have their form from now on, and what renders was found to be there. Raises
    ``RfedgeError`` for what cannot be.
    """
    from rfcore.wire.settings import configure_logs, words_of_command_line

    words = words_of_command_line(sys.argv[1:], option_names(kind))
    config = parse_options(kind, name, words)
    configure_logs(sys.stderr, config.log)
    config.render.check()
    return config


def run_program(name: str, work: Callable[[], None]) -> int:
    """Do ``work``, which begins with parsing the command line, and return the exit status."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # so that a log file gets each line at once
        sys.stdout.reconfigure(line_buffering=True)
    try:
        return _run(name, work)
    except BrokenPipeError as error:
        if not _nobody_reads():
            print(f"{name}: {error}", file=sys.stderr)
            return 2
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at the exit
        return SIGPIPE_STATUS


@cache
def _wrap_help_as_paragraphs() -> None:
    """Let tyro wrap the docstring of an option as one paragraph.

    tyro 1.0 breaks it where the source does. Another version without this function keeps its own
    line breaks.
    """
    module, name = sys.modules.get("tyro._docstrings"), "parse_docstring_from_object"
    parse = getattr(module, name, None)
    if parse is None:
        return

    def cleaned(documented: object) -> dict[str, str]:
        return {option: _paragraphs(text) for option, text in parse(documented).items()}

    setattr(module, name, cleaned)


def _paragraphs(text: str) -> str:
    return re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.cleandoc(text))


def _nobody_reads() -> bool:
    """Return whether standard output is a pipe whose reader is gone, like `head`."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _run(name: str, work: Callable[[], None]) -> int:
    if sys.argv[1:] == ["--version"]:
        print(f"{name} {version('rfedge')}")
        return 0
    try:
        work()
    except BrokenPipeError:
        raise
    except (RfedgeError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return 130
    return 0
