"""The maps of all clusters, as the renderer reads them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..system.jit import upload
from ..system.ray_counts import Ray, count
from ..system.spectrum import padded, read_last, read_texel
from .cube import direction_to_face, exit_distance, fold, n_texels, texel
from .cube_map import CubeMap

#: Steps of the fixed point iteration that finds the far hit (Szirmay-Kalos et al. 2005).
CORRECTION_STEPS = 3
#: A far hit is trusted if the map's distance there agrees with it to this fraction.
DISTANCE_TOLERANCE = 0.1
#: Rays are traced up to this fraction beyond the cube, at random, so that its border turns into
#: noise. Never less: the map doesn't hold what is inside.
HAND_OFF = 0.1


@dataclass(frozen=True)
class Cube:
    """A lane's cube: its cluster, centre, half width [world units], and whether there is one."""

    cluster: mi.UInt32
    centre: mi.Point3f
    half_width: mi.Float
    valid: mi.Bool

    def exit(self, o: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        """Distance along a ray from inside to the cube's surface, infinite if there is no cube."""
        return dr.select(self.valid, exit_distance(self.centre, self.half_width, o, d), dr.inf)


@dataclass(frozen=True)
class FarField:
    """Radiance and distance beyond the cubes of all clusters.

    cubes              [M * 4]   centre and half width of each cube, world units
    texels             [T * (C + 1)]  radiance [W/m²/sr] by C channels and inverse distance [1/m]
                                 from the centre, negative where masked (``padded``); all maps, one
                                 after the other, each laid out as in ``cube``
    layout             [M * 2]   face resolution R of the finest level and first texel of each map
    cluster_of_cell    cluster index of each large cell of the coarse mesh, M where there is none
    n_samples          [1]       samples that share a pixel: spp times secondary samples
    mip_bias           [1]       levels added to the look-up
    map_mirrors        whether mirrors and narrow lobes read the map too (else traced)
    corrected          whether look-ups use the distance (else where the ray leaves the cube)
    emitter_scene      scene of the emitters' shapes alone, for the mirrors that read the map
    has_environment    whether the scene has an environment emitter
    """

    cubes: mi.Float
    texels: mi.Float
    layout: mi.UInt32
    cluster_of_cell: mi.UInt32
    n_clusters: mi.UInt32
    n_samples: mi.Float
    mip_bias: mi.Float
    corrected: bool
    map_mirrors: bool
    emitter_scene: mi.Scene | None
    has_environment: bool

    def cube(self, cell: mi.UInt32, p: mi.Point3f, active: mi.Bool) -> Cube:
        """The cube whose map serves rays from a point in a cell of the coarse mesh.

        None where the cell belongs to no cluster or the point isn't in the cluster's cube.
        """
        cluster = dr.gather(mi.UInt32, self.cluster_of_cell, cell, active)
        active = active & (cluster < self.n_clusters)
        cube = dr.gather(mi.Vector4f, self.cubes, cluster, active)
        centre, half_width = mi.Point3f(cube.x, cube.y, cube.z), cube.w
        active &= dr.all(dr.abs(p - centre) < half_width)
        return Cube(cluster, centre, half_width, active)

    def bound(
        self, cube: Cube, ray: mi.Ray3f, wide: mi.Bool, u: mi.Float, active: mi.Bool | bool
    ) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Bound secondary rays by their cube: ``(bounded, maxt, reach)``.

        Only wide lobes are bounded, unless mirrors are to read the map too: tracing the few narrow
        ones in full costs less than looking for the sources that they see beyond the cube. Rays
        are traced a little farther than the cube, but wide lobes count only the sources that they
        hit inside (``reach``): shadow rays alone count those beyond.
        """
        t = cube.exit(ray.o, ray.d)
        bounded = active & (wide | self.map_mirrors) & (t > 0) & (t < dr.inf)
        maxt = dr.select(bounded, t * (1 + HAND_OFF * u), dr.largest(mi.Float))
        return bounded, maxt, dr.select(bounded & wide, t, dr.inf)

    def eval(
        self,
        cluster: mi.UInt32,
        ray: mi.Ray3f,
        pdf: mi.Float,
        specular: mi.Bool,
        u_level: mi.Float,
        u_texel: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.Bool]:
        """Far radiance along rays that have left their cube, from the prefiltered map.

        Returns the radiance [W/m²/sr] and whether it can be trusted. The level is chosen so that
        a texel covers what the sample stands for (paper section 2, Figure 4; Křivánek and Colbert
        2008): 1 / (N pdf) sr, as seen from the cube's centre.
        """
        cube = dr.gather(mi.Vector4f, self.cubes, cluster, active)
        centre = mi.Point3f(cube.x, cube.y, cube.z)
        layout = dr.gather(mi.Vector2u, self.layout, cluster, active)
        resolution = layout.x
        offset, d = ray.o - centre, ray.d
        trusted = mi.Bool(True)
        footprint = mi.Float(1)
        if not self.corrected:
            far = offset + exit_distance(centre, cube.w, ray.o, d) * d
        else:
            far = mi.Vector3f(d)
            b = dr.dot(offset, d)
            c = dr.squared_norm(offset)
            for _ in range(CORRECTION_STEPS):
                inverse = dr.abs(self._inverse_distance(layout, far, active))
                # |offset + t d| = 1 / inverse, in a form that stands infinite distance.
                t = dr.safe_sqrt(dr.rcp(dr.square(inverse)) - c + b * b) - b
                far = dr.select(inverse > 0, offset + t * d, d)
            inverse_at = self._inverse_distance(layout, far, active)
            distance = dr.select(inverse > 0, dr.norm(far), dr.inf)
            trusted = dr.select(
                inverse > 0,
                dr.abs(inverse_at * distance - 1) < DISTANCE_TOLERANCE,
                inverse_at == 0,
            )  # A masked texel's inverse distance is negative.
            footprint = dr.select(inverse > 0, dr.square(t / distance), 1)

        face, uv = direction_to_face(far)
        solid_angle = footprint / (self.n_samples * pdf)
        solid_angle = dr.select(specular, 0, solid_angle)
        texels = solid_angle * dr.square(mi.Float(resolution)) * 0.25
        texels *= (1 + dr.squared_norm(uv)) ** 1.5
        level = 0.5 * dr.log2(dr.maximum(texels, 1e-6)) + self.mip_bias
        coarsest = mi.Float(31 - dr.lzcnt(resolution))
        # Stochastic trilinear filtering: one packed gather. Low bits of the random number choose
        # the face where three meet.
        level = mi.UInt32(dr.clip(dr.floor(level + u_level), 0, coarsest))
        level_resolution = resolution >> level
        uv += (2 * u_texel - 1) / mi.Float(level_resolution)
        face, uv = fold(face, uv, 256 * u_texel.x - dr.floor(256 * u_texel.x))
        index = layout.y + texel(face, uv, layout.x, level_resolution)
        return read_texel(self.texels, index, ray.wavelengths, active), trusted

    def intersect_emitters(
        self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Bool]:
        """Find the emitter that a ray beyond its cube reaches, if any.

        Cheap and exact: the ray meets a scene of emitters only, and visibility is tested where it
        hits one. Returns a surface interaction (invalid for the environment) and its visibility.
        """
        count(Ray.SOURCE, ray, active)
        si = self.emitter_scene.ray_intersect(ray, active)
        found = active & (si.is_valid() | self.has_environment)
        ray = mi.Ray3f(ray)
        ray.maxt = dr.select(si.is_valid(), si.t * (1 - 1e-4), dr.largest(mi.Float))
        count(Ray.SHADOW, ray, found)
        return si, found & ~scene.ray_test(ray, found)

    def _inverse_distance(self, layout, d, active):
        face, uv = direction_to_face(d)
        index = layout.y + texel(face, uv, layout.x, layout.x)
        return read_last(self.texels, index, active)


def far_field(
    scene: mi.Scene,
    maps: tuple[CubeMap, ...],
    cluster_of_cell: np.ndarray,
    n_samples: int,
    mip_bias: float,
    corrected: bool,
    map_mirrors: bool,
) -> FarField | None:
    """Put the maps of a scene where kernels can read them; None if there are no maps."""
    if not maps:
        return None
    cubes = [[*cube_map.cluster.centre, cube_map.cluster.half_width] for cube_map in maps]
    resolutions = [cube_map.resolution for cube_map in maps]
    first = np.cumsum([0, *map(n_texels, resolutions)])[:-1]
    return FarField(
        cubes=upload(mi.Float, np.array(cubes, dtype=np.float32)),
        texels=upload(mi.Float, padded(np.concatenate([m.texels() for m in maps]))),
        layout=upload(mi.UInt32, np.stack([resolutions, first], axis=-1)),
        cluster_of_cell=upload(mi.UInt32, cluster_of_cell),
        n_clusters=dr.opaque(mi.UInt32, len(maps)),
        n_samples=dr.opaque(mi.Float, n_samples),
        mip_bias=dr.opaque(mi.Float, mip_bias),
        corrected=corrected,
        map_mirrors=map_mirrors,
        emitter_scene=_emitter_scene(scene) if map_mirrors else None,
        has_environment=scene.environment() is not None,
    )


def _emitter_scene(scene: mi.Scene) -> mi.Scene:
    """A scene of the emitters' shapes alone."""
    shapes = [shape for shape in scene.shapes() if shape.is_emitter()]
    # An empty scene can't be traced; a shape out of reach stands for it.
    nowhere = {"type": "sphere", "center": [1e12, 1e12, 1e12]}
    ids = [shape.id() for shape in shapes]
    emitters = mi.load_dict(
        {"type": "scene", "nowhere": nowhere} | {f"shape{i}": s for i, s in enumerate(shapes)}
    )
    for shape, id_ in zip(shapes, ids, strict=True):  # Loading has renamed them.
        shape.set_id(id_)
    return emitters
