"""The coarse mesh while it is made: patches, and the surface points that they were built over."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from ...lookup.patches import DROPPED, UNEVEN, Patches
from ...system.jit import upload
from .surface_points import SurfacePoints


@dataclass(frozen=True)
class CoarseMesh:
    """Patches over surface points, and where each of the N points belongs.

    points           what the mesh is built over
    patches          what kernels find of it
    patch_of_point   [N]  index of the patch that a point stands for, -1 if it stands for none
    cell_of_point    [N]  index of its large cell, -1 if it has none
    space_of_point   [N]  its space (``find_spaces``), counted from 0; -1 if that isn't known
    """

    points: SurfacePoints
    patches: Patches
    patch_of_point: np.ndarray
    cell_of_point: np.ndarray
    space_of_point: np.ndarray

    def parts(self) -> mi.UInt32:
        """Which of its ``PARTS`` of a patch each point [N] lies in."""
        place = self.points.places()
        return self.patches.part(place[0], self.patches.locate(*place).patch_size)

    def without(self, dropped: np.ndarray) -> CoarseMesh:
        """The mesh without some patches [P]: paths that come there are traced on."""
        kept = (self.patch_of_point >= 0) & ~dropped[self.patch_of_point]
        return replace(
            self,
            patches=_marked(self.patches, dropped, DROPPED),
            patch_of_point=np.where(kept, self.patch_of_point, -1),
        )

    def with_uneven(self, uneven: np.ndarray) -> CoarseMesh:
        """Some patches [P] stand for indirect light alone: shadow rays bring the direct light."""
        return replace(self, patches=_marked(self.patches, uneven, UNEVEN))


def _marked(patches: Patches, chosen: np.ndarray, mark: int) -> Patches:
    cells = patches.cells.numpy() | np.where(chosen, np.uint32(mark), np.uint32(0))
    return replace(patches, cells=upload(mi.UInt32, cells))
