"""The part of a scene that lies in a box: how much it is, and files to load it alone from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from envmap_integrator.system.scene_file import SceneFile

ANALYTIC_BYTES = 64
"""Of a sphere, a rectangle or the like: a matrix."""

OCCLUDER = "occluder"
"""Id of what stands for all that a worker doesn't hold."""

COARSE_CELL = 1 / 64
"""Edge of the cells in which the vertices of an occluder become one, as a fraction of the scene."""


@dataclass(frozen=True)
class Size:
    """How much there is, without hierarchies of bounding volumes.

    triangles   analytic shapes count as one each
    bytes       of vertices, with all that they have, and of triangles
    textures    bytes of the bitmaps of the materials
    """

    triangles: int = 0
    bytes: int = 0
    textures: int = 0


@dataclass(frozen=True)
class Box:
    """An axis-aligned cube: centre [3] and half width, world units."""

    centre: NDArray[np.float64]
    half_width: float

    def meets(self, low: NDArray, high: NDArray) -> NDArray[np.bool_]:
        """Which boxes with these corners [N, 3] overlap it, [N]."""
        inner, outer = self.centre - self.half_width, self.centre + self.half_width
        return ((np.atleast_2d(low) <= outer) & (np.atleast_2d(high) >= inner)).all(axis=1)


def whole_shapes(shapes: Iterable[mi.Shape], box: Box | None = None) -> Size:
    """All shapes whose bounding boxes overlap a box, or all without one."""
    kept = [shape for shape in shapes if box is None or _meets(shape, box)]
    sizes = [_arrays(shape) for shape in kept]
    return Size(sum(triangles for triangles, _ in sizes), sum(n for _, n in sizes), _textures(kept))


def single_triangles(shapes: Iterable[mi.Shape], box: Box) -> Size:
    """All triangles whose bounding boxes overlap a box, and the vertices that they need."""
    kept, n_triangles, n_bytes = [], 0, 0
    for shape in shapes:
        if not _meets(shape, box):
            continue
        found = triangles(shape)
        if found is None:
            count, size = _arrays(shape)
        else:
            faces = found.faces[found.inside(box)]
            count = len(faces)
            size = faces.nbytes + len(np.unique(faces)) * found.vertex_bytes
        if count:
            kept.append(shape)
            n_triangles, n_bytes = n_triangles + count, n_bytes + size
    return Size(n_triangles, n_bytes, _textures(kept))


# ---------------------- Meshes ----------------------


@dataclass(frozen=True)
class Triangles:
    """A mesh in world space.

    positions [V, 3], faces [F, 3]
    normals, uv    [V, 3] and [V, 2], empty where it has none
    """

    positions: NDArray[np.float32]
    faces: NDArray[np.uint32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32]

    @property
    def vertex_bytes(self) -> int:
        """Of a vertex."""
        return 4 * (3 + (3 if len(self.normals) else 0) + (2 if len(self.uv) else 0))

    def inside(self, box: Box) -> NDArray[np.bool_]:
        """Which triangles' bounding boxes overlap a box, [F]."""
        corners = self.positions[self.faces]
        return box.meets(corners.min(axis=1), corners.max(axis=1))

    def only(self, kept: NDArray[np.bool_]) -> Triangles:
        """Some of the triangles [F], and the vertices that they need."""
        used, faces = np.unique(self.faces[kept], return_inverse=True)
        normals, uv = (a[used] if len(a) else a for a in (self.normals, self.uv))
        faces = faces.reshape(-1, 3).astype(np.uint32)
        return Triangles(self.positions[used], faces, normals, uv)

    def coarse(self, cell: float) -> Triangles:
        """Vertices of one cell of a grid become one (Rossignac and Borrel 1993)."""
        place = np.floor(self.positions / cell).astype(np.int64)
        _, index = np.unique(place, axis=0, return_inverse=True)
        index = index.ravel()
        count = np.bincount(index)
        mean = np.stack([np.bincount(index, weights=x) / count for x in self.positions.T], axis=1)
        faces = np.sort(index[self.faces], axis=1)
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])]
        none = np.empty((0, 3), np.float32)
        faces = np.unique(faces, axis=0).astype(np.uint32)
        return Triangles(mean.astype(np.float32), faces, none, none)


def triangles(shape: mi.Shape) -> Triangles | None:
    """Those of a mesh; None for shapes that are none."""
    values = mi.traverse(shape)
    if "faces" not in values:
        return None

    def rows(name: str, width: int, dtype: type) -> NDArray:
        found = values[name] if name in values else ()
        return np.array(found, dtype=dtype).reshape(-1, width)

    return Triangles(
        rows("vertex_positions", 3, np.float32),
        rows("faces", 3, np.uint32),
        rows("vertex_normals", 3, np.float32),
        rows("vertex_texcoords", 2, np.float32),
    )


def _arrays(shape: mi.Shape) -> tuple[int, int]:
    found = triangles(shape)
    if found is None:
        return 1, ANALYTIC_BYTES
    return len(found.faces), found.faces.nbytes + len(found.positions) * found.vertex_bytes


