"""A log of 123D (py123d, Apache-2.0), to which it converts Argoverse 2, nuScenes, KITTI-360, Waymo,
nuPlan, PandaSet and more: Arrow files, a kind of data (modality) each::

    LOG/sync.arrow
        ego_state_se3.arrow         timestamp_us, imu_se3: poses of the vehicle
        camera.CAMERA.arrow         timestamp_us, data, camera_to_global_se3

Columns are called by the file's name and theirs (``camera.pcam_f0.data``). A pose is x, y, z and a
quaternion w, x, y, z, a_to_b is b_from_a. ``data`` is a JPEG or PNG, the number of a frame of
``camera.CAMERA.mp4``, or a path in the original set, which is looked for beside the log and above
it. The schema's metadata is MessagePack and describes the camera. A picture without a pose of its
own gets the vehicle's at its time. Pinholes are read, with their lens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path

from rfcore.camera import Pose
from rfcore.dataset.arrow_file import arrow_metadata, arrow_rows, opened_arrow
from rfcore.dataset.bag_transforms import Edge
from rfcore.dataset.drive_set import US, Shot, pinhole_of_matrix, posed_source
from rfcore.dataset.keys import lens_of, pose_of_quaternion, table_at
from rfcore.dataset.picture_file import is_whole_jpeg, require_size
from rfcore.dataset.picture_name import file_inside
from rfcore.dataset.source import Source, SourceCamera
from rfcore.dataset.video import Video
from rfcore.errors import DatasetError
from rfcore.image import Rgb, rgb_from_bytes
from rfcore.tables import Table

SYNC = "sync.arrow"
"""The file by which a log is recognised."""
EGO = "ego_state_se3"
LENS = ("k1", "k2", "p1", "p2", "k3")


class Log123D:
    """A log, known by its file of synchronised rows."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._folder = file.absolute().parent

    @property
    def names(self) -> Sequence[str]:
        """Cameras, by 123D's names."""
        files = self._folder.glob("camera.*.arrow")
        return sorted(file.name.split(".")[1] for file in files)

    def read(self, name: str) -> Source:
        """Read one camera's pictures."""
        file = self._folder / f"camera.{name}.arrow"
        stated = table_at(str(file), arrow_metadata(file))
        camera, ego_from_cam = _camera(str(file), stated), _pose(str(file), stated, "imu")
        key = f"camera.{name}"
        columns = [f"{key}.{part}" for part in ("timestamp_us", "camera_to_global_se3")]
        rows = arrow_rows(file, columns)
        times_ns = [row.whole(columns[0]) * US for _, row in rows]
        own = {
            time_ns: _pose_at(where, row, columns[1]).compose(ego_from_cam.inverse())
            for time_ns, (where, row) in zip(times_ns, rows, strict=True)
            if row.value(columns[1]) is not None
        }
        ego = Edge("global", f"{file.name}", False, own)
        if len(own) < len(rows):
            ego = self._ego(own)
        picture_of = _Pictures(file, f"{key}.data", camera)
        shots = [
            picture_of.shot(i, name, time_ns, ego_from_cam) for i, time_ns in enumerate(times_ns)
        ]
        log = table_at(str(self.file), arrow_metadata(self.file))
        notes = [
            f"world: 123D's global frame of {log.text('dataset')} ({log.text('log_name')}), metres",
            f"{name} is {stated.text('camera_name')} there",
        ]
        return posed_source(self.file, shots, ego, notes)

    def _ego(self, own: dict[int, Pose]) -> Edge:
        """Return the vehicle's poses, and those that pictures state themselves."""
        columns = [f"{EGO}.timestamp_us", f"{EGO}.imu_se3"]
        poses = {
            row.whole(columns[0]) * US: _pose_at(where, row, columns[1])
            for where, row in arrow_rows(self._folder / f"{EGO}.arrow", columns)
        }
        return Edge("global", f"{EGO}.arrow", False, poses | own)


def _camera(where: str, stated: Table) -> SourceCamera:
    model = stated.value("camera_model")
    if model not in (0, "pinhole"):
        raise DatasetError(f"{where}: camera_model is {model!r}; only pinholes are read")
    fx, fy, cx, cy, skew = stated.numbers("intrinsics", 5)
    rows = [[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    camera = pinhole_of_matrix(where, rows, (stated.whole("width"), stated.whole("height")))
    if stated.flag("is_undistorted") or stated.value("distortion") is None:
        return camera
    lens = table_at(where, dict(zip(LENS, stated.numbers("distortion", 5), strict=True)))
    return SourceCamera(camera.intrinsics, lens_of(where, "OPENCV", lens))


def _pose(where: str, stated: Table, frame: str) -> Pose:
    return _pose_at(where, stated, f"camera_to_{frame}_se3")


def _pose_at(where: str, row: Table, key: str) -> Pose:
    values = row.numbers(key, 7)
    return pose_of_quaternion(f"{where}: {key}", values[:3], values[3:])


class _Pictures:
    """The column ``data`` of a camera's file."""

    def __init__(self, file: Path, column: str, camera: SourceCamera) -> None:
        self._file, self._column, self._camera = file, column, camera
        with opened_arrow(file, [column]) as content:
            self._kind = str(content.schema.types[0])
            sizes = [content.get_batch(i).num_rows for i in range(content.num_record_batches)]
        self._places = [(batch, row) for batch, size in enumerate(sizes) for row in range(size)]
        self._kept: list[object] = []
        if self._kind != "binary":
            self._kept = [row.value(column) for _, row in arrow_rows(file, [column])]
        self._video = Video(file.with_suffix(".mp4")) if self._kind == "int32" else None

    def shot(self, number: int, name: str, time_ns: int, ego_from_cam: Pose) -> Shot:
        """Return the picture of a row."""
        where = f"{self._file}: row {number}"
        if self._kind == "string":
            return Shot.of_file(self._path(where, number), time_ns, self._camera, ego_from_cam)
        read: Callable[[], Rgb] = partial(self._decoded, where, number)
        if self._video is not None:
            frame, count = self._kept[number], len(self._video.index.times_ns)
            if not isinstance(frame, int) or not 0 <= frame < count:
                raise DatasetError(f"{where}: frame {frame} is none of {count} of the video")
            read = partial(self._checked, where, partial(self._video.read, frame))
        return Shot(where, f"{name}_{number:06d}", time_ns, self._camera, ego_from_cam, read)

    def _path(self, where: str, number: int) -> Path:
        name = self._kept[number]
        if not isinstance(name, str):
            raise DatasetError(f"{where}: names no picture")
        for folder in self._file.parents:
            if (path := file_inside(where, folder, name)) is not None:
                return path
        raise DatasetError(
            f"{where}: its picture {name} is neither beside the log nor above it; move the log "
            "into the original set's folder, or convert with pictures inside (jpeg_binary)"
        )

    def _decoded(self, where: str, number: int) -> Rgb:
        batch, row = self._places[number]
        with opened_arrow(self._file, [self._column]) as content:
            data = content.get_batch(batch).column(0)[row].as_py()
        if data is None or not is_whole_jpeg(BytesIO(data)):
            raise DatasetError(f"{where}: its picture is missing or cut")
        return self._checked(where, partial(rgb_from_bytes, data, where))

    def _checked(self, where: str, read: Callable[[], Rgb]) -> Rgb:
        rgb = read()
        require_size(where, (rgb.shape[1], rgb.shape[0]), self._camera.intrinsics)
        return rgb
