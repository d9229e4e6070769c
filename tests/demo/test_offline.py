"""The codec without a network: what is decoded is the vehicle's closed loop, or an error."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.codec.h264.config import CodecConfig, LightChange
from rfcore.codec.h264.qp_map import MaskSettings
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.dataset import Dataset, read_dataset
from rfcore.errors import InvalidData, InvalidInput
from rfcore.field import SplatField, render_field_view
from rfcore.image import write_png
from rfcore.native.yuv import i420_from_rgb
from rfcore.raster.gaussians import Gaussians
from rfcore.wire.drive_file import read_drive, write_drive
from rfedge.offline import CodingSettings, decode_drive, encode_drive

SETTINGS = CodingSettings(effort="fast", crf=27.0)


@pytest.fixture
def drive(tiny_sample: Path) -> Dataset:
    return read_dataset(tiny_sample / "transforms_drive_vehicles.json")


@pytest.fixture
def field(tiny_gaussians: Gaussians) -> SplatField:
    return SplatField(tiny_gaussians)


def test_a_decoded_file_is_the_senders_closed_loop(drive, field, tmp_path):
    path = tmp_path / "drive.rfv"
    write_drive(path, encode_drive(drive, field, SETTINGS))
    encoder = DeltaEncoder(CodecConfig(96, 64, "fast", 27.0))
    state = encoder.start(1)
    decoded = list(decode_drive(read_drive(path), field))
    assert [frame.sequence for frame in decoded] == [0, 1, 2, 3]
    for picture, frame in zip(drive.pictures, decoded, strict=True):
        own = encoder.encode(
            state, i420_from_rgb(picture.read()), render_field_view(field, picture.camera)
        )
        state = own.state
        assert frame.frame.digest() == own.reconstruction.digest()


def test_a_drive_coded_with_a_mask_decodes(drive, field, tmp_path):
    mask = np.zeros((64, 96, 3), np.uint8)
    mask[:32] = 255
    write_png(tmp_path / "mask.png", mask)
    asked = MaskSettings(tmp_path / "mask.png", -8)
    settings = replace(SETTINGS, qp_map=asked.qp_map((96, 64)))
    plain, coded = (encode_drive(drive, field, how) for how in (SETTINGS, settings))
    bits = [sum(len(frame.packet.payload) for frame in made.frames) for made in (plain, coded)]
    assert bits[1] > bits[0]
    assert len(list(decode_drive(coded, field))) == 4


def test_another_field_is_refused_with_both_ids_named(drive, field):
    coded = encode_drive(drive, field, SETTINGS)
    g = field.gaussians
    other = SplatField(Gaussians(g.means + 1, g.quaternions, g.log_scales, g.opacity_logits, g.sh))
    with pytest.raises(InvalidData, match=f"{field.field_id}, given {other.field_id}"):
        next(decode_drive(coded, other))


def test_the_light_is_told_by_its_name_or_refused():
    assert CodingSettings(light="off").light is LightChange.OFF
    with pytest.raises(InvalidInput, match="light: 'dark' is not one of auto, off"):
        CodingSettings(light="dark")
