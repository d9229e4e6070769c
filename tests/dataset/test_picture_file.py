"""The size of a picture is read from its header, and no name leaves the dataset's folder."""

import os
import subprocess
import venv
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from docs.pages import ROOT
from rfcore.camera import Intrinsics
from rfcore.dataset.colour_profile import OTHER_PROFILE, profile_of
from rfcore.dataset.picture_file import PictureFile, picture_paths, read_picture
from rfcore.dataset.picture_header import SIGNATURES, UNREAD, picture_header
from rfcore.dataset.picture_name import find_picture, inside
from rfcore.dataset.video import CONTAINERS
from rfcore.errors import DatasetError

RGB = np.random.default_rng(2).integers(0, 256, (31, 77, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.png", []),
        ("a.jpg", []),
        ("a.jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        ("a.webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
        ("a.webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
    ],
)
def test_the_header_says_how_large_a_picture_is(name, options, tmp_path):
    assert cv2.imwrite(str(tmp_path / name), RGB, options)
    assert picture_header(tmp_path / name).size_px == (77, 31)


@pytest.mark.parametrize("shape", [(31, 77, 3), (31, 77)])
def test_the_first_row_of_a_pfm_is_its_last(shape, tmp_path):
    """OpenCV writes it; floating point is linear."""
    light = np.random.default_rng(4).random(shape, np.float32)
    assert cv2.imwrite(str(tmp_path / "a.pfm"), light)
    path = picture_paths(tmp_path)[0]
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    expected = np.broadcast_to(srgb[..., None], (*shape, 3)) if len(shape) == 2 else srgb[..., ::-1]
    seen = read_picture(path, Intrinsics(77, 31, 9, 9, 4, 3))
    assert np.abs(seen - 255 * expected).max() < 1


@pytest.mark.parametrize("suffix", [".bmp", ".tif", ".ppm", ".avif"])
def test_other_formats_are_decoded_for_their_size_and_known_by_content(suffix, tmp_path):
    path = tmp_path / "a.png"
    assert cv2.imwrite(str(tmp_path / f"b{suffix}"), RGB)
    (tmp_path / f"b{suffix}").rename(path)
    assert picture_header(path).size_px == (77, 31)
    assert picture_paths(tmp_path) == [path]
    assert read_picture(path, Intrinsics(77, 31, 9, 9, 4, 3)).shape == RGB.shape


def test_a_hostile_size_is_refused_unread(tmp_path):
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (30_000).to_bytes(4) * 2
    (tmp_path / "huge.png").write_bytes(header)
    with pytest.raises(DatasetError, match=r"huge\.png: picture is 30000x30000 px, over.*8192"):
        PictureFile.of(tmp_path / "huge.png", Intrinsics(8, 6, 9, 9, 4, 3))


def test_a_name_without_suffix_finds_its_picture(tmp_path):
    cv2.imwrite(str(tmp_path / "r_0.jpg"), RGB)
    cv2.imwrite(str(tmp_path / "r_1.5.png"), RGB)
    assert find_picture("x", tmp_path, "./r_0") == tmp_path / "r_0.jpg"
    assert find_picture("x", tmp_path, "r_1.5") == tmp_path / "r_1.5.png"
    cv2.imwrite(str(tmp_path) + ".png", RGB)
    for name in ("r_2", "."):
        with pytest.raises(DatasetError, match=r"^x: picture .* is missing"):
            find_picture("x", tmp_path, name)


def test_a_name_in_other_upper_and_lower_case_finds_the_only_file_it_can_mean(tmp_path):
    (tmp_path / "Images").mkdir()
    cv2.imwrite(str(tmp_path / "Images" / "IMG_1.JPG"), RGB)
    for name in (
        "images/img_1.jpg",
        "Images/IMG_1.jpg",
        "images/img_1",
        "/home/x/images/Img_1.jpg",
    ):
        assert find_picture("x", tmp_path, name) == tmp_path / "Images" / "IMG_1.JPG"
    cv2.imwrite(str(tmp_path / "Images" / "img_1.JPG"), RGB)
    assert find_picture("x", tmp_path, "images/img_1.JPG").name == "img_1.JPG"
    with pytest.raises(DatasetError, match=r"Img_1\.JPG is missing"):
        find_picture("x", tmp_path, "Images/Img_1.JPG")


@pytest.mark.parametrize("name", ["../a.png", "/etc/passwd", "b/../../a.png", "..\\a.png", "a\0b"])
def test_no_name_leaves_the_folder(name, tmp_path):
    with pytest.raises(DatasetError, match="leaves the dataset's folder"):
        inside("x", tmp_path, name)


def test_a_name_may_go_out_of_a_folder_and_back_in(tmp_path):
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), RGB)
    name = "./images/../images/a.png"
    assert find_picture("x", tmp_path, name) == tmp_path / "images" / "a.png"
    with pytest.raises(DatasetError, match="into a folder above all pictures"):
        find_picture("x", tmp_path / "images", "../images/a.png")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.97])
