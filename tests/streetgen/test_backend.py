"""Which Mitsuba runs: a bad LLVM is found out without ending this process."""

import sys
from pathlib import Path

import pytest

from rfcore.errors import BackendUnavailable
from streetgen.render import backend


def test_the_newest_llvm_comes_first_one_a_version_and_none_too_old(tmp_path):
    for name in (
        "libLLVM-18.so",
        "libLLVM-18.so.1",
        "libLLVM-17.so",
        "libLLVM-16.so",
        "libLLVM-9.so",
        "libLLVM.so.19.1",
        "libLLDB.so",
    ):
        (tmp_path / name).touch()
    found = backend.installed_llvms([str(tmp_path), "/nowhere"])
    assert [Path(name).name for name in found] == [
        "libLLVM.so.19.1",
        "libLLVM-18.so",
        "libLLVM-17.so",
    ]


def test_a_library_that_cannot_render_leaves_the_scalar_variant(tmp_path, monkeypatch):
    (tmp_path / "libLLVM-99.so").write_bytes(b"no library")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-99.so"))
    monkeypatch.setattr(backend, "_has_cuda", lambda: False)
    assert backend.chosen_backend() == backend.Backend("scalar_rgb")


def test_a_library_that_aborts_the_process_is_passed_over(tmp_path, monkeypatch):
    """Stood in for by a Python that aborts for one library and renders with the other."""
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\ncase "$DRJIT_LIBLLVM_PATH" in *LLVM-18*) kill -ABRT $$;; esac\n')
    python.chmod(0o755)
    for name in ("libLLVM-18.so", "libLLVM-17.so"):
        (tmp_path / name).touch()
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.setattr(backend, "FOLDERS", (str(tmp_path),))
    monkeypatch.setattr(backend, "_has_cuda", lambda: False)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    chosen = backend.chosen_backend()
    assert (chosen.variant, Path(chosen.llvm).name) == ("llvm_ad_rgb", "libLLVM-17.so")


@pytest.fixture
def with_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with CUDA's driver and LLVM 17; return the Python that its probes run."""
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\n")
    python.chmod(0o755)
    (tmp_path / "libLLVM-17.so").touch()
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.setattr(backend, "FOLDERS", (str(tmp_path),))
    monkeypatch.setattr(backend, "_has_cuda", lambda: True)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    return python


@pytest.mark.usefixtures("with_driver")
def test_a_gpu_comes_first_unless_another_variant_is_named():
    assert backend.chosen_backend() == backend.Backend("cuda_ad_rgb")
    assert backend.chosen_backend("cuda") == backend.Backend("cuda_ad_rgb")
    assert backend.chosen_backend("llvm").variant == "llvm_ad_rgb"
    assert backend.chosen_backend("scalar") == backend.Backend("scalar_rgb")


def test_a_gpu_without_optix_is_passed_over_and_refused_by_name(with_driver):
    """Stood in for by a Python that aborts for CUDA's variant, as Mitsuba may without OptiX."""
    with_driver.write_text('#!/bin/sh\n[ "$3" != cuda_ad_rgb ] || kill -ABRT $$\n')
    assert backend.chosen_backend().variant == "llvm_ad_rgb"
    with pytest.raises(BackendUnavailable, match="NVIDIA GPU and a driver with OptiX"):
        backend.chosen_backend("cuda")


def test_an_llvm_that_is_asked_for_and_not_there_is_an_error(monkeypatch):
    monkeypatch.setattr(backend, "FOLDERS", ())
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    with pytest.raises(BackendUnavailable, match="DRJIT_LIBLLVM_PATH names it"):
        backend.chosen_backend("llvm")
