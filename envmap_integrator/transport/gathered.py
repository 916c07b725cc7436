"""What a surface seen by the camera gathers, which pixels may share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..system.spectrum import colour, colour_type


@dataclass
class Gathered:
    """Indirect light that a surface seen by the camera has gathered, or sums of that.

    radiance   [W/m²/sr]  what its wide lobes reflect
    albedo     [1]        what that is in proportion to, while irradiance is the same: where there
                          are wavelengths, weighted by the hue of light
    normal     [3]        shading normal
    position   [3]        relative to a point near the scene, world units
    nearness   [1/m]      inverse distance of what the secondary ray hit
    weight     [1]        1 if there is such a surface, else all are zero; in sums, what the
                          three above are weighted by
    """

    radiance: mi.Spectrum | mi.Color3f
    albedo: mi.Spectrum | mi.Color3f
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

    def to_add(self, wavelengths: mi.Color0f | mi.Spectrum) -> Gathered:
        """The same with what adds up over samples of any wavelengths [nm], and of any surfaces.

        Each counts by what it reflects, as its irradiance does. So a pixel that sees one through a
        pane and another mirrored in it is somewhere between them, and as far from a pixel where the
        first is darker as their irradiance is unlike.
        """
        radiance, albedo = (colour(x, wavelengths) for x in (self.radiance, self.albedo))
        # Not their mean: dividing isn't the same to the last bit in kernels of other pixels.
        weight = self.weight * dr.abs(dr.sum(self.albedo))
        guides = (weight * x for x in (self.normal, self.position, self.nearness))
        return Gathered(radiance, albedo, *guides, weight)

    @classmethod
    def count(cls) -> int:
        """Number of channels."""
        return 2 * len(colour_type()()) + 8

    @classmethod
    def of_channels(cls, channels: list[mi.Float]) -> Gathered:
        """Inverse of ``channels``."""
        values = iter(channels)

        def take(kind):
            return kind(*(next(values) for _ in range(len(kind()))))

        return cls(
            radiance=take(colour_type()),
            albedo=take(colour_type()),
            normal=take(mi.Vector3f),
            position=take(mi.Vector3f),
            nearness=next(values),
            weight=next(values),
        )
