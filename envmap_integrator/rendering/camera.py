"""Radiance along camera and bake rays."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..radiosity.irradiance import IrradianceCache
from .transport import (
    PathState,
    Transport,
    camera_path,
    facing,
    follow,
    sample_sources,
    skip_sources,
)


@dr.syntax
def camera_radiance(
    scene: mi.Scene,
    transport: Transport,
    cache: IrradianceCache,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    active: mi.Bool,
    secondary_samples: int,
) -> tuple[mi.Spectrum, mi.Float, mi.Bool]:
    """Radiance [W/m²/sr] along rays, distance to the first hit, whether there was one.

    With several secondary samples the first hit is shaded once and paths split there.
    """
    if dr.hint(secondary_samples == 1, mode="scalar"):
        end = follow(scene, transport, sampler, camera_path(ray), active)
        radiance = end.radiance + end.weight * cache.irradiance(end.row) * dr.inv_pi
        return radiance, end.distance, end.valid

    # ---------------------- First vertex, shaded once ----------------------

    pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    if dr.hint(transport.hide_emitters, mode="scalar"):
        pi = skip_sources(scene, ray, pi, active)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    hit = active & si.is_valid()
    bsdf = si.bsdf(ray)
    smooth = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    cell, _, found = transport.patches.find_cell(
        si.p, facing(si, ray), transport.object_ids(si), smooth
    )

    emitted = si.emitter(scene).eval(si, active & (not transport.hide_emitters))
    nowhere = mi.Bool(False)
    radiance = emitted + sample_sources(
        scene, si, bsdf, sampler, mi.UInt32(transport.shadow_samples), nowhere, nowhere, smooth
    )

    # ---------------------- Secondary rays, stratified ----------------------

    ctx = mi.BSDFContext()
    beyond = replace(transport, hide_emitters=False)
    valid = ~si.is_valid() & (scene.environment() is not None and not transport.hide_emitters)
    sum_ = mi.Spectrum(0)
    i = mi.UInt32(0)
    pending = mi.Bool(hit)
    while dr.hint(pending, exclude=[transport, beyond, cache, bsdf], label="Secondary rays"):
        u = (mi.Float(i) + sampler.next_1d()) / mi.Float(secondary_samples)
        bs, weight = bsdf.sample(ctx, si, u, sampler.next_2d(), pending)
        start = leave(transport, sampler, si, bs, cell, found)
        end = follow(scene, beyond, sampler, start, pending & (dr.max(weight) > 0))
        sum_ += weight * (end.radiance + end.weight * cache.irradiance(end.row) * dr.inv_pi)
        valid |= end.valid | (pending & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null))
        i += 1
        pending &= i < secondary_samples
    return radiance + sum_ / secondary_samples, si.t, valid


def leave(transport, sampler, si, bs, cell, found):
    """The path that leaves a camera hit in a sampled direction."""
    specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    start = PathState(
        ray=si.spawn_ray(si.to_world(bs.wo)),
        depth=dr.select(specular, mi.UInt32(0), mi.UInt32(1)),
        origin=mi.Interaction3f(si),
        pdf=bs.pdf,
        specular=specular,
        bounded=mi.Bool(False),
        cluster=mi.UInt32(0),
    )
    if transport.far_field is not None:
        start.cluster, start.bounded, start.ray.maxt = transport.far_field.bound(
            cell, start.ray, bs.pdf, specular, sampler.next_1d(), found
        )
    return start
