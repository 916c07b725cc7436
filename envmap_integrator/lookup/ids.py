"""Ids of the shapes of a scene, for kernels."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..system.jit import upload
from ..system.scene_order import lasting_ids, ordered_shapes


@dataclass(frozen=True)
class ObjectIds:
    """Id of the top-level shape under an interaction: see ``lasting_ids``.

    Dr.Jit's own registry ids are global to the process and change from run to run; these don't,
    so what is stored by object id can be saved.

    count   number of shapes
    table   id of each of Dr.Jit's ids
    """

    count: int
    table: mi.UInt32

    @classmethod
    def of(cls, scene: mi.Scene) -> ObjectIds:
        """Those of the shapes of a scene."""
        shapes = ordered_shapes(scene)
        registry_ids = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shapes)).numpy()
        table = np.zeros(int(registry_ids.max(initial=0)) + 1, dtype=np.uint32)
        table[registry_ids] = lasting_ids(shapes)
        return cls(len(shapes), upload(mi.UInt32, table))

    def __call__(self, si: mi.SurfaceInteraction3f) -> mi.UInt32:
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        instance = dr.reinterpret_array(mi.UInt32, si.instance)
        index = dr.select(instance != 0, instance, shape)
        return dr.gather(mi.UInt32, self.table, index, si.is_valid())
