"""Beyond the cubes: what the maps say of it, and what is traced there all the same."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..lookup.far_field import FarField
from ..system.jit import SpareNumbers
from ..system.ray_counts import Ray, count
from .state import Path


@dataclass
class Met:
    """What rays have met, near or far.

    si              the surface that the path goes on from, invalid where it ends
    emitter_si      where an emitter may have been hit; invalid for an environment,
    counts          ... and whether its light counts
    radiance        [W/m²/sr]  from the map, times the path's throughput
    boost           [1]  factor on all that the path brings from there on
    mapped          whether the map was read,
    retraced        ... and whether the ray was traced on from the cube
    """

    si: mi.SurfaceInteraction3f
    emitter_si: mi.SurfaceInteraction3f
    counts: mi.Bool
    radiance: mi.Spectrum
    boost: mi.Float
    mapped: mi.Bool
    retraced: mi.Bool


def near_alone(path: Path, si: mi.SurfaceInteraction3f) -> Met:
    """Without maps."""
    counts, no = path.active & (si.t <= path.reach), mi.Bool(False)
    return Met(si, si, counts, mi.Spectrum(0), mi.Float(1), no, no)


def look_up_far(
    scene: mi.Scene,
    far_field: FarField,
    path: Path,
    si: mi.SurfaceInteraction3f,
    estimates: mi.Bool,
    spare: SpareNumbers,
) -> Met:
    """Read the map where paths have left their cube without a hit (paper section 2).

    Paths are traced on from there where the map can't be trusted, and where they go on to estimate
    its error (``Residual``). Emitters that shadow rays or the map's own search have counted don't
    count again.
    """
    ray = path.ray
    left = path.active & path.bounded & ~si.is_valid()
    radiance, trusted = far_field.eval(
        path.cluster,
        ray,
        path.pdf,
        path.specular,
        spare.next_1d(),
        spare.next_2d(),
        left,
    )
    read, residual = left & trusted, left & trusted & estimates
    share = dr.select(residual, 1 - dr.rcp(path.q), 1)
    radiance = dr.select(read, path.throughput * share * radiance, 0)

    # ---------------------- Trace on ----------------------

    traced_on = left & (~trusted | estimates)
    beyond = mi.Ray3f(ray(ray.maxt), ray.d, wavelengths=ray.wavelengths)
    count(Ray.RETRACED, beyond, traced_on)
    further = scene.ray_intersect(beyond, traced_on)
    counts = path.active & (si.t <= path.reach) & ~left
    counts |= traced_on & ~residual & (path.reach == dr.inf)
    si = dr.select(traced_on, further, si)

    # ---------------------- Emitters for mirrors that read the map ----------------------

    emitter_si = si
    if far_field.emitter_scene is not None:
        searching = read & (path.reach == dr.inf)
        far_si, visible = far_field.intersect_emitters(scene, beyond, searching)
        emitter_si = dr.select(searching, far_si, si)
        counts |= visible
    boost = dr.select(residual, dr.rcp(path.q), 1)
    path.q[residual] = 1
    return Met(si, emitter_si, counts, radiance, boost, read, traced_on)