def test_a_truncated_picture_is_refused(name, share, tmp_path):
    path = tmp_path / name
    assert cv2.imwrite(str(path), RGB)
    camera = Intrinsics(77, 31, 50.0, 50.0, 38.0, 15.0)
    assert read_picture(path, camera).shape == (31, 77, 3)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DatasetError, match=rf"{path.name}: (truncated|not a readable)"):
        read_picture(path, camera)


def test_a_picture_longer_than_its_pixels_can_be_is_refused_unread(tmp_path):
    path = tmp_path / "long.jpg"
    assert cv2.imwrite(str(path), RGB)
    k = Intrinsics(77, 31, 9, 9, 4, 3)
    assert read_picture(path, k).shape == RGB.shape
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(DatasetError, match="1099511627776 bytes are too many for 77x31 px"):
        read_picture(path, k)


def with_exif(path, number, big_endian=False):
    """Put an EXIF orientation into a JPEG, PNG or WebP file."""
    order, ends = (b"MM", "big") if big_endian else (b"II", "little")
    word = lambda value, size: value.to_bytes(size, ends)  # noqa: E731
    entry = word(0x0112, 2) + word(3, 2) + word(1, 4) + word(number, 2) + bytes(2)
    exif = order + word(42, 2) + word(8, 4) + word(1, 2) + entry + bytes(4)
    content = path.read_bytes()
    if content.startswith(b"\xff\xd8"):
        data = b"Exif\0\0" + exif
        segment = b"\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data
        path.write_bytes(content[:2] + segment + content[2:])
    elif content.startswith(b"\x89PNG"):
        chunk = b"eXIf" + exif
        crc = zlib.crc32(chunk).to_bytes(4, "big")
        path.write_bytes(content[:33] + len(exif).to_bytes(4, "big") + chunk + crc + content[33:])
    else:
        image = content[12:]
        header = b"VP8X" + (10).to_bytes(4, "little") + bytes([8, 0, 0, 0])
        header += (76).to_bytes(3, "little") + (30).to_bytes(3, "little")
        body = b"WEBP" + header + image + b"EXIF" + len(exif).to_bytes(4, "little") + exif
        path.write_bytes(b"RIFF" + len(body).to_bytes(4, "little") + body)
    return path


@pytest.mark.parametrize("number", range(1, 9))
@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp"])
def test_exif_turns_a_picture_where_its_camera_is_of_the_turned_one(name, number, tmp_path):
    path = tmp_path / name
    assert cv2.imwrite(str(path), RGB, [cv2.IMWRITE_WEBP_QUALITY, 101])
    stored = read_picture(path, Intrinsics(77, 31, 9, 9, 4, 3))
    with_exif(path, number, big_endian=number % 2 == 0)
    assert picture_header(path).orientation == number
    upright = PictureFile.of(path, Intrinsics(77, 31, 9, 9, 4, 3))
    assert np.array_equal(upright.read(), stored)
    assert [note.startswith("are not ") for note in upright.notes] == [True] * (number > 1)
    turned_camera = Intrinsics(31, 77, 9, 9, 4, 3)
    if number < 5:
        with pytest.raises(DatasetError, match="picture is 77x31 px, its camera says 31x77"):
            PictureFile.of(path, turned_camera)
        return
    turned = PictureFile.of(path, turned_camera)
    oracle = {5: cv2.transpose, 6: lambda a: cv2.rotate(a, cv2.ROTATE_90_CLOCKWISE)}
    oracle[7] = lambda a: cv2.rotate(cv2.transpose(a), cv2.ROTATE_180)
    oracle[8] = lambda a: cv2.rotate(a, cv2.ROTATE_90_COUNTERCLOCKWISE)
    assert np.array_equal(turned.read(), oracle[number](stored))
    assert turned.notes[0].startswith("are ")


