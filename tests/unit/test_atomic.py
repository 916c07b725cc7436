"""A file is replaced as a whole or not at all, by however many writers."""

from __future__ import annotations

import itertools
import os
import threading
import time

import pytest

from envmap_integrator.system.atomic import PREFIX, StorageError, replacing
from tests.helpers import unprivileged


@pytest.fixture
def path(tmp_path):
    result = tmp_path / "state.exr"
    result.write_text("old")
    return result


def put(path, text: str) -> None:
    with replacing(path) as file:
        file.write(text.encode())


def names_in(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_nothing_shows_before_the_end(path):
    with replacing(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert names_in(path.parent) == [path.name]


@pytest.mark.parametrize("error", [OSError("disk full"), RuntimeError("bug"), KeyboardInterrupt()])
def test_an_error_leaves_the_old_file_and_nothing_else(path, error):
    expected = StorageError if isinstance(error, OSError) else type(error)
    with pytest.raises(expected), replacing(path) as file:
        file.write(b"half")
        raise error
    assert path.read_text() == "old"
    assert names_in(path.parent) == [path.name]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_an_error_of_the_system_is_one_line_with_a_mend(path, monkeypatch, step):
    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(StorageError) as caught:
        put(path, "new")
    monkeypatch.undo()
    assert str(caught.value) == (
        f"{path}: can't be written: No space left on device; make room there or choose another "
        "folder"
    )
    assert path.read_text() == "old"
    assert names_in(path.parent) == [path.name]


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(StorageError, match=f"no folder {tmp_path}/nowhere; make it first"):
        put(tmp_path / "nowhere" / "state.exr", "new")


def test_a_folder_in_place_of_the_file(tmp_path):
    with pytest.raises(StorageError, match=f"^{tmp_path}: is a folder; choose another name"):
        put(tmp_path, "new")


def test_a_folder_that_is_not_writable(public_folder):
    path = public_folder / "state.exr"
    expected = f"^{path}: the folder {path.parent} isn't writable; change its permissions or choose"
    public_folder.chmod(0o555)
    with unprivileged(), pytest.raises(StorageError, match=expected):
        put(path, "new")
    assert names_in(public_folder) == []


def test_a_folder_that_is_out_of_reach(public_folder):
    inner = public_folder / "inner"
    inner.mkdir()
    public_folder.chmod(0)
    with unprivileged(), pytest.raises(StorageError) as caught:
        put(inner / "state.exr", "new")
    assert str(caught.value).startswith(f"{inner}/state.exr: can't be written: Permission denied;")


def test_a_link_stays_a_link(path):
    link = path.with_name("link.exr")
    link.symlink_to(path)
    put(link, "new")
    assert link.is_symlink() and path.read_text() == "new"


def test_a_name_as_long_as_can_be(tmp_path):
    path = tmp_path / f"{'x' * 251}.exr"
    put(path, "new")
    assert names_in(tmp_path) == [path.name]


def test_what_killed_writers_left_is_removed(path):
    path.with_name(f"{PREFIX}0123456789abcdef.exr").write_text("half")
    other = path.with_name(".envmap_integrator.exr")
    other.write_text("not ours")
    put(path, "new")
    assert names_in(path.parent) == [other.name, path.name]


def test_writers_leave_each_others_files_alone(path):
    with replacing(path) as first:
        first.write(b"first")
        put(path, "second")
        assert path.read_text() == "second"
    assert path.read_text() == "first"


def test_many_writers_at_once(path):
    """Each of their versions is whole, and no writer fails for another's sake."""
    versions = [str(number) * 100_000 for number in range(8)]
    failures, stop = [], threading.Event()

    def keep_writing(text):
        try:
            while not stop.is_set():
                put(path, text)
        except Exception as error:
            failures.append(error)

    writers = [threading.Thread(target=keep_writing, args=(text,)) for text in versions]
    put(path, versions[0])
    for writer in writers:
        writer.start()
    seen, patience = set(), time.monotonic() + 60
    for count in itertools.count(1):
        seen.add(path.read_text())
        if (count > 300 and len(seen) > 1) or time.monotonic() > patience:
            break
    stop.set()
    for writer in writers:
        writer.join()
    assert not failures
    assert seen <= set(versions) and len(seen) > 1
    assert names_in(path.parent) == [path.name]
