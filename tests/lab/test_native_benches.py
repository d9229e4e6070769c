"""Benches check before they time, and their rows have the published keys."""

import json
from dataclasses import replace

import pytest

from forward_isas import DEVICE, OPENCL
from lab.bench import codec, print_rows, raster, run_case, train
from lab.bench.street import street_camera, street_gaussians
from rfcore.camera import Camera
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.opencl.self_check import open_device
from rfcore.views import View
from rfedge.results import write_result

RASTER_KEYS = [
    *("width", "height", "gaussians", "visible", "blends_per_px", "threads", "isa"),
    *("native_ms", "reference_ms", "max_abs_error"),
]
OPENCL_KEYS = [
    *("width", "height", "gaussians", "device", "device_ms", "device_view_ms"),
    *("isa", "threads", "native_ms", "native_view_ms", "ratio"),
]
TRAIN_KEYS = ["width", "height", "gaussians", "threads", "iteration_ms"]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same benches on a street of a thousand Gaussians and thumbnails."""

    def street() -> Gaussians:
        return street_gaussians(1000)

    monkeypatch.setattr(raster, "street_gaussians", street)
    monkeypatch.setattr(raster, "SIZES_PX", ((30, 20), (48, 32)))
    monkeypatch.setattr(raster, "REFERENCE_SIZES_PX", ((30, 20),))
    monkeypatch.setattr(train, "SIZES_PX", ((48, 32),))


@pytest.mark.slow
def test_a_device_is_named_with_its_driver_beside_the_cpu(monkeypatch):
    monkeypatch.setattr(raster, "street_gaussians", lambda: street_gaussians(1000))
    monkeypatch.setattr(raster, "OPENCL_SIZES_PX", ((30, 20), (48, 32)))
    rows = run_case("raster", isa=OPENCL)["rows"]
    assert [list(row) for row in rows] == [OPENCL_KEYS] * 2
    assert {row["device"] for row in rows} == {open_device(DEVICE).description}
    assert all(row["device_ms"] > 0 for row in rows)


@pytest.mark.slow
def test_a_device_that_draws_other_bytes_is_not_timed(monkeypatch):
    monkeypatch.setattr(raster, "street_gaussians", lambda: street_gaussians(1000))
    render = Rasterizer.render

    def brighter(self: Rasterizer, camera: Camera) -> View:
        view = render(self, camera)
        return replace(view, opacity=view.opacity + 1) if self.isa == OPENCL else view

    monkeypatch.setattr(Rasterizer, "render", brighter)
    with pytest.raises(RfedgeError, match=f"the opacity of {OPENCL} is not that of"):
        run_case("raster", isa=OPENCL)


@pytest.mark.usefixtures("small")
def test_raster_rows_have_the_published_keys_and_null_where_not_run():
    rows = run_case("raster", rows="all")["rows"]
    assert [list(row) for row in rows] == [RASTER_KEYS] * 4
    assert [(row["width"], row["threads"]) for row in rows] == [(30, 1), (30, 2), (48, 1), (48, 2)]
    assert rows[0]["max_abs_error"] < 0.05
    assert rows[0]["reference_ms"] > 0
    assert rows[2]["reference_ms"] is rows[2]["max_abs_error"] is None
    native = run_case("raster", rows="native")["rows"]
    assert all(row["reference_ms"] is None and row["native_ms"] > 0 for row in native)


@pytest.mark.usefixtures("small")
def test_a_result_says_where_it_came_from_and_survives_json(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(train, "street_gaussians", lambda count=1000: street_gaussians(count))
    result = run_case("train")
    assert [list(row) for row in result["rows"]] == [TRAIN_KEYS] * 2
    write_result(tmp_path / "train.json", result)
    assert json.loads((tmp_path / "train.json").read_text()) == result
    write_result("-", result)
    assert json.loads(capsys.readouterr().out) == result
    assert {"case", "host", "revision", "rows"} < set(result)
    assert (result["kind"], result["case"]) == ("bench", "train")
    print_rows(result)
    assert "iteration" in capsys.readouterr().out


def test_a_wrong_renderer_is_not_timed(monkeypatch):
    class Wrong(Rasterizer):
        def render_colour(self, camera: object) -> F32:
            return super().render_colour(camera) + 1e-3

    monkeypatch.setattr(raster, "Rasterizer", Wrong)
    with pytest.raises(RfedgeError, match="nothing was timed"):
        raster.check_against_reference(street_gaussians(500), street_camera(20, 12))


def test_an_unknown_case_is_refused_by_name():
    with pytest.raises(InvalidInput, match="'speed' is not one of raster, train, codec"):
        run_case("speed")


def test_every_coder_has_its_row_at_each_number_of_references(monkeypatch):
    monkeypatch.setattr(codec, "street_gaussians", lambda: street_gaussians(2000))
    monkeypatch.setattr(codec, "SIZES_PX", ((64, 48),))
    monkeypatch.setattr(codec, "THREADS", (2,))
    monkeypatch.setattr(codec, "WARM_UP", 1)
    monkeypatch.setattr(codec, "REPETITIONS", 2)
    rows = codec.codec_rows()
    for row in rows:
        assert row.receiver_ms["last byte"] > 0
        assert row.receiver_ms["total"] > 0
    assert [(row.references, row.effort) for row in rows] == [
        (references, effort) for references in (1, 3) for effort in codec.EFFORTS
    ]
    for row in rows:
        assert (row.threads, row.width, row.height) == (2, 64, 48)
        assert row.payload_bytes > 0
        assert row.psnr_db > 25
        assert row.sender_ms["total"] > row.sender_ms["render"] > 0
        assert row.receiver_ms["total"] > 0
        assert row.sender_ms["relight"] == row.receiver_ms["relight"] > 0
