"""INRIA .ply files: exact both ways, by header name, refused with a reason."""

import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import TileOrigin
from rfcore.errors import FieldFormatError
from rfcore.field import ply_table
from rfcore.field.ply_table import read_vertices, write_vertices
from rfcore.field.splat_file import read_splat_file
from rfcore.field.splat_ply import write_ply
from rfcore.harmonics import SH_DC
from rfcore.raster.gaussians import Gaussians
from tests.field.some import as_text, compressed_ply, make_gaussians

NAMES = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def read_ply(path: Path, tile_origin: TileOrigin | None = None, **limits: int) -> Gaussians:
    return read_splat_file(path, tile_origin, **limits).splats


def assert_equal(a: Gaussians, b: Gaussians) -> None:
    for name in NAMES:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 7])
def test_gaussians_survive_a_ply(tmp_path, n, sh_degree):
    gaussians = make_gaussians(n, sh_degree)
    write_ply(tmp_path / "a.ply", gaussians)
    assert_equal(read_ply(tmp_path / "a.ply"), gaussians)


def test_the_columns_are_those_of_the_reference_implementation(tmp_path):
    gaussians = make_gaussians(3, 3)
    write_ply(tmp_path / "a.ply", gaussians)
    table = read_vertices(tmp_path / "a.ply", ())
    names = table.dtype.names
    assert names[:9] == ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
    assert names[9:54] == tuple(f"f_rest_{i}" for i in range(45))
    assert names[54:] == (
        *("opacity", "scale_0", "scale_1", "scale_2"),
        *("rot_0", "rot_1", "rot_2", "rot_3"),
    )
    np.testing.assert_array_equal(table["f_dc_1"], gaussians.sh[:, 0, 1])
    np.testing.assert_array_equal(table["f_rest_0"], gaussians.sh[:, 1, 0])
    np.testing.assert_array_equal(table["f_rest_14"], gaussians.sh[:, 15, 0], "red goes first")
    np.testing.assert_array_equal(table["f_rest_15"], gaussians.sh[:, 1, 1], "then green")
    np.testing.assert_array_equal(table["nx"], 0)


@given(st.permutations(range(17)), st.sampled_from(["<f4", "<f8"]))
def test_order_type_and_further_properties_do_not_matter(tmp_path_factory, order, dtype):
    directory = tmp_path_factory.mktemp("ply")
    gaussians = make_gaussians(4, 0)
    write_ply(directory / "a.ply", gaussians)
    table = read_vertices(directory / "a.ply", ())
    names = [table.dtype.names[i] for i in order]
    names = [name for name in names if name not in ("nx", "ny", "nz")] + ["label"]
    other = np.zeros(len(table), [(name, "u1" if name == "label" else dtype) for name in names])
    for name in names[:-1]:
        other[name] = table[name]
    header = ["ply", "format binary_little_endian 1.0", "comment made by hand", "element vertex 4"]
    kinds = {"<f4": "float", "<f8": "double", "u1": "uchar"}
    header += [f"property {kinds['u1' if n == 'label' else dtype]} {n}" for n in names]
    header += ["element face 0", "property list uchar int vertex_indices", "end_header", ""]
    (directory / "b.ply").write_bytes("\n".join(header).encode() + other.tobytes())
    assert_equal(read_ply(directory / "b.ply"), gaussians)


def test_the_tile_origin_is_taken_off_in_float64(tmp_path):
    gaussians = make_gaussians(2, 0)
    write_ply(tmp_path / "a.ply", gaussians)
    moved = read_ply(tmp_path / "a.ply", TileOrigin(1.0, 2.0, 3.0))
    want = (gaussians.means.astype(np.float64) - [1, 2, 3]).astype(np.float32)
    np.testing.assert_array_equal(moved.means, want)