@pytest.mark.parametrize(
    ("content", "todo"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "convert: pip install pillow-heif && python -c"),
        (b"\xff\x0a\0\0", "export as JPEG or PNG"),
    ],
)
def test_formats_that_are_not_read_are_named_with_what_to_do(content, todo, tmp_path):
    (tmp_path / "IMG_1.HEIC").write_bytes(content)
    for read in (picture_paths, lambda folder: picture_header(folder / "IMG_1.HEIC")):
        with pytest.raises(DatasetError, match=f"is not read; {todo}") as refused:
            read(tmp_path)
        assert "\n" not in str(refused.value)
    cv2.imwrite(str(tmp_path / "IMG_1.HEIC.png"), RGB)
    assert picture_paths(tmp_path) == [tmp_path / "IMG_1.HEIC.png"]


MADE_HEIC = """
import sys, pillow_heif
from PIL import Image, ImageCms
pillow_heif.register_heif_opener()
image = Image.new("RGB", (64, 48), (200, 40, 40))
image.paste((40, 200, 40), (0, 24, 32, 48))
exif = Image.Exif()
exif[0x0112] = 6
profile = open(sys.argv[2], "rb").read()
image.save(sys.argv[1], quality=100, exif=exif.tobytes(), icc_profile=profile)
"""


@pytest.mark.slow
def test_the_command_for_heic_leads_to_pictures(tmp_path):
    """Turned by its orientation, with its colour profile: as phones write it."""
    scene, tools = tmp_path / "a b", tmp_path / "tools"
    scene.mkdir()
    venv.create(tools, with_pip=True)
    install = [tools / "bin" / "pip", "install", "-q", "pillow-heif"]
    if subprocess.run(install, check=False).returncode:
        pytest.skip("needs the package index")
    (tmp_path / "p3.icc").write_bytes(icc(GAMUTS["Display P3"], "Display P3"))
    words = [tools / "bin" / "python", "-c", MADE_HEIC, scene / "IMG_1.HEIC", tmp_path / "p3.icc"]
    subprocess.run(words, check=True)
    with pytest.raises(DatasetError) as refused:
        picture_paths(scene)
    command = str(refused.value).partition("convert: ")[2]
    path = f"{tools / 'bin'}:{os.environ['PATH']}"
    subprocess.run(command, shell=True, check=True, env=os.environ | {"PATH": path})
    assert picture_paths(scene) == [scene / "IMG_1.HEIC.png"], "the command leads on"
    opened = PictureFile.of(scene / "IMG_1.HEIC.png", Intrinsics(48, 64, 9, 9, 4, 3))
    assert opened.notes == ("are in Display P3 and become sRGB",)
    assert opened.read()[5, 5].argmax() == 1
    assert opened.read()[5, 40].argmax() == 0


MASKED = np.zeros((31, 77), bool)
MASKED[5:20, 10:40] = True


@pytest.mark.parametrize(
    ("picture", "mask", "white_hides"),
    [
        ("images/a.jpg", "masks/a.jpg.png", False),
        ("images/a.jpg", "masks/a.png", False),
        ("images/left/a.jpg", "masks/left/a.png", False),
        ("images/a.jpg", "images/dynamic_mask_a.png", True),
        ("images/a.jpg", "masks/a_mask.png", False),
        ("images/a.jpg", "masks/a.tif", False),
        ("images/a.jpg", "mask/a.png", False),
        ("images/a.jpg", "Masks/a.png", False),
        ("images/a.jpg", "images/a.jpg.mask.png", False),
        ("images/a.jpg", "images/a.mask.png", False),
        ("images/a.jpg", "images/a_mask.png", False),
    ],
)
@pytest.mark.parametrize("white", [255, 1])
def test_a_mask_beside_a_picture_is_found(picture, mask, white_hides, white, tmp_path):
    for name in (picture, mask):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(tmp_path / picture), RGB)
    is_white = MASKED if white_hides else ~MASKED
    cv2.imwrite(str(tmp_path / mask), np.where(is_white, white, 0).astype(np.uint8))
    opened = PictureFile.of(tmp_path / picture, Intrinsics(77, 31, 9, 9, 4, 3))
    assert np.array_equal(opened.mask(), ~MASKED)
    assert opened.notes == ("have a mask: what it hides is not learnt or measured",)
    assert picture_paths((tmp_path / picture).parent) == [tmp_path / picture]


