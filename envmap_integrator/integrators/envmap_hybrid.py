"""``envmap_hybrid``: trace near, look up far."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import asdict, replace

import drjit as dr
import mitsuba as mi

from ..emitters.mipmap_cube import MipmapCube
from ..lookup.cube_map import MAX_RESOLUTION
from ..lookup.far_field import FarField
from ..preparation.baked_state import BakedState, Settings, StateKey, load
from ..preparation.pipeline import prepare
from ..preparation.scene_state import SceneState
from ..system.checks import check_scene
from ..system.interrupt import interruptible
from ..system.parameters import Parameters
from ..transport.rules import PathRules
from .base import GatheringIntegrator, camera_samples
from .envmap_bake import EnvmapBake


class EnvmapHybrid(GatheringIntegrator):
    r"""
    Environment mapping for diffuse interreflection (:monosp:`envmap_hybrid`)

    Secondary rays are traced only inside a cube around the cluster of objects they start from;
    those that leave it read a prefiltered map of what lies beyond, at the mip level that the
    density of the samples asks for. What they hit inside is shaded from the irradiance cache. Light
    sources are reached by shadow rays (Reinhard, Tijssen and Jansen 1994).

    Without any parameter, clusters are found automatically, and get maps if these are predicted to
    spare more than they cost; without maps, this is :monosp:`one_level_path`. Nested emitters
    :monosp:`mipmap_cube` with ``shapes`` list clusters instead, which get maps in any case; a
    nested :monosp:`envmap_bake` sets how maps are baked.

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
       - Shadow rays at a camera hit (paper: 16). (Default: 2)
     * - secondary_samples
       - |int|
       - Secondary rays at a camera hit (paper: 100). (Default: 1)
     * - gather_depth
       - |int|
       - Non-specular bounces before a path may end in the cache; each is bounded by the cube of the
         surface it starts from (paper Figure 2). (Default: 1)
     * - second_hit
       - |string|
       - Direct light where secondary rays end: ``cache`` takes it from the cache, ``shadow_rays``
         samples the sources there too. (Default: cache)
     * - lookup
       - |string|
       - ``corrected`` finds the far hit by the distance in the map; ``plain`` looks up the point
         where the ray leaves the cube, as the paper does. (Default: corrected)
     * - mirrors
       - |string|
       - ``trace`` follows mirrors and narrow lobes in full; ``map`` looks them up like all
         else. (Default: trace)
     * - maps
       - |string|
       - ``auto`` makes maps of automatic clusters if they are predicted to pay, ``always`` in any
         case. (Default: auto)
     * - no_cluster
       - |string|
       - Ids of shapes that belong to no automatic cluster, separated by commas. (Default: none)
     * - map_resolution
       - |int|
       - Texels along the edge of a map's face, a power of two up to 2048. (Default: 64)
     * - distance_ratio
       - |float|
       - Half width of a cube over the radius of its cluster, at least 1. (Default: 2)
     * - mip_bias
       - |float|
       - Levels added to every look-up, -32 … 32. Below 0, less blur: a texel covers a part of what
         the sample stands for. (Default: -2)
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

    .. tabs::
        .. code-tab:: xml

            <integrator type="envmap_hybrid">
                <float name="distance_ratio" value="3"/>
                <integrator type="envmap_bake" name="baker">
                    <integer name="samples" value="16"/>
                </integrator>
                <emitter type="mipmap_cube" id="desk">
                    <string name="shapes" value="table, ball"/>
                    <point name="center" x="0" y="1" z="0.5"/>
                </emitter>
            </integrator>

        .. code-tab:: python

            'type': 'envmap_hybrid',
            'distance_ratio': 3.0,
            'baker': {'type': 'envmap_bake', 'samples': 16},
            'desk': {'type': 'mipmap_cube', 'shapes': 'table, ball', 'center': [0, 1, 0.5]}
    """

    HAS_MAPS = True

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        parameters = Parameters(props)
        self.gather_depth = parameters.integer("gather_depth", 1, 1, 64)
        self.second_hit = parameters.choice("second_hit", "cache", ("cache", "shadow_rays"))
        self.lookup = parameters.choice("lookup", "corrected", ("corrected", "plain"))
        self.mirrors = parameters.choice("mirrors", "trace", ("trace", "map"))
        self.maps = parameters.choice("maps", "auto", ("auto", "always"))
        self.no_cluster = parameters.names("no_cluster")
        self.map_resolution = parameters.power_of_two("map_resolution", 64, 1, MAX_RESOLUTION)
        self.distance_ratio = parameters.number("distance_ratio", 2.0, 1.0)
        self.mip_bias = parameters.number("mip_bias", -2.0, -32.0, 32.0)

        self.baker = None
        requests = []
        for _, child in props.objects():
            if isinstance(child, EnvmapBake) and self.baker is None:
                self.baker = child
            elif isinstance(child, MipmapCube) and child.request is not None:
                requests.append(child.request)
            else:
                raise TypeError(
                    f'{self.owner}: the nested {child.class_name()} "{child.id()}" must be one '
                    'envmap_bake or a mipmap_cube with "shapes"'
                )
            for shape_id in self.no_cluster:
                if requests and shape_id in requests[-1].shapes:
                    raise ValueError(
                        f'{self.owner}: "no_cluster" names shape "{shape_id}", which mipmap_cube '
                        f'"{requests[-1].name}" lists; leave it out of one of them'
                    )
        self.requests = tuple(requests)
        self.baker = self.baker or mi.load_dict({"type": "envmap_bake"})

    def _parameters(self) -> dict[str, object]:
        return super()._parameters() | {"requests": [asdict(each) for each in self.requests]}

    def settings(self) -> Settings:
        return super().settings(
            maps=True,
            map_resolution=self.map_resolution,
            map_samples=self.baker.samples,
            map_shadow_samples=self.baker.shadow_samples,
            distance_ratio=self.distance_ratio,
            map_mirrors=self.mirrors == "map",
            map_always=self.maps == "always" or self.mirrors == "map",
            requests=self.requests,
            no_cluster=self.no_cluster,
        )

    def rebake(
        self, scene: mi.Scene, path: str | os.PathLike, clusters: Collection[str]
    ) -> BakedState:
        """The state in a file, with the maps of some of its clusters baked anew.

        The file is one of ``envmap-render bake`` or of ``prepare(scene).save``, for this scene and
        these settings but those of the ``clusters``. What comes out is what baking everything would
        make; the other maps and the irradiance cache are those of the file, to the bit.

        Raises ``ValueError`` for a cluster that isn't in the file, and for a file that is missing,
        damaged, or of another scene, other settings or another kind of machine.
        """
        check_scene(scene, self.owner)
        now, asked = self._scenes(scene), self.settings()
        key = StateKey(now.fingerprint, asked)
        old = load(path, key, f"{self.owner}:", len(scene.emitters()), but=clusters)
        names = [cube_map.cluster.name for cube_map in old.maps]
        for name in clusters:
            if name not in names:
                there = ", ".join(names) or "none"
                raise ValueError(
                    f'{self.owner}: {path} has no cluster "{name}", but {there}; name one of them, '
                    "or bake it whole"
                )
        kept = tuple(m for m in old.maps if m.cluster.name not in clusters)
        settings = asked.for_render(camera_samples(next(iter(scene.sensors()), None), 0))
        with interruptible(), dr.suspend_grad():
            new = prepare(scene, now, asked, settings, scene.sensors(), self.owner, kept)
        if not old.cache.same_as(new.cache):
            raise ValueError(
                f"{self.owner}: {path} has another irradiance cache than is made here, by another "
                "kind of machine or for another number of samples; bake it whole"
            )
        return new

    def rules(self, seed: int) -> PathRules:
        return replace(
            super().rules(seed),
            gather_depth=self.gather_depth,
            shadow_rays=self.second_hit == "shadow_rays",
        )

    def maps_for(
        self, scene: mi.Scene, now: SceneState, baked: BakedState, spp: int
    ) -> FarField | None:
        return now.maps(
            scene,
            baked,
            spp * self.secondary_samples,
            self.mip_bias,
            corrected=self.lookup == "corrected",
            map_mirrors=self.mirrors == "map",
        )
