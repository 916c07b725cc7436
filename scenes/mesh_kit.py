"""Small triangle-mesh helpers of the scene scripts; numpy only.

A mesh is a tuple ``(P, N, T, F)``: positions [V, 3] in metres, unit shading normals
[V, 3], texture coordinates [V, 2] and triangles [M, 3] (indices, counter-clockwise
seen from outside). z points up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a binary little-endian PLY with normals and texture coordinates."""
    positions, normals, uv, faces = mesh
    vertex_fields = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(positions)}"]
    header += [f"property float {name}" for name in vertex_fields]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += ["end_header", ""]
    records = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    records["count"], records["index"] = 3, faces
    with open(path, "wb") as stream:
        stream.write("\n".join(header).encode("ascii"))
        stream.write(np.hstack([positions, normals, uv]).astype("<f4").tobytes())
        stream.write(records.tobytes())


def merge(meshes: list[Mesh]) -> Mesh:
    """One mesh out of many."""
    offsets = np.cumsum([0] + [len(mesh[0]) for mesh in meshes[:-1]])
    faces = [mesh[3] + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    parts = [np.concatenate([mesh[i] for mesh in meshes]) for i in range(3)]
    return parts[0], parts[1], parts[2], np.concatenate(faces)


def grid(positions: np.ndarray, flip: bool = False) -> Mesh:
    """Triangulate a parametric surface sampled as ``positions [rows, columns, 3]``.

    The normal points along d(row) x d(column), or the other way with ``flip``.
    """
    rows, columns = positions.shape[:2]
    d_row, d_column = np.gradient(positions, axis=0), np.gradient(positions, axis=1)
    wraps = np.allclose(positions[:, 0], positions[:, -1])
    if wraps:  # closed along the columns: same normal on both sides of the seam
        ring = positions[:, [-2, 0, 1]]
        d_column[:, 0] = d_column[:, -1] = (ring[:, 2] - ring[:, 0]) / 2
    normals = np.cross(d_row, d_column)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    for row, neighbour in ((0, 1), (-1, -2)):  # poles borrow their neighbours' mean normal
        if length[row].max() < 1e-9:
            normals[row] = normals[neighbour].mean(axis=0)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    if flip:
        normals = -normals
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    a = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = a[:-1, :-1], a[1:, :-1], a[1:, 1:], a[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    if flip:
        faces = faces[:, ::-1]
    flat = positions.reshape(-1, 3)
    faces = drop_degenerate(flat, faces)
    return flat, normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), faces


def drop_degenerate(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Remove the triangles of zero area (at the poles of a lathe, say)."""
    a, b, c = (positions[faces[:, i]] for i in range(3))
    return faces[np.linalg.norm(np.cross(b - a, c - a), axis=-1) > 1e-9]


def lathe(profile: np.ndarray, segments: int = 32) -> Mesh:
    """Turn ``profile [n, 2]`` (radius, height) about z.

    Outward normals need a profile that runs with the material on its left: up the
    inside and down the outside, or simply downwards for a solid.
    """
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    radius, height = profile[:, 0, None], profile[:, 1, None]
    points = [radius * np.cos(angle), radius * np.sin(angle), height + 0 * angle]
    return grid(np.stack(points, -1))


def smooth(points: np.ndarray, count: int) -> np.ndarray:
    """Catmull-Rom curve through ``points [n, d]``, ``count`` samples."""
    points = np.asarray(points, dtype=float)
    padded = np.vstack([2 * points[0] - points[1], points, 2 * points[-1] - points[-2]])
    t = np.linspace(0, len(points) - 1, count)
    i = np.minimum(t.astype(int), len(points) - 2)
    s = (t - i)[:, None]
    p0, p1, p2, p3 = (padded[i + k] for k in range(4))
    cubic = 3 * p1 - 3 * p2 + p3 - p0
    return 0.5 * (2 * p1 + (p2 - p0) * s + (2 * p0 - 5 * p1 + 4 * p2 - p3) * s**2 + cubic * s**3)


def tube(path: np.ndarray, radius: float | np.ndarray, segments: int = 12) -> Mesh:
    """Sweep a circle along ``path [n, 3]``; a closed path gives a ring without a seam."""
    closed = np.allclose(path[0], path[-1])
    tangent = np.gradient(path, axis=0)
    if closed:
        tangent[0] = tangent[-1] = path[1] - path[-2]
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    helper = np.array([0.0, 0.0, 1.0]) if abs(tangent[0, 2]) < 0.9 else np.array([1.0, 0, 0])
    side = [np.cross(tangent[0], helper)]
    for t in tangent[1:]:  # parallel transport keeps the frame from twisting
        side.append(side[-1] - t * (side[-1] @ t))
    side = np.array([s / np.linalg.norm(s) for s in side])
    up = np.cross(tangent, side)
    if closed:  # spread the holonomy over the ring
        gap = np.arctan2(side[-1] @ up[0], side[-1] @ side[0])
        twist = -gap * np.linspace(0, 1, len(path))[:, None]
        c, s = np.cos(twist), np.sin(twist)
        side, up = c * side + s * up, c * up - s * side
    angle = np.linspace(0, 2 * np.pi, segments + 1)[None, :, None]
    ring = np.cos(angle) * side[:, None] + np.sin(angle) * up[:, None]
    r = np.broadcast_to(radius, len(path))[:, None, None]
    return grid(path[:, None] + r * ring, flip=True)


def leaf(length: float, width: float, droop: float, rows: int = 5, columns: int = 3) -> Mesh:
    """A pointed leaf along +x, folded at its midrib, its tip hanging by ``droop``."""
    t = np.linspace(0, 1, rows)[:, None]
    s = np.linspace(-1, 1, columns)[None, :]
    half = 0.5 * width * (np.sin(np.pi * t**0.75) + 0.02)
    x, y = length * t + 0 * s, half * s
    z = -droop * t**2 + 0.35 * half * np.abs(s)
    return grid(np.stack([x, y, z], -1))


def place(mesh: Mesh, matrix: np.ndarray, offset: np.ndarray) -> Mesh:
    """Rotate (and uniformly scale) by ``matrix [3, 3]``, then move by ``offset [3]``."""
    normals = mesh[1] @ matrix.T
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return mesh[0] @ matrix.T + offset, normals, mesh[2], mesh[3]


def turn(azimuth, elevation=0.0, roll=0.0) -> np.ndarray:
    """Rotation [..., 3, 3]: roll about x, lift x by ``elevation``, turn about z; radians."""
    azimuth, elevation, roll = np.broadcast_arrays(azimuth, elevation, roll)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    cr, sr = np.cos(roll), np.sin(roll)
    zero, one = np.zeros_like(ca), np.ones_like(ca)

    def matrix(*rows: tuple) -> np.ndarray:
        return np.stack([np.stack(row, -1) for row in rows], -2)

    about_z = matrix((ca, -sa, zero), (sa, ca, zero), (zero, zero, one))
    about_y = matrix((ce, zero, -se), (zero, one, zero), (se, zero, ce))
    about_x = matrix((one, zero, zero), (zero, cr, -sr), (zero, sr, cr))
    return about_z @ about_y @ about_x