def edited(path: Path, old: str, new: str) -> None:
    path.write_bytes(path.read_bytes().replace(old.encode(), new.encode(), 1))


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("binary_little_endian", "binary_middle_endian", "'format binary_middle_endian 1.0' where"),
        ("format binary_little_endian 1.0\n", "", "'element vertex 4' where 'format'"),
        ("binary_little_endian 1.0", "binary_little_endian 2.0", "1.0 is needed"),
        ("element vertex 4", "element chunk 1", "no chunk property min_x"),
        ("property float nx", "property float filter_3D", "create_fused_ply"),
        ("property float nx", "property float motion_0", "splats that move .motion_0., which"),
        ("property float nx", "property float scale_t", "splats that move .scale_t., which"),
        ("ply\n", "plx\n", "is no .ply, .spz or .glb by its content: it begins with b'plx"),
        ("end_header", "end_of_it", "no 'end_header'|not a scalar"),
        ("element vertex 4", "element vertex many", "does not state a count"),
        ("element vertex 4", "element vertex -4", "does not state a count"),
        ("element vertex 4", "element vertex 2000000000", "header claims 496000000000 bytes"),
        ("element vertex 4", "element face 4", "no element 'vertex' among its elements .face."),
        ("property float opacity", "property list uchar float opacity", "lists are not read"),
        ("property float opacity", "property half opacity", "not a scalar property"),
        ("property float opacity", "property float transparency", "no vertex property opacity"),
        ("property float nx", "property float x", "repeated"),
        ("property float f_rest_44", "property float f_rest_45", "without a gap"),
        ("property float f_rest_44", "property float other", "44 f_rest properties"),
    ],
)
def test_a_header_that_cannot_be_read_is_refused_by_name(tmp_path, old, new, named):
    file = tmp_path / "a.ply"
    write_ply(file, make_gaussians(4, 3))
    edited(file, old, new)
    with pytest.raises(FieldFormatError, match=named) as caught:
        read_ply(file)
    assert "a.ply" in str(caught.value)


def test_every_truncation_is_refused(tmp_path):
    file = tmp_path / "a.ply"
    write_ply(file, make_gaussians(2, 0))
    data = file.read_bytes()
    for length in range(len(data)):
        file.write_bytes(data[:length])
        with pytest.raises(FieldFormatError):
            read_ply(file)


@given(st.binary(max_size=200))
def test_noise_is_refused(tmp_path_factory, noise):
    file = tmp_path_factory.mktemp("ply") / "noise.ply"
    for data in (noise, b"ply\nformat binary_little_endian 1.0\n" + noise):
        file.write_bytes(data)
        with pytest.raises(FieldFormatError):
            read_ply(file)


def rewritten(path: Path, dtype: str, **values: float) -> None:
    """Give all columns one type, and the second of three splats other values."""
    table = read_vertices(path, ())
    wide = table.astype([(name, dtype) for name in table.dtype.names or ()])
    for name, value in values.items():
        wide[name][1] = value
    write_vertices(path, wide)


def test_a_value_beyond_float32_leaves_its_splat_out(tmp_path):
    write_ply(tmp_path / "a.ply", make_gaussians(3, 0))
    rewritten(tmp_path / "a.ply", "<f8", scale_1=1e300)
    read = read_splat_file(tmp_path / "a.ply")
    assert len(read.splats) == 2
    assert "1 of 3 splats are not finite (log_scales of 1; the first: 1)" in read.notes[0]


def with_element_first(path: Path, rows: bytes) -> None:
    """Put an element of two rows, a uchar and a double each, before the vertices."""
    header, end, data = path.read_bytes().partition(b"end_header\n")
    extra = b"element camera 2\nproperty uchar kind\nproperty double fov\nelement vertex"
    header = header.replace(b"element vertex", extra, 1)
    path.write_bytes(header + end + rows + data)


def test_vertices_need_not_come_first(tmp_path):
    gaussians = make_gaussians(5, 1)
    write_ply(tmp_path / "a.ply", gaussians)
    (tmp_path / "b.ply").write_bytes(as_text(tmp_path / "a.ply"))
    with_element_first(tmp_path / "a.ply", bytes(18))
    with_element_first(tmp_path / "b.ply", b"1 0.5\n2 0.25\n")
    for name in ("a.ply", "b.ply"):
        assert_equal(read_ply(tmp_path / name), gaussians)
    edited(tmp_path / "a.ply", "property uchar kind", "property list uchar int kind")
    with pytest.raises(FieldFormatError, match=r"kind' is not a scalar property \(lists"):
        read_ply(tmp_path / "a.ply")


