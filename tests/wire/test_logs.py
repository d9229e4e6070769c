"""A log line says whom it is about, in a form that machines or people read."""

import io
import json
from collections.abc import Iterator

import pytest
import structlog

from rfcore.wire.settings import LogForm, configure_logs


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    yield
    structlog.reset_defaults()


def written(stream: io.StringIO, form: LogForm) -> str:
    configure_logs(stream, form)
    with structlog.contextvars.bound_contextvars(vehicle="cav-1"):
        structlog.get_logger().bind(session="s-7").warning("frame lost", seq=3, reason="crc")
    return stream.getvalue()


@pytest.mark.parametrize("form", [LogForm.AUTO, LogForm.JSON])
def test_off_a_terminal_a_line_is_one_json_object_with_vehicle_session_and_seq(
    form: LogForm,
) -> None:
    (line,) = written(io.StringIO(), form).splitlines()
    said = json.loads(line)
    assert said.pop("timestamp").endswith("Z")
    assert said == {
        "event": "frame lost",
        "level": "warning",
        "vehicle": "cav-1",
        "session": "s-7",
        "seq": 3,
        "reason": "crc",
    }


def test_a_terminal_gets_colours_and_a_console_elsewhere_none() -> None:
    assert "\x1b[" in written(Terminal(), LogForm.AUTO)
    plain = written(io.StringIO(), LogForm.CONSOLE)
    assert "\x1b[" not in plain
    assert "vehicle=cav-1" in plain


def test_json_can_be_asked_for_on_a_terminal() -> None:
    assert json.loads(written(Terminal(), LogForm.JSON))["seq"] == 3


def test_an_exception_stays_on_its_line() -> None:
    stream = io.StringIO()
    configure_logs(stream)
    try:
        raise ValueError("no\nway")
    except ValueError:
        structlog.get_logger().exception("failed")
    (line,) = stream.getvalue().splitlines()
    assert "ValueError" in json.loads(line)["exception"]
