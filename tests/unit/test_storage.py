"""Files: what is read is what was written, and what is damaged is refused."""

from __future__ import annotations

import struct
import tracemalloc

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envmap_integrator.system import storage
from envmap_integrator.system.storage import StorageError, Stored, read, write
from tests.helpers import at_most, unprivileged

pytestmark = pytest.mark.usefixtures("variant")

METADATA = {"name": 'the "map"', "sizes": [4, 3.5], "nothing": None}
MADE_BY = "make it with envmap-render bake"


def parts() -> storage.Parts:
    """All that is hard to keep: NaN, infinities, denormals, both zeros, all 32 bits."""
    special = np.array([[np.nan, np.inf, -np.inf, 1e-40, -0.0, 0.0, 3.4e38]], np.float32)
    random = np.random.default_rng(6)
    return {
        "special": {"Y": special},
        "colours": {name: random.normal(size=(5, 7)).astype(np.float32) for name in "RGB"},
        "words": {"id": random.integers(0, 2**32, (3, 1000), dtype=np.uint32)},
    }


@pytest.fixture
def path(tmp_path):
    result = tmp_path / "state.exr"
    write(result, parts(), METADATA)
    return result


def files_in(folder) -> list[str]:
    return [path.name for path in folder.iterdir()]


def test_what_was_written_is_read_to_the_bit(path):
    stored = read(path, MADE_BY)
    assert METADATA.items() <= stored.metadata.items()
    assert stored.parts.keys() == parts().keys()
    for name, channels in parts().items():
        assert stored.parts[name].keys() == channels.keys()
        for channel, values in channels.items():
            assert stored.array(name, channel, values.dtype).tobytes() == values.tobytes()


def test_what_is_written_stays_as_it_is(tmp_path):
    ours = parts()
    write(tmp_path / "first.exr", ours, METADATA)
    write(tmp_path / "second.exr", ours, METADATA)
    assert (tmp_path / "first.exr").read_bytes() == (tmp_path / "second.exr").read_bytes()


