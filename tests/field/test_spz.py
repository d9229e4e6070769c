"""``.spz`` keeps splats: the writer against a decoder written from the format's text.

The reader is held against the writer."""

import gzip
import io
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import TileOrigin
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.similarity import spherical_harmonics
from rfcore.field.splat_file import read_open_splat_file
from rfcore.field.spz import COORDINATE_SYSTEM, SYSTEMS, VERTICAL, encode_spz
from rfcore.field.stored_splats import ImportedSplats
from rfcore.raster.gaussians import Gaussians

HEADER = struct.Struct("<IIIBBBB")


def random_gaussians(seed: int, n: int, degree: int, reach_m: float) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-reach_m, reach_m, (n, 3)).astype(np.float32),
        rng.normal(size=(n, 4)).astype(np.float32),
        rng.uniform(-9, 3, (n, 3)).astype(np.float32),
        rng.uniform(-6, 6, n).astype(np.float32),
        rng.uniform(-0.9, 0.9, (n, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def rotation(packed: int) -> np.ndarray:
    """x, y, z, w of the smallest-three code."""
    largest, xyzw, rest = packed >> 30, np.zeros(4), packed
    for axis in (3, 2, 1, 0):
        if axis != largest:
            xyzw[axis] = (rest & 511) / 511 / np.sqrt(2) * (-1 if rest >> 9 & 1 else 1)
            rest >>= 10
    xyzw[largest] = np.sqrt(max(0.0, 1 - (xyzw**2).sum()))
    return xyzw


@given(st.integers(0, 2**31), st.integers(0, 3), st.sampled_from([0.5, 40.0, 3000.0, 2e5]))
def test_each_attribute_keeps_its_precision(seed, degree, reach_m):
    given_ = random_gaussians(seed, 17, degree, reach_m)
    data = gzip.decompress(encode_spz(given_, antialiased=True))
    magic, version, n, sh_degree, fraction_bits, flags, _ = HEADER.unpack_from(data)
    assert (magic, version, n, sh_degree, flags) == (0x5053474E, 3, 17, degree, 1)
    raw = np.frombuffer(data, np.uint8, offset=HEADER.size)
    sizes = [9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)]
    means, alpha, colour, scales, turns, sh = (
        block.reshape(n, size)
        for block, size in zip(
            np.split(raw, np.cumsum([n * s for s in sizes])[:-1]), sizes, strict=True
        )
    )
    wide = np.zeros((n, 3, 4), np.uint8)
    wide[..., 1:] = means.reshape(n, 3, 3)
    metres = wide.view("<i4")[..., 0] / 256 / 2.0**fraction_bits
    assert np.abs(metres - given_.means).max() <= 0.5001 / 2**fraction_bits
    assert 2.0**-fraction_bits <= max(2**-12, reach_m / 2**21)
    opacity = 1 / (1 + np.exp(-given_.opacity_logits.astype(np.float64)))
    assert np.abs(alpha[:, 0] / 255 - opacity).max() <= 0.51 / 255
    assert np.abs((colour / 255 - 0.5) / 0.15 - given_.sh[:, 0]).max() <= 0.51 / 255 / 0.15
    assert np.abs(scales / 16 - 10 - given_.log_scales).max() <= 0.51 / 16
    for code, q in zip(turns.copy().view("<u4")[:, 0], given_.quaternions, strict=True):
        xyzw = np.roll(q / np.linalg.norm(q), -1)
        assert abs(rotation(int(code)) @ xyzw) > 0.99999
    if degree:
        bands = given_.sh[:, 1:].reshape(n, -1)
        steps = np.repeat(np.where(np.arange(bands.shape[1] // 3) < 3, 8, 16), 3)
        assert (np.abs((sh.astype(int) - 128) - bands * 128) <= steps / 2 + 1).all()


def test_no_splats_are_a_file_too():
    data = gzip.decompress(encode_spz(random_gaussians(1, 0, 0, 1.0), antialiased=False))
    assert HEADER.unpack(data)[2:6] == (0, 0, 12, 0)


def test_the_same_splats_give_the_same_bytes():
    one, other = (encode_spz(random_gaussians(3, 50, 3, 9.0), antialiased=True) for _ in range(2))
    assert one == other


def test_the_sky_is_written_nearby_as_wide_to_the_eye_and_the_street_as_finely_as_ever():
    street = random_gaussians(1, 40, 0, 60.0)
    street.means[::5] *= 1e5 / np.linalg.norm(street.means[::5], axis=1, keepdims=True)
    street.log_scales[::5] = 6.8
    read, _ = decoded(encode_spz(street, antialiased=True))
    is_sky = np.arange(40) % 5 == 0
    assert np.abs(read.means - street.means)[~is_sky].max() <= 2.0**-12
    turn = (read.means * street.means).sum(axis=1)[is_sky] / 1e5
    assert np.linalg.norm(read.means[is_sky], axis=1) == pytest.approx(2000, rel=0.05)
    assert turn == pytest.approx(np.linalg.norm(read.means[is_sky], axis=1), rel=1e-3)
    assert read.log_scales[is_sky] == pytest.approx(6.8 - np.log(50), abs=0.05)


def test_a_splat_beyond_24_bits_of_metres_is_refused():
    with pytest.raises(InvalidInput, match=r"means: .* reaches 8388607 m"):
        encode_spz(random_gaussians(3, 9, 0, 3e7), antialiased=False)


# --- reading

NAME = Path("a.spz")
SIZES = (9, 1, 3, 3, 4, 45)


def imported(data: bytes, max_bytes: int = 1 << 20) -> ImportedSplats:
    return read_open_splat_file(NAME, io.BytesIO(data), None, max_bytes)


def decoded(data: bytes, max_bytes: int = 1 << 20) -> tuple[Gaussians, bool | None]:
    read = imported(data, max_bytes)
    return read.splats, read.antialiased


def with_extensions(data: bytes, *records: tuple[int, bytes]) -> bytes:
    """A file of version 4 with records before its table."""
    block = b"".join(struct.pack("<II", kind, len(body)) + body for kind, body in records)
    plain = bytearray(as_version_4(data))
    plain[14] |= 2
    plain[16:20] = struct.pack("<I", 32 + len(block))
    return bytes(plain[:32]) + block + bytes(plain[32:])


def axes(number: int) -> tuple[int, bytes]:
    return COORDINATE_SYSTEM, struct.pack("<I", number)


def as_version_4(data: bytes) -> bytes:
    """The same blocks, each a Zstandard stream, behind the header and the table of version 4."""
    plain = gzip.decompress(data)
    magic, _, n, degree, fraction_bits, flags, _ = HEADER.unpack_from(plain)
    sizes = [n * size for size in (*SIZES[:5], 3 * ((degree + 1) ** 2 - 1))]
    blocks = np.split(np.frombuffer(plain, np.uint8, offset=16), np.cumsum(sizes)[:-1])
    coded = [zstandard.compress(block.tobytes()) for block in blocks]
    lengths = [n for pair in zip(map(len, coded), sizes, strict=True) for n in pair]
    header = HEADER.pack(magic, 4, n, degree, fraction_bits, flags, 6) + struct.pack("<I12x", 32)
    return header + struct.pack("<12Q", *lengths) + b"".join(coded)


def assert_same(one: Gaussians, other: Gaussians) -> None:
    for name, array in vars(one).items():
        np.testing.assert_array_equal(array, getattr(other, name))


@given(st.integers(0, 2**31), st.integers(0, 3), st.sampled_from([0.5, 40.0, 3000.0]))
def test_what_is_written_is_read_within_its_steps(seed, degree, reach_m):
    given_ = random_gaussians(seed, 17, degree, reach_m)
    read, antialiased = decoded(encode_spz(given_, antialiased=seed % 2 == 0))
    assert antialiased == (seed % 2 == 0)
    assert np.abs(read.means - given_.means).max() <= max(2**-12, reach_m / 2**20)
    assert np.abs(read.log_scales - given_.log_scales).max() <= 0.51 / 16
    assert np.abs(read.sh[:, 0] - given_.sh[:, 0]).max() <= 0.51 / 255 / 0.15
    assert np.abs(read.sh - given_.sh).max() <= 9.0 / 128
    opacities = [1 / (1 + np.exp(-g.opacity_logits.astype(np.float64))) for g in (read, given_)]
    assert np.abs(opacities[0] - opacities[1]).max() <= 0.51 / 255
    turns = given_.quaternions / np.linalg.norm(given_.quaternions, axis=1, keepdims=True)
    assert (np.abs((read.quaternions * turns).sum(axis=1)) > 0.99999).all()


@pytest.mark.parametrize("degree", range(4))
def test_a_file_without_splats_is_read(degree):
    empty, _ = decoded(encode_spz(random_gaussians(1, 0, degree, 1.0), antialiased=False))
    assert empty.sh.shape == (0, (degree + 1) ** 2, 3)


@pytest.mark.parametrize("degree", range(4))
def test_reading_is_exact_once_the_splats_are_in_steps(degree):
    once, antialiased = decoded(encode_spz(random_gaussians(5, 40, degree, 9.0), antialiased=True))
    twice, _ = decoded(encode_spz(once, antialiased=antialiased))
    np.testing.assert_allclose(twice.means, once.means, atol=0)
    np.testing.assert_allclose(twice.sh, once.sh, atol=1e-6)
    np.testing.assert_allclose(twice.opacity_logits, once.opacity_logits, atol=1e-5)


@pytest.mark.parametrize("degree", range(4))
def test_version_4_holds_the_same_splats(degree):
    data = encode_spz(random_gaussians(6, 40, degree, 9.0), antialiased=True)
    assert_same(decoded(as_version_4(data))[0], decoded(data)[0])


def test_version_2_has_rotations_of_three_bytes():
    given_ = random_gaussians(7, 30, 1, 9.0)
    plain = bytearray(gzip.decompress(encode_spz(given_, antialiased=False)))
    plain[4] = 2
    turns = given_.quaternions / np.linalg.norm(given_.quaternions, axis=1, keepdims=True)
    turns *= np.where(turns[:, :1] < 0, -1, 1)
    start = 16 + 30 * (9 + 1 + 3 + 3)
    plain[start : start + 30 * 4] = np.round((turns[:, 1:] + 1) * 127.5).astype(np.uint8).tobytes()
    read, _ = decoded(gzip.compress(bytes(plain)))
    assert (np.abs((read.quaternions * turns).sum(axis=1)) > 0.999).all()


def test_version_1_has_positions_of_float16():
    given_ = random_gaussians(7, 30, 1, 9.0)
    plain = bytearray(gzip.decompress(encode_spz(given_, antialiased=False)))
    plain[4] = 1
    turns = np.full((30, 3), 255, np.uint8).tobytes()
    rest, after = plain[16 + 30 * 9 : 16 + 30 * 16], plain[16 + 30 * 20 :]
    data = plain[:16] + given_.means.astype("<f2").tobytes() + rest + turns + after
    read, _ = decoded(gzip.compress(bytes(data)))
    np.testing.assert_array_equal(read.means, given_.means.astype(np.float16))


def test_the_tiles_origin_is_taken_off_before_float32():
    data = encode_spz(random_gaussians(8, 20, 0, 4000.0), antialiased=False)
    origin = TileOrigin(100.0, 200.0, 3.0)
    moved = read_open_splat_file(NAME, io.BytesIO(data), origin, 1 << 20).splats
    here, _ = decoded(data)
    np.testing.assert_allclose(moved.means, here.means - np.float32([100, 200, 3]), atol=5e-4)


@pytest.mark.parametrize("degree", range(4))
def test_both_versions_that_are_written_hold_the_same_and_the_fourth_states_its_axes(degree):
    given_ = random_gaussians(6, 40, degree, 9.0)
    read = [imported(encode_spz(given_, antialiased=True, version=v)) for v in (3, 4)]
    assert_same(read[0].splats, read[1].splats)
    assert [r.antialiased for r in read] == [True, True]
    assert "states none" in read[0].notes[0]
    assert read[1].notes == ("axes: RDF, as the file states",)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, -0.8)])
def test_version_4_states_the_vertical(up):
    given_ = random_gaussians(6, 20, 1, 9.0)
    read = imported(encode_spz(given_, antialiased=False, version=4, up=up))
    assert read.up == up
    assert_same(read.splats, imported(encode_spz(given_, antialiased=False)).splats)
    assert imported(encode_spz(given_, antialiased=False, up=up)).up is None


@pytest.mark.parametrize("record", [bytes(11), struct.pack("<fff", 0, 0, 9), bytes(12)])
def test_a_vertical_that_is_no_direction_is_refused(record):
    data = encode_spz(random_gaussians(6, 20, 1, 9.0), antialiased=False)
    with pytest.raises(FieldFormatError, match="up"):
        imported(with_extensions(data, axes(6), (VERTICAL, record)))


def test_no_splats_are_a_file_of_version_4_too():
    data = encode_spz(random_gaussians(1, 0, 2, 1.0), antialiased=False, version=4)
    assert decoded(data)[0].sh.shape == (0, 9, 3)


def test_degree_4_is_reduced_and_said():
    given_ = random_gaussians(4, 12, 3, 9.0)
    plain = gzip.decompress(encode_spz(given_, antialiased=False))
    bands = np.frombuffer(plain, np.uint8, offset=16 + 12 * 20).reshape(12, 45)
    wide = np.concatenate([bands, np.full((12, 27), 200, np.uint8)], axis=1)
    head = bytearray(plain[: 16 + 12 * 20])
    head[12] = 4
    read = imported(gzip.compress(bytes(head) + wide.tobytes()))
    assert_same(read.splats, decoded(gzip.compress(plain))[0])
    assert "degree 4 are reduced to degree 3" in read.notes[1]


def test_unknown_extensions_are_left_out_and_said():
    data = encode_spz(random_gaussians(6, 20, 1, 9.0), antialiased=False)
    orbit = (0xADBE0002, bytes(12))
    read = imported(with_extensions(data, orbit, axes(6), (0x12340001, b"{}")))
    assert_same(read.splats, decoded(data)[0])
    assert "0xadbe0002, 0x12340001" in read.notes[1]
    plain = bytearray(gzip.decompress(data))
    plain[14] |= 2
    legacy = imported(gzip.compress(bytes(plain) + struct.pack("<III", *(0xADBE0002, 4, 1))))
    assert_same(legacy.splats, decoded(data)[0])


TOWARDS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0)} | {
    "F": (0, 0, 1),
    "B": (0, 0, -1),
}
DIRECTIONS = np.random.default_rng(2).normal(size=(20, 3))


