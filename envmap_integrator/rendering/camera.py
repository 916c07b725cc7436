"""Radiance along camera and bake rays."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from .ray_counts import Ray, count
from .transport import (
    PathState,
    Transport,
    Vertex,
    camera_path,
    facing,
    follow,
    is_wide,
    sample_sources,
    skip_sources,
)


def camera_radiance(
    scene: mi.Scene,
    transport: Transport,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    active: mi.Bool,
    secondary_samples: int,
) -> tuple[mi.Spectrum, mi.Float, mi.Bool]:
    """Radiance [W/m²/sr] along rays, distance to the first hit, whether there was one.

    Where the cache may end a path at once (``gather_depth`` 0) there are no secondary rays.
    """
    if transport.gather_depth == 0:
        end = follow(scene, transport, sampler, camera_path(ray), active)
        return end.radiance, end.distance, end.valid
    return split(scene, transport, sampler, ray, active, secondary_samples)


@dr.syntax
def split(scene, transport, sampler, ray, active, secondary_samples):
    """Shade the first hit once and send secondary rays from it.

    The first vertex stands outside the loop over the others also for a single secondary ray: it
    needs no patch and those need hardly any shadow rays, which saves a fifth of the time.
    """
    # ---------------------- First vertex ----------------------

    count(Ray.PRIMARY, ray, active)
    pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    if dr.hint(transport.hide_emitters, mode="scalar"):
        pi = skip_sources(scene, ray, pi, active)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    hit = active & si.is_valid()
    bsdf = si.bsdf(ray)
    smooth = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    cube, mapped = None, smooth
    if dr.hint(transport.far_field is not None and transport.far_field.map_mirrors, mode="scalar"):
        mapped = hit
    object_id = transport.object_ids(si)
    cell, _, found = transport.patches.find_cell(si.p, facing(si, ray), object_id, mapped)
    if dr.hint(transport.far_field is not None, mode="scalar"):
        cube = transport.far_field.cube(cell, si.p, found)
    sources = transport.sources
    source_row = sources.row(cell, found)
    no = mi.Bool(False)
    vertex = Vertex(si, bsdf, sources, source_row, no, no, cube, mi.Float(1))

    emitted = si.emitter(scene).eval(si, active & (not transport.hide_emitters))
    n_shadow = transport.shadow_samples
    radiance = emitted + sample_sources(
        scene, vertex, sampler, mi.UInt32(n_shadow), n_shadow > 1, smooth
    )

    # ---------------------- Secondary rays ----------------------

    beyond = replace(transport, hide_emitters=False)
    valid = active & (scene.environment() is not None and not transport.hide_emitters)
    if dr.hint(secondary_samples == 1, mode="scalar"):
        u = sampler.next_1d()
        arriving, solid = secondary(scene, beyond, sampler, vertex, u, hit)
        radiance += arriving
        valid |= solid
    else:
        i = mi.UInt32(0)
        arriving = mi.Spectrum(0)
        pending = mi.Bool(hit)
        while dr.hint(pending, exclude=[beyond, vertex], label="Secondary rays"):
            u = (mi.Float(i) + sampler.next_1d()) / mi.Float(secondary_samples)
            one, solid = secondary(scene, beyond, sampler, vertex, u, pending)
            arriving += one
            valid |= pending & solid
            i += 1
            pending &= i < secondary_samples
        radiance += arriving / secondary_samples
    return radiance, dr.select(hit, si.t, dr.inf), valid


def secondary(scene, transport, sampler, vertex, u, active):
    """One secondary ray: radiance [W/m²/sr] that it brings, and whether the surface is solid."""
    si = vertex.si
    bs, weight = vertex.bsdf.sample(mi.BSDFContext(), si, u, sampler.next_2d(), active)
    specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    start = PathState(
        ray=si.spawn_ray(si.to_world(bs.wo)),
        depth=dr.select(specular, mi.UInt32(0), mi.UInt32(1)),
        origin=mi.Interaction3f(si),
        source_row=vertex.source_row,
        pdf=bs.pdf,
        specular=specular,
        bounded=mi.Bool(False),
        cluster=mi.UInt32(0),
        reach=mi.Float(dr.inf),
    )
    if vertex.cube is not None:
        wide = is_wide(si, bs.wo, bs.pdf) & ~specular
        start.cluster = vertex.cube.cluster
        start.bounded, start.ray.maxt, start.reach = transport.far_field.bound(
            vertex.cube, start.ray, wide, sampler.next_1d(), active
        )
    end = follow(scene, transport, sampler, start, active & (dr.max(weight) > 0))
    solid = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    return weight * end.radiance, end.valid | solid
