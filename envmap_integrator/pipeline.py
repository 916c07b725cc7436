"""The pre-passes in order: scene → coarse mesh → irradiance cache → clusters → maps."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from .jit import opaque_point
from .maps.clusters import (
    Cluster,
    ClusterRequest,
    cluster_of_patch,
    find_clusters,
    listed_clusters,
)
from .maps.cube_map import CubeMap, from_parts, to_parts
from .radiosity.irradiance import IrradianceCache, solve_irradiance
from .radiosity.patches import Patches, build_patches
from .radiosity.surface_points import ObjectIds, scatter_points
from .rendering.transport import Transport
from .storage import StorageError, read, write

#: Surface points per patch of the budget.
POINTS_PER_PATCH = 16


@dataclass(frozen=True)
class Settings:
    """What the pre-passes depend on besides the scene; see the integrators for the meanings."""

    patches: int
    patch_samples: int
    maps: bool = False
    map_resolution: int = 0
    map_samples: int = 0
    distance_ratio: float = 0.0
    requests: tuple[ClusterRequest, ...] = ()


@dataclass(frozen=True)
class Prepared:
    """The baked state of a scene, the same for every view.

    key                content hash of the scene, and the settings
    cache              irradiance on the patches
    maps               one cube map per cluster
    cluster_of_patch   [P] cluster index, ``len(maps)`` where there is none
    stage_times        seconds spent in each stage
    """

    key: str
    cache: IrradianceCache
    maps: tuple[CubeMap, ...] = ()
    cluster_of_patch: np.ndarray | None = None
    stage_times: dict[str, float] = field(default_factory=dict)

    def save(self, path) -> None:
        """Write the state to an OpenEXR file, for ``cache_file`` and ``mipmap_cube``."""
        save(path, self)


def prepare(scene: mi.Scene, key: str, settings: Settings, baker=None) -> Prepared:
    """Run the pre-passes. ``baker`` is the ``envmap_bake`` that fills the maps."""
    times: dict[str, float] = {}

    with _timed(times, "coarse mesh"):
        object_ids = ObjectIds(scene)
        points = scatter_points(scene, object_ids, POINTS_PER_PATCH * settings.patches)
        patches, patch_of_point = build_patches(points, object_ids, settings.patches)

    with _timed(times, "irradiance cache"):
        cache = solve_irradiance(
            scene, Transport(patches, object_ids), points, patch_of_point, settings.patch_samples
        )
    prepared = Prepared(key, cache, stage_times=times)
    if not settings.maps:
        return prepared

    with _timed(times, "clusters"):
        if settings.requests:
            clusters = listed_clusters(points, scene, settings.requests, settings.distance_ratio)
        else:
            clusters = find_clusters(points, settings.distance_ratio)
        membership = cluster_of_patch(clusters, points, patch_of_point, patches.count)

    with _timed(times, "maps"):
        maps = tuple(
            _bake(scene, prepared, baker, cluster, points, settings.map_resolution, seed)
            for seed, cluster in enumerate(clusters, start=1)
        )
    return replace(prepared, maps=maps, cluster_of_patch=membership)


def _bake(scene, prepared, baker, cluster: Cluster, points, resolution, seed) -> CubeMap:
    members = points.take(np.flatnonzero(np.isin(points.object_id, cluster.objects)))
    return baker.bake(scene, prepared, cluster, members, resolution, seed)


@contextmanager
def _timed(times: dict[str, float], name: str):
    begin = time.perf_counter()
    yield
    dr.sync_thread()
    times[name] = time.perf_counter() - begin


# ---------------------- Files ----------------------

#: Width of the images that hold one-dimensional arrays.
_WIDTH = 1024


def save(path, prepared: Prepared) -> None:
    """Write a prepared state to an OpenEXR file."""
    patches = prepared.cache.patches
    parts = {
        "patch_table": {"entry": _image(patches.table.numpy())},
        "irradiance": {"Y": _image(prepared.cache.table.numpy())},
    }
    if prepared.cluster_of_patch is not None:
        parts["cluster_of_patch"] = {"cluster": _image(prepared.cluster_of_patch)}
    maps = []
    for index, cube_map in enumerate(prepared.maps):
        map_parts, map_metadata = to_parts(cube_map, prefix=f"map{index}/")
        parts |= map_parts
        maps.append(map_metadata)
    metadata = {
        "key": prepared.key,
        "origin": [float(c[0]) for c in patches.origin],
        "size": float(patches.size[0]),
        "table_size": dr.width(patches.table),
        "use_objects": patches.use_objects,
        "patches": patches.count,
        "channels": len(mi.Spectrum()),
        "maps": maps,
        "stage_times": prepared.stage_times,
    }
    write(path, parts, metadata)


def load(path, key: str, owner: str) -> Prepared:
    """Read a prepared state that belongs to ``key``; ``ValueError`` if there is none in the file."""
    path = mi.file_resolver().resolve(path)
    try:
        parts, metadata = read(path, "make it with envmap-render bake")
        if metadata.get("key") != key:
            raise StorageError(
                f"{path}: made for another scene or other settings; bake it again with "
                "envmap-render bake"
            )
        maps = tuple(
            from_parts(parts, map_metadata, prefix=f"map{index}/")
            for index, map_metadata in enumerate(metadata["maps"])
        )
    except StorageError as error:
        raise ValueError(f'{owner}: "cache_file" {error}') from None

    n_patches = metadata["patches"]
    table = parts["patch_table"]["entry"].ravel()[: metadata["table_size"]]
    irradiance = parts["irradiance"]["Y"].ravel()[: 2 * n_patches * metadata["channels"]]
    clusters = parts.get("cluster_of_patch")
    patches = Patches(
        origin=opaque_point(metadata["origin"]),
        size=dr.opaque(mi.Float, metadata["size"]),
        table=mi.UInt32(table),
        mask=dr.opaque(mi.UInt32, len(table) // 2 - 1),
        use_objects=metadata["use_objects"],
        count=n_patches,
    )
    return Prepared(
        key,
        IrradianceCache(patches, mi.Float(irradiance)),
        maps,
        clusters and clusters["cluster"].ravel()[:n_patches],
        metadata["stage_times"],
    )


def _image(values: np.ndarray) -> np.ndarray:
    """A one-dimensional array as an image, padded with zeros."""
    height = max(-(-len(values) // _WIDTH), 1)
    image = np.zeros(height * _WIDTH, dtype=values.dtype)
    image[: len(values)] = values
    return image.reshape(height, _WIDTH)