def _textures(shapes: list[mi.Shape]) -> int:
    """Bytes of the bitmaps of shapes' materials; those that are shared count once."""
    found = {}
    for shape in shapes:
        for name, value in mi.traverse(shape).items():
            if name.endswith(".data") and dr.is_tensor_v(value):
                found[value.array.index] = value.array.numpy().nbytes
    return sum(found.values())


def _meets(shape: mi.Shape, box: Box) -> bool:
    bounds = shape.bbox()
    low, high = (np.ravel(corner) for corner in (bounds.min, bounds.max))
    return bool(box.meets(low, high)[0])


# ---------------------- Files ----------------------


@dataclass(frozen=True)
class Part:
    """What a worker loads of a scene file.

    folder     of the files below
    kept       its shapes by their number in the file
    clipped    of these, meshes of which it has some triangles, by the names of their files
    occluder   name of the file of what stands for all other surfaces, if there is any
    """

    folder: str
    kept: list[int]
    clipped: dict[int, str]
    occluder: str | None


def write_part(scene: mi.Scene, box: Box, folder: Path, with_occluder: bool) -> Part:
    """Write the meshes of the part of a scene in a box; shapes that shine are part of it anyway.

    The scene must be loaded unmerged. With an occluder, triangles outside are kept as coarsely as
    ``COARSE_CELL`` says, and analytic shapes as they are.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kept, clipped, outside = [], {}, []
    for number, shape in enumerate(scene.shapes()):
        found = triangles(shape)
        if shape.is_emitter() or (found is None and (with_occluder or _meets(shape, box))):
            kept.append(number)
        elif found is not None:
            inside = found.inside(box)
            if inside.any():
                kept.append(number)
            if inside.any() and not inside.all():
                clipped[number] = f"shape{number}.ply"
                _write(found.only(inside), folder / clipped[number])
            outside.append(found.only(~inside))
    occluder = None
    if with_occluder:
        bounds = scene.bbox()
        cell = COARSE_CELL * float(np.linalg.norm(np.ravel(bounds.max) - np.ravel(bounds.min)))
        # Each mesh by itself: a common vertex would join what only lies side by side.
        coarse = _joined([one.coarse(cell) for one in outside if len(one.faces)])
        if len(coarse.faces):
            occluder = "occluder.ply"
            _write(coarse, folder / occluder)
    return Part(str(folder), kept, clipped, occluder)


def _joined(several: list[Triangles]) -> Triangles:
    none = np.empty((0, 3), np.float32)
    first = np.cumsum([0, *(len(one.positions) for one in several)])
    faces = [one.faces + begin for one, begin in zip(several, first, strict=False)]
    return Triangles(
        np.concatenate([none, *(one.positions for one in several)]),
        np.concatenate([np.empty((0, 3)), *faces]).astype(np.uint32),
        none,
        none,
    )


def _write(found: Triangles, path: Path) -> None:
    has_normals, has_uv = len(found.normals) > 0, len(found.uv) > 0
    size = len(found.positions), len(found.faces)
    shape = mi.Mesh("part", *size, mi.Properties(), has_normals, has_uv)
    values = mi.traverse(shape)
    values["vertex_positions"], values["faces"] = found.positions.ravel(), found.faces.ravel()
    if has_normals:
        values["vertex_normals"] = found.normals.ravel()
    if has_uv:
        values["vertex_texcoords"] = found.uv.ravel()
    values.update()
    shape.write_ply(str(path))


class PartFile(SceneFile):
    """A scene file of which only a part is loaded."""

    def keep(self, part: Part) -> None:
        """Leave out all shapes but those of the part.

        The occluder becomes the last shape, black. Materials that no shape needs go too.
        """
        root, folder = self._state.root, Path(part.folder)
        shapes = [
            (name, node)
            for name, node in self._named_children(root)
            if node.type in (mi.ObjectType.Shape, mi.ObjectType.BSDF)
        ]
        number = 0
        for name, node in shapes:
            if node.type == mi.ObjectType.BSDF:
                del root.props[name]  # Shapes refer to them by id.
                continue
            if number not in part.kept:
                del root.props[name]
            elif number in part.clipped:
                self._replace(node, folder / part.clipped[number])
            number += 1
        if part.occluder:
            self._append_child(root, mi.ObjectType.Shape, "ply", OCCLUDER)
            node = self._state.nodes[-1]
            node.props["filename"], node.props["face_normals"] = str(folder / part.occluder), True
            self._append_child(node, mi.ObjectType.BSDF, "diffuse")
            self._state.nodes[-1].props["reflectance"] = 0.0

    @staticmethod
    def _replace(node: mi.parser.SceneNode, path: Path) -> None:
        """Load a shape from a file in world space."""
        old, new = mi.Properties(node.props), mi.Properties("ply")
        new.set_id(old.id())
        for name, value in old.items():
            if isinstance(value, mi.Properties.Reference | mi.Properties.ResolvedReference):
                new[name] = value
        for name in ("face_normals", "flip_normals"):
            if name in old:
                new[name] = old[name]
        new["filename"] = str(path)
        node.props = new
