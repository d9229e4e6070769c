"""Splats are read in a process without rights: the same ones, the same refusals."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import TileOrigin
from rfcore.confinement import start
from rfcore.confinement.confine import Confinement
from rfcore.confinement.start import ConfinedProgram
from rfcore.errors import BackendUnavailable, FieldFormatError
from rfcore.field import read_splat_file, write_ply
from rfcore.field.gltf import encode_glb
from rfcore.field.spz import encode_spz
from rfcore.raster.gaussians import Gaussians
from rfedge.fields.confined_reader import read_confined
from tests.field.some import as_text, compressed_ply

MAX_BYTES = 1 << 24
ORIGIN = TileOrigin(1.0, 2.0, 0.1)
KINDS = [Confinement.LANDLOCK, pytest.param(Confinement.BUBBLEWRAP, marks=pytest.mark.slow)]


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    rng = np.random.default_rng(5)
    shapes = ((50, 3), (50, 4), (50, 3), (50,), (50, 4, 3))
    arrays = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    write_ply(tmp_path / "a.ply", Gaussians(*arrays), antialiased=True)
    return tmp_path / "a.ply"


@pytest.mark.parametrize("kind", KINDS)
def test_the_splats_are_those_read_in_this_process(ply, kind):
    for origin in (None, ORIGIN):
        there, confinement = read_confined(ply, origin, MAX_BYTES, (kind,))
        here = read_splat_file(ply, origin)
        for name, array in vars(here.splats).items():
            np.testing.assert_array_equal(getattr(there.splats, name), array)
        assert replace(there, splats=here.splats) == here
        assert confinement == kind


def written(ply: Path) -> dict[str, bytes]:
    """The same splats in each format that is read."""
    splats = read_splat_file(ply).splats
    zstandard = encode_spz(splats, antialiased=True, version=4)
    at = 32 + 8 + 3  # the coordinate system, in the one extension: RUB
    return {
        "text .ply": as_text(ply),
        "compressed .ply": compressed_ply(splats),
        "glb": encode_glb(splats, antialiased=True, up=(0.6, 0.0, 0.8)),
        "spz 3": encode_spz(splats, antialiased=True, version=3),
        "spz 4": zstandard,
        "spz 4 in RUB": zstandard[: at - 3] + b"\x04" + zstandard[at - 2 :],
    }


@pytest.mark.parametrize("kind", KINDS)
def test_every_format_is_read_in_the_sandbox(ply, tmp_path, kind):
    for name, content in written(ply).items():
        (tmp_path / "a").write_bytes(content)
        there, _ = read_confined(tmp_path / "a", None, MAX_BYTES, (kind,))
        here = read_splat_file(tmp_path / "a")
        assert len(here.splats) == 50, name
        for key, array in vars(here.splats).items():
            np.testing.assert_array_equal(getattr(there.splats, key), array, err_msg=name)
        assert replace(there, splats=here.splats) == here, name


def test_a_reader_that_a_signal_kills_is_said_to_be(ply, monkeypatch):
    class Killed(ConfinedProgram):
        def start(self, *_: object) -> subprocess.Popen[bytes]:
            text = "import os, signal; os.write(1, b'.'); os.kill(os.getpid(), signal.SIGSYS)"
            command = [sys.executable, "-c", text]
            return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    monkeypatch.setattr(start, "ConfinedProgram", Killed)
    with pytest.raises(FieldFormatError, match=r"a\.ply: its reader was killed by signal SIGSYS"):
        read_confined(ply, None, MAX_BYTES, (Confinement.LANDLOCK,))


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_wrong_is_said_in_the_same_words(ply, kind):
    ply.write_bytes(ply.read_bytes()[:-1])
    with pytest.raises(FieldFormatError) as here:
        read_splat_file(ply)
    with pytest.raises(FieldFormatError) as there:
        read_confined(ply, None, MAX_BYTES, (kind,))
    assert str(there.value) == str(here.value)


def test_what_takes_too_much_memory_is_refused(ply):
    with pytest.raises(FieldFormatError, match=r"50 of SH degree 1 take .* raise it"):
        read_confined(ply, None, 50 * 23 * 4 - 1, (Confinement.LANDLOCK,))


def test_the_next_confinement_is_tried_and_none_at_all_is_an_error(ply, monkeypatch):
    monkeypatch.setattr("rfcore.confinement.start.shutil.which", lambda _: None)
    assert read_confined(ply, None, MAX_BYTES)[1] is Confinement.LANDLOCK
    with pytest.raises(BackendUnavailable, match=r"bwrap is not on PATH.*give --unconfined"):
        read_confined(ply, None, MAX_BYTES, (Confinement.BUBBLEWRAP,))


def test_a_missing_file_is_one_error(tmp_path):
    with pytest.raises(FieldFormatError, match=r"none\.ply: cannot be read"):
        read_confined(tmp_path / "none.ply", None, MAX_BYTES)
