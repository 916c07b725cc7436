"""The map of one cluster as a record, and its files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..system.spectrum import BINS, bin_names
from ..system.storage import Parts, Stored
from .cube import n_levels


@dataclass(frozen=True)
class Cluster:
    """Surfaces that share a cube.

    name         for messages and files
    centre       [3] of the cube, world space; unless asked for, that of the box around the surfaces
    radius       largest distance of the surfaces from the centre along an axis, world units
    half_width   of the cube around the centre, world units
    benefit      part of the variance of what the sensors see that its map takes off, as predicted
    """

    name: str
    centre: np.ndarray
    radius: float
    half_width: float
    benefit: float = 0.0


#: Texels along the edge of a face at most.
MAX_RESOLUTION = 2048
#: Names of the radiance channels, by their number.
RADIANCE_CHANNELS = {1: ("Y",), 3: ("R", "G", "B"), BINS: bin_names()}


@dataclass(frozen=True)
class CubeMap:
    """The map of one cluster.

    cluster   what it is the map of
    levels    [6, R_l, R_l, C + 1] per level, finest first: radiance [W/m²/sr] as the variant stores
              it, inverse distance [1/m] from the cube's centre. Negative on the finest level where
              no ray from the cluster was seen to arrive: what such texels hold is made up from
              their neighbours.
    """

    cluster: Cluster
    levels: list[np.ndarray]

    @property
    def resolution(self) -> int:
        """Texels along the edge of a face of the finest level."""
        return self.levels[0].shape[1]

    @property
    def n_channels(self) -> int:
        """Number of colour channels C."""
        return self.levels[0].shape[-1] - 1

    @property
    def masked(self) -> float:
        """Share of finest texels that hold nothing of their own."""
        return float((self.levels[0][..., -1] < 0).mean())

    def texels(self) -> np.ndarray:
        """All levels in one row, [T, C + 1], as ``cube`` lays them out."""
        return np.concatenate([level.reshape(-1, level.shape[-1]) for level in self.levels])


def to_parts(cube_map: CubeMap, prefix: str = "") -> tuple[Parts, dict]:
    """EXR parts, one a level with the six faces side by side, and metadata of a map."""
    names = (*RADIANCE_CHANNELS[cube_map.n_channels], "inverse_distance")
    parts = {}
    for number, level in enumerate(cube_map.levels):
        image = np.concatenate(list(level), axis=1)
        parts[f"{prefix}level{number}"] = {
            name: np.ascontiguousarray(image[..., i]) for i, name in enumerate(names)
        }
    cluster = cube_map.cluster
    metadata = {
        "name": cluster.name,
        "centre": cluster.centre.tolist(),
        "radius": cluster.radius,
        "half_width": cluster.half_width,
        "benefit": cluster.benefit,
        "resolution": cube_map.resolution,
    }
    return parts, metadata


def from_stored(stored: Stored, prefix: str = "") -> CubeMap:
    """The map that ``to_parts`` has taken apart, from its metadata and the parts of a file.

    Raises ``StorageError`` if that isn't a map.
    """
    resolution = stored.integer("resolution", 1, MAX_RESOLUTION)
    if resolution & (resolution - 1):
        raise stored.refusal(f'its "resolution" must be a power of two, not {resolution}')
    finest = stored.parts.get(f"{prefix}level0", {})
    names = next((n for n in RADIANCE_CHANNELS.values() if n[0] in finest), RADIANCE_CHANNELS[1])
    levels = []
    for number in range(n_levels(resolution)):
        size = resolution >> number
        channels = [
            stored.array(f"{prefix}level{number}", name, np.float32)
            for name in (*names, "inverse_distance")
        ]
        if any(channel.shape != (size, 6 * size) for channel in channels):
            raise stored.refusal(f'its "{prefix}level{number}" has another size than 6 * {size}²')
        levels.append(np.stack(np.split(np.stack(channels, axis=-1), 6, axis=1)))
    centre = np.array(stored.point("centre"))
    radius, half_width = stored.number("radius"), stored.number("half_width")
    cluster = Cluster(stored.text("name"), centre, radius, half_width, stored.number("benefit"))
    return CubeMap(cluster, levels)
