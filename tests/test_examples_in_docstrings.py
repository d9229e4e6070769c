"""The examples in the docstrings of public entry points do what they say.

Each runs beside the samples, in a folder that takes what it writes. A package adds its entry points
to ``ENTRY_POINTS``.
"""

import doctest
import inspect
from importlib import import_module
from pathlib import Path

import pytest
import structlog

ROOT = Path(__file__).parents[1]
ENTRY_POINTS = [
    "mec_server.server.EdgeServer",
    "rfcore.dataset.read.read_dataset",
    "rfcore.link.plan.read_link",
    "rfcore.link.shaper.Link",
    "rfcore.localise.localiser.Localiser",
    "rfcore.wire.drive_file.read_drive",
    "cav_agent.vehicle.Vehicle",
    "rfcore.codec.sender.encoder.DeltaEncoder",
    "rfcore.field.interface.render_field_view",
    "rfcore.field.store.load_field",
    "rfcore.field.store.save_field",
    "rfcore.train.splats.SplatTrainer",
    "rfedge.offline.encode_drive",
]


@pytest.mark.sample
@pytest.mark.parametrize("name", ENTRY_POINTS)
def test_the_example_of_an_entry_point_runs(name, tmp_path, monkeypatch):
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    monkeypatch.chdir(tmp_path)
    module_name, _, attribute = name.rpartition(".")
    module = import_module(module_name)
    text = inspect.getdoc(getattr(module, attribute)) or ""
    example = doctest.DocTestParser().get_doctest(text, vars(module).copy(), name, None, None)
    assert example.examples, "the docstring has no example"
    report: list[str] = []
    outcome = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(
        example, out=report.append
    )
    structlog.reset_defaults()
    assert outcome.failed == 0, "".join(report)
