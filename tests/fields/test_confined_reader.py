"""A .ply is read in a process without rights: the same splats, the same refusals."""

from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import TileOrigin
from rfcore.confinement.confine import Confinement
from rfcore.errors import BackendUnavailable, FieldFormatError
from rfcore.field import read_splat_file, write_ply
from rfcore.raster.gaussians import Gaussians
from rfedge.fields.confined_reader import read_confined

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
        there, stated, confinement = read_confined(ply, origin, MAX_BYTES, (kind,))
        here, _ = read_splat_file(ply, origin)
        for name, array in vars(here).items():
            np.testing.assert_array_equal(getattr(there, name), array)
        assert (stated, confinement) == (True, kind)


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
    assert read_confined(ply, None, MAX_BYTES)[2] is Confinement.LANDLOCK
    with pytest.raises(BackendUnavailable, match=r"bwrap is not on PATH.*give --unconfined"):
        read_confined(ply, None, MAX_BYTES, (Confinement.BUBBLEWRAP,))


def test_a_missing_file_is_one_error(tmp_path):
    with pytest.raises(FieldFormatError, match=r"none\.ply: cannot be read"):
        read_confined(tmp_path / "none.ply", None, MAX_BYTES)
