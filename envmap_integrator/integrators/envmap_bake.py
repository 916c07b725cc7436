"""``envmap_bake``: bakes the maps of ``envmap_hybrid``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..system.parameters import Parameters
from ..transport.camera import CameraSample
from ..transport.rules import PathRules, as_baked
from .base import CachedIntegrator


class EnvmapBake(CachedIntegrator):
    r"""
    Map baking integrator (:monosp:`envmap_bake`)

    Radiance as a cube map holds it: direct light by shadow rays, indirect light from the irradiance
    cache, specular surfaces followed; sources that the ray itself hits are left out, since the
    renderer samples them (paper section 2, "map generation").

    Nested in :monosp:`envmap_hybrid` under the name ``baker`` it fills the maps. As the integrator
    of a scene it shows what a map would hold from the sensor's place; the AOV ``distance`` is the
    distance [world units] to what is seen.

    .. pluginparameters::

     * - samples
       - |int|
       - Rays per texel, a power of two. (Default: 8)
     * - patches
       - |int|
       - Budget of patches of the coarse mesh, 16 … 4194304; unused when nested. (Default: by the
         number of camera samples, 8192 … 16384)
     * - patch_samples
       - |int|
       - Gather rays and shadow rays per patch, a power of two; unused when nested. (Default: by the
         number of camera samples, 32 … 256)
     * - shadow_samples
       - |int|
       - Shadow rays where a bake ray hits. (Default: 1)
     * - sampler
       - |string|
       - Sample points: ``coherent`` ones of our own, stratified in each pixel and much alike in
         neighbouring ones, one of Mitsuba's samplers, or ``scene`` for the scene's. Mitsuba's may
         round the samples per pixel up. (Default: coherent)
     * - cache_file
       - |string|
       - File with the baked state, from :monosp:`envmap-render bake`; unused when nested. (Default:
         none, bake now)
     * - hide_emitters
       - |bool|
       - No effect here: sources that the sensor's rays hit are left out in any case. (Default:
         false)
    """

    SHADOW_SAMPLES = 1

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.samples = Parameters(props).power_of_two("samples", 8, 1, 1 << 12)

    def rules(self, seed: int) -> PathRules:
        return as_baked(self.shadow_samples)

    def aov_names(self) -> list[str]:
        return ["distance"]

    def aov_values(self, found: CameraSample) -> list[mi.Float]:
        return [dr.select(found.valid, found.distance, 0)]
