"""Points spread over the surfaces of a scene, found by casting rays.

Rays reach every shape that can be hit, whatever its type: merged meshes, instances, spheres,
curves. The cost doesn't depend on the number of triangles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ...lookup.ids import ObjectIds
from ...system.jit import mean_channel, upload
from ...system.random_numbers import RandomNumbers
from ...system.ray_counts import Ray, count
from ...system.spectrum import random_wavelengths

#: Hits followed along each global line, and along each walk from a sensor.
LINE_HITS, WALK_HITS = 8, 4
#: Batches of rays cast at most to find about as many points as asked for, what share of them is
#: enough, and how many times as many rays may be cast as if none were lost.
MAX_BATCHES, ENOUGH, MAX_RAYS = 4, 0.9, 8
#: Choices among the lobes of a material in which its diffuse one is looked for.
LOBES = 8
#: Cosine of the angle by which rounding may turn a normal.
UNTURNED = 1 - 1e-5
#: Points from which the extent of all is told, and steps of it per octave.
EXTENT_POINTS, EXTENT_STEPS = 1 << 14, 16
#: Steps of the place of a sphere or a grid, as a part of its size.
SPHERE_STEP, GRID_STEP = 1 / 64, 1 / 4
#: Spaces that the rays of one sensor may start in; what is left is taken for one more.
MOST_STARTS = 8


@dataclass(frozen=True)
class SurfacePoints:
    """Oriented points on surfaces; a point belongs to the side from which it was hit.

    position        [N, 3]  world space
    normal          [N, 3]  geometric normal, facing the side the point belongs to
    shading_normal  [N, 3]  shading normal of the material, on the same side
    object_id       [N]     id of the top-level shape (``ObjectIds``)
    material        [N]     2 * Dr.Jit's id of the BSDF, + 1 on the back of the surface
    seen            [N]     1 + the sensor's index for a point on a walk from it, 0 on a global line
    turned          [N]     whether a bump or normal map turns the shading normal
    bounce          [N]     which hit of its walk or line it is, from 0
    reflects        [N]     weight with which its walk has gone on, of all its bounces so far, mean
                            of the colour channels; 0 on a line
    diffuse         [N]     whether it has gone on by a diffuse lobe
    start           [N]     walks of one sensor with the same number start in sight of one place
    """

    position: np.ndarray
    normal: np.ndarray
    shading_normal: np.ndarray
    object_id: np.ndarray
    material: np.ndarray
    seen: np.ndarray
    turned: np.ndarray
    bounce: np.ndarray
    reflects: np.ndarray
    diffuse: np.ndarray
    start: np.ndarray

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
        """Diagonal of the box that holds most points, of walks if there are any; in steps."""
        low, high = self._most
        return in_steps(float(np.linalg.norm(high - low)))

    @cached_property
    def corner(self) -> np.ndarray:
        """Lowest corner [3] of that box, in steps."""
        return snapped(self._most[0], GRID_STEP * self.extent)

    @cached_property
    def _most(self) -> tuple[np.ndarray, np.ndarray]:
        if len(self) == 0:
            return np.zeros(3), np.full(3, 3**-0.5)
        seen = self.seen > 0
        return _usual(self.position[seen] if seen.any() else self.position)

    def interaction(self, index: mi.UInt32) -> mi.SurfaceInteraction3f:
        """The points of the given indices, as interactions from which rays can start."""
        position, normal, shading_normal = self._vectors
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        si.p = dr.gather(mi.Point3f, position, index)
        si.n = dr.gather(mi.Normal3f, normal, index)
        si.sh_frame = mi.Frame3f(dr.gather(mi.Normal3f, shading_normal, index))
        si.t = 0
        return si

    def is_turned(self, index: mi.UInt32) -> mi.Bool:
        """``turned`` of the points of the given indices."""
        return dr.gather(mi.UInt32, self._turned, index) != 0

    @cached_property
    def _turned(self) -> mi.UInt32:
        return upload(mi.UInt32, self.turned)

    @cached_property
    def _vectors(self) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Positions and normals [3 * N] where kernels can read them."""
        return tuple(
            upload(mi.Float, vectors)
            for vectors in (self.position, self.normal, self.shading_normal)
        )

    def places(self) -> tuple[mi.Point3f, mi.Normal3f, mi.UInt32]:
        """All points as kernels look them up in a coarse mesh: position, normal and object id."""
        position, normal, object_id = self._places
        return mi.Point3f(position), mi.Normal3f(normal), mi.UInt32(object_id)

    @cached_property
    def _places(self):
        position, normal, _ = self._vectors
        places = dr.unravel(mi.Point3f, position), dr.unravel(mi.Normal3f, normal)
        dr.eval(places)
        return *places, upload(mi.UInt32, self.object_id)

    def sensors(self, among: np.ndarray | slice = np.s_[:]) -> np.ndarray:
        """Values that ``seen`` has for points on walks ``among`` some of the points."""
        return 1 + np.flatnonzero(np.bincount(self.seen[among].astype(np.int64))[1:])

    def take(self, index: np.ndarray) -> SurfacePoints:
        """The points of the given indices, in that order, or those of a mask."""
        return SurfacePoints(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @staticmethod
    def concatenate(parts: list[SurfacePoints]) -> SurfacePoints:
        """All points of several batches."""
        return SurfacePoints(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in SurfacePoints.__dataclass_fields__
            )
        )


