"""The one light transport loop that all integrators, the bake and the radiosity pass record.

A path starts anywhere, follows specular surfaces in full, and ends at the first opportunity: in
the irradiance cache at a surface the cache serves, or in the map of the cube it leaves. What
differs between the algorithms of the paper is in ``rules``.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..lookup.lookup import Lookup
from ..system.jit import SpareNumbers
from ..system.ray_counts import Ray, count, count_secondary
from .direct_light import mis_weight, sample_emitters, sample_with_emitter
from .ending import Service, end_in_cache, record_end, serve
from .far import Met, look_up_far, near_alone
from .lobes import Scattered
from .rules import PathRules
from .state import Path, PathEnd, PathStart
from .vertex import Vertex, skip_emitters

#: Bounces before Russian roulette may end a path that neither cache nor map has ended, and before
#: it may end one that has lost no light: a path in glass that is reflected on and on would come out
#: a firefly if it had to survive one chance in twenty of its end at each bounce.
RR_DEPTH, LOSSLESS_RR_DEPTH = 6, 128


@dr.syntax
def follow(
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    sampler: mi.Sampler,
    start: PathStart,
    active: mi.Bool,
) -> PathEnd:
    """Follow paths from ``start`` until the cache or a map ends them, or nothing is left to find.

    Every emitter is counted exactly once: by shadow rays and by the rays that hit it, weighted by
    multiple importance sampling where both could, and never where the cache's total irradiance
    ends the path, which has counted it already.
    """
    path = Path.begin(start, rules, active)
    found = PathEnd.nothing(scene, rules, start, active)
    _count_first(start, path)
    while dr.hint(path.active, exclude=[lookup, rules, start], label="Trace near, look up far"):
        spare = SpareNumbers(sampler.next_1d())
        estimates = _estimates(rules, path)

        # ---------------------- Trace near, look up far ----------------------

        si = trace_near(scene, rules, start, path)
        found.distance = dr.select(
            (path.bounces == 0) & path.active & si.is_valid(), si.t, found.distance
        )
        if dr.hint(lookup.far_field is None, mode="scalar"):
            met = near_alone(path, si)
        else:
            met = look_up_far(scene, lookup.far_field, path, si, estimates, spare)
        found.radiance += met.radiance

        # ---------------------- Emitters hit ----------------------

        emitted = path.throughput * emitted_light(scene, lookup, rules, start, path, met, found)
        found.radiance += emitted
        found.direct[path.bounces == 0] = emitted
        path.throughput *= met.boost

        # ---------------------- Direct light ----------------------

        vertex = Vertex.met(lookup, met.si, path.ray, path.active)
        service = serve(lookup, rules, start, path, vertex, estimates, spare)
        light, scattered = direct_light(scene, lookup, rules, sampler, path, vertex, service)
        found.radiance += path.throughput * light

        # ---------------------- Scatter or end ----------------------

        if dr.hint(lookup.cache is None, mode="scalar"):
            ends = record_end(lookup, found, path, vertex, service, scattered)
        else:
            cached, scattered, ends = end_in_cache(
                lookup, rules, sampler, path, vertex, service, scattered
            )
            found.radiance += path.throughput * cached
        found.valid |= vertex.hit & ~mi.has_flag(scattered.bs.sampled_type, mi.BSDFFlags.Null)
        scatter(lookup, path, vertex, service, scattered, spare)
        path.active &= vertex.hit & ~ends & (dr.max(path.throughput) != 0)
        roulette(sampler, path)
        count_secondary(path.ray, path.bounded, path.active)
    return found


def _count_first(start: PathStart, path: Path) -> None:
    if start.primary:
        count(Ray.PRIMARY, path.ray, path.active)
    else:
        count_secondary(path.ray, path.bounded, path.active)


def _estimates(rules: PathRules, path: Path) -> mi.Bool:
    """Whether paths go on where they could end, to estimate what is wrong with that."""
    if rules.residual is None:
        return mi.Bool(False)
    return path.active & (rules.residual.decision(path.bounces) < path.q)


# ---------------------- Stages ----------------------


def trace_near(
    scene: mi.Scene, rules: PathRules, start: PathStart, path: Path
) -> mi.SurfaceInteraction3f:
    """What rays hit, as far as they are traced."""
    pi = scene.ray_intersect_preliminary(path.ray, coherent=False, active=path.active)
    if rules.hide_emitters and start.primary:
        pi = skip_emitters(scene, path.ray, pi, path.active & (path.bounces == 0))
    return pi.compute_surface_interaction(path.ray, mi.RayFlags.All, path.active)


def emitted_light(
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    start: PathStart,
    path: Path,
    met: Met,
    found: PathEnd,
) -> mi.Spectrum:
    """Light [W/m²/sr] of emitters that rays have hit, as far as shadow rays haven't brought it."""
    counts = met.counts
    if not rules.emission or (rules.hide_emitters and start.primary):
        counts &= path.bounces > 0
    if rules.hide_emitters:
        counts &= found.valid | met.si.is_valid()
    ds = mi.DirectionSample3f(scene, si=met.emitter_si, ref=path.origin)
    emitter_pdf = lookup.emitters.pdf_direction(
        path.origin, path.emitter_row, ds, counts & ~path.specular
    )
    mis = dr.select(path.specular, 1, mis_weight(path.pdf, emitter_pdf))
    return mis * ds.emitter.eval(met.emitter_si, counts)


