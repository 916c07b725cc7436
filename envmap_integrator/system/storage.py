"""Named arrays with metadata in multi-part OpenEXR files that any viewer opens.

Each file ends with a digest of all that comes before it, which viewers ignore. Nothing is made of a
file of ours unless that is right: OpenEXR doesn't survive every damage. Pictures of other tools,
which have no digest, are read as they are.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from .atomic import StorageError, replacing
from .memory import free_memory

#: EXR attribute that holds our metadata, as JSON.
ATTRIBUTE = "envmap_integrator"
FORMAT = 9

_MAGIC = b"v/1\x01"
#: The attribute as it lies in a file, within its first bytes; so it began in every format.
_ATTRIBUTE_BYTES = re.compile(ATTRIBUTE.encode() + rb'\0string\0....\{"format": (\d+)', re.DOTALL)
_HEADER = 1 << 16
_DIGEST_SIZE = 16
#: Deflate, which ours are compressed by, makes nothing smaller by more than this.
_COMPRESSION = 1032
#: What OpenEXR and JSON raise at what they can't read.
_NOT_PARSED = (RuntimeError, TypeError, ValueError, KeyError, AttributeError)

Parts = dict[str, dict[str, np.ndarray]]


def write(path: str | os.PathLike, parts: Parts, metadata: dict, compress: bool = True) -> None:
    """Write parts (name → channel → [H, W] array of float32 or uint32) and metadata.

    The file appears under its name only when it's complete. Raises ``StorageError`` if it can't be
    written.
    """
    compression = OpenEXR.ZIP_COMPRESSION if compress else OpenEXR.NO_COMPRESSION
    first = {ATTRIBUTE: json.dumps({"format": FORMAT, **metadata})}
    with replacing(path) as file:
        _exr(parts, {"compression": compression}, first).write(file)
        file.seek(0)
        file.write(_digest(file.read()))


def write_pictures(path: str | os.PathLike, parts: Parts, header: dict) -> None:
    """Likewise for other tools: parts that all have the OpenEXR attributes ``header``."""
    with replacing(path) as file:
        _exr(parts, {"compression": OpenEXR.ZIP_COMPRESSION} | header, {}).write(file)


def _exr(parts: Parts, header: dict, first: dict) -> OpenEXR.File:
    """A file of parts that all have one header, and the first some more."""
    header = header | {
        "type": OpenEXR.scanlineimage,
        "displayWindow": _display_window(parts),
    }
    return OpenEXR.File(
        [  # Which change the dictionaries that they are given.
            OpenEXR.Part(header | (first if i == 0 else {}), dict(channels), name=name)
            for i, (name, channels) in enumerate(parts.items())
        ]
    )


def is_ours(path: str | os.PathLike) -> bool:
    """Does a file begin as what ``write`` writes, in any format? False if it can't be read."""
    try:
        with open(str(path), "rb") as file:
            return _ATTRIBUTE_BYTES.search(file.read(_HEADER)) is not None
    except OSError:
        return False


def read(path: str | os.PathLike, made_by: str) -> Stored:
    """Read what ``write`` has written.

    Raises ``StorageError`` if the file is missing, damaged, of another format or none of ours;
    ``made_by`` tells the user where such files come from.
    """
    return _guarded(_read, path, made_by)


def read_pictures(path: str | os.PathLike, made_by: str) -> list[Picture]:
    """Read the parts of any OpenEXR file; raises ``StorageError`` if it's missing or damaged."""
    return _guarded(_read_pictures, path, made_by)


@dataclass(frozen=True)
class Picture:
    """A part of an OpenEXR file.

    name       of the part
    header     its attributes
    channels   name → [H, W] array
    """

    name: str
    header: dict[str, Any]
    channels: dict[str, np.ndarray]


def _guarded(reader: Callable, path: str | os.PathLike, made_by: str) -> Any:
    path = Path(str(path))  # Mitsuba's own paths aren't os.PathLike.
    try:
        return reader(path, made_by)
    except MemoryError:
        raise StorageError(
            f"{path}: needs more memory than the {free_memory() / 1e9:.1f} GB that are free; close "
            f"other programs, or {made_by}"
        ) from None


def _content(path: Path, made_by: str) -> bytes:
    try:
        if not path.is_file():
            raise StorageError(f"{path}: no such file; {made_by}")
        _ask_for_memory(path.stat().st_size)
        return path.read_bytes()
    except OSError as error:
        reason = f"can't be read: {error.strerror}; fix that, or {made_by}"
        raise StorageError(f"{path}: {reason}") from error


def _read(path: Path, made_by: str) -> Stored:
    content = _content(path, made_by)
    fault = _fault(content)
    if fault:
        raise StorageError(f"{path}: {fault}; {made_by}")
    try:
        parts, metadata = _parse(content)
    except _NOT_PARSED as error:
        raise StorageError(f"{path}: not as this version writes files; {made_by}") from error
    return Stored(parts, metadata, str(path), made_by)


def _read_pictures(path: Path, made_by: str) -> list[Picture]:
    content = _content(path, made_by)
    try:
        return _pictures(content)
    except _NOT_PARSED as error:
        raise StorageError(f"{path}: damaged or no OpenEXR file; {made_by}") from error