def test_any_viewer_sees_the_parts(path):
    """OpenEXR's own reader and Mitsuba's, which know nothing of the digest at the end."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert [part.name() for part in file.parts] == list(parts())
    first = np.array(mi.Bitmap(str(path)))
    assert np.array_equal(first, parts()["special"]["Y"], equal_nan=True)


# ---------------------- Files that can't be read ----------------------


def assert_refused(path, message: str) -> None:
    with pytest.raises(StorageError, match=message) as caught:
        read(path, MADE_BY)
    assert str(path) in str(caught.value)
    assert MADE_BY in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file(tmp_path):
    assert_refused(tmp_path / "none.exr", "no such file")


def test_a_folder(tmp_path):
    assert_refused(tmp_path, "no such file")


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.2, 0.5, 0.9, 0.999])
def test_a_truncated_file(path, kept):
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    assert_refused(path, "damaged")


def test_a_damaged_file(path):
    content = bytearray(path.read_bytes())
    for position in np.linspace(0, len(content) - 1, 100).astype(int):
        damaged = content.copy()
        damaged[position] ^= 0xFF
        path.write_bytes(damaged)
        assert_refused(path, "damaged")


def test_values_that_were_changed(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        file.parts[1].channels["R"].pixels[0, 0] += 1
        changed = [
            OpenEXR.Part(dict(part.header), dict(part.channels), name=part.name())
            for part in file.parts
        ]
        OpenEXR.File(changed).write(str(path))
    assert_refused(path, "damaged")


def test_a_picture_of_someone_else(tmp_path):
    path = tmp_path / "picture.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": np.ones((2, 2), np.float32)}).write(
        str(path)
    )
    assert_refused(path, "not a file of envmap_integrator")


def test_no_picture_at_all(tmp_path):
    path = tmp_path / "notes.exr"
    path.write_text("not an EXR file")
    assert_refused(path, "no OpenEXR file")


@pytest.mark.parametrize("other", [storage.FORMAT - 1, storage.FORMAT + 1])
def test_another_format(path, monkeypatch, other):
    monkeypatch.setattr(storage, "FORMAT", other)
    write(path, parts(), METADATA)
    monkeypatch.undo()
    assert_refused(path, f"written in format {other}, this version reads format {storage.FORMAT}")


@pytest.mark.parametrize("closed", ["file", "folder"])
def test_a_file_that_may_not_be_read(public_folder, closed):
    path = public_folder / "state.exr"
    write(path, parts(), METADATA)
    (path if closed == "file" else public_folder).chmod(0)
    with unprivileged():
        assert_refused(path, "can't be read: Permission denied")


# ---------------------- Values that aren't what they should be ----------------------


def stored(**metadata) -> Stored:
    return Stored(parts(), metadata, "room.exr", MADE_BY)


@pytest.mark.parametrize(
    ("method", "arguments", "good", "bad"),
    [
        ("text", (), ["desk", ""], [1, None, ["desk"]]),
        ("flag", (), [True, False], [0, 1, "true", None]),
        ("integer", (1, 8), [1, 8], [0, 9, 2.0, True, "4", None, float("nan")]),
        (
            "number",
            (),
            [0, 2, 0.5],
            [-1, float("nan"), float("inf"), 1e39, 10**400, True, "1", None],
        ),
        ("point", (), [[1, -2.5, 0]], [[1, 2], [1, 2, float("nan")], [1, 2, "3"], 3, None]),
        ("entries", (), [[], [{"a": 1}]], [[1], {"a": 1}, None]),
    ],
)
def test_values_are_checked(method, arguments, good, bad):
    for value in good:
        found = getattr(stored(x=value), method)("x", *arguments)
        if method == "entries":
            found = [entry.metadata for entry in found]
        assert found == value
    expected = '^room.exr: its "x" must be .*, not (.*); make it with envmap-render bake$'
    for value in bad:
        with pytest.raises(StorageError, match=expected) as caught:
            getattr(stored(x=value), method)("x", *arguments)
        assert repr(value)[:40] in str(caught.value)


@pytest.mark.parametrize(
    ("part", "channel", "dtype"),
    [("none", "Y", np.float32), ("special", "Z", np.float32), ("special", "Y", np.uint32)],
)
def test_arrays_are_checked(part, channel, dtype):
    name = np.dtype(dtype).name
    with pytest.raises(
        StorageError, match=f'holds no part "{part}" with {name} values "{channel}"'
    ):
        stored().array(part, channel, dtype)


def sealed(content: bytes) -> bytes:
    """With the digest that belongs to the content before it, as a forger would leave it."""
    kept = content[: -storage._DIGEST_SIZE]
    return kept + storage._digest(kept)


def test_sizes_that_cannot_be_true_are_not_asked_for(path):
    """A window of 16 GB in a file whose digest is right."""
    content = bytearray(path.read_bytes())
    window = content.index(b"dataWindow\0box2i\0") + 21
    content[window : window + 16] = struct.pack("<4i", 0, 0, (1 << 16) - 1, (1 << 16) - 1)
    path.write_bytes(sealed(content))
    tracemalloc.start()
    assert_refused(path, "not as this version writes files")
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


@pytest.mark.parametrize("text", ["[]", "3", "{", '{"a": [[[', "[" * 100_000])
def test_metadata_that_is_not_what_it_should_be(tmp_path, monkeypatch, text):
    path = tmp_path / "state.exr"
    monkeypatch.setattr(
        storage.json, "dumps", lambda value: f'{{"format": {storage.FORMAT}, "x": ' + text
    )
    write(path, parts(), METADATA)
    monkeypatch.undo()
    assert_refused(path, "not as this version writes files")


# ---------------------- Files that can't be written ----------------------


def test_a_failed_write_leaves_the_old_file_and_nothing_else(path, monkeypatch):
    def fail(*arguments):
        raise RuntimeError("no such compression")

    before = path.read_bytes()
    monkeypatch.setattr("envmap_integrator.system.storage.OpenEXR.File.write", fail)
    with pytest.raises(RuntimeError, match="no such compression"):
        write(path, parts(), METADATA)
    assert path.read_bytes() == before
    assert files_in(path.parent) == [path.name]


def test_a_disk_that_is_full(tmp_path):
    """Wherever in the file the room ends. A limit on the size of files stands for the disk."""
    path = tmp_path / "state.exr"
    write(path, parts(), METADATA)
    size = path.stat().st_size
    before = path.read_bytes()
    limits = [0, 100, *np.linspace(1000, size - 100, 10).astype(int), *range(size - 40, size)]
    for limit in limits:
        with at_most(limit), pytest.raises(StorageError) as caught:
            write(path, parts(), METADATA)
        assert str(caught.value) == (
            f"{path}: can't be written: File too large; make room there or choose another folder"
        )
        assert path.read_bytes() == before
        assert files_in(tmp_path) == [path.name]
    with at_most(size):
        write(path, parts(), METADATA)


def test_files_can_be_read_by_others(path):
    """As any file that a program of the user makes, not as the private one it was at first."""
    beside = path.with_name("beside.txt")
    beside.touch()
    assert path.stat().st_mode == beside.stat().st_mode