def test_colours_of_nerfstudio_are_the_same_from_all_sides(tmp_path):
    gaussians = make_gaussians(4, 0)
    write_ply(tmp_path / "a.ply", gaussians)
    table = read_vertices(tmp_path / "a.ply", ())
    names = [name for name in table.dtype.names or () if not name.startswith(("f_", "n"))]
    columns = [(name, "<f4") for name in names] + [
        (name, "u1") for name in ("red", "green", "blue")
    ]
    plain = np.zeros(4, columns)
    for name in names:
        plain[name] = table[name]
    plain["green"] = 255
    write_vertices(tmp_path / "b.ply", plain)
    read = read_splat_file(tmp_path / "b.ply")
    np.testing.assert_allclose(0.5 + SH_DC * read.splats.sh[:, 0], [[0, 1, 0]] * 4, atol=1e-6)
    assert "the same from all sides" in read.notes[0]


def test_points_are_told_from_splats(tmp_path):
    table = np.zeros(3, [(name, "<f4") for name in "xyz"])
    write_vertices(tmp_path / "a.ply", table)
    with pytest.raises(FieldFormatError, match=r"holds points, not splats.*train DATASET --points"):
        read_ply(tmp_path / "a.ply")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(FieldFormatError, match=r"none\.ply: cannot be read"):
        read_ply(tmp_path / "none.ply")


@pytest.mark.parametrize("n", [0, 1, 5000])
def test_text_gives_back_the_values_it_was_written_from(tmp_path, n):
    gaussians = make_gaussians(n, 0)
    write_ply(tmp_path / "a.ply", gaussians)
    (tmp_path / "b.ply").write_bytes(as_text(tmp_path / "a.ply"))
    assert_equal(read_ply(tmp_path / "b.ply"), gaussians)


def test_big_endian_rows_give_the_same_values(tmp_path):
    gaussians = make_gaussians(6, 1)
    write_ply(tmp_path / "a.ply", gaussians)
    table = read_vertices(tmp_path / "a.ply", ())
    header, _, _ = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    big = table.astype([(name, ">f4") for name in table.dtype.names or ()])
    header = header.replace(b"little", b"big") + b"end_header\n"
    (tmp_path / "b.ply").write_bytes(header + big.tobytes())
    assert_equal(read_ply(tmp_path / "b.ply"), gaussians)


def test_every_truncated_text_is_refused(tmp_path):
    """But for the last digits of the last number, which nobody can miss."""
    write_ply(tmp_path / "a.ply", make_gaussians(2, 0))
    (tmp_path / "b.ply").write_bytes(as_text(tmp_path / "a.ply"))
    data = (tmp_path / "b.ply").read_bytes()
    for length in range(len(data) - len(data.split()[-1])):
        (tmp_path / "b.ply").write_bytes(data[:length])
        with pytest.raises(FieldFormatError):
            read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (b"element vertex 3", b"element vertex 4", "3 rows, the header claims 4"),
        (b"element vertex 3", b"element vertex 2000000000", "claims 68000000000 bytes"),
        (b"\n0.125730", b"\nnan 0.125730", "row 0 has 18 numbers, not 17"),
        (b"\n0.125730", b"\nzero.125730", "could not convert"),
        (b"\n0.125730", b"\n" + b" " * 2000 + b"0.125730", "row 0 has 0 numbers"),
    ],
)
def test_text_that_is_not_rows_of_numbers_is_refused_by_name(tmp_path, old, new, named):
    write_ply(tmp_path / "a.ply", make_gaussians(3, 0))
    (tmp_path / "b.ply").write_bytes(as_text(tmp_path / "a.ply"))
    data = (tmp_path / "b.ply").read_bytes()
    assert old in data
    (tmp_path / "b.ply").write_bytes(data.replace(old, new, 1))
    with pytest.raises(FieldFormatError, match=named):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize("antialiased", [True, False, None])