@pytest.mark.parametrize("kind", ["16 bits of 0 and 1", "black with alpha"])
def test_a_mask_may_be_of_few_levels_or_of_alpha(kind, tmp_path):
    (tmp_path / "masks").mkdir()
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), RGB)
    mask = (~MASKED).astype(np.uint16)
    if kind == "black with alpha":
        mask = np.dstack([np.zeros((31, 77, 3), np.uint8), 255 * mask.astype(np.uint8)])
    cv2.imwrite(str(tmp_path / "masks" / "a.png"), mask)
    opened = PictureFile.of(tmp_path / "images" / "a.png", Intrinsics(77, 31, 9, 9, 4, 3))
    assert np.array_equal(opened.mask(), ~MASKED)


def test_a_picture_whose_name_ends_like_a_masks_is_one(tmp_path):
    for name in ("iron_mask.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), RGB)
    assert picture_paths(tmp_path) == [tmp_path / "b.png", tmp_path / "iron_mask.png"]


@pytest.mark.parametrize("size", [(38, 15), (39, 15), (154, 62), (308, 124)])
@pytest.mark.parametrize("exif", [1, 6])
def test_a_mask_of_another_size_is_scaled(size, exif, tmp_path):
    """By the nearest pixel, as OpenCV's INTER_NEAREST_EXACT takes it."""
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), RGB)
    white = np.random.default_rng(3).integers(0, 2, size[::-1], np.uint8) * 255
    cv2.imwrite(str(tmp_path / "masks" / "a.png"), white)
    shown = (77, 31)
    if exif == 6:
        with_exif(tmp_path / "images" / "a.png", 6)
        white, shown = cv2.rotate(white, cv2.ROTATE_90_CLOCKWISE), (31, 77)
    opened = PictureFile.of(tmp_path / "images" / "a.png", Intrinsics(*shown, 9, 9, 4, 3))
    expected = cv2.resize(white, shown, interpolation=cv2.INTER_NEAREST_EXACT) > 0
    assert np.array_equal(opened.mask(), expected)
    assert "have a mask of another size, which is scaled" in opened.notes[-1]


def test_a_mask_of_another_shape_is_refused(tmp_path):
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), RGB)
    cv2.imwrite(str(tmp_path / "masks" / "a.png"), RGB[:20, :20])
    opened = PictureFile.of(tmp_path / "images" / "a.png", Intrinsics(77, 31, 9, 9, 4, 3))
    with pytest.raises(DatasetError, match=r"masks/a\.png: mask is 20x20 px, its picture 77x31"):
        opened.mask()


def test_transparent_pixels_do_not_count(tmp_path):
    rgba = np.dstack([RGB, np.where(MASKED, 0, 255).astype(np.uint8)])
    cv2.imwrite(str(tmp_path / "a.png"), rgba)
    opened = PictureFile.of(tmp_path / "a.png", Intrinsics(77, 31, 9, 9, 4, 3))
    assert np.array_equal(opened.mask(), ~MASKED)
    assert not opened.read()[MASKED].any()
    assert "have an alpha channel" in opened.notes[0]


def test_a_png_of_linear_light_gets_the_curve_of_srgb(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.full((31, 77, 3), 128, np.uint8))
    content, chunk = path.read_bytes(), b"gAMA" + (100_000).to_bytes(4, "big")
    crc = zlib.crc32(chunk).to_bytes(4, "big")
    path.write_bytes(content[:33] + (4).to_bytes(4, "big") + chunk + crc + content[33:])
    opened = PictureFile.of(path, Intrinsics(77, 31, 9, 9, 4, 3))
    assert opened.notes == ("are linear and become sRGB",)
    assert np.unique(opened.read()).tolist() == [188]


def test_the_page_names_every_format():
    page = (ROOT / "docs" / "reference" / "media.md").read_text()
    names = [*SIGNATURES.values(), *UNREAD, *", ".join(CONTAINERS.values()).split(", ")]
    assert [name for name in names if name not in page] == []


def in_gamut(rgb, primaries):
    """Code sRGB for other primaries (CIE xy) with sRGB's transfer."""
    light = np.where(rgb / 255 <= 0.04045, rgb / 255 / 12.92, ((rgb / 255 + 0.055) / 1.055) ** 2.4)
    light = light @ (np.linalg.inv(to_xyz(primaries)) @ to_xyz(SRGB)).T
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(255 * code).astype(np.uint8)


def to_xyz(primaries):
    """Return the matrix of linear colours under D65 to XYZ."""
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in primaries]).T
    white = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])
    return columns * np.linalg.solve(columns, white)


