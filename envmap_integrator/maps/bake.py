"""Map generation: radiance and distance of what lies beyond a cluster's cube (paper section 2)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit import opaque_point, upload
from ..progress import stage
from ..radiosity.surface_points import SurfacePoints
from ..rendering.ray_counts import Ray, count
from .clusters import Cluster
from .cube import exit_distance, face_to_direction
from .cube_map import CubeMap
from .mipmap import build_levels

#: Bake rays per kernel launch: bounds memory.
MAX_LANES = 1 << 22
#: Least inverse distance [1/m] under the sign of a masked texel.
MASKED = 1e-15


def bake_map(
    scene: mi.Scene,
    radiance_distance,
    cluster: Cluster,
    points: SurfacePoints,
    resolution: int,
    samples: int,
    seed: int,
) -> CubeMap:
    """Bake the map of one cluster.

    ``radiance_distance(sampler, ray, active)`` gives radiance along rays and the distance to what
    they hit; ``points`` are the surface points of the cluster. Rays go out from the centre but
    start on the cube. Where a start lies behind geometry, no ray of the cluster ever leaves there:
    such texels, recognised because no point of the cluster sees the start, are masked and filled
    before mip-mapping. ``samples`` rays per texel, a power of two.
    """
    n_channels = len(mi.Spectrum())
    n_texels = 6 * resolution**2
    half_width = dr.opaque(mi.Float, cluster.half_width)
    centre = opaque_point(cluster.centre)
    resolution_ = dr.opaque(mi.UInt32, resolution)
    position = upload(mi.Float, points.position)
    normals = upload(mi.Float, points.normal)
    n_points = dr.opaque(mi.UInt32, len(points))

    launch = max(MAX_LANES // samples, 1)
    sums = []
    with stage(f"Baking {cluster.name}", total=n_texels) as advance:
        for begin in range(0, n_texels, launch):
            end = min(begin + launch, n_texels)
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(seed + begin, (end - begin) * samples)
            lane = dr.arange(mi.UInt32, (end - begin) * samples)
            index = dr.opaque(mi.UInt32, begin) + (
                lane >> dr.opaque(mi.UInt32, int(np.log2(samples)))
            )

            # ---- Direction through the texel ----
            pixels = resolution_ * resolution_
            face, y, x = (
                index // pixels,
                (index // resolution_) % resolution_,
                index % resolution_,
            )
            u = mi.Point2f(mi.Float(x), mi.Float(y)) + sampler.next_2d()
            d = dr.normalize(face_to_direction(face, 2 * u / mi.Float(resolution_) - 1))
            start = exit_distance(centre, half_width, centre, d)
            o = centre + start * d

            # ---- Can a ray from the cluster get there? ----
            k = dr.minimum(mi.UInt32(sampler.next_1d() * mi.Float(n_points)), n_points - 1)
            si = dr.zeros(mi.SurfaceInteraction3f, len(lane))
            si.p = dr.gather(mi.Point3f, position, k)
            si.n = dr.gather(mi.Normal3f, normals, k)
            reached = dr.dot(o - si.p, si.n) > 0
            ray = si.spawn_ray_to(o)
            ray.maxt = dr.norm(o - ray.o)  # No shorter: the start may lie just behind a wall.
            count(Ray.SURVEY, ray, reached)
            reached &= ~scene.ray_test(ray, reached)

            radiance, distance = radiance_distance(sampler, mi.Ray3f(o, d), reached)
            value = [*radiance, dr.rcp(start + distance)]
            value = [dr.select(reached & dr.isfinite(c), c, 0) for c in value]
            value.append(dr.select(reached, 1.0, 0.0))
            dr.eval(value)  # Once: each block sum would trace all rays anew.
            total = [dr.block_sum(c, samples) for c in value]
            dr.eval(total)
            sums.append(np.stack([t.numpy() for t in total], axis=-1))
            advance(end - begin)

    total = np.concatenate(sums).reshape(6, resolution, resolution, n_channels + 2)
    weight = total[..., -1]
    value = total[..., :-1] / np.maximum(weight, 1)[..., None]
    levels = build_levels(value.astype(np.float64), weight / samples)
    masked = weight == 0
    levels[0][masked, -1] = -np.maximum(levels[0][masked, -1], MASKED)
    return CubeMap(cluster, [level.astype(np.float32) for level in levels])
