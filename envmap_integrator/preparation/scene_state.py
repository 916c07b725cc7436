"""Scenes at hand, for as long as nothing in them changes."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from ..lookup.emitter_choice import EmitterChoice, Emitters
from ..lookup.far_field import FarField
from ..lookup.ids import ObjectIds
from ..lookup.lookup import Lookup
from ..system.fingerprint import SceneContent, SceneFingerprint
from .baked_state import BakedState


@dataclass(frozen=True)
class SceneState:
    """A scene as it is now, and how kernels tell its objects apart.

    Other scenes of the same content have other objects, and shapes that move change places. Holding
    on to the scene, which holds its integrator, would keep both alive for ever.

    content       its objects and the arrays that their parameters are in
    fingerprint   hash of the values of these
    ids           dense ids of its shapes
    emitters      its emitters
    """

    content: SceneContent
    fingerprint: str
    ids: ObjectIds
    emitters: Emitters

    def lookup(self, baked: BakedState, far_field: FarField | None) -> Lookup:
        """What paths look up in the scene, once it has been prepared."""
        choice = EmitterChoice(self.emitters, baked.emitter_table, baked.emitter_rows)
        return Lookup(baked.cache.patches, self.ids, choice, baked.cache, far_field)


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
            self._last = SceneState(content, fingerprint, ObjectIds(scene), Emitters(scene))
        return self._last