def direct_light(
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    sampler: mi.Sampler,
    path: Path,
    vertex: Vertex,
    service: Service,
) -> tuple[mi.Spectrum, Scattered]:
    """Direct light [W/m²/sr] by shadow rays, and the direction that the material has sampled."""
    share, si = service.share, vertex.si
    active = vertex.smooth & ~(share.lit & vertex.lobes.every)
    if rules.shadow_samples > 1:
        # Camera hits get several; further on one more sample of the pixel serves better.
        n = dr.select(path.depth == 0, mi.UInt32(rules.shadow_samples), mi.UInt32(1))
        light = sample_emitters(scene, lookup.emitters, vertex, share, sampler, n, active)
        lobe = sampler.next_1d()
        bs, weight = vertex.bsdf.sample(mi.BSDFContext(), si, lobe, sampler.next_2d(), vertex.hit)
    else:
        light, lobe, bs, weight = sample_with_emitter(
            scene, lookup.emitters, vertex, share, sampler, active
        )
    return light, vertex.lobes.scattered(lobe, bs, weight)


def scatter(
    lookup: Lookup,
    path: Path,
    vertex: Vertex,
    service: Service,
    scattered: Scattered,
    spare: SpareNumbers,
) -> None:
    """Send paths on from a surface."""
    bs, wide, specular = scattered.bs, scattered.wide, scattered.specular
    path.throughput *= scattered.weight
    path.eta *= bs.eta
    path.ray = vertex.si.spawn_ray(vertex.si.to_world(bs.wo))
    path.ray.maxt = dr.largest(mi.Float)
    path.pdf, path.specular = mi.Float(bs.pdf), mi.Bool(specular)
    path.origin = mi.Interaction3f(vertex.si)
    path.emitter_row = mi.UInt32(vertex.emitter_row)
    path.depth += dr.select(vertex.hit & ~specular, mi.UInt32(1), mi.UInt32(0))
    path.bounces += 1
    path.reach = mi.Float(dr.inf)
    if vertex.cube is not None:
        path.cluster = vertex.cube.cluster
        path.bounded, path.ray.maxt, path.reach = lookup.far_field.bound(
            vertex.cube, path.ray, wide, spare.next_1d(), True
        )
    # Shadow rays have counted what such rays hit.
    path.reach = dr.select(service.share.alone & wide, -1, path.reach)


def roulette(sampler: mi.Sampler, path: Path) -> None:
    """End paths that carry little, at random."""
    survival = survival_probability(path.throughput, path.eta, path.bounces)
    path.active &= sampler.next_1d() < survival
    path.throughput[path.active] *= dr.rcp(survival)


def survival_probability(throughput: mi.Spectrum, eta: mi.Float, bounces: mi.UInt32) -> mi.Float:
    """With which a path goes on after so many bounces: Russian roulette."""
    capped = dr.select(bounces < LOSSLESS_RR_DEPTH, mi.Float(1), 0.95)
    kept = dr.minimum(dr.max(throughput) * dr.square(eta), capped)
    return dr.select(bounces < RR_DEPTH, 1, kept)
