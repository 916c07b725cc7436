"""Clusters: groups of objects that share one cube map (paper section 2, "map generation")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from ..radiosity.surface_points import SurfacePoints

#: Objects larger than this fraction of the scene are surroundings (floors, walls), not contents.
LARGEST_OBJECT = 0.25
#: Objects nearer to each other than this fraction of the scene may share a cluster.
REACH = 0.3
#: A cluster seen by less than this fraction of the sensors' rays isn't worth a map.
MIN_SEEN = 0.005
MAX_CLUSTERS = 8
#: Objects considered, most seen first: bounds the cost of hierarchical clustering.
MAX_OBJECTS = 2000


@dataclass(frozen=True)
class ClusterRequest:
    """A cluster listed by the user: a nested ``mipmap_cube`` with ``shapes``."""

    name: str
    shape_ids: tuple[str, ...]
    distance_ratio: float | None


@dataclass(frozen=True)
class Cluster:
    """Objects that share a cube.

    name         for messages and files
    objects      object ids
    centre       [3] of the box around the objects, world space
    radius       largest distance of the objects from the centre along an axis, world units
    half_width   of the cube around the centre, world units
    """

    name: str
    objects: np.ndarray
    centre: np.ndarray
    radius: float
    half_width: float


def listed_clusters(
    points: SurfacePoints, scene, requests: list[ClusterRequest], distance_ratio: float
) -> list[Cluster]:
    """The clusters that the user listed.

    Raises ``ValueError`` if a shape isn't in the scene, is listed twice or has no surface.
    """
    ids = [shape.id() for shape in scene.shapes()]
    clusters, owner = [], {}
    for request in requests:
        objects = []
        for shape_id in request.shape_ids:
            if shape_id not in ids:
                raise ValueError(
                    f'mipmap_cube "{request.name}": the scene has no shape "{shape_id}"; '
                    f"it has {_shortened(ids)}"
                )
            if shape_id in owner:
                raise ValueError(
                    f'mipmap_cube "{request.name}": shape "{shape_id}" is already in cluster '
                    f'"{owner[shape_id]}"; list it once'
                )
            owner[shape_id] = request.name
            objects.append(ids.index(shape_id))
        member = np.isin(points.object_id, objects)
        if not member.any():
            raise ValueError(
                f'mipmap_cube "{request.name}": no surface was found on its shapes '
                f"{_shortened(list(request.shape_ids))}; are they hidden or empty?"
            )
        ratio = request.distance_ratio or distance_ratio
        clusters.append(_cluster(request.name, np.array(objects), points.position[member], ratio))
    return clusters


def find_clusters(points: SurfacePoints, distance_ratio: float) -> list[Cluster]:
    """Group the contents of the scene, as far as its sensors see them, into clusters."""
    low, high = np.percentile(points.position, [2, 98], axis=0)
    extent = float(np.linalg.norm(high - low))
    n_objects = int(points.object_id.max(initial=0)) + 1

    lowest, highest = np.full((n_objects, 3), np.inf), np.full((n_objects, 3), -np.inf)
    np.minimum.at(lowest, points.object_id, points.position)
    np.maximum.at(highest, points.object_id, points.position)
    seen = np.bincount(points.object_id, weights=points.seen, minlength=n_objects)
    with np.errstate(invalid="ignore"):
        small = np.linalg.norm(highest - lowest, axis=1) < 2 * LARGEST_OBJECT * extent
    objects = np.flatnonzero(small & (seen > 0))
    objects = objects[np.argsort(-seen[objects], kind="stable")][:MAX_OBJECTS]
    if len(objects) == 0:
        return []

    centres = 0.5 * (lowest + highest)[objects]
    group = np.ones(1, dtype=int)
    if len(objects) > 1:
        group = fcluster(linkage(centres, "complete"), REACH * extent, "distance")
    share = np.bincount(group, weights=seen[objects]) / max(seen.sum(), 1)
    best = [g for g in np.argsort(-share, kind="stable") if share[g] >= MIN_SEEN][:MAX_CLUSTERS]

    clusters = []
    for number, g in enumerate(best):
        members = objects[group == g]
        position = points.position[np.isin(points.object_id, members)]
        clusters.append(_cluster(f"cluster{number}", members, position, distance_ratio))
    lowest, highest = points.position.min(axis=0), points.position.max(axis=0)
    return [c for c in clusters if not _holds(c, lowest, highest)]


def cluster_of_patch(
    clusters: list[Cluster], points: SurfacePoints, patch_of_point: np.ndarray, n_patches: int
) -> np.ndarray:
    """Cluster index of every patch [P], ``len(clusters)`` where it belongs to none."""
    n_objects = int(points.object_id.max(initial=0)) + 1
    of_object = np.full(n_objects, len(clusters), dtype=np.uint32)
    for index, cluster in enumerate(clusters):
        of_object[cluster.objects[cluster.objects < n_objects]] = index
    result = np.full(n_patches, len(clusters), dtype=np.uint32)
    has_patch = patch_of_point >= 0
    result[patch_of_point[has_patch]] = of_object[points.object_id[has_patch]]
    return result


def _cluster(name, objects, position, distance_ratio):
    low, high = position.min(axis=0), position.max(axis=0)
    radius = max(float((high - low).max()) / 2, 1e-30)
    return Cluster(name, objects, (low + high) / 2, radius, distance_ratio * radius)


def _holds(cluster, low, high):
    """Does the cube hold the whole scene, so that nothing is left to put into a map?"""
    inside = (cluster.centre - cluster.half_width <= low) & (
        cluster.centre + cluster.half_width >= high
    )
    return bool(inside.all())


def _shortened(names: list[str]) -> str:
    listed = ", ".join(f'"{name}"' for name in names[:8])
    return listed + (f", … ({len(names)} in all)" if len(names) > 8 else "")
