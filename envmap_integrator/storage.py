"""Named arrays with metadata in multi-part OpenEXR files that any viewer opens."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import OpenEXR

#: EXR attribute that holds our metadata, as JSON.
ATTRIBUTE = "envmap_integrator"
FORMAT = 2

Parts = dict[str, dict[str, np.ndarray]]


class StorageError(ValueError):
    """A file that can't be read or isn't what it should be; the message is one line."""


def write(path: str | os.PathLike, parts: Parts, metadata: dict) -> None:
    """Write parts (name → channel → [H, W] array of float32 or uint32) and metadata.

    The file appears under its name only when it's complete.
    """
    path = Path(path)
    metadata = {"format": FORMAT, "checksum": _checksum(parts), **metadata}
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "displayWindow": _display_window(parts),
    }
    exr_parts = [
        OpenEXR.Part(
            header | ({ATTRIBUTE: json.dumps(metadata)} if i == 0 else {}), channels, name=name
        )
        for i, (name, channels) in enumerate(parts.items())
    ]
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}; make it first")
    temporary = path.with_name(f".{path.stem}-{os.getpid()}.exr")
    try:
        OpenEXR.File(exr_parts).write(str(temporary))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read(path: str | os.PathLike, made_by: str) -> tuple[Parts, dict]:
    """Read what ``write`` has written.

    Raises ``StorageError`` if the file is missing, truncated or none of ours; ``made_by`` tells
    the user where such files come from.
    """
    path = Path(str(path))  # Mitsuba's own paths aren't os.PathLike.
    if not path.is_file():
        raise StorageError(f"{path}: no such file; {made_by}")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            metadata = json.loads(file.parts[0].header[ATTRIBUTE])
            parts = {
                part.name(): {name: channel.pixels for name, channel in part.channels.items()}
                for part in file.parts
            }
            complete = metadata["format"] == FORMAT and metadata["checksum"] == _checksum(parts)
    except KeyError:
        raise StorageError(f"{path}: not a file of envmap_integrator; {made_by}") from None
    except (RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise StorageError(f"{path}: damaged or no OpenEXR file; {made_by}") from error
    if not complete:
        raise StorageError(f"{path}: truncated or damaged; {made_by}")
    return parts, metadata


def _display_window(parts: Parts) -> tuple[np.ndarray, np.ndarray]:
    """OpenEXR wants one for all parts: the one that holds them all."""
    shapes = [image.shape for channels in parts.values() for image in channels.values()]
    return np.zeros(2, np.int32), np.max(shapes, axis=0)[::-1].astype(np.int32) - 1


def _checksum(parts: Parts) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(parts):
        for channel in sorted(parts[name]):
            digest.update(f"{name}/{channel}".encode())
            digest.update(np.ascontiguousarray(parts[name][channel]).tobytes())
    return digest.hexdigest()
