"""Geometry of cube maps: directions, faces and texels.

A direction d lies on the face of its largest component: face 2a for +a, 2a + 1 for -a, with axis
a = 0, 1, 2. On it, (u, v) are the next two components in cyclic order over the largest, both in
[-1, 1]. Texel (x, y) of an R x R face covers [2x/R - 1, 2(x+1)/R - 1] and alike in y.

Levels of a map with faces of R (a power of two) lie one after the other, largest first, each as
[face, y, x]; level l starts at texel 8 (R² - R_l²), R_l = R / 2^l.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def n_levels(resolution: int) -> int:
    """Number of levels from R x R down to 1 x 1."""
    return resolution.bit_length()


def n_texels(resolution: int | mi.UInt32) -> int | mi.UInt32:
    """Texels of all six faces and all levels."""
    return 8 * resolution * resolution - 2


def level_offset(resolution: int | mi.UInt32, level_resolution: int | mi.UInt32) -> int | mi.UInt32:
    """Index of the first texel of the level with the given resolution."""
    return 8 * (resolution * resolution - level_resolution * level_resolution)


def direction_to_face(d: mi.Vector3f) -> tuple[mi.UInt32, mi.Point2f]:
    """Face index and (u, v) in [-1, 1]² of a direction of any length."""
    a = dr.abs(d)
    on_x = (a.x >= a.y) & (a.x >= a.z)
    on_y = ~on_x & (a.y >= a.z)
    axis = dr.select(on_x, mi.UInt32(0), dr.select(on_y, mi.UInt32(1), mi.UInt32(2)))
    major = dr.select(on_x, d.x, dr.select(on_y, d.y, d.z))
    u = dr.select(on_x, d.y, dr.select(on_y, d.z, d.x))
    v = dr.select(on_x, d.z, dr.select(on_y, d.x, d.y))
    face = 2 * axis + dr.select(major < 0, mi.UInt32(1), mi.UInt32(0))
    return face, mi.Point2f(u, v) / dr.abs(major)


def face_to_direction(face: mi.UInt32, uv: mi.Point2f, depth: mi.Float = 1.0) -> mi.Vector3f:
    """Direction (not normalised) of a point on a face, or on a parallel plane at ``depth``."""
    major = dr.select((face & 1) == 0, mi.Float(depth), -mi.Float(depth))
    axis = face >> 1
    x = dr.select(axis == 0, major, dr.select(axis == 1, uv.y, uv.x))
    y = dr.select(axis == 0, uv.x, dr.select(axis == 1, major, uv.y))
    z = dr.select(axis == 0, uv.y, dr.select(axis == 1, uv.x, major))
    return mi.Vector3f(x, y, z)


def fold(face: mi.UInt32, uv: mi.Point2f, u: mi.Float) -> tuple[mi.UInt32, mi.Point2f]:
    """Face and (u, v) of a point that may lie off its face by up to that face's width.

    What is off is folded over the edge, as far beyond it and at the same place along it, so that
    points spread around one on an edge fall on the same texels whichever of its faces they come
    from. Beyond a corner there are only three faces: ``u``, uniform in the unit interval, gives
    each a third.
    """
    over = dr.maximum(dr.abs(uv) - 1, 0)
    corner = (over.x > 0) & (over.y > 0)
    over.x = dr.select(corner & (u > 1 / 3), 0, over.x)
    over.y = dr.select(corner & (u < 2 / 3), 0, over.y)
    # Off the diagonals, where two faces would claim it.
    inside = 1 - 1e-6
    u_ = dr.select(over.x > 0, dr.sign(uv.x), dr.clip(uv.x, -inside, inside))
    v_ = dr.select(over.y > 0, dr.sign(uv.y), dr.clip(uv.y, -inside, inside))
    return direction_to_face(face_to_direction(face, mi.Point2f(u_, v_), 1 - over.x - over.y))


def texel(
    face: mi.UInt32, uv: mi.Point2f, resolution: mi.UInt32, level_resolution: mi.UInt32
) -> mi.UInt32:
    """Index of the texel at (u, v) of a face, on the level with the given resolution."""
    last = level_resolution - 1
    size = mi.Float(level_resolution)
    x = dr.minimum(mi.UInt32(dr.maximum((uv.x * 0.5 + 0.5) * size, 0)), last)
    y = dr.minimum(mi.UInt32(dr.maximum((uv.y * 0.5 + 0.5) * size, 0)), last)
    row = face * level_resolution + y
    return level_offset(resolution, level_resolution) + row * level_resolution + x


def solid_angles(resolution: int) -> np.ndarray:
    """Exact solid angles [sr] of the texels of one face, [R, R]; all six faces add up to 4π."""
    edge = np.linspace(-1, 1, resolution + 1)
    u, v = np.meshgrid(edge, edge)
    corner = np.arctan2(u * v, np.sqrt(u * u + v * v + 1))
    return corner[1:, 1:] - corner[1:, :-1] - corner[:-1, 1:] + corner[:-1, :-1]


def texel_directions(resolution: int) -> np.ndarray:
    """Directions (not normalised) of the centres of texels, [face, y, x, 3]."""
    centre = (2 * np.arange(resolution) + 1) / resolution - 1
    d = np.empty((6, resolution, resolution, 3))
    for face in range(6):
        axis = face // 2
        d[face, ..., axis] = -1 if face % 2 else 1
        d[face, ..., (axis + 1) % 3] = centre
        d[face, ..., (axis + 2) % 3] = centre[:, None]
    return d


def exit_distance(
    centre: mi.Point3f, half_width: mi.Float, o: mi.Point3f, d: mi.Vector3f
) -> mi.Float:
    """Distance along a ray from inside a cube to its surface; negative if ``o`` is outside."""
    towards = dr.select(d > 0, half_width, -half_width)
    # A component that doesn't move never leaves.
    t = dr.select(d == 0, dr.inf, (centre + towards - o) / d)
    inside = dr.all(dr.abs(o - centre) <= half_width)
    return dr.select(inside, dr.min(t), -1)
