"""The settings both services share are refused by the name of the option."""

from collections.abc import Callable
from pathlib import Path

import pytest

from rfcore.errors import BackendUnavailable, InvalidInput
from rfcore.program import parse_options
from rfcore.wire.settings import MetricsSettings, RenderSettings, TransportSettings


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: RenderSettings(threads=0), "threads: 0 is outside 1..256"),
        (lambda: RenderSettings(threads=1000), "threads: 1000 is outside 1..256"),
        (
            lambda: RenderSettings(renderer="gpu"),
            "renderer: 'gpu' is neither cpu nor opencl[:DEVICE]",
        ),
        (
            lambda: RenderSettings(isa="avx2", renderer="opencl"),
            "isa: 'avx2' is for --renderer cpu, not for opencl",
        ),
        (lambda: MetricsSettings(port=-1), "metrics_port: -1 is outside 0..65535"),
        (lambda: MetricsSettings(port=70000), "metrics_port: 70000 is outside 0..65535"),
        (
            lambda: TransportSettings(certificate=Path("a.pem")),
            "tls: --tls-cert, --tls-key and --tls-ca belong together",
        ),
    ],
)
def test_a_bad_setting_is_refused_by_the_name_of_its_option(
    make: Callable[[], object], said: str
) -> None:
    with pytest.raises(InvalidInput) as caught:
        make()
    assert str(caught.value) == said


def test_groups_become_flat_options() -> None:
    metrics = parse_options(
        MetricsSettings, "mec-server", ["--metrics-port", "9", "--metrics-per-vehicle"]
    )
    assert metrics == MetricsSettings(port=9, per_vehicle=True)


def test_a_renderer_is_a_device_or_the_cpu_with_an_instruction_set() -> None:
    assert RenderSettings().field_isa is None
    assert RenderSettings(isa="avx2").field_isa == "avx2"
    assert RenderSettings(renderer="opencl:1").field_isa == "opencl:1"


def test_what_this_machine_lacks_is_refused_before_a_service_starts() -> None:
    with pytest.raises(BackendUnavailable, match="'vax' is not available here"):
        RenderSettings(isa="vax").check()
