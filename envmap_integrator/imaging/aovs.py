"""What there is to know of the surface that a camera ray sees, as AOVs.

They are named as those of Mitsuba's ``aov``: ``name:type, name:type``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..lookup.lookup import Lookup
from ..system.jit import mix, unit
from ..transport.camera import CameraSample, camera_radiance
from ..transport.rules import PathRules
from ..transport.served import served
from ..transport.vertex import Vertex

#: Channels of each type.
TYPES = {
    "patch": "RGB",
    "irradiance": "RGB",
    "indirect_irradiance": "RGB",
    "irradiance_error": "Y",
    "cluster": "RGB",
    "served": "RGB",
    "near": "Y",
}
#: Brightness of the colours of patches that stand for indirect light alone.
UNEVEN = 0.4
#: 2³² over the golden ratio: multiples of it spread evenly over a circle of hues.
GOLDEN = 0x9E3779B9


@dataclass(frozen=True)
class Aov:
    """An AOV: its name in the film, and its type."""

    name: str
    type: str

    def channels(self) -> list[str]:
        """Names of its channels."""
        return [f"{self.name}.{channel}" for channel in TYPES[self.type]]


def parse_aovs(text: str, owner: str) -> tuple[Aov, ...]:
    """AOVs from ``name:type, name:type``; ``ValueError``, in the name of ``owner``, for others."""
    found: dict[str, Aov] = {}
    for entry in filter(None, (entry.strip() for entry in text.split(","))):
        name, _, kind = (part.strip() for part in entry.partition(":"))
        if not name or kind not in TYPES:
            raise ValueError(
                f'{owner}: "aovs" must list name:type, not "{entry}"; types are {", ".join(TYPES)}'
            )
        if name in found:
            raise ValueError(f'{owner}: "aovs" has two of the name "{name}"; rename one')
        found[name] = Aov(name, kind)
    return tuple(found.values())


def camera_sample(
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    aovs: tuple[Aov, ...],
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    active: mi.Bool,
) -> CameraSample:
    """What rays of a sensor find, with AOVs of it."""
    found = camera_radiance(scene, lookup, rules, sampler, ray, active)
    if not aovs:
        return found
    # After all else, so that the picture takes the same random numbers.
    return replace(found, aovs=_values(aovs, scene, lookup, rules, sampler, found.vertex))


def _values(
    aovs: tuple[Aov, ...],
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    sampler: mi.Sampler,
    vertex: Vertex,
) -> list[mi.Float]:
    """Values of the channels of AOVs at a camera hit, 0 where there is none.

    All of them are exact, what is stored for the very place, but ``served`` and ``near``, which
    tell of one secondary ray.
    """
    patch = lookup.patches.find(
        vertex.si.p, vertex.normal, vertex.object_id, vertex.cell, vertex.hit
    )
    cache = lookup.cache
    ends = ()
    if any(aov.type in ("served", "near") for aov in aovs):
        ends = served(scene, lookup, rules, sampler, vertex)

    def value(kind: str) -> tuple[mi.Float, ...]:
        match kind:
            case "patch":
                shade = dr.select(patch.found, dr.select(patch.even, 1, UNEVEN), 0)
                return tuple(shade * c for c in false_colour(patch.index))
            case "irradiance":
                return cache.rgb(2 * patch.index, patch.found)
            case "indirect_irradiance":
                return cache.rgb(2 * patch.index + 1, patch.found)
            case "irradiance_error":
                return (dr.gather(mi.Float, cache.error, 2 * patch.index, patch.found),)
            case "cluster":
                if vertex.cube is None:
                    return (mi.Float(0),) * 3
                colour = false_colour(vertex.cube.cluster)
                return tuple(dr.select(vertex.cube.valid, c, 0) for c in colour)
            case "served":
                return ends[:3]
            case "near":
                return ends[3:]

    return [channel for aov in aovs for channel in value(aov.type)]


def false_colour(index: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.Float]:
    """A colour for a number, sRGB in [0, 1], unlike those of the numbers beside it."""
    hue = 6 * unit(index * GOLDEN)
    ramps = dr.abs(hue - 3) - 1, 2 - dr.abs(hue - 2), 2 - dr.abs(hue - 4)
    brightness = 0.6 + 0.4 * unit(mix(index + 1))
    return tuple(brightness * (0.3 + 0.7 * dr.clip(ramp, 0, 1)) for ramp in ramps)
