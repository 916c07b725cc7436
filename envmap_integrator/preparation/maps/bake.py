"""Map generation: radiance and distance of what lies beyond a cluster's cube (paper section 2)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from blake3 import blake3

from ...lookup.cube import exit_distance, face_to_direction
from ...lookup.cube_map import Cluster, CubeMap
from ...system.jit import mix, upload
from ...system.progress import stage
from ...system.random_numbers import RandomNumbers
from ...system.ray_counts import Ray, count
from ...system.spectrum import n_packets, n_stored, packet_wavelengths
from ..coarse_mesh.surface_points import SurfacePoints
from .mipmap import build_levels

#: Bake rays per kernel launch: bounds memory.
MAX_LANES = 1 << 22
#: Least inverse distance [1/m] under the sign of a masked texel.
MASKED = 1e-15


def bake_maps(
    scene: mi.Scene,
    radiance_distance,
    clusters: list[Cluster],
    points: list[SurfacePoints],
    resolution: int,
    samples: int,
    seed: int,
) -> tuple[CubeMap, ...]:
    """Bake the maps of clusters, all at once.

    ``radiance_distance(sampler, ray, active)`` gives radiance along rays and the distance to what
    they hit; ``points`` are the surface points of each cluster. Rays go out from the centre but
    start on the cube. Where a start lies behind geometry, no ray of the cluster ever leaves there:
    such texels, recognised because no point of the cluster sees the start, are masked and filled
    before mip-mapping. ``samples`` rays per texel, a power of two; packets of wavelengths share
    them. Random numbers go by the names of clusters: a map comes out the same whatever else is
    baked.
    """
    if not clusters:
        return ()
    n_texels = len(clusters) * 6 * resolution**2
    centres = upload(mi.Float, np.stack([cluster.centre for cluster in clusters]))
    half_widths = upload(mi.Float, np.array([cluster.half_width for cluster in clusters]))
    names = (blake3(cluster.name.encode()).digest(length=4) for cluster in clusters)
    keys = upload(mi.UInt32, np.array([int.from_bytes(name, "little") for name in names]))
    members = SurfacePoints.concatenate(points)
    first = upload(mi.UInt32, np.cumsum([0, *map(len, points)]))
    resolution_ = dr.opaque(mi.UInt32, resolution)
    n_pixels = resolution_ * resolution_

    packets = n_packets()
    each = max(samples // packets, 1)
    samples = packets * each
    launch = max(MAX_LANES // samples, 1)
    totals = np.empty((n_texels, n_stored() + 2), np.float32)
    with stage("Baking maps", total=n_texels) as advance:
        for begin in range(0, n_texels, launch):
            end = min(begin + launch, n_texels)
            lane = dr.arange(mi.UInt32, (end - begin) * samples)
            index = dr.opaque(mi.UInt32, begin) + (
                lane >> dr.opaque(mi.UInt32, int(np.log2(samples)))
            )

            # ---- Direction through the texel ----
            face, y, x = (
                index // n_pixels,
                (index // resolution_) % resolution_,
                index % resolution_,
            )
            cluster, face = face // 6, face % 6
            key = dr.gather(mi.UInt32, keys, cluster) ^ mix(index - cluster * 6 * n_pixels)
            sampler = RandomNumbers.of_keys(seed, key, lane & (dr.opaque(mi.UInt32, samples) - 1))
            u = mi.Point2f(mi.Float(x), mi.Float(y)) + sampler.next_2d()
            d = dr.normalize(face_to_direction(face, 2 * u / mi.Float(resolution_) - 1))
            centre = dr.gather(mi.Point3f, centres, cluster)
            half_width = dr.gather(mi.Float, half_widths, cluster)
            start = exit_distance(centre, half_width, centre, d)
            o = centre + start * d

            # ---- Can a ray from the cluster get there? ----
            first_point = dr.gather(mi.UInt32, first, cluster)
            n_points = dr.gather(mi.UInt32, first, cluster + 1) - first_point
            k = dr.minimum(mi.UInt32(sampler.next_1d() * mi.Float(n_points)), n_points - 1)
            si = members.interaction(first_point + k)
            reached = dr.dot(o - si.p, si.n) > 0
            ray = si.spawn_ray_to(o)
            ray.maxt = dr.norm(o - ray.o)  # No shorter: the start may lie just behind a wall.
            count(Ray.SURVEY, ray, reached)
            reached &= ~scene.ray_test(ray, reached)

            within_bin = sampler.next_1d() if packets > 1 else 0
            wavelengths = packet_wavelengths(lane // each % packets, within_bin)
            ray = mi.Ray3f(o, d, wavelengths=wavelengths)
            radiance, distance = radiance_distance(sampler, ray, reached)
            value = [*radiance, dr.rcp(start + distance)]
            value = [dr.select(reached & dr.isfinite(c), c, 0) for c in value]
            value.append(dr.select(reached, 1.0, 0.0))
            dr.eval(value)  # Once: each block sum would trace all rays anew.
            total = [dr.block_sum(c, each) for c in value]
            dr.eval(total)
            totals[begin:end] = _joined(np.stack([t.numpy() for t in total], axis=-1), packets)
            advance(end - begin)

    shape = 6, resolution, resolution, totals.shape[1]
    return tuple(
        CubeMap(cluster, _levels(total.reshape(shape), each))
        for cluster, total in zip(clusters, np.split(totals, len(clusters)), strict=True)
    )


def _joined(total: np.ndarray, packets: int) -> np.ndarray:
    """Sums [T, C + 2] of texels from those [T * packets, S + 2] of packets of S wavelengths each.

    As if as many rays had arrived in each packet as in the one that has fewest: without any in one
    of them, a texel isn't known.
    """
    if packets == 1:
        return total
    total = total.reshape(len(total) // packets, packets, -1)
    arrived = total[..., -1:]
    least = arrived.min(axis=1)
    mean = total[..., :-2] / np.maximum(arrived, 1)
    distance = total[..., -2].sum(axis=1) / np.maximum(arrived.sum(axis=(1, 2)), 1)
    value = np.column_stack([mean.reshape(len(total), -1), distance])
    return np.column_stack([value * least, least])


def _levels(total: np.ndarray, samples: int) -> list[np.ndarray]:
    """All levels of a map from the sums [6, R, R, C + 2] over the rays that arrived, and these."""
    weight = total[..., -1]
    value = total[..., :-1] / np.maximum(weight, 1)[..., None]
    levels = build_levels(value.astype(np.float64), weight / samples)
    masked = weight == 0
    levels[0][masked, -1] = -np.maximum(levels[0][masked, -1], MASKED)
    return [level.astype(np.float32) for level in levels]
