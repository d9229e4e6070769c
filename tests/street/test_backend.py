"""Which Mitsuba runs: a bad LLVM is found out without ending this process."""

import sys
from pathlib import Path

import pytest

from rfcore.errors import BackendUnavailable
from rfedge.street.render import backend


def test_the_newest_llvm_comes_first_one_a_version_and_none_too_old(tmp_path: Path) -> None:
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


def test_a_library_that_cannot_render_leaves_the_scalar_variant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "libLLVM-99.so").write_bytes(b"no library")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-99.so"))
    assert backend.chosen_backend() == backend.Backend("scalar_rgb")


def test_a_library_that_aborts_the_process_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stood in for by a Python that aborts for one library and renders with the other."""
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\ncase "$DRJIT_LIBLLVM_PATH" in *LLVM-18*) kill -ABRT $$;; esac\n')
    python.chmod(0o755)
    for name in ("libLLVM-18.so", "libLLVM-17.so"):
        (tmp_path / name).touch()
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.setattr(backend, "FOLDERS", (str(tmp_path),))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    chosen = backend.chosen_backend()
    assert (chosen.variant, Path(chosen.llvm).name) == ("llvm_ad_rgb", "libLLVM-17.so")


@pytest.mark.parametrize("missing", ["mitsuba", "pyoidn", "scipy"])
def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(
        BackendUnavailable, match=rf"^{missing} is missing: pip install 'rfedge\[scene\]'$"
    ):
        backend.require_renderer()
