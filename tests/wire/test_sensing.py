"""What a frame says of its time and of its pose comes over as it was said."""

from dataclasses import replace

import pytest

from rfcore.localise.estimate import LocalisationState
from rfcore.wire.convert import client_message_from_wire, client_message_to_wire
from rfcore.wire.messages import Frame
from rfcore.wire.values import ClockKind


@pytest.mark.parametrize("clock", [None, *ClockKind])
@pytest.mark.parametrize("localisation", [None, *LocalisationState])
def test_clock_and_localisation_survive_the_wire(
    frame: Frame, clock: ClockKind | None, localisation: LocalisationState | None
) -> None:
    said = replace(frame, clock=clock, localisation=localisation)
    assert client_message_from_wire(client_message_to_wire(said)) == said


def test_what_is_not_said_takes_no_bytes(frame: Frame) -> None:
    said = replace(frame, clock=ClockKind.ARRIVAL, localisation=LocalisationState.TRACKING)
    silent = client_message_to_wire(frame)
    assert client_message_to_wire(said).ByteSize() - silent.ByteSize() == 6


def test_a_number_of_a_newer_peer_counts_as_not_said(frame: Frame) -> None:
    message = client_message_to_wire(frame)
    message.frame.capture_clock = 99  # type: ignore[assignment]
    message.frame.localisation = 99  # type: ignore[assignment]
    assert client_message_from_wire(message) == frame
