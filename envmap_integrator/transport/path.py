"""The one light transport loop that all integrators, the bake and the radiosity pass record.

A path starts anywhere, follows specular surfaces in full, and ends at the first opportunity: in
the irradiance cache at a surface the cache serves, or in the map of the cube it leaves. What
differs between the algorithms of the paper (its section 3) is only ``gather_depth`` and whether
there are maps:

======================  ============  ====
algorithm               gather_depth  maps
======================  ============  ====
``envmap_hybrid``       1             yes
``one_level_path``      1             no
``source_selection``    0             no
``envmap_bake``         0             no
======================  ============  ====
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..lookup.emitter_choice import SourceChoice
from ..lookup.far_field import Cube, FarField
from ..lookup.ids import ObjectIds
from ..lookup.irradiance_cache import IrradianceCache
from ..lookup.patches import PARTS, Patches
from ..system.jit import LANES_ALIKE, SpareNumbers, mix, unit
from ..system.ray_counts import Ray, count, count_secondary

#: Directions sampled more densely than this [1/sr] belong to a lobe for which a Lambertian
#: stand-in would misplace the light: they are traced on instead of read from the cache.
#: (A cosine lobe has 0.32 at most.)
NARROW_PDF = 1.0
#: Choices among the lobes of a surface that the cache serves: those that it can't stand for, such
#: as the gloss of a varnish, are found as many times more often as if one choice were made.
LOBE_CHOICES = 4
#: Bounces before Russian roulette may end a path that neither cache nor map has ended, and before
#: it may end one that has lost no light: a path in glass that is reflected on and on would come out
#: a firefly if it had to survive one chance in twenty of its end at each bounce.
RR_DEPTH, LOSSLESS_RR_DEPTH = 6, 128


@dataclass(frozen=True)
class Residual:
    """Estimate by further tracing what cache and maps get wrong, now and then.

    Where a path could end with light B of the cache or a map, it goes on with probability q and
    finds light X; B + (X - B) / q then stands for it, B otherwise. The mean is that of X whatever
    B is: an unbiased control variate.

    probability   q at the first opportunity of a path
    seed          of the decisions
    """

    probability: mi.Float
    seed: mi.UInt32

    def decision(self, lane, bounces):
        """A random number in [0, 1) for each bounce of the lanes that share registers."""
        group = lane // LANES_ALIKE
        return unit(mix(mix(self.seed ^ group * 0x9E3779B1) + bounces))


@dataclass(frozen=True)
class Transport:
    """What a path may use, and how far it goes before it uses it.

    patches          the coarse mesh
    object_ids       dense ids of the shapes of the scene at hand
    sources          how shadow rays choose a source
    far_field        maps of the clusters, or None to trace every ray in full
    gather_depth     non-specular bounces before the cache may end the path
    shadow_samples   shadow rays at a camera hit; further on it's one
    shadow_rays      direct light by shadow rays also where the cache could give it
    emission         whether sources count where the first ray hits them
    hide_emitters    sources seen by camera rays are left out, as in Mitsuba
    cache            irradiance on the patches; None while it is being made, when a path's only end
                     in a patch is recorded
    residual         how the errors of cache and maps are estimated, or None to leave them
    clamp            largest radiance [W/m²/sr] that a secondary ray may bring, or None
    """

    patches: Patches
    object_ids: ObjectIds
    sources: SourceChoice
    far_field: FarField | None = None
    gather_depth: int = 1
    shadow_samples: int = 1
    shadow_rays: bool = False
    emission: bool = True
    hide_emitters: bool = False
    cache: IrradianceCache | None = None
    residual: Residual | None = None
    clamp: mi.Float | None = None

    def of_sample(self, index: mi.UInt32) -> Transport:
        """The same; each sample of a pixel decides anew where residuals are estimated."""
        residual = self.residual and replace(self.residual, seed=mix(self.residual.seed + index))
        return replace(self, residual=residual)


def as_baked(transport: Transport, shadow_samples: int) -> Transport:
    """What maps hold (paper section 2): paths end in the cache at once, and sources aren't seen."""
    return replace(transport, gather_depth=0, emission=False, shadow_samples=shadow_samples)


