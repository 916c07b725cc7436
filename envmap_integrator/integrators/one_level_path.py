"""``one_level_path``: the paper's "path tracing", one bounce and then the cache."""

from __future__ import annotations

from .base import GatheringIntegrator


class OneLevelPath(GatheringIntegrator):
    r"""
    One-level path tracing (:monosp:`one_level_path`)

    Direct light by shadow rays; secondary rays are traced in full and end in the irradiance cache
    at what they hit (Rushmeier 1988; paper section 3, "path tracing").

    .. pluginparameters::

     * - patches
       - |int|
       - Budget of patches of the coarse mesh, 16 … 4194304. (Default: by the number of camera
         samples, 8192 … 16384)
     * - patch_samples
       - |int|
       - Gather rays and shadow rays per patch, a power of two. (Default: by the number of camera
         samples, 32 … 256)
     * - shadow_samples
       - |int|
       - Shadow rays at a camera hit. (Default: 2)
     * - secondary_samples
       - |int|
       - Secondary rays at a camera hit. (Default: 1)
     * - residual_probability
       - |float|
       - Probability of tracing on where the cache or a map could end a path, to correct what they
         get wrong. Above 0 the mean is that of :monosp:`path`: there is no bias, but more
         noise, and pixels of few samples may fall below zero. (Default: 0)
     * - irradiance_filter
       - |bool|
       - Let neighbouring pixels share the indirect light that diffuse surfaces gather, where it
         can't differ by much. Off where ``residual_probability`` is above 0. (Default: true)
     * - indirect_aovs
       - |bool|
       - Also give the indirect light that diffuse surfaces gather, as AOVs: ``indirect`` as in the
         picture, ``gathered`` before pixels share it, and ``albedo``, what it's in proportion to.
         The denoiser takes it apart from direct light. (Default: false)
     * - aovs
       - |string|
       - AOVs as in Mitsuba's :monosp:`aov`, such as ``p:patch, s:served``: ``patch`` and
         ``cluster``, a colour for each; ``irradiance``, ``indirect_irradiance``,
         ``irradiance_error``: what the cache holds, and its standard error [W/m²]; ``served``: part
         of the secondary rays that were traced on (R), ended in the cache (G) or in a map (B);
         ``near``: part of them traced on as what they hit was too near for the cache.
         (Default: none)
     * - clamp_indirect
       - |float|
       - Largest radiance [W/m²/sr] that a secondary ray may bring: cuts fireflies, and the light of
         caustics with them. 0 cuts nothing. (Default: 0)
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
