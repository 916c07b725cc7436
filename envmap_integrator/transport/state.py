"""Where paths start, where they are, and what they have found."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .rules import PathRules


@dataclass
class PathStart:
    """Where a path starts.

    ray             its first ray
    depth           non-specular bounces behind it
    origin          the vertex it comes from, for the MIS weight of the emitters it hits
    emitter_row     of the choice among emitters there
    pdf, specular   density [1/sr] with which the direction was sampled; no density if specular
    bounded         whether ``ray.maxt`` ends it at the cube of ``cluster``
    reach           distance [world units] up to which the ray counts the emitters that it hits;
                    shadow rays alone count those beyond
    primary         whether its first ray is what a sensor or a texel sees
    solid           whether it has met more than what lets light straight through: else the sky
                    isn't shown if emitters are hidden
    """

    ray: mi.Ray3f
    depth: mi.UInt32
    origin: mi.Interaction3f
    emitter_row: mi.UInt32
    pdf: mi.Float
    specular: mi.Bool
    bounded: mi.Bool | bool = False
    cluster: mi.UInt32 | int = 0
    reach: mi.Float | float = dr.inf
    primary: bool = False
    solid: mi.Bool | bool = False


@dataclass
class PathEnd:
    """What a path found: ``radiance + weight * E[row] / pi`` is the light it brings.

    radiance   [W/m²/sr]  from emitters, maps and the cache, if there is one yet
    direct     [W/m²/sr]  the part of it that came from emitters on the first ray
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

    @staticmethod
    def nothing(scene: mi.Scene, rules: PathRules, start: PathStart, active: mi.Bool) -> PathEnd:
        """What a path has found before it starts."""
        # As in path, a visible environment is never transparent.
        shown = scene.environment() is not None and not rules.hide_emitters
        return PathEnd(
            radiance=mi.Spectrum(0),
            direct=mi.Spectrum(0),
            weight=mi.Spectrum(0),
            row=mi.UInt32(0),
            place=mi.UInt32(0),
            valid=start.solid | (active & shown),
            distance=mi.Float(dr.inf),
        )


@dataclass
class Path:
    """A path on its way: the state of the loop.

    active               whether it goes on
    ray                  where it goes
    depth, bounces       non-specular bounces so far, and all bounces of this call
    origin               previous vertex,
    emitter_row          ... choice among emitters there,
    pdf                  ... density [1/sr] of the direction sampled there,
    specular             ... whether emitters weren't sampled for it
    bounded, cluster     whether the ray ends where it leaves the cube of a cluster
    reach                distance beyond which emitters that are hit have been counted
    throughput, eta      β [1], and the relative index of refraction so far
    q                    probability of going on where the cache or a map could end the path
    """

    active: mi.Bool
    ray: mi.Ray3f
    depth: mi.UInt32
    bounces: mi.UInt32
    origin: mi.Interaction3f
    emitter_row: mi.UInt32
    pdf: mi.Float
    specular: mi.Bool
    bounded: mi.Bool
    cluster: mi.UInt32
    reach: mi.Float
    throughput: mi.Spectrum
    eta: mi.Float
    q: mi.Float

    @staticmethod
    def begin(start: PathStart, rules: PathRules, active: mi.Bool) -> Path:
        """A path at its start."""
        residual = rules.residual
        return Path(
            active=mi.Bool(active),
            ray=mi.Ray3f(start.ray),
            depth=mi.UInt32(start.depth),
            bounces=mi.UInt32(0),
            origin=mi.Interaction3f(start.origin),
            emitter_row=mi.UInt32(start.emitter_row),
            pdf=mi.Float(start.pdf),
            specular=mi.Bool(start.specular),
            bounded=mi.Bool(start.bounded),
            cluster=mi.UInt32(start.cluster),
            reach=mi.Float(start.reach),
            throughput=mi.Spectrum(1),
            eta=mi.Float(1),
            q=mi.Float(0) if residual is None else mi.Float(residual.probability),
        )


def camera_path(ray: mi.Ray3f) -> PathStart:
    """A path that starts at a sensor."""
    return PathStart(
        ray=ray,
        depth=mi.UInt32(0),
        origin=dr.zeros(mi.Interaction3f),
        emitter_row=mi.UInt32(0),
        pdf=mi.Float(1),
        specular=mi.Bool(True),
        primary=True,
    )
