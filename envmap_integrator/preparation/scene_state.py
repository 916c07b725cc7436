"""Scenes at hand, for as long as nothing in them changes."""

from __future__ import annotations

import mitsuba as mi

from ..lookup.cube_map import CubeMap
from ..lookup.emitter_choice import EmitterChoice, Emitters
from ..lookup.far_field import FarField, far_field
from ..lookup.ids import ObjectIds
from ..lookup.lookup import Lookup
from ..system.fingerprint import SceneContent, SceneFingerprint
from .baked_state import BakedState


class SceneState:
    """A scene as it is now, and how kernels tell its objects apart.

    Other scenes of the same content have other objects, and shapes that move change places. Holding
    on to the scene, which holds its integrator, would keep both alive for ever.

    content       its objects and the arrays that their parameters are in
    fingerprint   hash of the values of these
    ids           ids of its shapes
    emitters      its emitters
    """

    def __init__(self, scene: mi.Scene, content: SceneContent, fingerprint: str):
        self.content, self.fingerprint = content, fingerprint
        self.ids, self.emitters = ObjectIds.of(scene), Emitters.of(scene)
        self._maps: tuple[tuple[CubeMap, ...], tuple, FarField] | None = None

    def lookup(self, baked: BakedState, maps: FarField | None) -> Lookup:
        """What paths look up in the scene, once it has been prepared."""
        choice = EmitterChoice(self.emitters, baked.emitter_table, baked.emitter_rows)
        return Lookup(baked.cache.patches, self.ids, choice, baked.cache, maps)

    def maps(
        self,
        scene: mi.Scene,
        baked: BakedState,
        n_samples: int,
        mip_bias: float,
        corrected: bool,
        map_mirrors: bool,
    ) -> FarField | None:
        """Its maps where kernels read them, uploaded once: see ``far_field``."""
        if not baked.maps:
            return None
        settings = n_samples, mip_bias, corrected, map_mirrors
        if self._maps is None or self._maps[0] is not baked.maps or self._maps[1] != settings:
            found = far_field(scene, baked.maps, baked.cluster_of_cell, *settings)
            self._maps = baked.maps, settings, found
        return self._maps[2]


class SceneStates:
    """The state of the last scene that was asked for."""

    def __init__(self):
        self._fingerprint = SceneFingerprint()
        self._last: SceneState | None = None

    def __call__(self, scene: mi.Scene) -> SceneState:
        """The same record as long as nothing in the scene has been replaced."""
        content = SceneContent(scene)
        if self._last is None or self._last.content != content:
            fingerprint = self._fingerprint.of(content)
            self._last = SceneState(scene, content, fingerprint)
        return self._last
