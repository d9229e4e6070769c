"""Names and numbers that both ends rely on agree with the generated code and with each other."""

import grpc
import pytest

from every_error import every_error
from mec_server.peers import status_of
from rfcore.errors import RejectReason, RfedgeError
from rfcore.wire.conventions import (
    CHANNEL_OPTIONS,
    MAX_MESSAGE_BYTES,
    SERVER_OPTIONS,
    STREAM_METHOD,
)
from rfcore.wire.v1 import edge_pb2
from rfcore.wire.values import MAX_PAYLOAD_BYTES


@pytest.mark.parametrize("error", every_error(), ids=lambda e: type(e).__name__)
def test_every_error_has_a_status_and_only_the_root_is_internal_by_default(
    error: RfedgeError,
) -> None:
    status = status_of(error)
    assert status is not grpc.StatusCode.OK
    expected_internal = type(error).__name__ in ("RfedgeError", "CodecError", "TrainingDiverged")
    assert (status is grpc.StatusCode.INTERNAL) == expected_internal


def test_the_stream_method_is_the_one_of_the_proto() -> None:
    service = edge_pb2.DESCRIPTOR.services_by_name["EdgeService"]
    assert f"/{service.full_name}/{service.methods[0].name}" == STREAM_METHOD


def test_every_reject_reason_is_on_the_wire_under_the_same_name() -> None:
    on_wire = {
        name.removeprefix("REJECT_REASON_")
        for name in edge_pb2.RejectReason.DESCRIPTOR.values_by_name
    }
    assert on_wire == {reason.name for reason in RejectReason}


def test_the_largest_payload_fits_a_message_with_its_header() -> None:
    assert MAX_PAYLOAD_BYTES + 1024 < MAX_MESSAGE_BYTES


def test_the_server_permits_the_keepalive_of_the_client_with_margin() -> None:
    client, server = dict(CHANNEL_OPTIONS), dict(SERVER_OPTIONS)
    permitted_ms = server["grpc.http2.min_ping_interval_without_data_ms"]
    assert 2 * permitted_ms <= client["grpc.keepalive_time_ms"]