@dr.syntax
def diffuse_normal(bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Normal3f:
    """Shading normal about which a material reflects diffusely, in world space.

    Bump and normal maps turn it without telling: it's where they send the middle of their
    cosine-distributed directions.
    """
    normal = mi.Normal3f(si.sh_frame.n)
    i = mi.UInt32(0)
    pending = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
    while dr.hint(pending, exclude=[bsdf, si], label="Look for the diffuse lobe"):
        lobe = 1 - (mi.Float(i) + 0.5) / LOBES  # The diffuse one comes last in most materials.
        bs, _ = bsdf.sample(mi.BSDFContext(), si, lobe, mi.Point2f(0.5), pending)
        found = pending & mi.has_flag(bs.sampled_type, mi.BSDFFlags.DiffuseReflection)
        normal = dr.select(found, mi.Normal3f(si.to_world(bs.wo)), normal)
        i += 1
        pending &= ~found & (i < LOBES)
    return normal


def scatter_points(
    scene: mi.Scene,
    object_ids: ObjectIds,
    count: int,
    sensors: list[mi.Sensor],
    mirrors: bool = False,
    seed: int = 0,
) -> SurfacePoints:
    """Spread about ``count`` points over the surfaces that matter to ``sensors``.

    Half come from walks that start at the sensors and follow the BSDFs: that is where the renderer
    will ask. Half come from global lines, uniform in position and direction around each sensor's
    walks, which hit all surfaces there in proportion to their area (Cauchy-Crofton; Sbert 1993).
    Without sensors, all come from lines around the scene. Mirrors and glass get points only if
    ``mirrors`` is set.
    """
    wanted = mi.BSDFFlags.Smooth
    if mirrors:
        wanted = wanted | mi.BSDFFlags.DeltaReflection

    def walks(n_rays, batch):
        points = []
        for index, sensor in enumerate(sensors):
            seed_ = 1009 * (MAX_BATCHES * seed + batch) + index + 1
            numbers = RandomNumbers.of_lanes(seed_, n_rays)
            ray = _sensor_rays(sensor, numbers)
            start = _starts(scene, sensor, ray.o, batch)
            points.append(
                _hits_along(
                    scene, object_ids, numbers, ray, wanted, WALK_HITS, walk=index + 1, start=start
                )
            )
        return points

    points = []
    if sensors:
        points = _enough(walks, count // 2, WALK_HITS * len(sensors))
        count -= count // 2
    spheres = _spheres(scene, points)

    def lines(n_rays, batch):
        numbers = RandomNumbers.of_lanes(1009 * (MAX_BATCHES * seed + batch), n_rays)
        ray, within = _global_lines(spheres, numbers, n_rays)
        return [_hits_along(scene, object_ids, None, ray, wanted, LINE_HITS, within=within)]

    return SurfacePoints.concatenate(points + _enough(lines, count, LINE_HITS))


def walk_from(
    scene: mi.Scene, object_ids: ObjectIds, sensor: mi.Sensor, n_rays: int, n_hits: int
) -> SurfacePoints:
    """What walks of so many hits from a sensor meet, sorted by bounce.

    As ``scatter_points`` does it, but for ``start``: it counts the walks.
    """
    numbers = RandomNumbers.of_lanes(0, n_rays)
    ray, start = _sensor_rays(sensor, numbers), np.arange(n_rays)
    return _hits_along(scene, object_ids, numbers, ray, mi.BSDFFlags.Smooth, n_hits, 1, None, start)


def _starts(
    scene: mi.Scene, sensor: mi.Sensor, origin: mi.Point3f, batch: int
) -> np.ndarray | None:
    """Which rays of a sensor start in the same space: a number for each, None if all do.

    The film of an orthographic camera may lie across a wall. Rays that start in sight of the middle
    of the film get 0, those in sight of another start the next number, which no other batch uses.
    """
    middle, _ = sensor.sample_ray_differential(0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    place = mi.Point3f(middle.o)
    if not dr.any(dr.any(origin != place)):
        return None
    dr.eval(origin)
    start = np.full(dr.width(origin), MOST_STARTS)
    for number in range(MOST_STARTS):
        ray = mi.Ray3f(origin, place - origin)
        ray.maxt = mi.Float(1)
        count(Ray.SURVEY, ray, True)
        open_ = (start == MOST_STARTS) & ~scene.ray_test(ray).numpy()
        start[open_] = number
        missing = np.flatnonzero(start == MOST_STARTS)
        if len(missing) == 0:
            break
        place = dr.gather(mi.Point3f, origin, mi.UInt32(int(missing[0])))
    return np.where(start > 0, start + (MOST_STARTS + 1) * batch, 0)


def _spheres(scene: mi.Scene, walks: list[SurfacePoints]) -> np.ndarray:
    """Centres and radii [V, 4] of where the walks of each sensor have been, or of the scene.

    A few that have gone far, over a plain or out of a window, don't count.
    """
    spheres = []
    points = SurfacePoints.concatenate(walks) if walks else None
    for number in points.sensors() if points else ():
        spheres.append(_around(points.position[points.seen == number]))
    if not spheres:
        sphere = scene.bbox().bounding_sphere()
        spheres.append([*sphere.center, sphere.radius])
    return np.array(spheres, dtype=np.float32)


def _around(position: np.ndarray) -> list[float]:
    """Centre and radius of a sphere about most of some positions [N, 3]."""
    low, high = _usual(position)
    diagonal = 1.05 * (high - low)  # What is cut off where a box is filled evenly.
    radius = in_steps(0.5 * float(np.linalg.norm(diagonal)) * (1 + SPHERE_STEP), up=True)
    return [*snapped((low + high) / 2, SPHERE_STEP * radius), radius]


def _usual(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box that holds most of some positions [N, 3]."""
    some = position[:: max(len(position) // EXTENT_POINTS, 1)]
    return tuple(np.percentile(some, [2, 98], axis=0).astype(np.float64))


def in_steps(length: float, up: bool = False) -> float:
    """A length, rounded, and above 0 where all is at one place.

    What is told from points at random, or by where something that moves happens to be, would change
    all patches with every frame of an animation.
    """
    octaves = EXTENT_STEPS * math.log2(max(length, 1e-30)) + 0.2764
    return 2 ** ((math.ceil(octaves) if up else round(octaves)) / EXTENT_STEPS)


def snapped(place: np.ndarray, step: float) -> np.ndarray:
    """A place, likewise; shifted, as many things stand at round numbers."""
    return step * (np.round(place / step - 0.2764) + 0.2764)


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


def _sensor_rays(sensor: mi.Sensor, numbers: RandomNumbers) -> mi.Ray3f:
    time = sensor.shutter_open() + sensor.shutter_open_time() * numbers.next_1d()
    ray, _ = sensor.sample_ray_differential(
        time, numbers.next_1d(), numbers.next_2d(), numbers.next_2d()
    )
    return mi.Ray3f(ray)


def _global_lines(
    spheres: np.ndarray, numbers: RandomNumbers, n_rays: int
) -> tuple[mi.Ray3f, mi.Vector4f]:
    """Lines of uniform measure through spheres [V, 4], equally many through each.

    Returns the lines and the sphere of each.
    """
    lane = dr.arange(mi.UInt32, n_rays) % dr.opaque(mi.UInt32, len(spheres))
    sphere = dr.gather(mi.Vector4f, upload(mi.Float, spheres), lane)
    direction = mi.warp.square_to_uniform_sphere(numbers.next_2d())
    disk = mi.warp.square_to_uniform_disk_concentric(numbers.next_2d())
    offset = mi.Frame3f(direction).to_world(mi.Vector3f(disk.x, disk.y, -1.01))
    origin, wavelengths = mi.Point3f(sphere.xyz) + sphere.w * offset, random_wavelengths(numbers)
    return mi.Ray3f(origin, direction, wavelengths=wavelengths), sphere


@dr.syntax
def _hits_along(
    scene: mi.Scene,
    object_ids: ObjectIds,
    numbers: RandomNumbers | None,
    ray: mi.Ray3f,
    wanted: mi.BSDFFlags,
    n_hits: int,
    walk: int = 0,
    within: mi.Vector4f | None = None,
    start: np.ndarray | None = None,
) -> SurfacePoints:
    """Follow rays over several hits, on a walk of a sensor or straight through surfaces.

    Points are kept where the BSDF has any of the ``wanted`` flags, and ``within`` a sphere.
    """
    n_rays = dr.width(ray)
    size = n_hits * n_rays
    positions, normals, shading_normals = (dr.zeros(mi.Float, 3 * size) for _ in range(3))
    object_of_point, material = (dr.zeros(mi.UInt32, size) for _ in range(2))
    reflects = dr.zeros(mi.Float, size)
    kept, turned, diffuse = (dr.zeros(mi.Bool, size) for _ in range(3))
    n_hits_, n_rays_ = dr.opaque(mi.UInt32, n_hits), dr.opaque(mi.UInt32, n_rays)

    # Only what changes is part of the loop's state: with more, it would be traced twice.
    origin, line = mi.Point3f(ray.o), ray.d
    direction, maxt, throughput = (
        (mi.Vector3f(ray.d), mi.Float(ray.maxt), mi.Spectrum(1)) if walk else (None, None, None)
    )
    time, wavelengths = ray.time, ray.wavelengths
    index = dr.arange(mi.UInt32, n_rays)
    active = dr.full(mi.Bool, True, n_rays)
    while dr.hint(
        active,
        exclude=[
            object_ids,
            within,
            line,
            time,
            wavelengths,
            n_hits_,
            n_rays_,
            positions,
            normals,
            shading_normals,
            object_of_point,
            material,
            kept,
            turned,
            reflects,
            diffuse,
        ],
        label="Scatter points",
    ):
        towards = direction if walk else line
        reach = maxt if walk else dr.largest(mi.Float)
        sent = mi.Ray3f(origin, towards, reach, time, wavelengths)
        count(Ray.SURVEY, sent, active)
        si = scene.ray_intersect(sent, active)
        active &= si.is_valid()
        bsdf = si.bsdf()
        facing = dr.dot(si.n, towards) < 0
        normal = dr.select(facing, si.n, -si.n)
        shading_normal = diffuse_normal(bsdf, si, active)
        shading_normal = dr.mulsign(shading_normal, dr.dot(shading_normal, normal))
        keep = active & ((bsdf.flags() & int(wanted)) != 0)
        keep &= dr.all(dr.isfinite(si.p)) & dr.all(dr.isfinite(shading_normal))
        keep &= dr.squared_norm(normal) > 0.5
        if dr.hint(within is not None, mode="scalar"):
            keep &= dr.norm(si.p - mi.Point3f(within.xyz)) <= 1.01 * within.w
        dr.scatter(positions, si.p, index, keep)
        dr.scatter(normals, normal, index, keep)
        dr.scatter(shading_normals, shading_normal, index, keep)
        dr.scatter(object_of_point, object_ids(si), index, keep)
        back = dr.select(si.wi.z < 0, mi.UInt32(1), 0)
        dr.scatter(material, 2 * dr.reinterpret_array(mi.UInt32, bsdf) + back, index, keep)
        dr.scatter(kept, mi.Bool(True), index, keep)
        aligned = dr.abs(dr.dot(shading_normal, si.sh_frame.n))
        dr.scatter(turned, aligned < UNTURNED, index, keep)

        if dr.hint(walk > 0, mode="scalar"):
            bs, weight = bsdf.sample(
                mi.BSDFContext(), si, numbers.next_1d(), numbers.next_2d(), active
            )
            direction = towards = si.to_world(bs.wo)
            maxt = mi.Float(dr.largest(mi.Float))
            throughput *= weight
            dr.scatter(reflects, mean_channel(throughput), index, keep)
            by_lobe = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DiffuseReflection)
            dr.scatter(diffuse, by_lobe, index, keep)
            active &= mi.luminance(weight) > 0 if mi.is_rgb else dr.max(weight) > 0
        origin = mi.Point3f(si.spawn_ray(towards).o)
        index += n_rays_
        active &= index < n_hits_ * n_rays_

    dr.eval(positions, normals, shading_normals, object_of_point, material)
    dr.eval(kept, turned, reflects, diffuse)
    chosen = np.flatnonzero(kept.numpy())
    position, normal, shading_normal = (
        vectors.numpy().reshape(size, 3).take(chosen, axis=0)
        for vectors in (positions, normals, shading_normals)
    )
    return SurfacePoints(
        position,
        normal,
        shading_normal,
        object_of_point.numpy()[chosen],
        material.numpy()[chosen],
        np.full(len(chosen), float(walk), dtype=np.float32),
        turned.numpy()[chosen],
        (chosen // n_rays).astype(np.uint32),
        reflects.numpy()[chosen],
        diffuse.numpy()[chosen],
        np.zeros(len(chosen), dtype=np.int64) if start is None else start[chosen % n_rays],
    )
