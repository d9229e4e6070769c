"""The settings both services share are refused by the name of the option."""

from collections.abc import Callable
from pathlib import Path

import pytest
import tyro

from rfcore.errors import InvalidInput
from rfcore.wire.settings import OPTIONS, MetricsSettings, RenderSettings, TransportSettings


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: RenderSettings(threads=0), "threads: 0 is outside 1..256"),
        (lambda: RenderSettings(threads=1000), "threads: 1000 is outside 1..256"),
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
    metrics = tyro.cli(
        MetricsSettings, config=OPTIONS, args=["--metrics-port", "9", "--metrics-per-vehicle"]
    )
    assert metrics == MetricsSettings(port=9, per_vehicle=True)
