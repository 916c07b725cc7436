"""Which emitter a shadow ray goes to, by what each is known to send to the place.

The paper's source selection: with one choice for all places, most shadow rays of a room with
several lamps are spent on those that hardly matter there.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..system.jit import upload
from ..system.scene_order import ordered_emitters

#: Largest number below 1.
ALMOST_ONE = 1 - 2**-24


@dataclass(frozen=True)
class Emitters:
    """The emitters of a scene, as ``ordered_emitters`` counts them.

    count      number of emitters L
    size       [1]  the same where kernels read it as data: other numbers compile nothing
    pointers   [L]
    table      index of each of Dr.Jit's ids
    weights    [L]  their ``sampling_weight``, in sum 1
    """

    count: int
    size: mi.UInt32
    pointers: mi.EmitterPtr
    table: mi.UInt32
    weights: np.ndarray

    @classmethod
    def of(cls, scene: mi.Scene) -> Emitters:
        """Those of a scene."""
        emitters = ordered_emitters(scene)
        count, pointers = len(emitters), mi.EmitterPtr(emitters)
        weights = np.array([emitter.sampling_weight() for emitter in emitters], dtype=np.float64)
        weights /= max(weights.sum(), 1e-30)
        registry_ids = dr.reinterpret_array(mi.UInt32, pointers).numpy()
        table = np.zeros(int(registry_ids.max(initial=0)) + 1, dtype=np.uint32)
        table[registry_ids] = np.arange(count, dtype=np.uint32)
        size = dr.opaque(mi.UInt32, count)
        return cls(count, size, pointers, upload(mi.UInt32, table), weights)

    def index(self, emitter: mi.EmitterPtr, active: mi.Bool | bool = True) -> mi.UInt32:
        """Index of each emitter."""
        return dr.gather(mi.UInt32, self.table, dr.reinterpret_array(mi.UInt32, emitter), active)


@dataclass(frozen=True)
class EmitterChoice:
    """Probabilities of the emitters in each large cell of the coarse mesh, and anywhere else.

    emitters      the L emitters to choose from
    table         [R * L * 4]  alias tables (Walker 1974): where the first emitter's share of a bin
                               ends, the second emitter, and the probabilities of both
    row_of_cell   [C]          row for each large cell, [1] if it's the same for all; the last row
                               is that of all other places
    """

    emitters: Emitters
    table: mi.Float
    row_of_cell: mi.UInt32

    def row(self, cell: mi.UInt32, found: mi.Bool) -> mi.UInt32:
        """Row of the table for places in a large cell, if they are in one."""
        n_rows = dr.width(self.table) // (4 * max(self.emitters.count, 1))
        last = dr.opaque(mi.UInt32, max(n_rows - 1, 0))
        cell = dr.minimum(cell, dr.opaque(mi.UInt32, dr.width(self.row_of_cell) - 1))
        return dr.select(found, dr.gather(mi.UInt32, self.row_of_cell, cell, found), last)

    def sample_direction(
        self, ref: mi.Interaction3f, row: mi.UInt32, u: mi.Point2f, active: mi.Bool | bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Choose an emitter and a direction to it: ``(ds, weight)``, as Mitsuba's scene does.

        Visibility isn't tested.
        """
        if self.emitters.count == 0:
            return dr.zeros(mi.DirectionSample3f, dr.width(ref)), mi.Spectrum(0)
        n, u = self.emitters.size, mi.Point2f(u)
        u.x *= mi.Float(n)
        bin_ = dr.minimum(mi.UInt32(u.x), n - 1)
        u.x -= mi.Float(bin_)
        entry = dr.gather(mi.Vector4f, self.table, row * n + bin_, active)
        first = u.x < entry.x
        index = dr.select(first, bin_, mi.UInt32(entry.y))
        probability = dr.select(first, entry.z, entry.w)
        u.x = dr.select(first, u.x / entry.x, (u.x - entry.x) / (1 - entry.x))
        u.x = dr.clip(u.x, 0, ALMOST_ONE)
        emitter = dr.gather(mi.EmitterPtr, self.emitters.pointers, index, active)
        ds, weight = emitter.sample_direction(ref, u, active)
        ds.pdf *= probability
        return ds, weight * dr.rcp(probability)

    def pdf_direction(
        self,
        ref: mi.Interaction3f,
        row: mi.UInt32,
        ds: mi.DirectionSample3f,
        active: mi.Bool | bool,
    ) -> mi.Float:
        """Density [1/sr] of ``sample_direction``."""
        n = self.emitters.size
        index = self.emitters.index(ds.emitter, active)
        probability = dr.gather(mi.Float, self.table, 4 * (row * n + index) + 2, active)
        return ds.emitter.pdf_direction(ref, ds, active) * probability