def test_how_splats_are_drawn_survives_a_ply_and_changes_no_splat(tmp_path, antialiased):
    gaussians = make_gaussians(3, 1)
    write_ply(tmp_path / "a.ply", gaussians, antialiased=antialiased)
    assert read_splat_file(tmp_path / "a.ply").antialiased is antialiased
    assert_equal(read_ply(tmp_path / "a.ply"), gaussians)


def test_the_comment_is_spelled_as_other_tools_read_it(tmp_path):
    for antialiased, line in ((True, b"mip"), (False, b"default")):
        write_ply(tmp_path / "a.ply", make_gaussians(1, 0), antialiased=antialiased)
        header = (tmp_path / "a.ply").read_bytes().split(b"\n")
        assert header[2] == b"comment SplatRenderMode: " + line


@pytest.mark.parametrize(
    ("comments", "stated"),
    [
        (["SplatRenderMode: mip"], True),
        (["splatrendermode:MIP"], True),
        (["Exported from Brush", "SplatRenderMode: default"], False),
        (["SplatRenderMode: default", "SplatRenderMode: mip"], True),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["antialiased by hand"], None),
        (["mip"], None),
        ([], None),
    ],
)
def test_every_spelling_in_use_is_read_and_the_last_counts(tmp_path, comments, stated):
    write_ply(tmp_path / "a.ply", make_gaussians(1, 0))
    lines = "".join(f"comment {text}\n" for text in comments)
    edited(tmp_path / "a.ply", "element vertex", f"{lines}element vertex")
    assert read_splat_file(tmp_path / "a.ply").antialiased is stated


@pytest.mark.parametrize("up", [None, (0.0, 0.0, 1.0), (0.1, -0.7, 0.7071)])
def test_which_way_is_up_survives_a_ply(tmp_path, up):
    gaussians = make_gaussians(3, 1)
    write_ply(tmp_path / "a.ply", gaussians, up=up)
    assert read_splat_file(tmp_path / "a.ply").up == up
    assert_equal(read_ply(tmp_path / "a.ply"), gaussians)


@pytest.mark.parametrize("words", ["0 0", "0 0 up", "0 0 9", "nan 0 0", ""])
def test_an_up_that_is_no_direction_is_refused(tmp_path, words):
    write_ply(tmp_path / "a.ply", make_gaussians(1, 0), up=(0.0, 0.0, 1.0))
    edited(tmp_path / "a.ply", "up: 0 0 1", f"up: {words}")
    with pytest.raises(FieldFormatError, match="no unit vector"):
        read_splat_file(tmp_path / "a.ply")


def test_a_mode_there_is_not_is_refused_by_name(tmp_path):
    write_ply(tmp_path / "a.ply", make_gaussians(1, 0), antialiased=True)
    edited(tmp_path / "a.ply", "SplatRenderMode: mip", "SplatRenderMode: 2dgs")
    with pytest.raises(FieldFormatError, match="'SplatRenderMode: 2dgs' names neither mode"):
        read_splat_file(tmp_path / "a.ply")


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
def test_a_count_that_lies_allocates_nothing(tmp_path, form):
    file = tmp_path / "a.ply"
    write_ply(file, make_gaussians(4, 3))
    edited(file, "binary_little_endian", form)
    edited(file, "element vertex 4", "element vertex 2000000000")
    tracemalloc.start()
    try:
        with pytest.raises(FieldFormatError, match="the header claims"):
            read_ply(file)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_a_sparse_file_of_a_terabyte_is_one_error(tmp_path):
    write_ply(tmp_path / "a.ply", make_gaussians(3, 3))
    header, end, _ = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(header.replace(b"vertex 3", b"vertex 4000000000") + end)
    os.truncate(tmp_path / "a.ply", 10**12)
    with pytest.raises(FieldFormatError, match=r"4000000000 of SH degree 3 take 944\.00 GB"):
        read_ply(tmp_path / "a.ply")
    with pytest.raises(FieldFormatError, match=r"4000000000 vertices take 9\d\d\.00 GB"):
        read_vertices(tmp_path / "a.ply", ())