def looks(g: Gaussians, turned: np.ndarray) -> tuple[np.ndarray, ...]:
    """Means, covariances and the colours seen along ``DIRECTIONS``, all turned."""
    w, x, y, z = (g.quaternions / np.linalg.norm(g.quaternions, axis=1, keepdims=True)).T
    i, j, k = np.eye(3)[:, :, None] * np.ones_like(w)
    q = np.stack([x, y, z])
    columns = [
        v + 2 * w * np.cross(q, v, axis=0) + 2 * np.cross(q, np.cross(q, v, axis=0), axis=0)
        for v in (i, j, k)
    ]
    axes_ = np.stack(columns, axis=2).transpose(1, 0, 2) * np.exp(g.log_scales)[:, None]
    axes_ = turned @ axes_
    along = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True) @ turned
    basis = spherical_harmonics(along)[:, : g.sh.shape[1]]
    colours = np.einsum("dk,nkc->ndc", basis, g.sh)
    return g.means @ turned.T, axes_ @ axes_.transpose(0, 2, 1), colours


@pytest.mark.parametrize("name", SYSTEMS)
def test_axes_that_are_stated_are_obeyed(name):
    """The file's splats, turned by what its axes point to, are those that are read."""
    given_ = random_gaussians(3, 12, 3, 9.0)
    data = encode_spz(given_, antialiased=False)
    stored = decoded(data)[0]
    read = imported(with_extensions(data, axes(SYSTEMS.index(name) + 1)))
    ply_from_file = np.array([TOWARDS[letter] for letter in name], float).T
    for got, want in zip(looks(read.splats, np.eye(3)), looks(stored, ply_from_file), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-4 * np.abs(want).max())
    assert f"axes: {name}, as the file states" in read.notes[0]
    assert read.up == (0.0, -1.0, 0.0)


