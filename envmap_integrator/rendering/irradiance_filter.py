"""Neighbouring pixels share the indirect light that they have gathered.

Irradiance changes slowly where what it comes from is far away: by no more than the distance
between two points over the harmonic mean distance of what they see, and with the turn of the
normal (the split-sphere model of Ward, Rubinstein and Clear 1988). As irradiance caching does in
space, this filter averages it in the image over places between which it can't change by more than
a tolerance (Kontkanen, Räsänen and Keller 2004). Direct light, sources, gloss and textures aren't
touched.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

#: Pixels on each side that may contribute. What is farther away adds cost but hardly less noise.
RADIUS = 4
#: Relative change of irradiance that one sample per pixel allows for; with n samples it is n^(-1/6)
#: times that. The bias that it leaves grows with its square, the variance falls with its square:
#: so the sum of squared bias and variance is least for every n.
TOLERANCE = 0.5
#: Floats of a pixel's record: a cache line.
_RECORD = 16


@dataclass
class Gathered:
    """Indirect light that a surface seen by the camera has gathered, or sums of that.

    radiance   [W/m²/sr]  what its wide lobes reflect
    albedo     [1]        what that is in proportion to, while irradiance is the same
    normal     [3]        shading normal
    position   [3]        relative to a point near the scene, world units
    nearness   [1/m]      inverse distance of what the secondary ray hit
    weight     [1]        1 if there is such a surface, else all are zero
    """

    radiance: mi.Spectrum
    albedo: mi.Spectrum
    normal: mi.Vector3f
    position: mi.Vector3f
    nearness: mi.Float
    weight: mi.Float

    CHANNELS = ("radiance", "albedo", "normal", "position", "nearness", "weight")

    def channels(self) -> list[mi.Float]:
        """All numbers of it, in a fixed order."""
        values = []
        for name in self.CHANNELS:
            value = getattr(self, name)
            values += [value] if dr.depth_v(value) == 1 else [*value]
        return values

    def scaled(self, factor: mi.Spectrum | mi.Float) -> Gathered:
        """The same, seen with a throughput or a weight of the sensor [1]."""
        return replace(self, radiance=factor * self.radiance, albedo=factor * self.albedo)

    def where(self, mask: mi.Bool) -> Gathered:
        """The same where ``mask`` is set, and no surface elsewhere."""
        values = (dr.select(mask, getattr(self, name), 0) for name in self.CHANNELS)
        return Gathered(*values)

    @classmethod
    def count(cls) -> int:
        """Number of channels."""
        return 2 * len(mi.Spectrum()) + 8

    @classmethod
    def of_channels(cls, channels: list[mi.Float]) -> Gathered:
        """Inverse of ``channels``."""
        values = iter(channels)

        def take(kind):
            return kind(*(next(values) for _ in range(len(kind()))))

        return cls(
            radiance=take(mi.Spectrum),
            albedo=take(mi.Spectrum),
            normal=take(mi.Vector3f),
            position=take(mi.Vector3f),
            nearness=next(values),
            weight=next(values),
        )


def tolerance(n_samples: int) -> float:
    """Relative change of irradiance that is allowed for with so many samples per pixel."""
    return TOLERANCE * n_samples ** (-1 / 6)


def filter_irradiance(records: mi.Float, width: int, allowed: float) -> mi.Spectrum:
    """The gathered radiance of every pixel, from the irradiance around it.

    ``records`` are those of an image of ``width`` pixels, row by row; ``allowed`` is the
    ``tolerance``. The unit is that of the sums in the records.
    """
    result = _average(records, width, dr.opaque(mi.Float, 1 / allowed))
    dr.eval(result)
    return result


def pixel_records(gathered: Gathered) -> mi.Float:
    """What neighbours ask a pixel for, from sums over its samples [_RECORD * pixels]."""
    n_pixels = dr.width(gathered.weight)
    # What isn't finite would spread.
    finite = dr.isfinite(dr.sum(gathered.radiance) + dr.sum(gathered.albedo))
    shared = (gathered.weight > 0) & finite
    scale = dr.select(shared, dr.rcp(gathered.weight), 0)
    near = mi.Vector4f(gathered.nearness * scale)
    length = dr.sqrt(dr.squared_norm(gathered.normal))
    near.x, near.y, near.z = dr.select(shared & (length > 0), gathered.normal / length, 0)
    place = mi.Vector4f(dr.select(shared, mi.Float(1), 0))
    place.x, place.y, place.z = gathered.position * scale
    records = dr.empty(mi.Float, _RECORD * n_pixels)
    first = (_RECORD // 4) * dr.arange(mi.UInt32, n_pixels)
    colours = (_padded(gathered.radiance), _padded(gathered.albedo))
    for index, value in enumerate((near, place, *colours)):
        dr.scatter(records, value, first + index)
    dr.eval(records)
    return records


def _padded(colour: mi.Spectrum) -> mi.Vector4f:
    return mi.Vector4f(*colour, *[0] * (4 - len(colour)))


@dr.syntax
def _average(records, width, sharpness):
    n_pixels = dr.width(records) // _RECORD
    own = dr.arange(mi.UInt32, n_pixels)
    width_ = dr.opaque(mi.Int32, width)
    height_ = dr.opaque(mi.Int32, n_pixels // width)
    y, x = mi.Int32(own) // width_, mi.Int32(own) % width_
    near, place, radiance, albedo = _record(records, own, True)
    diameter = 2 * RADIUS + 1
    i = mi.UInt32(0)
    active = place.w > 0
    radiance_sum, albedo_sum = mi.Vector4f(radiance), mi.Vector4f(albedo)
    while dr.hint(active & (i < diameter * diameter), exclude=[records], label="Share irradiance"):
        dy = mi.Int32(i // diameter) - RADIUS
        dx = mi.Int32(i % diameter) - RADIUS
        # Falls off to all sides, so that no square shows around a bright pixel.
        taper = 1 - mi.Float(dx * dx + dy * dy) / (RADIUS + 1) ** 2
        inside = (x + dx >= 0) & (x + dx < width_) & (y + dy >= 0) & (y + dy < height_)
        inside &= ((dx != 0) | (dy != 0)) & (taper > 0)
        other = mi.UInt32((y + dy) * width_ + x + dx)
        its_near, its_place, its_radiance, its_albedo = _record(records, other, active & inside)
        distance = dr.norm(its_place.xyz - place.xyz)
        turn = dr.sqrt(dr.maximum(1 - dr.dot(its_near.xyz, near.xyz), 0))
        change = (distance * dr.maximum(its_near.w, near.w) + turn) * sharpness
        weight = taper * dr.exp(-dr.square(change))
        shared = inside & (its_place.w > 0)
        radiance_sum += dr.select(shared, weight * its_radiance, 0)
        albedo_sum += dr.select(shared, weight * its_albedo, 0)
        i += 1
    mean = dr.select(albedo_sum > 0, radiance_sum / albedo_sum, 0) * albedo
    mean = dr.select(albedo > 0, mean, radiance)
    return mi.Spectrum(*(mean[c] for c in range(len(mi.Spectrum()))))


def _record(records, pixel, active):
    """Normal and nearness; position and whether there is a surface; radiance; albedo."""
    first = (_RECORD // 4) * pixel
    return tuple(dr.gather(mi.Vector4f, records, first + i, active) for i in range(4))
