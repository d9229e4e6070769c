"""A file appears whole or not at all."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rfcore.files import whole_file, whole_folder, write_whole


def test_text_and_bytes_replace_what_was_there(tmp_path):
    path = tmp_path / "a.json"
    write_whole(path, b"old")
    write_whole(path, "né")
    assert path.read_bytes() == "né".encode()
    assert list(tmp_path.iterdir()) == [path]


def fail_halfway(path: Path) -> None:
    with whole_file(path) as file:
        file.write(b"half")
        raise ZeroDivisionError


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.bin"
    write_whole(path, b"old")
    with pytest.raises(ZeroDivisionError):
        fail_halfway(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_is_on_the_disk_before_it_gets_its_name_and_its_name_before_the_end(
    tmp_path, monkeypatch
):
    synced: list[tuple[str, list[str]]] = []

    def noted(descriptor: int) -> None:
        target = Path(f"/proc/self/fd/{descriptor}").readlink()
        names = sorted(path.name for path in tmp_path.iterdir())
        synced.append((target.name, names))

    monkeypatch.setattr(os, "fsync", noted)
    write_whole(tmp_path / "a.bin", b"new")
    assert synced == [("a.bin.part", ["a.bin.part"]), (tmp_path.name, ["a.bin"])]


def test_a_folder_is_on_the_disk_with_all_it_holds_before_it_gets_its_name(tmp_path, monkeypatch):
    synced: list[tuple[str, bool]] = []

    def noted(descriptor: int) -> None:
        target = Path(f"/proc/self/fd/{descriptor}").readlink()
        synced.append((target.name, (tmp_path / "out").exists()))

    monkeypatch.setattr(os, "fsync", noted)
    with whole_folder(tmp_path / "out") as folder:
        (folder / "inner").mkdir()
        (folder / "inner" / "a.txt").write_text("a")
        (folder / "b.txt").write_text("b")
    assert set(synced[:-2]) == {("inner", False), ("a.txt", False), ("b.txt", False)}
    assert synced[-2:] == [("out.part", False), (tmp_path.name, True)]


def test_writers_of_one_file_take_turns(tmp_path):
    path, begun, may_end = tmp_path / "a.bin", threading.Event(), threading.Event()

    def slow() -> None:
        with whole_file(path) as file:
            file.write(b"first")
            begun.set()
            assert may_end.wait(10)

    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(slow)
        assert begun.wait(10)
        second = threads.submit(write_whole, path, b"2nd")
        may_end.set()
        first.result(10)
        second.result(10)
    assert path.read_bytes() == b"2nd"
    assert list(tmp_path.iterdir()) == [path]


def test_a_part_that_was_left_is_written_anew(tmp_path):
    (tmp_path / "a.bin.part").write_bytes(b"left by a process that was killed")
    write_whole(tmp_path / "a.bin", b"new")
    assert (tmp_path / "a.bin").read_bytes() == b"new"
    assert len(list(tmp_path.iterdir())) == 1
