"""What the radiosity system is solved for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...system.spectrum import n_packets
from ..coarse_mesh.patch_points import PatchPoints


@dataclass(frozen=True)
class Unknowns:
    """The irradiance of each patch that has points, once for each packet of wavelengths.

    Light of one packet never becomes light of another: each has a system of its own, over rays of
    its own. Of n packets, n p + packet stands for patch p; the table has the rows of its total and
    its indirect irradiance one after the other. In variants without wavelengths, n is 1.

    members   the K patches and their surface points
    """

    members: PatchPoints

    @property
    def packets(self) -> int:
        """Number n of packets."""
        return n_packets()

    def __len__(self) -> int:
        """Number U = n K of unknowns."""
        return self.packets * len(self.members.patches)

    @cached_property
    def patches(self) -> np.ndarray:
        """The patch [U] of each unknown, as the rows of the table count them."""
        n = self.packets
        return (n * self.members.patches[:, None] + np.arange(n)).ravel()

    @cached_property
    def rank_of_patch(self) -> np.ndarray:
        """Place [n P + n] in ``patches``, U of others; the last n stand for none."""
        n = self.packets
        rank = n * self.members.rank_of_patch[:, None] + np.arange(n)
        return np.minimum(rank, len(self)).ravel()

    @cached_property
    def cells(self) -> np.ndarray:
        """Large cell [U] of each unknown's patch, -1 if it has none."""
        return np.repeat(self.members.cells, self.packets)

    def by_patch(self, values: np.ndarray) -> np.ndarray:
        """Values [U, …] of unknowns as those of the packets of each patch [K, n, …]."""
        return values.reshape(-1, self.packets, *values.shape[1:])
