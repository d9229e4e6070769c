"""A coded drive becomes an MCAP that the reference reader opens; so do the twin's objects."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader

import bags
from rfcore.camera import Intrinsics, Pose, TileOrigin
from rfcore.dataset import bag_records
from rfcore.dataset.read import read_source
from rfcore.errors import InvalidInput
from rfcore.field import FieldMetadata, SplatField
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfcore.perception.objects import StreetObject
from rfedge.cli import parse
from rfedge.mcap_file import KEY_EVERY, McapFile, ShownPicture
from tests.field.some import make_gaussians

K = Intrinsics(33, 24, 30.0, 31.0, 16.0, 12.0)
ORIGIN = TileOrigin(100.0, 200.0, 5.0)


def messages_of(path: Path) -> dict:
    """Return messages by topic, decoded by the schemas that are in the file and by nothing else."""
    found: dict = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if schema.encoding == "jsonschema":
                value = json.loads(message.data)
            else:
                pool = descriptor_pool.DescriptorPool()
                for one in FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(one)
                kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                value = kind.FromString(message.data)
            found.setdefault(channel.topic, []).append(value)
    return found


def field():
    metadata = FieldMetadata("", ORIGIN, up=(0.0, 1.0, 0.0))
    return SplatField(make_gaussians(50, 1), metadata)


def smooth(number: int):
    y, x = np.mgrid[:24, :33]
    return np.dstack([4 * x + number, 8 * y, 0 * x + 90]).astype(np.uint8)


def shown(number: int, field_id: str, **keys) -> ShownPicture:
    values = {
        "vehicle_id": "cav-1",
        "camera_id": "front",
        "time_ns": bags.time_ns(number),
        "planes": i420_from_rgb(smooth(number)),
        "intrinsics": K,
        "pose": Pose((number, 0.0, 1.5), (0.5, -0.5, 0.5, -0.5)),
        "field_id": field_id,
        "metrics": {"age_ms": 12.5},
    }
    return ShownPicture(**{**values, **keys})


def test_pictures_poses_and_points_are_read_by_the_reference_reader(tmp_path):
    street = field()
    with McapFile(tmp_path / "out.mcap", street) as file:
        for number in range(KEY_EVERY + 3):
            file.show(shown(number, street.field_id), bags.time_ns(number))
        file.show(shown(1, street.field_id), bags.time_ns(99))
    assert file.late == 1
    found = messages_of(tmp_path / "out.mcap")
    video = found["/cav-1/front/video"]
    assert [v.timestamp.ToNanoseconds() for v in video] == [
        bags.time_ns(number) for number in range(KEY_EVERY + 3)
    ]
    kinds = [[data[at + 4] & 31 for at in starts(data)] for data in (v.data for v in video)]
    for number, types in enumerate(kinds):
        is_key = number % KEY_EVERY == 0
        assert ({7, 8, 5} <= set(types)) if is_key else (types == [1]), number
    assert found["/tf"][2].parent_frame_id == "map"
    assert found["/tf"][2].translation.x == 102.0
    (cloud,) = found["/field"]
    assert cloud.pose.position.y == 200.0
    points = np.frombuffer(cloud.data, np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)]))
    kept = street.gaussians.opacity_logits > -2
    np.testing.assert_array_equal(points["xyz"], street.gaussians.means[kept])
    assert found["/cav-1/front/metrics"][0] == {"age_ms": 12.5}


def starts(data: bytes) -> list[int]:
    """Return where NAL units with a long or short start code begin, as if all were long."""
    found, at = [], data.find(b"\0\0\1")
    while at >= 0:
        found.append(at - 1)
        at = data.find(b"\0\0\1", at + 3)
    return found


def test_what_is_written_is_read_back_as_a_dataset(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_records, "confined_records", bags.records_here)
    street = field()
    with McapFile(tmp_path / "out.mcap", street) as file:
        for number in range(4):
            file.show(shown(number, street.field_id), bags.time_ns(number))
    source = read_source(tmp_path / "out.mcap")
    assert source.notes == ("poses: transforms of 'cav-1/front_optical' in 'map'",)
    assert source.pictures[0].camera.intrinsics == replace(K, width_px=32)
    for number, picture in enumerate(source.pictures):
        assert picture.time_ns == bags.time_ns(number)
        assert picture.world_from_cam.translation_m == (100.0 + number, 200.0, 6.5)
        expected = rgb_from_i420(i420_from_rgb(smooth(number)))[:, :32].astype(float)
        error = np.mean((picture.read() - expected) ** 2)
        assert 10 * np.log10(255**2 / error) > 36


def test_lost_pictures_have_no_pose_and_other_fields_their_own_frame(tmp_path):
    with McapFile(tmp_path / "out.mcap") as file:
        file.show(shown(0, "ab" * 16, pose=None), 1)
        file.show(shown(1, "ab" * 16), 2)
    found = messages_of(tmp_path / "out.mcap")
    assert len(found["/cav-1/front/video"]) == 2
    (moved,) = found["/tf"]
    assert (moved.parent_frame_id, moved.child_frame_id) == (
        "field-abababab",
        "cav-1/front_optical",
    )


def test_objects_stand_upright_in_the_field(tmp_path):
    street = field()
    seen = StreetObject(7, (1.0, 2.0, 3.0), (4.0, 0.0, 0.0), 1.8, 1.5, 0.9, 1.0, 0.0, ())
    with McapFile(tmp_path / "out.mcap", street) as file:
        file.show_objects(street.field_id, (seen,), bags.time_ns(0), bags.time_ns(0))
    file.show_objects(street.field_id, (seen,), bags.time_ns(1), bags.time_ns(1))
    ((entity,),) = [update.entities for update in messages_of(tmp_path / "out.mcap")["/objects"]]
    (cube,) = entity.cubes
    place, turn = cube.pose.position, cube.pose.orientation
    assert (place.x, place.y, place.z) == (101.0, 202.75, 8.0)
    up = Pose((0.0, 0.0, 0.0), (turn.w, turn.x, turn.y, turn.z)).apply((0, 0, 1))
    assert up == pytest.approx((0, 1, 0))
    assert entity.id == "7"


def test_without_the_extra_the_command_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr("rfcore.extras.find_spec", lambda _: None)
    with pytest.raises(Exception, match=r"pip install 'rfedge\[bags\]'"):
        parse(["watch", "127.0.0.1:1", "--mcap", str(tmp_path / "a.mcap")]).run()
    with pytest.raises(InvalidInput, match="belongs to --mcap"):
        parse(["watch", "127.0.0.1:1", "--field", "a"]).run()