@dataclass
class PathState:
    """Where a path starts.

    ray             its first ray
    depth           non-specular bounces behind it
    origin          the vertex it comes from, for the MIS weight of the sources it hits
    source_row      of the choice among sources there
    pdf, specular   density [1/sr] with which the direction was sampled; no density if specular
    bounded         whether ``ray.maxt`` ends it at the cube of ``cluster``
    reach           distance [world units] up to which the ray counts the sources that it hits;
                    shadow rays alone count those beyond
    primary         whether its first ray is what a sensor or a texel sees
    solid           whether it has met more than what lets light straight through: else the sky
                    isn't shown if sources are hidden
    """

    ray: mi.Ray3f
    depth: mi.UInt32
    origin: mi.Interaction3f
    source_row: mi.UInt32
    pdf: mi.Float
    specular: mi.Bool
    bounded: mi.Bool
    cluster: mi.UInt32
    reach: mi.Float
    primary: bool = False
    solid: mi.Bool | bool = False


@dataclass
class PathEnd:
    """What a path found: ``radiance + weight * E[row] / pi`` is the light it brings.

    radiance   [W/m²/sr]  from sources, maps and the cache, if there is one yet
    direct     [W/m²/sr]  the part of it that came from sources on the first ray
    weight     [1]        throughput times albedo at the patch the path ended in, 0 if none
    row        [1]        row of the irradiance table (2 * patch, + 1 for indirect light only)
    place      [1]        where that was: PARTS * the patch of that very place + its part
    valid                 whether something was hit (alpha)
    distance   [m]        to the first hit, infinite if none
    """

    radiance: mi.Spectrum
    direct: mi.Spectrum
    weight: mi.Spectrum
    row: mi.UInt32
    place: mi.UInt32
    valid: mi.Bool
    distance: mi.Float


def mis_weight(pdf_a, pdf_b):
    """Power heuristic."""
    a2 = dr.square(pdf_a)
    weight = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.detach(dr.select(dr.isfinite(weight), weight, 0))


def camera_path(ray: mi.Ray3f) -> PathState:
    """A path that starts at a sensor."""
    return PathState(
        ray=ray,
        depth=mi.UInt32(0),
        origin=dr.zeros(mi.Interaction3f),
        source_row=mi.UInt32(0),
        pdf=mi.Float(1),
        specular=mi.Bool(True),
        bounded=mi.Bool(False),
        cluster=mi.UInt32(0),
        reach=mi.Float(dr.inf),
        primary=True,
    )


