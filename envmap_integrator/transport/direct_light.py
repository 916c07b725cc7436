"""Direct light by shadow rays, each emitter counted exactly once.

Emitters are reached by shadow rays and by the rays that hit them, weighted by multiple importance
sampling where both could, by one of them alone where the other can't.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..lookup.emitter_choice import EmitterChoice
from ..system.ray_counts import Ray, count
from .vertex import Vertex


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Weight [1] of a sample of density ``pdf_a`` that could also come from ``pdf_b``: the power
    heuristic (Veach 1997).
    """
    a2 = dr.square(pdf_a)
    weight = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.detach(dr.select(dr.isfinite(weight), weight, 0))


@dataclass
class WideShare:
    """Who else brings direct light to the wide lobes of a surface.

    lit     whether the cache brings all of it, so that shadow rays bring none
    alone   whether shadow rays bring all of it, as rays that wide lobes send on count no emitters
    boost   factor [1] on what shadow rays bring
    """

    lit: mi.Bool | bool = False
    alone: mi.Bool | bool = False
    boost: mi.Float | float = 1.0


def reflected(
    scene: mi.Scene,
    vertex: Vertex,
    share: WideShare,
    ds: mi.DirectionSample3f,
    em_weight: mi.Spectrum,
    bsdf_value: mi.Spectrum,
    bsdf_pdf: mi.Float,
    active: mi.Bool,
) -> mi.Spectrum:
    """Light [W/m²/sr] that a surface reflects from a sampled direction to an emitter.

    Traces the shadow ray. To wide lobes, shadow rays alone bring light from beyond the cube. (So
    many parameters, as ``bsdf.eval_pdf`` is called here or together with ``bsdf.sample``.)
    """
    si = vertex.si
    alone = mi.Bool(share.alone)
    if vertex.cube is not None:
        # The distance of an environment is made up.
        infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        beyond = infinite | (vertex.cube.exit(si.p, ds.d) < ds.dist)
        alone |= vertex.cube.valid & beyond
    wide = vertex.lobes.wide_share(si.to_local(ds.d), bsdf_value, active)
    of_wide = dr.select(share.lit, 0, wide * share.boost)
    of_wide *= dr.select(ds.delta, 1, mis_weight(ds.pdf, dr.select(alone, 0, bsdf_pdf)))
    of_others = (1 - wide) * dr.select(ds.delta, 1, mis_weight(ds.pdf, bsdf_pdf))
    light = bsdf_value * em_weight * (of_wide + of_others)
    active = active & (ds.pdf != 0) & (dr.max(light) > 0)
    ray = si.spawn_ray_to(ds.p)
    count(Ray.SHADOW, ray, active)
    active &= ~scene.ray_test(ray, active)
    return dr.select(active, light, 0)


def sample_emitter(
    scene: mi.Scene,
    emitters: EmitterChoice,
    vertex: Vertex,
    share: WideShare,
    u: mi.Point2f,
    active: mi.Bool,
) -> mi.Spectrum:
    """Direct light [W/m²/sr] reflected at a surface, by one shadow ray."""
    si = vertex.si
    ds, em_weight = emitters.sample_direction(si, vertex.emitter_row, u, active)
    value, pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
    return reflected(scene, vertex, share, ds, em_weight, value, pdf, active)


@dr.syntax
def sample_emitters(
    scene: mi.Scene,
    emitters: EmitterChoice,
    vertex: Vertex,
    share: WideShare,
    sampler: mi.Sampler,
    n: mi.UInt32,
    active: mi.Bool,
) -> mi.Spectrum:
    """Direct light [W/m²/sr] reflected at a surface, by ``n`` stratified shadow rays of a lane."""
    result = mi.Spectrum(0)
    i = mi.UInt32(0)
    active = mi.Bool(active)
    while dr.hint(active, exclude=[emitters, vertex, share], label="Shadow rays"):
        u = sampler.next_2d()
        u.x = (u.x + mi.Float(i)) / mi.Float(n)
        result += sample_emitter(scene, emitters, vertex, share, u, active)
        i += 1
        active &= i < n
    return result / mi.Float(n)


def sample_with_emitter(
    scene: mi.Scene,
    emitters: EmitterChoice,
    vertex: Vertex,
    share: WideShare,
    sampler: mi.Sampler,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.Float, mi.BSDFSample3f, mi.Spectrum]:
    """As ``sample_emitter``, and a direction sampled from the material, in a single call of it.

    Returns the light, the random number that chose a lobe, the direction and its weight.
    """
    si = vertex.si
    ds, em_weight = emitters.sample_direction(si, vertex.emitter_row, sampler.next_2d(), active)
    lobe = sampler.next_1d()
    value, pdf, bs, weight = vertex.bsdf.eval_pdf_sample(
        mi.BSDFContext(),
        si,
        si.to_local(ds.d),
        lobe,
        sampler.next_2d(),
        vertex.hit,
    )
    return reflected(scene, vertex, share, ds, em_weight, value, pdf, active), lobe, bs, weight