def test_lichtfelds_layout_is_turned_back():
    """It turns a .ply half round x, and says so: RUB."""
    given_ = decoded(encode_spz(random_gaussians(3, 12, 1, 9.0), antialiased=False))[0]
    signs = np.float32([1, -1, -1])
    bands = np.float32([1, -1, -1, 1])[:, None]
    turned = Gaussians(
        given_.means * signs,
        given_.quaternions * np.float32([1, 1, -1, -1]),
        given_.log_scales,
        given_.opacity_logits,
        given_.sh * bands,
    )
    provenance = (0x4C460001, b'{"tool": "LichtFeld Studio"}')
    data = encode_spz(turned, antialiased=False)
    read = imported(with_extensions(data, axes(4), provenance)).splats
    np.testing.assert_allclose(read.means, given_.means, atol=1e-6)
    np.testing.assert_allclose(read.sh, given_.sh, atol=1e-2)
    for got, want in zip(looks(read, np.eye(3)), looks(given_, np.eye(3)), strict=True):
        np.testing.assert_allclose(got, want, atol=2e-2 * np.abs(want).max())


def edited(at: int, value: int) -> Callable[[bytes], bytes]:
    def edit(data: bytes) -> bytes:
        plain = bytearray(gzip.decompress(data))
        plain[at] = value
        return gzip.compress(bytes(plain))

    return edit


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (lambda _: b"", "is empty"),
        (lambda _: gzip.compress(b"other"), "does not begin with NGSP"),
        (lambda data: data[: len(data) // 2], "ended before|end-of-stream|ends"),
        (lambda data: gzip.compress(gzip.decompress(data)[:-1]), "ends 1 bytes before"),
        (lambda data: gzip.compress(gzip.decompress(data) + b"."), "goes on after its 20 splats"),
        (edited(4, 9), "version 9.* export it as version 3 or 4"),
        (edited(12, 5), "SH degree 5"),
        (edited(13, 24), "24 fraction bits"),
        (lambda data: with_extensions(data, axes(17)), "coordinate system 17"),
        (lambda data: with_extensions(data, (5, b""))[:38], "ends 2 bytes"),
        (edited(11, 255), "take .* GB of memory, over the limit"),
        (lambda data: as_version_4(data)[:-1], "ends 1 bytes before"),
        (lambda data: as_version_4(data)[:40], "before the last splat"),
        (lambda data: as_version_4(data).replace(b"\x28\xb5\x2f\xfd", b"none"), "a.spz: "),
        (lambda data: as_version_4(data)[:32] + b"\xff" * 200, "stream of"),
    ],
)
def test_what_is_no_whole_spz_is_refused_by_name(edit, named):
    data = encode_spz(random_gaussians(9, 20, 1, 9.0), antialiased=False)
    with pytest.raises(FieldFormatError, match=named):
        decoded(edit(data))
