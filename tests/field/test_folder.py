"""A folder lists its archives, whatever else lies in it, and reads each file once."""

import hashlib
import os
from pathlib import Path

from rfcore.field.archive import MAGIC, Archive, encode_archive
from rfcore.field.folder import MAX_ARCHIVE_BYTES, FieldFolder


def archive(path: Path, content: bytes = b"field") -> str:
    data = encode_archive(Archive("test", {"content": content.decode()}, {}))
    path.write_bytes(data)
    return hashlib.sha256(data).hexdigest()


def test_entries_that_are_no_archives_are_skipped_with_their_reason(tmp_path):
    field_id = archive(tmp_path / "street.rff")
    (tmp_path / "folder.rff").mkdir()
    os.mkfifo(tmp_path / "pipe.rff")
    (tmp_path / "dangling.rff").symlink_to(tmp_path / "nowhere")
    (tmp_path / "loop.rff").symlink_to(tmp_path / "loop.rff")
    (tmp_path / "text.rff").write_text("hello")
    (tmp_path / "empty.rff").write_bytes(b"")
    (tmp_path / "magic.rff").write_bytes(MAGIC)
    archive(tmp_path / "longer.rff")
    with (tmp_path / "longer.rff").open("ab") as longer:
        longer.truncate(3 << 30)
    with (tmp_path / "huge.rff").open("wb") as huge:
        huge.truncate(MAX_ARCHIVE_BYTES + 1)
    listing = FieldFolder(tmp_path).look()
    assert listing.paths == {field_id: tmp_path / "street.rff"}
    reasons = {path.stem: problem for path, problem in listing.skipped.items()}
    assert reasons == {
        "folder": "is no regular file",
        "pipe": "is no regular file",
        "dangling": "cannot be read (No such file or directory)",
        "loop": "cannot be read (Too many levels of symbolic links)",
        "text": "is no field archive: its first bytes are others",
        "empty": "is no field archive: its first bytes are others",
        "magic": "is no field archive: 8 bytes are too few for a field file",
        "longer": "is no field archive: 3221225472 bytes, the header says 192",
        "huge": f"has {MAX_ARCHIVE_BYTES + 1} bytes, above {MAX_ARCHIVE_BYTES}: not listed",
    }


def test_a_link_to_an_archive_is_an_archive(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "fields").mkdir()
    field_id = archive(tmp_path / "elsewhere" / "street")
    (tmp_path / "fields" / "street.rff").symlink_to(tmp_path / "elsewhere" / "street")
    assert set(FieldFolder(tmp_path / "fields").look().paths) == {field_id}


def test_a_file_is_read_once_until_it_changes(tmp_path, monkeypatch):
    digest, digests = hashlib.file_digest, []

    def counted(file: object, name: str) -> object:
        digests.append(name)
        return digest(file, name)

    monkeypatch.setattr(hashlib, "file_digest", counted)
    archive(tmp_path / "street.rff")
    folder = FieldFolder(tmp_path)
    first = [folder.look().paths for _ in range(5)]
    assert len(digests) == 1
    assert first == [first[0]] * 5
    changed = archive(tmp_path / "street.rff", b"another field")
    assert set(folder.look().paths) == {changed}
    assert len(digests) == 2
    (tmp_path / "street.rff").unlink()
    assert folder.look().paths == {}


def test_a_file_that_grows_is_left_out_until_two_looks_find_it_the_same(tmp_path):
    folder, path = FieldFolder(tmp_path), tmp_path / "street.rff"
    archive(path, b"hal")
    assert folder.look(settled=True).paths == {}
    whole = archive(path, b"half and half")
    assert folder.look(settled=True).paths == {}, "it has grown since"
    assert set(folder.look(settled=True).paths) == {whole}
    assert set(folder.look(settled=True).paths) == {whole}
