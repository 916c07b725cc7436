"""How paths go: what tells the algorithms of the paper (its section 3) apart.

======================  ============  ====
algorithm               gather_depth  maps
======================  ============  ====
``envmap_hybrid``       1             yes
``one_level_path``      1             no
``source_selection``    0             no
``envmap_bake``         0             no
======================  ============  ====
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi

from ..system.jit import LANES_ALIKE, mix, unit


@dataclass(frozen=True)
class Residual:
    """Estimate by further tracing what cache and maps get wrong, now and then.

    Where a path could end with light B of the cache or a map, it goes on with probability q and
    finds light X; B + (X - B) / q then stands for it, B otherwise. The mean is that of X whatever
    B is: an unbiased control variate.

    probability   q at the first opportunity of a path
    seed          of the decisions
    """

    probability: mi.Float
    seed: mi.UInt32

    def of_sample(self, index: mi.UInt32, lane: mi.UInt32) -> Residual:
        """Those of a sample of a pixel; ``lane`` tells which pixels decide alike."""
        group = lane // LANES_ALIKE
        return replace(self, seed=mix(self.seed + index) ^ group * 0x9E3779B1)

    def decision(self, bounces: mi.UInt32) -> mi.Float:
        """A random number in [0, 1) for each bounce of the lanes that share registers."""
        return unit(mix(mix(self.seed) + bounces))


@dataclass(frozen=True)
class PathRules:
    """How far a path goes before it uses what there is to look up, and what it counts.

    gather_depth        non-specular bounces before the cache may end the path
    secondary_samples   secondary rays at a camera hit
    shadow_samples      shadow rays at a camera hit; further on it's one
    shadow_rays         direct light by shadow rays also where the cache could give it
    emission            whether emitters count where the first ray hits them
    hide_emitters       emitters seen by camera rays are left out, as in Mitsuba
    residual            how the errors of cache and maps are estimated, or None to leave them
    clamp               largest radiance [W/m²/sr] that a secondary ray may bring, or None
    """

    gather_depth: int = 1
    secondary_samples: int = 1
    shadow_samples: int = 1
    shadow_rays: bool = False
    emission: bool = True
    hide_emitters: bool = False
    residual: Residual | None = None
    clamp: mi.Float | None = None

    def of_sample(self, index: mi.UInt32, lane: mi.UInt32) -> PathRules:
        """The same; each sample of a pixel decides anew where residuals are estimated, in one way
        for pixels whose lanes share registers.
        """
        residual = self.residual and self.residual.of_sample(index, lane)
        return replace(self, residual=residual)


def as_baked(shadow_samples: int) -> PathRules:
    """Rules for what maps hold (paper section 2): paths end in the cache at once, and emitters that
    they see at once don't count, as the renderer samples them.
    """
    return PathRules(gather_depth=0, emission=False, shadow_samples=shadow_samples)