@dataclass(frozen=True)
class Stored:
    """What a file holds. Everything is checked as it's taken; complaints name file and value.

    parts      name → channel → [H, W] array
    metadata   values by name
    path       of the file
    made_by    tells the user where such files come from
    """

    parts: Parts
    metadata: dict[str, Any]
    path: str
    made_by: str

    def refusal(self, reason: str) -> StorageError:
        """The error to raise for a fault of the file."""
        return StorageError(f"{self.path}: {' '.join(reason.split())}; {self.made_by}")

    def array(self, part: str, channel: str, dtype: type) -> np.ndarray:
        """A channel [H, W] of float32 or uint32."""
        image = self.parts.get(part, {}).get(channel)
        if image is None or image.dtype != dtype:
            raise self.refusal(f'holds no part "{part}" with {np.dtype(dtype)} values "{channel}"')
        return image

    def text(self, name: str) -> str:
        """A string."""
        return self._value(name, "a string", lambda value: isinstance(value, str))

    def texts(self, name: str) -> list[str]:
        """A list of strings."""
        return self._value(
            name,
            "a list of strings",
            lambda v: isinstance(v, list) and all(isinstance(entry, str) for entry in v),
        )

    def flag(self, name: str) -> bool:
        """True or false."""
        return self._value(name, "true or false", lambda value: isinstance(value, bool))

    def integer(self, name: str, low: int, high: int = 2**31 - 1) -> int:
        """An integer of ``low`` to ``high``."""
        return self._value(
            name,
            f"an integer of {low} to {high}",
            lambda value: type(value) is int and low <= value <= high,
        )

    def number(self, name: str) -> float:
        """A number that isn't negative."""
        return self._value(name, "a number of at least 0", lambda v: _is_finite(v) and v >= 0)

    def point(self, name: str) -> list[float]:
        """Three numbers."""
        return self._value(
            name,
            "three numbers",
            lambda v: isinstance(v, list) and len(v) == 3 and all(map(_is_finite, v)),
        )

    def entries(self, name: str) -> list[Stored]:
        """The objects of a list, over the same parts."""
        values = self._value(
            name,
            "a list of objects",
            lambda v: isinstance(v, list) and all(isinstance(entry, dict) for entry in v),
        )
        return [replace(self, metadata=value) for value in values]

    def _value(self, name: str, wanted: str, valid: Callable[[Any], bool]) -> Any:
        value = self.metadata.get(name)
        if not valid(value):
            raise self.refusal(f'its "{name}" must be {wanted}, not {repr(value)[:40]}')
        return value


def _fault(content: bytes) -> str:
    """What keeps the content of a file from being what ``write`` has written, to the bit."""
    if not content.startswith(_MAGIC):
        return "damaged or no OpenEXR file"
    ours = _ATTRIBUTE_BYTES.search(content, 0, _HEADER)
    if not ours:
        return "damaged or not a file of envmap_integrator"
    if int(ours[1]) != FORMAT:
        return f"written in format {int(ours[1])}, this version reads format {FORMAT}"
    if _digest(content[:-_DIGEST_SIZE]) != content[-_DIGEST_SIZE:]:
        return "truncated or damaged"
    return ""


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_DIGEST_SIZE).digest()


def _parse(content: bytes) -> tuple[Parts, dict[str, Any]]:
    pictures = _pictures(content, _COMPRESSION)
    parts = {picture.name: picture.channels for picture in pictures}
    return parts, dict(json.loads(pictures[0].header[ATTRIBUTE]))


def _pictures(content: bytes, compression: float = math.inf) -> list[Picture]:
    """The parts of a file that is smaller than its pixels by no more than ``compression``."""
    with OpenEXR.File(io.BytesIO(content), separate_channels=True, header_only=True) as file:
        headers = [dict(part.header) for part in file.parts]
    size = _claimed_size(headers)
    if size > compression * len(content):
        raise ValueError("sizes that can't be true")
    _ask_for_memory(size)
    with OpenEXR.File(io.BytesIO(content), separate_channels=True) as file:
        channels = [
            {name: channel.pixels for name, channel in part.channels.items()} for part in file.parts
        ]
        names = [part.name() for part in file.parts]
    return [Picture(*each) for each in zip(names, headers, channels, strict=True)]


def _ask_for_memory(size: int) -> None:
    if size > free_memory():
        raise MemoryError


def _claimed_size(headers: list[dict[str, Any]]) -> int:
    """Bytes of the pixels that headers announce."""
    total = 0
    for header in headers:
        low, high = (np.asarray(corner, dtype=object) for corner in header["dataWindow"])
        total += 4 * len(header["channels"]) * int(np.prod(high - low + 1))
    return total


def _is_finite(value: Any) -> bool:
    """Whether it's a number that Mitsuba can hold."""
    return type(value) in (int, float) and abs(value) <= float(np.finfo(np.float32).max)


def _display_window(parts: Parts) -> tuple[np.ndarray, np.ndarray]:
    """OpenEXR wants one for all parts: the one that holds them all."""
    shapes = [image.shape for channels in parts.values() for image in channels.values()]
    return np.zeros(2, np.int32), np.max(shapes, axis=0)[::-1].astype(np.int32) - 1
