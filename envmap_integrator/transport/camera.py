"""Radiance along camera and bake rays."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi

from ..lookup.lookup import Lookup
from ..system.jit import opaque_point
from ..system.ray_counts import Ray, count
from .direct_light import WideShare, sample_emitter, sample_emitters
from .gathered import Gathered
from .lobes import Lobes, Scattered, is_delta, is_diffuse, lets_all_pass
from .path import follow, survival_probability
from .rules import PathRules
from .state import PathStart, camera_path
from .vertex import Vertex, skip_emitters


@dataclass
class CameraSample:
    """What a camera ray finds.

    radiance   [W/m²/sr]
    distance   [m]  to the first hit, infinite if there is none
    valid           whether there is one (alpha)
    gathered        the part of the radiance that pixels may share, None if there is none at all
    vertex          the first surface but mirrors, glass and holes, None without secondary rays
    aovs            what else the film is to hold of it
    """

    radiance: mi.Spectrum
    distance: mi.Float
    valid: mi.Bool
    gathered: Gathered | None = None
    vertex: Vertex | None = None
    aovs: list[mi.Float] = field(default_factory=list)

    def scaled(self, factor: mi.Spectrum | mi.Float) -> CameraSample:
        """The same, seen with a throughput or a weight of the sensor [1]."""
        gathered = self.gathered and self.gathered.scaled(factor)
        return replace(self, radiance=factor * self.radiance, gathered=gathered)

    def finite(self) -> CameraSample:
        """The same, but black where it isn't finite: materials give what isn't where shading
        normals aren't, and a single sample would spoil its pixel.
        """
        known = dr.all(dr.isfinite(self.radiance))
        gathered = self.gathered and self.gathered.where(known)
        return replace(self, radiance=dr.select(known, self.radiance, 0), gathered=gathered)


def camera_radiance(
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    active: mi.Bool,
) -> CameraSample:
    """What rays of a sensor or a texel find.

    Where the cache may end a path at once (``gather_depth`` 0) there are no secondary rays.
    """
    if rules.gather_depth == 0:
        end = follow(scene, lookup, rules, sampler, camera_path(ray), active)
        return CameraSample(end.radiance, end.distance, end.valid).finite()
    return split(scene, lookup, rules, sampler, ray, active).finite()


@dr.syntax
def split(
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    active: mi.Bool,
) -> CameraSample:
    """Shade the first surface but mirrors, glass and holes, and send secondary rays from it.

    This vertex stands outside the loop over the others also for a single secondary ray: it needs no
    patch and those need hardly any shadow rays, which saves a fifth of the time.
    """
    # ---------------------- First hit ----------------------

    count(Ray.PRIMARY, ray, active)
    pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    if dr.hint(rules.hide_emitters, mode="scalar"):
        pi = skip_emitters(scene, ray, pi, active)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    distance = dr.select(active & si.is_valid(), si.t, dr.inf)
    shown = active & (not rules.hide_emitters)
    valid = shown & (scene.environment() is not None)
    throughput, on_mirrors = mi.Spectrum(1), mi.Spectrum(0)
    if dr.hint(lookup.far_field is None or not lookup.far_field.map_mirrors, mode="scalar"):
        mirrored = leads_on(si, ray, active)
        si, ray, throughput, on_mirrors, solid = follow_mirrors(scene, sampler, si, ray, mirrored)
        shown |= solid | (mirrored & si.is_valid())
        valid |= solid

    # ---------------------- First vertex ----------------------

    active &= dr.max(throughput) > 0
    vertex = Vertex.met(lookup, si, ray, active)
    radiance = si.emitter(scene).eval(si, active & shown)
    if dr.hint(rules.shadow_samples > 1, mode="scalar"):
        n = mi.UInt32(rules.shadow_samples)
        radiance += sample_emitters(
            scene, lookup.emitters, vertex, WideShare(), sampler, n, vertex.smooth
        )
    else:
        u = sampler.next_2d()
        radiance += sample_emitter(scene, lookup.emitters, vertex, WideShare(), u, vertex.smooth)

    # ---------------------- Secondary rays ----------------------

    if dr.hint(rules.secondary_samples == 1, mode="scalar"):
        u = sampler.next_1d()
        arriving, wide, nearness, solid = secondary(
            scene, lookup, rules, sampler, vertex, u, vertex.hit
        )
        valid |= solid
    else:
        i = mi.UInt32(0)
        arriving, wide, nearness = mi.Spectrum(0), mi.Spectrum(0), mi.Float(0)
        pending = mi.Bool(vertex.hit)
        while dr.hint(pending, exclude=[lookup, rules, vertex], label="Secondary rays"):
            u = (mi.Float(i) + sampler.next_1d()) / mi.Float(rules.secondary_samples)
            one = secondary(scene, lookup, rules, sampler, vertex, u, pending)
            arriving += one[0]
            wide += one[1]
            nearness += one[2]
            valid |= pending & one[3]
            i += 1
            pending &= i < rules.secondary_samples
        arriving /= rules.secondary_samples
        wide /= rules.secondary_samples
        nearness /= rules.secondary_samples
    gathered = gathering(scene, lookup, vertex, sampler.next_2d(), wide, nearness)
    seen = CameraSample(radiance + arriving, distance, valid, gathered, vertex).scaled(throughput)
    return replace(seen, radiance=seen.radiance + on_mirrors)


@dr.syntax
def follow_mirrors(
    scene: mi.Scene,
    sampler: mi.Sampler,
    si: mi.SurfaceInteraction3f,
    ray: mi.Ray3f,
    active: mi.Bool,
) -> tuple[mi.SurfaceInteraction3f, mi.Ray3f, mi.Spectrum, mi.Spectrum, mi.Bool]:
    """Follow perfect mirrors, glass and holes to what is seen in them.

    Returns an interaction, invalid where nothing is seen, the ray to it, the throughput, what the
    mirrors and the glass themselves emit [W/m²/sr], and whether anything on the way was solid.
    """
    si, ray, active = mi.SurfaceInteraction3f(si), mi.Ray3f(ray), mi.Bool(active)
    throughput, eta, bounces, solid = mi.Spectrum(1), mi.Float(1), mi.UInt32(0), mi.Bool(False)
    emitted = mi.Spectrum(0)
    while dr.hint(active, label="Follow mirrors"):
        emitted += throughput * si.emitter(scene).eval(si, active)
        u, v = sampler.next_1d(), sampler.next_2d()
        bsdf = si.bsdf(ray)
        scattered = Lobes.of(bsdf, si, active).scattered(
            u, *bsdf.sample(mi.BSDFContext(), si, u, v, active)
        )
        bs = scattered.bs
        solid |= active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        throughput[active] *= scattered.weight
        eta[active] *= bs.eta
        bounces += 1
        survival = survival_probability(throughput, eta, bounces)
        survives = sampler.next_1d() < survival
        throughput[active] *= dr.select(survives, dr.rcp(survival), 0)
        active &= dr.max(throughput) > 0
        ray = dr.select(active, si.spawn_ray(si.to_world(bs.wo)), ray)
        count(Ray.UNBOUNDED, ray, active)
        si = dr.select(active, scene.ray_intersect(ray, active), si)
        active = leads_on(si, ray, active)
    return si, ray, throughput, emitted, solid


def leads_on(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
    """Is what is seen at a surface elsewhere: in a mirror, behind glass or a hole?"""
    bsdf, hit = si.bsdf(ray), active & si.is_valid()
    return hit & (is_delta(bsdf) | lets_all_pass(bsdf, si, hit))


def gathering(
    scene: mi.Scene,
    lookup: Lookup,
    vertex: Vertex,
    u: mi.Point2f,
    radiance: mi.Spectrum,
    nearness: mi.Float,
) -> Gathered:
    """What pixels may share of the ``radiance`` [W/m²/sr] that the wide lobes of a surface reflect.

    ``u``, uniform in the unit square, is for the albedo, and ``nearness`` [1/m] is the inverse
    distance to where that comes from. Colours of light at several wavelengths are in proportion to
    the albedo at these only if it's weighted by the light's hue.
    """
    si, albedo = vertex.si, vertex.lobes.albedo(u, vertex.smooth)
    if lookup.cache.hue is not None:
        albedo *= lookup.cache.hue_at(si.wavelengths)
    shared = vertex.smooth & is_diffuse(vertex.bsdf) & (dr.max(albedo) > 0)
    centre = opaque_point(scene.bbox().center())
    found = Gathered(radiance, albedo, si.sh_frame.n, si.p - centre, nearness, mi.Float(1))
    return found.where(shared)


def secondary(
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    sampler: mi.Sampler,
    vertex: Vertex,
    u: mi.Float,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.Spectrum, mi.Float, mi.Bool]:
    """One secondary ray.

    Returns the radiance [W/m²/sr] that it brings, the part of it by wide lobes, the inverse
    distance [1/m] to where they were traced, and whether anything was solid.
    """
    start, scattered = leave(lookup, sampler, vertex, u, active)
    wide = scattered.wide
    going = active & (dr.max(scattered.weight) > 0)
    end = follow(scene, lookup, rules, sampler, start, going)
    arriving = scattered.weight * end.radiance
    if rules.clamp is not None:
        largest = dr.max(dr.abs(arriving))
        arriving *= dr.select(largest > rules.clamp, rules.clamp / largest, 1)
    nearness = dr.rcp(dr.minimum(end.distance, start.ray.maxt))
    return arriving, dr.select(wide, arriving, 0), dr.select(wide, nearness, 0), end.valid


def leave(
    lookup: Lookup, sampler: mi.Sampler, vertex: Vertex, u: mi.Float, active: mi.Bool
) -> tuple[PathStart, Scattered]:
    """Start of a secondary ray from a camera hit, and the direction that the material sampled."""
    bsdf, si = vertex.bsdf, vertex.si
    scattered = vertex.lobes.scattered(
        u, *bsdf.sample(mi.BSDFContext(), si, u, sampler.next_2d(), active)
    )
    bs = scattered.bs
    start = PathStart(
        ray=si.spawn_ray(si.to_world(bs.wo)),
        depth=dr.select(scattered.specular, mi.UInt32(0), mi.UInt32(1)),
        origin=mi.Interaction3f(si),
        emitter_row=vertex.emitter_row,
        pdf=bs.pdf,
        specular=scattered.specular,
        solid=active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null),
    )
    if vertex.cube is not None:
        start.cluster = vertex.cube.cluster
        start.bounded, start.ray.maxt, start.reach = lookup.far_field.bound(
            vertex.cube, start.ray, scattered.wide, sampler.next_1d(), active
        )
    return start, scattered
