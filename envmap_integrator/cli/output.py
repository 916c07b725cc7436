"""Writing pictures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mitsuba as mi


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; on success it takes the place of ``path``.

    So ``path`` is at no time half written, and an error leaves its old content alone.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_png(path: Path, bitmap: mi.Bitmap) -> None:
    """Write the radiance channels of ``bitmap`` in sRGB, 8 bits a channel."""
    _, radiance = bitmap.split()[0]
    picture = radiance.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    with replacing(path) as temporary:
        picture.write(str(temporary))