SRGB = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
GAMUTS = {
    "sRGB": SRGB,
    "Display P3": ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    "Rec. 2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    "Adobe RGB": ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06)),
}


GAMMA = b"curv" + bytes(4) + (1).to_bytes(4) + b"\2\x33"


def icc(primaries, text, curve=GAMMA):
    """Return a matrix profile: colours adapted to D50 by Bradford's matrix."""
    bradford = np.array(
        [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
    )
    d65, d50 = to_xyz(SRGB).sum(axis=1), np.array([0.9642, 1.0, 0.8249])
    scale = np.diag(bradford @ d50 / (bradford @ d65))
    xyz = np.linalg.inv(bradford) @ scale @ bradford @ to_xyz(primaries)
    tags = {b"desc": b"mluc" + bytes(4) + text.encode("utf-16-be"), b"rTRC": curve}
    for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), xyz.T, strict=True):
        fixed = b"".join(round(65536 * v).to_bytes(4, "big", signed=True) for v in column)
        tags[name] = b"XYZ " + bytes(4) + fixed
    start, table, data = 132 + 12 * len(tags), b"", b""
    for name, content in tags.items():
        table += name + (start + len(data)).to_bytes(4) + len(content).to_bytes(4)
        data += content + bytes(-len(content) % 4)
    return bytes(128) + len(tags).to_bytes(4) + table + data


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp", "a.tif", "a.avif"])
@pytest.mark.parametrize("gamut", GAMUTS)
def test_a_profile_is_known_by_its_numbers(name, gamut, tmp_path):
    """Android calls Display P3 "Display P3 Gamut with sRGB Transfer"."""
    rgb = np.kron(RGB[:4, :10] // 2 + 64, np.ones((8, 8, 1), np.uint8))[:31, :77]
    path = tmp_path / name
    profile = icc(GAMUTS[gamut], f"{gamut} Gamut with sRGB Transfer")
    stored = rgb if gamut == "Adobe RGB" else in_gamut(rgb, GAMUTS[gamut])
    exact = {"a.jpg": {"quality": 100, "subsampling": 0}, "a.webp": {"lossless": True}}
    exact["a.avif"] = {"quality": 100, "subsampling": "4:4:4"}
    Image.fromarray(stored).save(path, icc_profile=profile, **exact.get(name, {}))
    opened = PictureFile.of(path, Intrinsics(77, 31, 9, 9, 4, 3))
    off = np.abs(opened.read().astype(int) - rgb)
    assert off.max() <= 12
    assert off.mean() < 1.5
    said = {
        "sRGB": (),
        "Adobe RGB": ("have a colour profile that is not read: they are taken as sRGB",),
    }
    assert opened.notes == said.get(gamut, (f"are in {gamut} and become sRGB",))


@pytest.mark.parametrize(
    ("profile", "known"),
    [
        (b"", None),
        (icc(SRGB, "sRGB", b"curv" + bytes(8)), OTHER_PROFILE),
        (icc(SRGB, "linear", b"para" + bytes(8) + (65536).to_bytes(4)), OTHER_PROFILE),
        (icc(SRGB, "sRGB")[:200], OTHER_PROFILE),
        (bytes(128) + b"\xff" * 40, OTHER_PROFILE),
        (bytes(140) + b"sRGB by tables", None),
    ],
)
def test_a_profile_that_is_linear_cut_or_of_tables(profile, known):
    assert profile_of(profile) == known


def test_a_tiff_is_turned_as_exif_says(tmp_path):
    tags = {0x0112: 6}
    Image.fromarray(RGB).save(tmp_path / "a.tif", tiffinfo=tags)
    opened = PictureFile.of(tmp_path / "a.tif", Intrinsics(31, 77, 9, 9, 4, 3))
    assert np.array_equal(opened.read(), np.rot90(RGB, -1))
    assert "EXIF" in opened.notes[0]


def test_what_ffmpeg_shows_wrongly_is_refused(tmp_path):
    """JPEG in a TIFF gets wrong colours, and an AVIF loses its alpha."""
    Image.fromarray(RGB).save(tmp_path / "a.tif", compression="jpeg")
    with pytest.raises(DatasetError, match="JPEG compression inside TIFF is not read; export"):
        picture_header(tmp_path / "a.tif")
    Image.fromarray(np.dstack([RGB, RGB[..., 0]])).save(tmp_path / "a.avif")
    with pytest.raises(DatasetError, match="AVIF with alpha is not read; export"):
        picture_header(tmp_path / "a.avif")
