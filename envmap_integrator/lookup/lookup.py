"""All that paths look up, in one record."""

from __future__ import annotations

from dataclasses import dataclass

from .emitter_choice import EmitterChoice
from .far_field import FarField
from .ids import ObjectIds
from .irradiance_cache import IrradianceCache
from .patches import Patches


@dataclass(frozen=True)
class Lookup:
    """What kernels read of a scene besides the scene itself.

    patches      the coarse mesh
    object_ids   ids of the shapes of the scene at hand
    emitters     how shadow rays choose an emitter
    cache        irradiance on the patches; None while it is being made, when a path's only end in
                 a patch is recorded
    far_field    maps of the clusters, or None to trace every ray in full
    """

    patches: Patches
    object_ids: ObjectIds
    emitters: EmitterChoice
    cache: IrradianceCache | None = None
    far_field: FarField | None = None
