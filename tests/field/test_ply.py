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
from rfcore.field.splat_file import read_splat_file, write_ply
from rfcore.raster.gaussians import Gaussians
from tests.field.some import make_gaussians

NAMES = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def read_ply(path: Path, tile_origin: TileOrigin | None = None, **limits: int) -> Gaussians:
    return read_splat_file(path, tile_origin, **limits)[0]


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
        ("element vertex 4", "element chunk 1", "compressed .ply of PlayCanvas"),
        ("property float nx", "property float filter_3D", "create_fused_ply"),
        ("ply\n", "plx\n", "does not start with 'ply'"),
        ("end_header", "end_of_it", "no 'end_header'|not a scalar"),
        ("element vertex 4", "element vertex many", "does not state a count"),
        ("element vertex 4", "element vertex -4", "does not state a count"),
        ("element vertex 4", "element vertex 2000000000", "header claims 496000000000 bytes"),
        ("element vertex 4", "element face 4", "must be 'vertex'"),
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


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_values_that_are_not_finite_are_refused(tmp_path, bad):
    write_ply(tmp_path / "a.ply", make_gaussians(3, 0))
    table = read_vertices(tmp_path / "a.ply", ())
    names = table.dtype.names or ()
    wide = np.zeros(3, [(name, "<f4") for name in names])
    for name in names:
        wide[name] = table[name]
    with np.errstate(over="ignore"):
        wide["scale_1"][2] = np.float32(bad)
    write_vertices(tmp_path / "a.ply", wide)
    with pytest.raises(FieldFormatError, match=r"log_scales: 1 of 3 .* number 2"):
        read_ply(tmp_path / "a.ply")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(FieldFormatError, match=r"none\.ply: cannot be read"):
        read_ply(tmp_path / "none.ply")


def as_text(path: Path, out: Path, digits: int = 9) -> None:
    """Rewrite a binary file as text, with nine digits as float32 needs."""
    table = read_vertices(path, ())
    header, _, _ = path.read_bytes().partition(b"end_header\n")
    lines = [" ".join(f"{value:.{digits}g}" for value in row.tolist()) for row in table]
    text = header.replace(b"binary_little_endian", b"ascii") + b"end_header\n"
    out.write_bytes(text + "\n".join(lines).encode())


@pytest.mark.parametrize("n", [0, 1, 5000])
def test_text_gives_back_the_values_it_was_written_from(tmp_path, n):
    gaussians = make_gaussians(n, 0)
    write_ply(tmp_path / "a.ply", gaussians)
    as_text(tmp_path / "a.ply", tmp_path / "b.ply")
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
    as_text(tmp_path / "a.ply", tmp_path / "b.ply")
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
        (b"\n0.125730217", b"\nnan", "means: 1 of 3 .* number 0"),
    ],
)
def test_text_that_is_not_rows_of_numbers_is_refused_by_name(tmp_path, old, new, named):
    write_ply(tmp_path / "a.ply", make_gaussians(3, 0))
    as_text(tmp_path / "a.ply", tmp_path / "b.ply")
    data = (tmp_path / "b.ply").read_bytes()
    assert old in data
    (tmp_path / "b.ply").write_bytes(data.replace(old, new, 1))
    with pytest.raises(FieldFormatError, match=named):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("a.splat", r"splat-transform a\.splat a\.ply$"),
        ("a.ksplat", r"splat-transform a\.ksplat a\.ply$"),
        ("a.SOG", r"splat-transform a\.SOG a\.ply$"),
        ("a.sogs", r"unpack it .* splat-transform meta\.json a\.ply$"),
        ("a.glb", r"export the splats as \.ply"),
        ("a.gltf", r"export the splats as \.ply"),
    ],
)
def test_other_formats_are_refused_with_what_converts_them(tmp_path, name, advice):
    with pytest.raises(FieldFormatError, match=advice):
        read_ply(tmp_path / name)


@pytest.mark.parametrize("antialiased", [True, False, None])
def test_how_splats_are_drawn_survives_a_ply_and_changes_no_splat(tmp_path, antialiased):
    gaussians = make_gaussians(3, 1)
    write_ply(tmp_path / "a.ply", gaussians, antialiased=antialiased)
    assert read_splat_file(tmp_path / "a.ply")[1] is antialiased
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
    assert read_splat_file(tmp_path / "a.ply")[1] is stated


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
    as_text(tmp_path / "a.ply", tmp_path / "b.ply")
    monkeypatch.setattr(ply_table, "ROWS_AT_ONCE", 3)
    for name in ("a.ply", "b.ply"):
        assert_equal(read_ply(tmp_path / name), gaussians)
