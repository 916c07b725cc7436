"""``source_selection``: direct and specular rays; diffuse indirect light from the cache."""

from __future__ import annotations

from ..transport.rules import PathRules
from .base import CachedIntegrator


class SourceSelection(CachedIntegrator):
    r"""
    Two-pass radiosity with source sampling (:monosp:`source_selection`)

    Direct light by shadow rays, specular reflection by rays; diffuse indirect light is read from
    the irradiance cache where the camera looks (Kok and Jansen 1991; paper section 3).

    .. pluginparameters::

     * - patches
       - |int|
       - Budget of patches of the coarse mesh, 16 … 4194304. (Default: by the number of camera
         samples, 8192 … 16384)
     * - patch_samples
       - |int|
       - Gather rays and shadow rays per patch, a power of two. (Default: by the number of camera
         samples, 128 … 256)
     * - shadow_samples
       - |int|
       - Shadow rays at a camera hit. (Default: 2)
     * - sampler
       - |string|
       - Sample points: ``coherent`` ones of our own, stratified in each pixel and much alike in
         neighbouring ones, one of Mitsuba's samplers, or ``scene`` for the scene's. Mitsuba's may
         round the samples per pixel up. (Default: coherent)
     * - cache_file
       - |string|
       - File with the baked state, from :monosp:`envmap-render bake`. (Default: none, bake now)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: false)
    """

    LEAST_PATCH_SAMPLES = 128
    """The cache is looked at directly, and its noise with it."""

    def rules(self, seed: int) -> PathRules:
        return PathRules(
            gather_depth=0, shadow_samples=self.shadow_samples, hide_emitters=self.hide_emitters
        )
