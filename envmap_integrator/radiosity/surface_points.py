"""Points spread over the surfaces of a scene, found by casting rays.

Rays reach every shape that can be hit, whatever its type: merged meshes, instances, spheres,
curves. The cost doesn't depend on the number of triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit import opaque_point, upload
from ..rendering.ray_counts import Ray, count
from ..scene_order import ordered_shapes

#: Hits followed along each global line, and along each walk from a sensor.
LINE_HITS, WALK_HITS = 8, 4
#: Batches of rays cast at most to find about as many points as asked for, what share of them is
#: enough, and how many times as many rays may be cast as if none were lost.
MAX_BATCHES, ENOUGH, MAX_RAYS = 4, 0.9, 8
#: Points from which the extent of all is told.
EXTENT_POINTS = 1 << 14


@dataclass(frozen=True)
class SurfacePoints:
    """Oriented points on surfaces; a point belongs to the side from which it was hit.

    position        [N, 3]  world space
    normal          [N, 3]  geometric normal, facing the side the point belongs to
    shading_normal  [N, 3]  shading normal, on the same side
    object_id       [N]     dense index of the top-level shape (``ObjectIds``)
    seen            [N]     1 + the sensor's index for a point on a walk from it, 0 on a global line
    """

    position: np.ndarray
    normal: np.ndarray
    shading_normal: np.ndarray
    object_id: np.ndarray
    seen: np.ndarray

    def __len__(self) -> int:
        return len(self.position)

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner [3] of all points."""
        low_high = np.zeros((2, 3), self.position.dtype)
        if len(self):
            axes = np.ascontiguousarray(self.position.T)  # Ten times as fast in NumPy.
            low_high[:] = axes.min(axis=1), axes.max(axis=1)
        return low_high[0], low_high[1]

    @cached_property
    def extent(self) -> float:
        """Diagonal of the box that holds most points."""
        if len(self) == 0:
            return 1.0
        some = self.position[:: max(len(self) // EXTENT_POINTS, 1)]
        low, high = np.percentile(some, [2, 98], axis=0)
        return max(float(np.linalg.norm(high - low)), 1e-30)

    def interaction(self, index: mi.UInt32) -> mi.SurfaceInteraction3f:
        """The points of the given indices, as interactions from which rays can start."""
        position, normal, shading_normal = self._vectors
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        si.p = dr.gather(mi.Point3f, position, index)
        si.n = dr.gather(mi.Normal3f, normal, index)
        si.sh_frame = mi.Frame3f(dr.gather(mi.Normal3f, shading_normal, index))
        si.t = 0
        return si

    @cached_property
    def _vectors(self) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Positions and normals [3 * N] where kernels can read them."""
        return tuple(
            upload(mi.Float, vectors)
            for vectors in (self.position, self.normal, self.shading_normal)
        )

    def take(self, index: np.ndarray) -> SurfacePoints:
        """The points of the given indices, in that order."""
        return SurfacePoints(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @staticmethod
    def concatenate(parts: list[SurfacePoints]) -> SurfacePoints:
        return SurfacePoints(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in SurfacePoints.__dataclass_fields__
            )
        )


class ObjectIds:
    """Dense index of the top-level shape under an interaction, as ``ordered_shapes`` counts them.

    Dr.Jit's own registry ids are global to the process and change from run to run; these don't,
    so what is stored by object id can be saved.
    """

    def __init__(self, scene: mi.Scene):
        shapes = mi.ShapePtr(ordered_shapes(scene))
        registry_ids = dr.reinterpret_array(mi.UInt32, shapes).numpy()
        table = np.zeros(int(registry_ids.max(initial=0)) + 1, dtype=np.uint32)
        table[registry_ids] = np.arange(len(registry_ids), dtype=np.uint32)
        self.count = len(registry_ids)
        self._table = upload(mi.UInt32, table)

    def __call__(self, si: mi.SurfaceInteraction3f) -> mi.UInt32:
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        instance = dr.reinterpret_array(mi.UInt32, si.instance)
        index = dr.select(instance != 0, instance, shape)
        return dr.gather(mi.UInt32, self._table, index, si.is_valid())


def scatter_points(
    scene: mi.Scene, object_ids: ObjectIds, count: int, mirrors: bool = False, seed: int = 0
) -> SurfacePoints:
    """Spread about ``count`` points over the surfaces of a scene.

    Half come from global lines, uniform in position and direction, which hit all surfaces in
    proportion to their area (Cauchy-Crofton; Sbert 1993). Half come from walks that start at the
    scene's sensors and follow the BSDFs: that is where the renderer will ask. Mirrors and glass
    get points only if ``mirrors`` is set.
    """
    wanted = mi.BSDFFlags.Smooth
    if mirrors:
        wanted = wanted | mi.BSDFFlags.DeltaReflection
    sampler = mi.load_dict({"type": "independent"})
    sensors = scene.sensors()

    def walks(n_rays, batch):
        points = []
        for index, sensor in enumerate(sensors):
            sampler.seed(1009 * (MAX_BATCHES * seed + batch) + index + 1, n_rays)
            ray = _sensor_rays(sensor, sampler)
            points.append(
                _hits_along(scene, object_ids, sampler, ray, WALK_HITS, wanted, index + 1)
            )
        return points

    def lines(n_rays, batch):
        sampler.seed(1009 * (MAX_BATCHES * seed + batch), n_rays)
        ray = _global_lines(scene, sampler)
        return [_hits_along(scene, object_ids, sampler, ray, LINE_HITS, wanted)]

    points = []
    if sensors:
        points += _enough(walks, count // 2, WALK_HITS * len(sensors))
        count -= count // 2
    return SurfacePoints.concatenate(points + _enough(lines, count, LINE_HITS))


def _enough(trace, count: int, n_hits: int) -> list[SurfacePoints]:
    """Points of about ``count`` hits, ``n_hits`` of a ray at most.

    Rays miss open scenes and leave them early: ``trace(n_rays, batch)`` goes on until there are
    enough hits. Recording a batch costs more than tracing it, so the second is made to be the last.
    """
    least = max(count // n_hits, 1)
    points, traced, n_rays = [], 0, least
    for batch in range(MAX_BATCHES):
        points += trace(n_rays, batch)
        traced += n_rays
        found = sum(map(len, points))
        if found >= ENOUGH * count or traced >= MAX_RAYS * least:
            break
        missing = (count - found) * traced // max(found, 1)
        n_rays = min(max(missing, 1), MAX_RAYS * least - traced)
    return points


def _sensor_rays(sensor: mi.Sensor, sampler: mi.Sampler) -> mi.Ray3f:
    time = sensor.shutter_open() + sensor.shutter_open_time() * sampler.next_1d()
    ray, _ = sensor.sample_ray_differential(
        time, sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
    )
    return mi.Ray3f(ray)


def _global_lines(scene: mi.Scene, sampler: mi.Sampler) -> mi.Ray3f:
    """Lines of uniform measure through the bounding sphere."""
    sphere = scene.bbox().bounding_sphere()
    direction = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
    frame = mi.Frame3f(direction)
    offset = frame.to_world(mi.Vector3f(disk.x, disk.y, -1.01))
    radius = dr.opaque(mi.Float, sphere.radius)
    return mi.Ray3f(opaque_point(sphere.center) + radius * offset, direction)


@dr.syntax
def _hits_along(
    scene: mi.Scene,
    object_ids: ObjectIds,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    n_hits: int,
    wanted: mi.BSDFFlags,
    walk: int = 0,
) -> SurfacePoints:
    """Follow rays over ``n_hits`` hits, on a walk of a sensor or straight through surfaces.

    Points are kept where the BSDF has any of the ``wanted`` flags.
    """
    n_rays = dr.width(ray)
    size = n_hits * n_rays
    positions, normals, shading_normals = (dr.zeros(mi.Float, 3 * size) for _ in range(3))
    object_of_point, kept = dr.zeros(mi.UInt32, size), dr.zeros(mi.Bool, size)
    n_hits_, n_rays_ = dr.opaque(mi.UInt32, n_hits), dr.opaque(mi.UInt32, n_rays)

    ray = mi.Ray3f(ray)
    index = dr.arange(mi.UInt32, n_rays)
    active = dr.full(mi.Bool, True, n_rays)
    while dr.hint(
        active,
        exclude=[positions, normals, shading_normals, object_of_point, kept],
        label="Scatter points",
    ):
        count(Ray.SURVEY, ray, active)
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf()
        facing = dr.dot(si.n, ray.d) < 0
        normal = dr.select(facing, si.n, -si.n)
        shading_normal = si.sh_frame.n
        shading_normal = dr.mulsign(shading_normal, dr.dot(shading_normal, normal))
        keep = active & ((bsdf.flags() & int(wanted)) != 0)
        keep &= dr.all(dr.isfinite(si.p)) & dr.all(dr.isfinite(shading_normal))
        keep &= dr.squared_norm(normal) > 0.5
        dr.scatter(positions, si.p, index, keep)
        dr.scatter(normals, normal, index, keep)
        dr.scatter(shading_normals, shading_normal, index, keep)
        dr.scatter(object_of_point, object_ids(si), index, keep)
        dr.scatter(kept, mi.Bool(True), index, keep)

        direction = ray.d
        if dr.hint(walk > 0, mode="scalar"):
            bs, weight = bsdf.sample(
                mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), active
            )
            direction = si.to_world(bs.wo)
            active &= mi.luminance(weight) > 0 if len(weight) == 3 else weight[0] > 0
        ray = si.spawn_ray(direction)
        index += n_rays_
        active &= index < n_hits_ * n_rays_

    dr.eval(positions, normals, shading_normals, object_of_point, kept)
    chosen = np.flatnonzero(kept.numpy())
    position, normal, shading_normal = (
        vectors.numpy().reshape(size, 3)[chosen]
        for vectors in (positions, normals, shading_normals)
    )
    return SurfacePoints(
        position,
        normal,
        shading_normal,
        object_of_point.numpy()[chosen],
        np.full(len(chosen), float(walk), dtype=np.float32),
    )
