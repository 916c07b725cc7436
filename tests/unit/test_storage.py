"""Files: what is read is what was written, and what is damaged is refused."""

from __future__ import annotations

import numpy as np
import OpenEXR
import pytest

from envmap_integrator import storage
from envmap_integrator.storage import StorageError, read, write

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
    stored, metadata = read(path, MADE_BY)
    assert METADATA.items() <= metadata.items()
    assert stored.keys() == parts().keys()
    for name, channels in parts().items():
        assert stored[name].keys() == channels.keys()
        for channel, values in channels.items():
            assert stored[name][channel].dtype == values.dtype
            assert stored[name][channel].tobytes() == values.tobytes()


def test_any_viewer_sees_the_parts(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert [part.name() for part in file.parts] == list(parts())


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
    """Most damage is found by the compression, the rest by the checksum."""
    content = bytearray(path.read_bytes())
    for position in np.linspace(len(content) // 2, len(content) - 1, 20).astype(int):
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


def test_another_format(path, monkeypatch):
    monkeypatch.setattr(storage, "FORMAT", storage.FORMAT + 1)
    assert_refused(path, "damaged")


# ---------------------- Files that can't be written ----------------------


@pytest.mark.parametrize("step", ["os.replace", "OpenEXR.File.write"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(path, monkeypatch, step):
    def fail(*arguments):
        raise OSError("disk full")

    before = path.read_bytes()
    monkeypatch.setattr(f"envmap_integrator.storage.{step}", fail)
    with pytest.raises(OSError, match="disk full"):
        write(path, parts(), METADATA)
    assert path.read_bytes() == before
    assert files_in(path.parent) == [path.name]


def test_an_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("envmap_integrator.storage.os.replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "state.exr", parts(), METADATA)
    assert files_in(tmp_path) == []


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(StorageError, match=f"there is no folder {tmp_path}/nowhere"):
        write(tmp_path / "nowhere" / "state.exr", parts(), METADATA)


def test_files_can_be_read_by_others(path):
    """As any file that a program of the user makes, not as the private one it was at first."""
    beside = path.with_name("beside.txt")
    beside.touch()
    assert path.stat().st_mode == beside.stat().st_mode
