"""How paths end in the irradiance cache: which surfaces it serves, and what it stands for there."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..lookup.lookup import Lookup
from ..lookup.patches import PARTS
from ..system.jit import SpareNumbers
from .direct_light import WideShare
from .lobes import Scattered, choose_lobes, is_diffuse, single_lobe
from .rules import PathRules
from .state import Path, PathEnd, PathStart
from .vertex import Vertex


@dataclass
class Service:
    """What the cache does at a surface.

    served     whether it ends the path there, in its wide lobes,
    residual   ... or could, but the path goes on to estimate what is wrong with that,
    near       ... or would, were the surface not too near for a coarse mesh
    boost      [1]  factor on what such a path brings
    own        the patch that the surface lies in
    row        of the irradiance table that stands for what wide lobes gather
    share      who brings their direct light
    """

    served: mi.Bool
    residual: mi.Bool
    near: mi.Bool
    boost: mi.Float
    own: mi.UInt32
    row: mi.UInt32
    share: WideShare


def serve(
    lookup: Lookup,
    rules: PathRules,
    start: PathStart,
    path: Path,
    vertex: Vertex,
    estimates: mi.Bool,
    spare: SpareNumbers,
) -> Service:
    """Ask the cache what it does at a surface."""
    si = vertex.si
    deep = is_diffuse(vertex.bsdf) & (path.depth >= rules.gather_depth)
    patch = lookup.patches.find(
        si.p, vertex.normal, vertex.object_id, vertex.cell, deep, spare.next_2d()
    )
    # A coarse mesh can't serve hits about as near as its patches are large (corners, contacts). The
    # threshold is random, so that no border shows.
    near = dr.norm(si.p - path.origin.p) < vertex.cell.patch_size * (0.5 + spare.next_1d())
    # A sensor is no surface. And gather rays start all over their own patch: what they read near it
    # is an average anyway.
    if start.primary or lookup.cache is None:
        near &= path.bounces > 0
    could = patch.found & ~near
    # Total irradiance stands for direct light too: single shadow rays beside a lamp are noisy. But
    # where it changes within patches, a ray knows better.
    lit = mi.Bool(False) if rules.shadow_rays else could & patch.even & (path.depth > 0)
    residual, served = could & estimates, could & ~estimates
    boost = dr.select(residual, dr.rcp(path.q), 1)
    share = WideShare(
        lit=lit & served, alone=could & ~(residual & lit), boost=dr.select(lit, boost, 1)
    )
    row = 2 * patch.index + dr.select(lit, mi.UInt32(0), mi.UInt32(1))
    return Service(served, residual, patch.found & near, boost, patch.own, row, share)


def record_end(
    lookup: Lookup,
    found: PathEnd,
    path: Path,
    vertex: Vertex,
    service: Service,
    scattered: Scattered,
) -> mi.Bool:
    """Note in which patch paths end, while there is no cache yet; returns whether they do."""
    ends = service.served & scattered.wide
    found.weight[ends] = path.throughput * scattered.weight
    found.row[ends] = service.row
    part = lookup.patches.part(vertex.si.p, vertex.cell.patch_size)
    found.place[ends] = PARTS * service.own + part
    return ends


def end_in_cache(
    lookup: Lookup,
    rules: PathRules,
    sampler: mi.Sampler,
    path: Path,
    vertex: Vertex,
    service: Service,
    scattered: Scattered,
) -> tuple[mi.Spectrum, Scattered, mi.Bool]:
    """Let cached irradiance stand for what wide lobes gather.

    Returns the light [W/m²/sr] that it brings, where the path goes on, and whether it ends. Of
    several lobes one that the cache can't stand for is followed.
    """
    residual = service.residual
    asked = service.served | residual
    weight = dr.select(asked & scattered.wide, scattered.weight, 0)
    ends = service.served & scattered.wide
    several = asked & ~single_lobe(vertex.bsdf)
    of_wide, other = choose_lobes(vertex.lobes, scattered, sampler, several, residual)
    weight = dr.select(several, of_wide, weight)
    scattered = dr.select(several, other, scattered)
    ends = dr.select(several, dr.max(scattered.weight) == 0, ends)
    if rules.residual is not None:
        weight *= dr.select(residual, 1 - service.boost, 1)
        residual = residual & scattered.wide
        scattered.weight *= dr.select(residual, service.boost, 1)
        # Later residuals count less by the albedo, and deserve as much less effort.
        less = dr.max(scattered.weight) / service.boost
        path.q[residual] = dr.clip(less, 0.1, 1)
    irradiance = lookup.cache.irradiance(service.row, vertex.si.wavelengths, dr.any(weight != 0))
    return weight * irradiance * dr.inv_pi, scattered, ends
