"""``mipmap_cube``: a cube map as an emitter, or the list of a cluster's shapes."""

from __future__ import annotations

import os
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lookup.cube import direction_to_face, face_to_direction, solid_angles, texel
from ..lookup.cube_map import MAX_RESOLUTION, from_stored
from ..preparation.maps.clusters import ClusterRequest
from ..preparation.maps.interchange import (
    cube_directions,
    latlong_directions,
    read_cube,
    write_cube,
    write_latlong,
)
from ..system.checks import check_variant, misplaced
from ..system.jit import upload, upload_vectors
from ..system.parameters import Parameters
from ..system.spectrum import n_stored, read_at, read_rgb, row_of
from ..system.storage import StorageError, is_ours, read

_MADE_BY = "make it with envmap-render bake"


class MipmapCube(mi.Emitter):
    r"""
    Cube map emitter (:monosp:`mipmap_cube`)

    Two uses. With ``filename``, an environment emitter that shows a map baked by
    :monosp:`envmap_hybrid`, or a cube map of another tool, at any of its levels, in any scene. With
    ``shapes``, nested in :monosp:`envmap_hybrid`, it lists the objects of one cluster in place of
    the automatic choice.

    .. pluginparameters::

     * - filename
       - |string|
       - OpenEXR file with a map: a baked state, or a cube map in OpenEXR's layout.
     * - map
       - |string|
       - Name of the map, if a baked state holds several. (Default: the first)
     * - level
       - |float|
       - Mip level that is shown, 0 the finest; fractions blend two levels. (Default: 0)
     * - to_world
       - |transform|
       - Rotation of the map. (Default: none)
     * - scale
       - |float|
       - Factor of the map's radiance. (Default: 1)
     * - shapes
       - |string|
       - Ids of the shapes of a cluster, separated by commas.
     * - distance_ratio
       - |float|
       - Half width of the cluster's cube over the cluster's radius, at least 1. (Default: that of
         the integrator)
     * - center
       - |point|
       - Centre of the cluster's cube, from which its map is seen. (Default: that of the box around
         the shapes)
     * - resolution
       - |int|
       - Texels along the edge of a face of the cluster's map, a power of two up to
         2048. (Default: that of the integrator)
    """

    def __init__(self, props: mi.Properties):
        check_variant(props.plugin_name())
        super().__init__(props)
        parameters = Parameters(props)
        shapes = parameters.names("shapes")
        filename = parameters.text("filename")
        if bool(shapes) == bool(filename):
            raise ValueError(
                f'{parameters.owner}: give either "filename" (a map) or "shapes" (a '
                f"cluster), not {'both' if shapes else 'neither'}"
            )
        if shapes:
            if "to_world" in props:
                raise ValueError(
                    f'{parameters.owner}: "to_world" turns a map, and "shapes" ask for one that '
                    'lies in world space; remove it, or move its "center"'
                )
            self.request = ClusterRequest(
                props.id(),
                shapes,
                parameters.number("distance_ratio", None, 1.0),
                parameters.point("center"),
                parameters.power_of_two("resolution", None, 1, MAX_RESOLUTION),
            )
            self.level = 0.0
        else:
            self.request = None
            self.level = parameters.number("level", 0.0, 0.0)
            self._to_world = mi.Matrix3f(parameters.rotation("to_world"))
            dr.make_opaque(self._to_world)
            scale = parameters.number("scale", 1.0, 0.0)
            levels = _load(parameters.owner, filename, parameters.text("map"))
            self._prepare_evaluation([scale * level for level in levels])
        self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying

    # ---------------------- Evaluation ----------------------

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Spectrum:
        """Radiance [W/m²/sr] that arrives from ``-si.wi``, at the emitter's level."""
        return self.eval_level(-si.wi, self.level, active, si.wavelengths)

    def eval_level(
        self,
        direction: mi.Vector3f,
        level: float,
        active: mi.Bool | bool = True,
        wavelengths: mi.Color0f | mi.Spectrum | None = None,
    ) -> mi.Spectrum | mi.Color3f:
        """Radiance [W/m²/sr] from world space directions at any level, trilinearly filtered.

        In spectral variants at ``wavelengths`` [nm], or else the colour that films would hold.
        """
        self._require_map()

        def fetch(index):
            if mi.is_spectral and wavelengths is None:
                return mi.Color3f(*read_rgb(self._texels, partial(row_of, index), active))
            return read_at(self._texels, partial(row_of, index), wavelengths, active)

        direction = self._to_world.T @ direction
        top = self.n_levels - 1
        level = min(max(level, 0.0), float(top))
        fine = int(level)
        value = self._bilinear(direction, fine, fetch)
        if level > fine:
            value = dr.lerp(value, self._bilinear(direction, fine + 1, fetch), level - fine)
        return value

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool | bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """A direction in proportion to the radiance of the emitter's level, and its weight."""
        self._require_map()
        index, remapped, _ = self._distribution.sample_reuse_pmf(sample.x, active)
        resolution = self._sampling_resolution
        pixels = resolution * resolution
        face, y, x = index // pixels, index // resolution % resolution, index % resolution
        uv = 2 * (mi.Point2f(mi.Float(x), mi.Float(y)) + mi.Point2f(remapped, sample.y))
        d = dr.normalize(face_to_direction(face, uv / resolution - 1))

        ds = dr.zeros(mi.DirectionSample3f)
        pdf, d = self._pdf(d, active), self._to_world @ d
        ds.d = d
        ds.dist = self._far
        ds.p = it.p + d * self._far
        ds.n = -d
        ds.pdf = pdf
        ds.delta = False
        ds.emitter = mi.EmitterPtr(self)
        ds.time = it.time
        value = self.eval_level(d, self.level, active, it.wavelengths)
        return ds, dr.select(ds.pdf > 0, value / ds.pdf, 0) & active

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool | bool = True
    ) -> mi.Float:
        """Density [1/sr] of ``sample_direction``."""
        self._require_map()
        return self._pdf(self._to_world.T @ ds.d, active)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool | bool = True
    ) -> mi.Spectrum:
        """Radiance [W/m²/sr] from a direction."""
        return self.eval_level(ds.d, self.level, active, it.wavelengths)

    # ---------------------- Files ----------------------

    def save_cube(self, path: str | os.PathLike) -> None:
        """Write what it shows as a cube map that other tools open, its levels as parts.

        Raises ``StorageError`` if the file can't be written.
        """
        sizes = (self.resolution >> level for level in range(self.n_levels))
        levels = [self._seen(cube_directions(n), level) for level, n in enumerate(sizes)]
        write_cube(path, levels)

    def save_latlong(self, path: str | os.PathLike) -> None:
        """Write its finest level for Mitsuba's ``envmap``; raises likewise."""
        write_latlong(path, self._seen(latlong_directions(2 * self.resolution), 0))

    def _seen(self, directions: np.ndarray, level: int) -> np.ndarray:
        """Radiance [H, W, C] of a level from directions [H, W, 3]."""
        d = upload_vectors(mi.Vector3f, directions.reshape(-1, 3))
        return self.eval_level(d, level).numpy().T.reshape(*directions.shape[:2], -1)

    def to_string(self) -> str:
        """What it is, for messages."""
        return f"MipmapCube[request={self.request}]"

    # ---------------------- Internals ----------------------

    #: Distance [world units] that stands for "far away" in shadow rays: beyond all scenes, and its
    #: square is still a number of single precision.
    _far = 1e15

    def _require_map(self):
        if self.request is not None:
            raise RuntimeError(misplaced(self))

    def _prepare_evaluation(self, levels: list[np.ndarray]):
        n_channels = levels[0].shape[-1]
        if n_channels != n_stored():
            raise ValueError(
                f"mipmap_cube: the map has {n_channels} colour channels, variant {mi.variant()} "
                f"needs {n_stored()}; bake it with this variant, or use another one"
            )
        self.n_levels, self.resolution = len(levels), levels[0].shape[1]
        self._texels = upload(mi.Float, np.concatenate([np.ravel(level) for level in levels]))
        level = int(round(self.level))
        radiance = levels[min(level, self.n_levels - 1)].mean(axis=-1)
        self._sampling_resolution = radiance.shape[1]
        weight = radiance * solid_angles(radiance.shape[1])
        # Bilinear filtering spreads a texel's light over its neighbours: no texel may be missed.
        weight += 0.05 * max(weight.mean(), 1e-30)
        self._distribution = mi.DiscreteDistribution(upload(mi.Float, weight))

    def _pdf(self, d, active):
        resolution = self._sampling_resolution
        face, uv = direction_to_face(d)
        index = texel(face, uv, mi.UInt32(resolution), mi.UInt32(resolution))
        solid_angle = 4 / resolution**2 / (1 + dr.squared_norm(uv)) ** 1.5
        return self._distribution.eval_pmf_normalized(index, active) / solid_angle

    def _bilinear(self, direction, level: int, fetch):
        """Four texels around a direction, each found through its own direction: no seams.

        Only three texels meet at a corner of the cube; their mean stands for the fourth.
        """
        resolution = mi.UInt32(self.resolution)
        size = self.resolution >> level
        face, uv = direction_to_face(direction)
        grid = (uv + 1) * (0.5 * size) - 0.5
        corner = dr.floor(grid)
        w = grid - corner
        texels = []
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            centre = 2 * (corner + mi.Point2f(dx + 0.5, dy + 0.5)) / size - 1
            face_, uv_ = direction_to_face(face_to_direction(face, centre))
            index = texel(face_, uv_, resolution, mi.UInt32(size))
            weight = (w.x if dx else 1 - w.x) * (w.y if dy else 1 - w.y)
            texels.append((weight, fetch(index), dr.all(dr.abs(centre) > 1)))
        total = sum(value for _, value, _ in texels)
        return sum(
            weight * dr.select(missing, (total - value) / 3, value)
            for weight, value, missing in texels
        )


def _load(owner, filename, name) -> list[np.ndarray]:
    """Radiance [6, R_l, R_l, C] of all levels of a map, finest first."""
    path = mi.file_resolver().resolve(filename)
    try:
        if is_ours(path):
            return _baked(path, name)
        levels = read_cube(path, _MADE_BY)
        if name:
            raise StorageError(f'{path}: its map has no name "{name}"; leave "map" out')
        return levels
    except StorageError as error:
        raise ValueError(f"{owner}: {error}") from None


def _baked(path, name) -> list[np.ndarray]:
    stored = read(path, _MADE_BY)
    maps = stored.entries("maps")
    known = [entry.text("name") for entry in maps]
    if name and name not in known:
        raise StorageError(
            f'{path}: holds no map "{name}", only {", ".join(known) or "none"}; name one of these'
        )
    if not maps:
        raise StorageError(
            f'{path}: holds no maps, its scene has no clusters; set "maps" to "always" or list '
            "a cluster, and make it again with envmap-render bake"
        )
    index = known.index(name) if name else 0
    return [level[..., :-1] for level in from_stored(maps[index], prefix=f"map{index}/").levels]