def test_a_terminal_is_told_nothing_by_a_header(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\nformat \x1b]0;owned\x07 1.0\nend_header\n")
    with pytest.raises(FieldFormatError) as refused:
        read_ply(tmp_path / "a.ply")
    assert "format ?]0;owned? 1.0" in str(refused.value)
    assert str(refused.value).isprintable()


def test_splats_beyond_the_memory_they_may_take_are_refused(tmp_path):
    write_ply(tmp_path / "a.ply", make_gaussians(3, 0))
    assert_equal(read_ply(tmp_path / "a.ply", max_bytes=3 * 56), make_gaussians(3, 0))
    with pytest.raises(FieldFormatError, match="raise it"):
        read_ply(tmp_path / "a.ply", max_bytes=3 * 56 - 1)


def test_parts_of_a_file_make_the_whole(tmp_path, monkeypatch):
    gaussians = make_gaussians(10, 1)
    write_ply(tmp_path / "a.ply", gaussians)
    (tmp_path / "b.ply").write_bytes(as_text(tmp_path / "a.ply"))
    monkeypatch.setattr(ply_table, "ROWS_AT_ONCE", 3)
    for name in ("a.ply", "b.ply"):
        assert_equal(read_ply(tmp_path / name), gaussians)


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
@pytest.mark.parametrize("bounded_colours", [True, False])
def test_a_compressed_file_is_read_within_its_steps(tmp_path, sh_degree, bounded_colours):
    gaussians = make_gaussians(600, sh_degree)
    gaussians.opacity_logits[:2] = 40, -40
    (tmp_path / "a.ply").write_bytes(compressed_ply(gaussians, bounded_colours=bounded_colours))
    read = read_splat_file(tmp_path / "a.ply")
    assert read.notes == ()
    splats = read.splats
    for name in ("means", "log_scales"):
        given = getattr(gaussians, name)
        steps = np.ptp(given, axis=0) / [2047, 1023, 2047]
        assert (np.abs(getattr(splats, name) - given) <= 0.51 * steps).all()
    turns = gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)
    assert (np.abs((splats.quaternions * turns).sum(axis=1)) > 0.99999).all()
    opacity, want = (1 / (1 + np.exp(-g.opacity_logits)) for g in (splats, gaussians))
    assert np.abs(opacity - want).max() <= 0.51 / 255
    shown, want = (0.5 + SH_DC * g.sh[:, 0] for g in (splats, gaussians))
    if not bounded_colours:
        want = np.clip(want, 0, 1)
    assert np.abs(shown - want).max() <= 0.51 / 255 * max(1.0, np.ptp(want))
    if sh_degree:
        want = np.clip(gaussians.sh[:, 1:], -4, 4)
        assert np.abs(splats.sh[:, 1:] - want).max() <= 1.01 * 8 / 256


def test_a_compressed_file_that_is_damaged_is_refused_by_name(tmp_path):
    data = compressed_ply(make_gaussians(300, 1))
    for old, new, named in (
        (
            b"chunk 2",
            b"chunk 1",
            r"\[1, 300\] rows of chunk and sh where 300 splats need \[2, 300\]",
        ),
        (b"element sh 300", b"element sh 299", r"\[2, 299\] rows"),
        (b"f_rest_8", b"f_rest_9", "without a gap"),
        (b"packed_scale", b"packed_rates", "no vertex property packed_scale"),
        (b"max_scale_z", b"max_scale_q", "no chunk property max_scale_z"),
    ):
        (tmp_path / "a.ply").write_bytes(data.replace(old, new, 1))
        with pytest.raises(FieldFormatError, match=named):
            read_ply(tmp_path / "a.ply")
    for length in range(0, len(data), 97):
        (tmp_path / "a.ply").write_bytes(data[:length])
        with pytest.raises(FieldFormatError):
            read_ply(tmp_path / "a.ply")
