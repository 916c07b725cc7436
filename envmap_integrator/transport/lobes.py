"""Lobes of materials: which of them cached irradiance may stand for, and the choice among them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..system.jit import mix, unit

#: Choices among the lobes of a surface that the cache serves: those that it can't stand for, such
#: as the gloss of a varnish, are found as many times more often as if one choice were made.
LOBE_CHOICES = 4


def is_diffuse(bsdf: mi.BSDFPtr) -> mi.Bool:
    """May the cache serve a material?

    Metals and glass, however rough, reflect by where the light comes from, which the cache doesn't
    know. In glass, a lobe chosen seldom has a low density besides, and looks wider than it is.
    """
    flags = bsdf.flags()
    transmits = mi.has_flag(flags, mi.BSDFFlags.GlossyTransmission)
    return mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection) & ~transmits


def is_delta(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Does a material do nothing but reflect and refract as perfect mirrors and glass?"""
    flags = bsdf.flags()
    return mi.has_flag(flags, mi.BSDFFlags.Delta) & ~mi.has_flag(flags, mi.BSDFFlags.Smooth)


def single_lobe(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Does a material scatter by diffuse reflection alone?"""
    others = mi.BSDFFlags.Glossy | mi.BSDFFlags.Delta | mi.BSDFFlags.DiffuseTransmission
    return (bsdf.flags() & int(others)) == 0


def only_wide(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Are all smooth lobes of a material diffuse reflection, wide by nature?"""
    flags = bsdf.flags()
    narrow = mi.BSDFFlags.Glossy | mi.BSDFFlags.DiffuseTransmission
    return (flags & int(narrow)) == 0


def wide_share(
    bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, pdf: mi.Float
) -> mi.Float:
    """Part [1] of the light reflected from ``wo`` for which cached irradiance may stand.

    ``wo`` is in the local frame, ``pdf`` [1/sr] the density with which the material samples it. As
    much as a cosine lobe would sample belongs to wide lobes, what exceeds it to gloss. (Gloss is
    brightest at grazing angles, where cosine lobes sample least: no single density tells the two
    apart.) Without gloss all is wide, also where bumps turn the cosine. The cache holds the side
    that the path arrived on: transmission never qualifies.
    """
    cosine = mi.Frame3f.cos_theta(wo)
    wide = dr.abs(cosine) * dr.inv_pi
    share = dr.select(only_wide(bsdf) | (pdf <= wide), 1, wide / pdf)
    return dr.select(mi.Frame3f.cos_theta(si.wi) * cosine > 0, share, 0)


@dataclass
class Scattered:
    """Where a path goes on from a surface.

    bs         the direction,
    weight     [1]  ... what the path is multiplied by, zero if it goes nowhere,
    specular   ... whether it is that of a mirror or of glass,
    wide       ... and whether it belongs to the lobes that the cache may stand for
    """

    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    specular: mi.Bool
    wide: mi.Bool

    @staticmethod
    def of(
        bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f, weight: mi.Spectrum
    ) -> Scattered:
        """A direction that a material has sampled.

        Broken meshes have shading normals that are no numbers. Rays along such hit nothing, as if
        they had left the scene: the sky would shine into closed rooms.
        """
        weight = dr.select(dr.squared_norm(si.to_world(bs.wo)) > 0, weight, 0)
        specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        # Any random bits do to tell which lobe a direction is of.
        u = unit(mix(dr.reinterpret_array(mi.UInt32, bs.wo.x)))
        wide = (u < wide_share(bsdf, si, bs.wo, bs.pdf)) & ~specular
        return Scattered(bs, weight, specular, wide)


@dr.syntax
def choose_lobes(
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    sampler: mi.Sampler,
    active: mi.Bool,
    residual: mi.Bool,
) -> tuple[mi.Spectrum, Scattered]:
    """Sample a material ``LOBE_CHOICES`` times, stratified over its lobes.

    Returns the weight [1] of the wide lobes, for which the cache stands, and one direction for all
    that it can't stand for. Where a ``residual`` is to be estimated, that may be one of a wide
    lobe, though less often.
    """
    count = LOBE_CHOICES
    cached, weight = mi.Spectrum(0), mi.Spectrum(0)
    bs = dr.zeros(mi.BSDFSample3f)
    wide, i, chances = mi.Bool(False), mi.UInt32(0), mi.Float(0)
    active = mi.Bool(active)
    u = sampler.next_1d()
    while dr.hint(active, exclude=[bsdf, si, residual], label="Choose lobes"):
        lobe = (mi.Float(i) + u) / count
        one = Scattered.of(
            bsdf, si, *bsdf.sample(mi.BSDFContext(), si, lobe, sampler.next_2d(), active)
        )
        cached += dr.select(one.wide, one.weight, 0)
        chance = dr.select(one.wide, dr.select(residual, mi.Float(1), 0), count - 1)
        chance = dr.select(dr.max(one.weight) > 0, chance, 0)
        chances += chance
        taken = sampler.next_1d() * chances < chance
        bs = dr.select(taken, one.bs, bs)
        wide = dr.select(taken, one.wide, wide)
        weight = dr.select(taken, one.weight / chance, weight)
        i += 1
        active &= i < count
    specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    return cached / count, Scattered(bs, weight * chances / count, specular, wide)