@dr.syntax
def follow(
    scene: mi.Scene, transport: Transport, sampler: mi.Sampler, start: PathState, active: mi.Bool
) -> PathEnd:
    """Follow paths from ``start`` until the cache or a map ends them, or nothing is left to find.

    Every source is counted exactly once: by shadow rays and by the rays that hit it, weighted by
    multiple importance sampling where both could, and never where the cache's total irradiance
    ends the path, which has counted it already.
    """
    ctx = mi.BSDFContext()
    patches = transport.patches
    far_field = transport.far_field
    hide_emitters = transport.hide_emitters and start.primary
    cache, residual = transport.cache, transport.residual

    # ---------------------- Loop state ----------------------

    ray = mi.Ray3f(start.ray)
    depth = mi.UInt32(start.depth)  # Non-specular bounces so far
    bounces = mi.UInt32(0)  # All bounces of this call
    origin = mi.Interaction3f(start.origin)  # Previous vertex,
    source_row = mi.UInt32(start.source_row)  # ... choice among sources there,
    pdf = mi.Float(start.pdf)  # ... density of the direction sampled there,
    specular = mi.Bool(start.specular)  # ... whether sources weren't sampled for it
    bounded = mi.Bool(start.bounded)  # Does the ray end where it leaves its cube?
    cluster = mi.UInt32(start.cluster)
    reach = mi.Float(start.reach)  # Sources hit farther away have been counted
    throughput = mi.Spectrum(1)
    eta = mi.Float(1)
    radiance = mi.Spectrum(0)
    direct = mi.Spectrum(0)
    weight = mi.Spectrum(0)
    row = mi.UInt32(0)
    place = mi.UInt32(0)
    # As in path, a visible environment is never transparent.
    valid = start.solid | (
        active & (scene.environment() is not None and not transport.hide_emitters)
    )
    distance = mi.Float(dr.inf)
    going_on = mi.Float(0)  # Probability of going on where the cache or a map could end the path
    lane = dr.arange(mi.UInt32, dr.width(ray))
    if dr.hint(residual is not None, mode="scalar"):
        going_on = mi.Float(residual.probability)
    active = mi.Bool(active)
    if dr.hint(start.primary, mode="scalar"):
        count(Ray.PRIMARY, ray, active)
    else:
        count_secondary(ray, bounded, mi.Bool(False), active)

    while dr.hint(
        active,
        exclude=[transport, patches, far_field, cache, residual],
        label="Trace near, look up far",
    ):
        # ---------------------- Trace near ----------------------

        spare = SpareNumbers(sampler.next_1d())
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        if dr.hint(hide_emitters, mode="scalar"):
            pi = skip_sources(scene, ray, pi, active & (bounces == 0))
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        hit = active & si.is_valid()
        distance = dr.select((bounces == 0) & hit, si.t, distance)

        # ---------------------- Look up far ----------------------

        retrace = mi.Bool(False)
        goes_on = mi.Bool(False)
        if dr.hint(residual is not None, mode="scalar"):
            goes_on = active & (residual.decision(lane, bounces) < going_on)
        far_residual, far_going_on = mi.Bool(False), mi.Float(1)
        source_si = si
        source_active = active & (si.t <= reach)
        if dr.hint(far_field is not None, mode="scalar"):
            left = active & bounded & ~si.is_valid()
            far_radiance, trusted = far_field.eval(
                cluster, ray.o, ray.d, pdf, specular, spare.next_1d(), spare.next_2d(), left
            )
            far_residual = left & trusted & goes_on
            far_going_on = mi.Float(going_on)
            share = dr.select(far_residual, 1 - dr.rcp(going_on), 1)
            radiance[left & trusted] += throughput * share * far_radiance
            retrace = left & (~trusted | goes_on)
            source_active &= ~left
            if dr.hint(far_field.sources is not None, mode="scalar"):
                searching = left & trusted & (reach == dr.inf)
                beyond = mi.Ray3f(ray(ray.maxt), ray.d)
                far_si, visible = far_field.intersect_sources(scene, beyond, searching)
                source_si = dr.select(searching, far_si, si)
                source_active |= visible

        # ---------------------- Sources hit ----------------------

        if dr.hint(hide_emitters, mode="scalar"):
            source_active &= bounces > 0
        if dr.hint(transport.hide_emitters, mode="scalar"):
            source_active &= valid | si.is_valid()
        if dr.hint(not transport.emission, mode="scalar"):
            source_active &= bounces > 0
        ds = mi.DirectionSample3f(scene, si=source_si, ref=origin)
        source_pdf = transport.sources.pdf_direction(
            origin, source_row, ds, source_active & ~specular
        )
        mis = dr.select(specular, 1, mis_weight(pdf, source_pdf))
        emitted = throughput * mis * ds.emitter.eval(source_si, source_active)
        radiance += emitted
        direct[bounces == 0] = emitted

        # ---------------------- Direct light ----------------------

        bsdf = si.bsdf(ray)
        smooth = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        normal, object_id = facing(si, ray), transport.object_ids(si)
        mapped = smooth
        if dr.hint(far_field is not None and far_field.map_mirrors, mode="scalar"):
            mapped = hit
        cell, size, found = patches.find_cell(si.p, normal, object_id, mapped)
        next_source_row = transport.sources.row(cell, found)
        deep = found & is_diffuse(bsdf) & (depth >= transport.gather_depth)
        patch, has_patch, even, own = patches.find(
            si.p, normal, object_id, size, deep, spare.next_2d()
        )
        # A coarse mesh can't serve hits about as near as its patches are large (corners,
        # contacts). The threshold is random, so that no border shows.
        near = dr.norm(si.p - origin.p) < size * (0.5 + spare.next_1d())
        # A sensor is no surface. And gather rays start all over their own patch: what they read
        # near it is an average anyway.
        if dr.hint(start.primary or cache is None, mode="scalar"):
            near &= bounces > 0
        served = has_patch & ~near
        # Total irradiance stands for direct light too: single shadow rays beside a lamp are noisy.
        # But where it changes within patches, a ray knows better.
        lit = served & even & (depth > 0)
        if dr.hint(transport.shadow_rays, mode="scalar"):
            lit = mi.Bool(False)
        residual_here = served & goes_on
        shadow_rays_alone = served & ~(residual_here & lit)
        served &= ~goes_on
        cube = None
        if dr.hint(far_field is not None, mode="scalar"):
            cube = far_field.cube(cell, si.p, found)
        boost = dr.select(residual_here, dr.rcp(going_on), 1)
        vertex = Vertex(
            si,
            bsdf,
            transport.sources,
            next_source_row,
            lit & served,
            shadow_rays_alone,
            cube,
            dr.select(lit, boost, 1),
        )
        sampled = smooth & ~(lit & served & only_wide(bsdf))
        if dr.hint(transport.shadow_samples > 1, mode="scalar"):
            # Camera hits get several; further on one more sample of the pixel serves better.
            n = dr.select(depth == 0, mi.UInt32(transport.shadow_samples), mi.UInt32(1))
            light = sample_sources(scene, vertex, sampler, n, True, sampled)
            bs, bsdf_weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), hit)
        else:
            ds, em_weight = vertex.sample_direction(sampler.next_2d(), sampled)
            bsdf_value, bsdf_pdf, bs, bsdf_weight = bsdf.eval_pdf_sample(
                ctx, si, si.to_local(ds.d), sampler.next_1d(), sampler.next_2d(), hit
            )
            light = vertex.reflected(scene, ds, em_weight, bsdf_value, bsdf_pdf, sampled)
        radiance += throughput * light

        # ---------------------- End in the cache ----------------------

        sampled_specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        wide = is_wide(si, bs.wo, bs.pdf) & ~sampled_specular
        ends = served & wide
        cached_row = 2 * patch + dr.select(lit, mi.UInt32(0), mi.UInt32(1))
        if dr.hint(cache is None, mode="scalar"):
            weight[ends] = throughput * bsdf_weight
            row[ends] = cached_row
            place[ends] = PARTS * own + patches.part(si.p, size)
        else:
            cached_weight = dr.select((served | residual_here) & wide, bsdf_weight, 0)
            several = (served | residual_here) & ~single_lobe(bsdf)
            choice = choose_lobes(bsdf, si, sampler, several, residual_here)
            cached_weight = dr.select(several, choice.cached, cached_weight)
            bs = dr.select(several, choice.bs, bs)
            bsdf_weight = dr.select(several, choice.weight, bsdf_weight)
            sampled_specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            wide = dr.select(several, choice.wide, wide)
            ends = dr.select(several, dr.max(bsdf_weight) == 0, ends)
            if dr.hint(residual is not None, mode="scalar"):
                cached_weight *= dr.select(residual_here, 1 - boost, 1)
                residual_here &= wide
                bsdf_weight *= dr.select(residual_here, boost, 1)
                # Later residuals count less by the albedo, and deserve as much less effort.
                going_on[residual_here] = dr.clip(dr.max(bsdf_weight) / boost, 0.1, 1)
                going_on[far_residual] = 1
            in_cache = dr.any(cached_weight != 0)
            irradiance = cache.irradiance(cached_row, in_cache)
            radiance += throughput * cached_weight * irradiance * dr.inv_pi
        throughput = dr.select(retrace, throughput, throughput * bsdf_weight)
        throughput[far_residual] *= dr.rcp(far_going_on)
        eta = dr.select(retrace, eta, eta * bs.eta)
        valid |= hit & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)

        # ---------------------- Next ray ----------------------

        # ``retrace`` lanes repeat this segment from where it left the cube; sources farther away
        # than they may count have been counted.
        next_ray = si.spawn_ray(si.to_world(bs.wo))
        ray = dr.select(retrace, mi.Ray3f(ray(ray.maxt), ray.d), next_ray)
        ray.maxt = dr.largest(mi.Float)
        pdf = dr.select(retrace, pdf, bs.pdf)
        specular = dr.select(retrace, specular, sampled_specular)
        origin = dr.select(retrace, origin, mi.Interaction3f(si))
        source_row = dr.select(retrace, source_row, next_source_row)
        depth += dr.select(hit & ~sampled_specular, mi.UInt32(1), mi.UInt32(0))
        counted = retrace & ((reach < dr.inf) | far_residual)
        counted |= ~retrace & shadow_rays_alone & wide
        reach = mi.Float(dr.inf)
        if dr.hint(far_field is not None, mode="scalar"):
            cluster = cube.cluster
            bounded, ray.maxt, reach = far_field.bound(cube, ray, wide, spare.next_1d(), ~retrace)
        reach = dr.select(counted, -1, reach)
        active &= retrace | (hit & ~ends & (dr.max(throughput) != 0))

        # ---------------------- Russian roulette ----------------------

        bounces += 1
        survival = survival_probability(throughput, eta, bounces)
        active &= sampler.next_1d() < survival
        throughput[active] *= dr.rcp(survival)
        count_secondary(ray, bounded, retrace, active)

    return PathEnd(radiance, direct, weight, row, place, valid, distance)


