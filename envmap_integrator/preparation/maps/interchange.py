"""Cube maps and latitude-longitude maps as other tools read and write them.

OpenEXR's cube maps (``ImfEnvmap.h``) have the faces +x, -x, +y, -y, +z and -z one above the other,
and the centres of a face's outer pixels lie on its edges, so that neighbouring faces share them.
Ours have the centres of all texels inside of their faces: maps are resampled on the way.
"""

from __future__ import annotations

import os

import numpy as np
import OpenEXR

from ...lookup.cube import n_levels, texel_directions
from ...lookup.cube_map import RADIANCE_CHANNELS
from ...system.storage import Picture, StorageError, read_pictures, write_pictures
from .mipmap import build_levels

_X, _Y, _Z = np.eye(3)
#: Where the faces of OpenEXR's cube lie, and where their rows and columns go.
_OUTWARDS = np.array([_X, -_X, _Y, -_Y, _Z, -_Z])
_RIGHT = np.array([_Z, -_Z, _X, _X, -_X, _X])
_DOWN = np.array([-_Y, -_Y, -_Z, _Z, -_Y, -_Y])


def cube_directions(size: int) -> np.ndarray:
    """Directions (not normalised) of the pixels of a cube map in OpenEXR's layout, [6 N, N, 3]."""
    across = np.linspace(-1, 1, size) if size > 1 else np.zeros(1)
    faces = (
        _OUTWARDS[:, None, None]
        + across[:, None] * _RIGHT[:, None, None]
        + across[:, None, None] * _DOWN[:, None, None]
    )
    return faces.reshape(6 * size, size, 3)


def latlong_directions(height: int) -> np.ndarray:
    """Unit directions of the pixels of Mitsuba's ``envmap``, [H, 2 H, 3].

    The first row is +y, the last -y. Columns go from -z over +x, +z and -x, their centres between
    the borders: half a pixel from where OpenEXR has them.
    """
    theta = np.linspace(0, np.pi, height)[:, None]
    phi = (np.arange(2 * height) + 0.5) * (np.pi / height)
    d = np.sin(phi) * np.sin(theta), np.cos(theta) + 0 * phi, -np.cos(phi) * np.sin(theta)
    return np.stack(d, axis=-1)


def write_cube(path: str | os.PathLike, levels: list[np.ndarray]) -> None:
    """Write levels [6 N, N, C] in OpenEXR's layout, one a part, finest first."""
    parts = {f"level{number}": _channels(level) for number, level in enumerate(levels)}
    write_pictures(path, parts, {"envmap": OpenEXR.ENVMAP_CUBE})


def write_latlong(path: str | os.PathLike, picture: np.ndarray) -> None:
    """Write a picture [H, 2 H, C] for Mitsuba's ``envmap``."""
    write_pictures(path, {"latlong": _channels(picture)}, {"envmap": OpenEXR.ENVMAP_LATLONG})


def read_cube(path: str | os.PathLike, made_by: str) -> list[np.ndarray]:
    """Levels [6, R_l, R_l, C], finest first, of the first cube map of any OpenEXR file.

    R is the power of two next to the size of its faces, at least that. Levels that follow as parts
    of half the size are taken, others are averages as those of our own maps. Values that are
    negative or not finite count as zero. The attribute ``envmap`` may be missing, as many tools
    can't write it. Raises ``StorageError`` if there is no such map; ``made_by`` as in ``storage``.
    """
    pictures = read_pictures(path, made_by)
    first = next((i for i, picture in enumerate(pictures) if _size(picture)), None)
    if first is None:
        raise StorageError(
            f"{path}: holds no cube map, of six square faces one above the other with channels R, "
            f'G and B or Y; use Mitsuba\'s emitter "envmap" for other pictures, or {made_by}'
        )
    size = _size(pictures[first])
    finest = 1 << (size - 1).bit_length()
    levels = []
    for picture in pictures[first : first + n_levels(finest)]:
        if _size(picture) != max(size >> len(levels), 1):
            break
        image = _radiance(picture)
        if levels and image.shape[-1] != levels[0].shape[-1]:
            break
        levels.append(_resampled(image, finest >> len(levels)))
    coarsest = levels.pop().astype(np.float64)
    return levels + [
        level.astype(np.float32) for level in build_levels(coarsest, np.ones(coarsest.shape[:3]))
    ]


def _size(picture: Picture) -> int:
    """Pixels along the edge of a face of a cube map, 0 if a picture is none."""
    if picture.header.get("envmap", OpenEXR.ENVMAP_CUBE) != OpenEXR.ENVMAP_CUBE:
        return 0
    names = _names(picture)
    height, width = picture.channels[names[0]].shape if names else (0, 0)
    return width if height == 6 * width else 0


def _names(picture: Picture) -> tuple[str, ...]:
    """The channels that hold radiance."""
    known = reversed(RADIANCE_CHANNELS.values())
    return next((names for names in known if picture.channels.keys() >= set(names)), ())


def _radiance(picture: Picture) -> np.ndarray:
    """Radiance [6 N, N, C]."""
    image = np.stack([picture.channels[name] for name in _names(picture)], axis=-1)
    return np.maximum(np.nan_to_num(image.astype(np.float32), posinf=0), 0)


def _channels(image: np.ndarray) -> dict[str, np.ndarray]:
    names = RADIANCE_CHANNELS[image.shape[-1]]
    return {n: np.ascontiguousarray(image[..., i], np.float32) for i, n in enumerate(names)}


def _resampled(image: np.ndarray, resolution: int) -> np.ndarray:
    """Texels [6, R, R, C] of ours from a map [6 N, N, C] in OpenEXR's layout, bilinear."""
    size = image.shape[1]
    faces = image.reshape(6, size, size, -1)
    d = texel_directions(resolution)
    result = np.empty((6, resolution, resolution, image.shape[-1]), np.float32)
    for face in range(6):  # They come in the same order.
        column, row = ((d[face] @ axis[face] + 1) * (0.5 * (size - 1)) for axis in (_RIGHT, _DOWN))
        x, y = (np.minimum(c.astype(int), max(size - 2, 0)) for c in (column, row))
        u, v = (column - x)[..., None], (row - y)[..., None]
        x1, y1 = (np.minimum(c + 1, size - 1) for c in (x, y))
        above = (1 - u) * faces[face, y, x] + u * faces[face, y, x1]
        below = (1 - u) * faces[face, y1, x] + u * faces[face, y1, x1]
        result[face] = (1 - v) * above + v * below
    return result
