"""Lobes of materials: which of them cached irradiance may stand for, and the choice among them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..system.jit import mean_channel, mix, unit

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


def lets_all_pass(bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
    """Is there a hole in a surface, by the ``mask`` that cuts it out?"""
    cut = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
    return cut & (dr.min(bsdf.eval_null_transmission(si, cut)) >= 1)


def single_lobe(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Does a material scatter by diffuse reflection alone?"""
    others = mi.BSDFFlags.Glossy | mi.BSDFFlags.Delta | mi.BSDFFlags.DiffuseTransmission
    return (bsdf.flags() & int(others)) == 0


def only_wide(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Are all smooth lobes of a material diffuse reflection, wide by nature?"""
    flags = bsdf.flags()
    narrow = mi.BSDFFlags.Glossy | mi.BSDFFlags.DiffuseTransmission
    return (flags & int(narrow)) == 0


@dataclass
class Scattered:
    """Where a path goes on from a surface.

    bs         the direction,
    weight     [1]  ... what the path is multiplied by, zero if it goes nowhere,
    specular   ... whether it is that of a mirror or of glass,
    wide       ... and whether it belongs to the lobes that the cache may stand for
    lobe       the random number that has chosen among the lobes
    """

    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    specular: mi.Bool
    wide: mi.Bool
    lobe: mi.Float


@dataclass
class Lobes:
    """The lobes of a material at a surface.

    bsdf, si
    every      whether all of them but perfect mirrors are wide
    most       [1]  reflectance of a diffuse lobe that is beside others
    """

    bsdf: mi.BSDFPtr
    si: mi.SurfaceInteraction3f
    every: mi.Bool
    most: mi.Spectrum

    @staticmethod
    def of(bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, active: mi.Bool | bool) -> Lobes:
        """Those of what ``si`` has hit."""
        every = only_wide(bsdf)
        return Lobes(bsdf, si, every, bsdf.eval_diffuse_reflectance(si, active & ~every))

    def wide_share(
        self, wo: mi.Vector3f, value: mi.Spectrum, active: mi.Bool | bool = True
    ) -> mi.Spectrum:
        """Part [1] of the light reflected from ``wo`` for which cached irradiance may stand.

        ``wo`` is in the local frame, and ``value`` the BSDF there, times the cosine. What it is by
        its diffuse lobe is wide, the rest is gloss. Some materials can't tell their lobes apart: of
        those it's as much as a Lambertian surface of their reflectance would have. Without gloss
        all is wide, also where bumps turn the cosine. The cache holds the side that the path
        arrived on: transmission never qualifies.
        """
        diffuse = self.bsdf.eval(_diffuse_lobe(), self.si, wo, active & ~self.every)
        cosine = mi.Frame3f.cos_theta(wo)
        diffuse = dr.minimum(diffuse, self.most * dr.abs(cosine) * dr.inv_pi)
        all_of_it = self.every | (diffuse >= value)
        share = mi.Spectrum(dr.select(all_of_it, mi.Spectrum(1), diffuse / value))
        return dr.select(mi.Frame3f.cos_theta(self.si.wi) * cosine > 0, share, 0)

    def albedo(self, u: mi.Point2f, active: mi.Bool | bool = True) -> mi.Spectrum:
        """What the light that wide lobes reflect is in proportion to [1], on average over ``u``.

        Beside others, a diffuse lobe isn't in proportion to its reflectance: light goes to and fro
        below a varnish, and materials are blended. It's what it reflects from a direction ``u`` in
        the unit square, by the cosine.
        """
        alone = single_lobe(self.bsdf)
        wo = mi.warp.square_to_cosine_hemisphere(u)
        cosine = dr.maximum(wo.z, 1e-3)  # Where it's 0, so is what is reflected.
        wo.z = dr.mulsign(wo.z, self.si.wi.z)
        beside = self.bsdf.eval(_diffuse_lobe(), self.si, wo, active & ~alone) * dr.pi / cosine
        beside = dr.select(self.every, beside, dr.minimum(beside, self.most))
        return dr.select(alone, self.bsdf.eval_diffuse_reflectance(self.si, active), beside)

    def scattered(self, lobe: mi.Float, bs: mi.BSDFSample3f, weight: mi.Spectrum) -> Scattered:
        """A direction that the material has sampled, by the random number ``lobe`` among others.

        Broken meshes have shading normals that are no numbers. Rays along such hit nothing, as if
        they had left the scene: the sky would shine into closed rooms.
        """
        weight = dr.select(dr.squared_norm(self.si.to_world(bs.wo)) > 0, weight, 0)
        specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        share = self.wide_share(bs.wo, weight * bs.pdf, ~specular)
        share = dr.select(specular, 0, share)
        # Any random bits do to tell which lobe a direction is of.
        u = unit(mix(dr.reinterpret_array(mi.UInt32, bs.wo.x)))
        chance = mean_channel(share * weight) / mean_channel(weight)
        wide = u < chance
        part = dr.select(wide, share / chance, (1 - share) / (1 - chance))
        weight = dr.select(dr.max(weight) > 0, weight * part, 0)
        return Scattered(bs, weight, specular, wide, lobe)


def _diffuse_lobe() -> mi.BSDFContext:
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.DiffuseReflection
    return context


@dr.syntax
def choose_lobes(
    lobes: Lobes,
    first: Scattered,
    sampler: mi.Sampler,
    active: mi.Bool,
    residual: mi.Bool,
) -> tuple[mi.Spectrum, Scattered]:
    """Sample a material ``LOBE_CHOICES`` times, stratified over its lobes; ``first`` is a sample.

    Returns the weight [1] of the wide lobes, for which the cache stands, and one direction for all
    that it can't stand for. Where a ``residual`` is to be estimated, that may be one of a wide
    lobe, though less often.
    """
    count = LOBE_CHOICES
    cached, weight = mi.Spectrum(0), mi.Spectrum(0)
    bs = dr.zeros(mi.BSDFSample3f)
    wide, i, chances = mi.Bool(False), mi.UInt32(0), mi.Float(0)
    active = mi.Bool(active)
    one = dr.copy(first)
    while dr.hint(active, exclude=[lobes, residual], label="Choose lobes"):
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
        lobe = one.lobe + 1 / count
        lobe -= dr.floor(lobe)
        sample = lobes.bsdf.sample(mi.BSDFContext(), lobes.si, lobe, sampler.next_2d(), active)
        one = lobes.scattered(lobe, *sample)
    specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    return cached / count, Scattered(bs, weight * chances / count, specular, wide, first.lobe)