def survival_probability(throughput, eta, bounces):
    """With which a path goes on after so many bounces: Russian roulette."""
    capped = dr.select(bounces < LOSSLESS_RR_DEPTH, mi.Float(1), 0.95)
    kept = dr.minimum(dr.max(throughput) * dr.square(eta), capped)
    return dr.select(bounces < RR_DEPTH, 1, kept)


def facing(si, ray):
    """Geometric normal on the side of a surface that a ray hits."""
    return dr.mulsign(si.n, -dr.dot(si.n, ray.d))


@dataclass
class Vertex:
    """A surface that reflects light from sources.

    si, bsdf      the surface
    sources       how shadow rays choose a source
    source_row    ... by the row of the place
    lit           whether the cache alone brings direct light to wide lobes
    alone         whether rays that wide lobes send on count no sources
    cube          the cube that bounds secondary rays from it, or None
    boost         factor [1] on light that wide lobes reflect
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    sources: SourceChoice
    source_row: mi.UInt32
    lit: mi.Bool
    alone: mi.Bool
    cube: Cube | None
    boost: mi.Float

    def sample_direction(self, u, active):
        """A direction to a source: ``(ds, weight)``."""
        return self.sources.sample_direction(self.si, self.source_row, u, active)

    def reflected(self, scene, ds, em_weight, bsdf_value, bsdf_pdf, active):
        """Light [W/m²/sr] reflected from a sampled direction to a source.

        To wide lobes, shadow rays alone bring light from beyond the cube, and all of it where the
        cache ends the path with indirect light, none where with direct light too.
        """
        wide = is_wide(self.si, self.si.to_local(ds.d), bsdf_pdf)
        alone = wide & self.alone
        if self.cube is not None:
            # The distance of an environment is made up.
            infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            alone |= (
                wide & self.cube.valid & (infinite | (self.cube.exit(self.si.p, ds.d) < ds.dist))
            )
        mis = dr.select(ds.delta, 1, mis_weight(ds.pdf, dr.select(alone, 0, bsdf_pdf)))
        light = bsdf_value * em_weight * mis * dr.select(wide, self.boost, 1)
        active = active & (ds.pdf != 0) & ~(wide & self.lit) & (dr.max(light) > 0)
        ray = self.si.spawn_ray_to(ds.p)
        count(Ray.SHADOW, ray, active)
        active &= ~scene.ray_test(ray, active)
        return dr.select(active, light, 0)


@dr.syntax
def sample_sources(scene, vertex, sampler, count, several, active):
    """Direct light [W/m²/sr] reflected at a vertex, by ``count`` stratified shadow rays a lane.

    ``several`` tells whether any lane's count exceeds one.
    """
    if dr.hint(not several, mode="scalar"):
        return sample_source(scene, vertex, sampler.next_2d(), active)
    result = mi.Spectrum(0)
    i = mi.UInt32(0)
    active = mi.Bool(active)
    while dr.hint(active, exclude=[vertex], label="Shadow rays"):
        u = sampler.next_2d()
        u.x = (u.x + mi.Float(i)) / mi.Float(count)
        result += sample_source(scene, vertex, u, active)
        i += 1
        active &= i < count
    return result / mi.Float(count)


def sample_source(scene, vertex, u, active):
    """Direct light [W/m²/sr] reflected at a vertex, by one shadow ray."""
    si = vertex.si
    ds, em_weight = vertex.sample_direction(u, active)
    wo = si.to_local(ds.d)
    bsdf_value, bsdf_pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    return vertex.reflected(scene, ds, em_weight, bsdf_value, bsdf_pdf, active)


@dataclass
class LobeChoice:
    """What several choices among the lobes of a surface come to.

    cached   weight [1] of the wide lobes, for which the cache stands
    bs       the direction to follow,
    weight   ... its weight [1], zero if none was chosen,
    wide     ... and whether it belongs to the wide lobes
    """

    cached: mi.Spectrum
    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    wide: mi.Bool


@dr.syntax
def choose_lobes(bsdf, si, sampler, active, residual):
    """Sample a material ``LOBE_CHOICES`` times, stratified over its lobes.

    One direction stands for all that the cache can't stand for. Where a ``residual`` is to be
    estimated it may be one of a wide lobe, though less often.
    """
    count = LOBE_CHOICES
    cached, weight = mi.Spectrum(0), mi.Spectrum(0)
    bs = dr.zeros(mi.BSDFSample3f)
    wide, i, chances = mi.Bool(False), mi.UInt32(0), mi.Float(0)
    active = mi.Bool(active)
    u = sampler.next_1d()
    while dr.hint(active, exclude=[bsdf, si, residual], label="Choose lobes"):
        lobe = (mi.Float(i) + u) / count
        one, one_weight = bsdf.sample(mi.BSDFContext(), si, lobe, sampler.next_2d(), active)
        delta = mi.has_flag(one.sampled_type, mi.BSDFFlags.Delta)
        one_wide = is_wide(si, one.wo, one.pdf) & ~delta
        cached += dr.select(one_wide, one_weight, 0)
        chance = dr.select(one_wide, dr.select(residual, mi.Float(1), 0), count - 1)
        chance = dr.select(dr.max(one_weight) > 0, chance, 0)
        chances += chance
        taken = sampler.next_1d() * chances < chance
        bs = dr.select(taken, one, bs)
        wide = dr.select(taken, one_wide, wide)
        weight = dr.select(taken, one_weight / chance, weight)
        i += 1
        active &= i < count
    return LobeChoice(cached / count, bs, weight * chances / count, wide)


def is_diffuse(bsdf):
    """May the cache serve a material?

    Metals and glass, however rough, reflect by where the light comes from, which the cache doesn't
    know. In glass, a lobe chosen seldom has a low density besides, and looks wider than it is.
    """
    flags = bsdf.flags()
    transmits = mi.has_flag(flags, mi.BSDFFlags.GlossyTransmission)
    return mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection) & ~transmits


def is_delta(bsdf):
    """Does a material do nothing but reflect and refract as perfect mirrors and glass?"""
    flags = bsdf.flags()
    return mi.has_flag(flags, mi.BSDFFlags.Delta) & ~mi.has_flag(flags, mi.BSDFFlags.Smooth)


def single_lobe(bsdf):
    """Does a material scatter by diffuse reflection alone?"""
    others = mi.BSDFFlags.Glossy | mi.BSDFFlags.Delta | mi.BSDFFlags.DiffuseTransmission
    return (bsdf.flags() & int(others)) == 0


def only_wide(bsdf):
    """Are all smooth lobes of a material diffuse reflection, wide by nature?"""
    flags = bsdf.flags()
    narrow = mi.BSDFFlags.Glossy | mi.BSDFFlags.DiffuseTransmission
    return (flags & int(narrow)) == 0


def is_wide(si, wo, pdf):
    """Is light from ``wo`` reflected by a lobe so wide that cached irradiance may stand for it?

    The cache holds the side that the path arrived on: transmission never qualifies.
    """
    return (pdf <= NARROW_PDF) & (mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(wo) > 0)


@dr.syntax
def skip_sources(scene, ray, pi, active):
    """Where an intersection lies on an area emitter, look behind it (``hide_emitters``)."""
    ray = mi.Ray3f(ray)
    pi = mi.PreliminaryIntersection3f(pi)
    active = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    while dr.hint(active, label="Skip hidden sources"):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        behind = si.spawn_ray(ray.d)
        ray = dr.select(active, behind, ray)
        count(Ray.PRIMARY, ray, active)
        pi_behind = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        pi = dr.select(active, pi_behind, pi)
        active &= pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    return pi
