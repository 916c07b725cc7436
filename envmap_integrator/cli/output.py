"""Writing pictures."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi

from envmap_integrator.system.atomic import replacing


def write_bitmap(path: Path, bitmap: mi.Bitmap) -> None:
    """Write a picture in the format that the name asks for; raise ``StorageError`` if that fails.

    Through memory: Mitsuba doesn't notice if the last bytes find no room on a disk.
    """
    stream = mi.MemoryStream()
    bitmap.write(stream, getattr(mi.Bitmap.FileFormat, _FORMATS[path.suffix]))
    with replacing(path) as file:
        file.write(stream.raw_buffer())


def write_png(path: Path, bitmap: mi.Bitmap) -> None:
    """Write the radiance channels of ``bitmap`` in sRGB, 8 bits a channel."""
    _, radiance = bitmap.split()[0]
    picture = radiance.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    write_bitmap(path, picture)


#: Formats by the ends of names.
_FORMATS = {".exr": "OpenEXR", ".png": "PNG"}
