"""Clusters: groups of surfaces that share one cube map (paper section 2, "map generation").

A cluster is a set of cells of the coarse mesh, not of shapes: Mitsuba merges meshes that share a
material, so one shape may be all the woodwork of a house.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from ...lookup.cube_map import Cluster
from ...system.grouping import grouped
from ...system.scene_order import lasting_ids, ordered_shapes
from ..coarse_mesh.mesh import CoarseMesh
from ..coarse_mesh.surface_points import SurfacePoints

#: Flat pieces longer than this fraction of the scene are surroundings (floors, walls).
LARGEST_PLANE = 0.4
#: Diameter of automatic clusters, as a fraction of the scene.
DIAMETER = 0.3
#: Edge of the voxels that are grouped, as a fraction of the scene.
VOXEL = 1 / 40
#: A cluster seen by less than this fraction of the sensors' rays isn't worth a map.
MIN_SEEN = 0.005
MAX_CLUSTERS = 8
#: Names that are listed in messages at most, and how much alike (0 … 1) two have to be to be near.
MOST_NAMES, ALIKE = 8, 0.4
#: Voxels considered, most seen first: bounds the cost of hierarchical clustering.
MAX_VOXELS = 1500
#: Part of the time of a render that looking for maps and reading them takes, without which the same
#: rays are traced in full (measured: 0.10 … 0.15 in seven scenes).
LOOK_UP_COST = 0.12


@dataclass(frozen=True)
class ClusterRequest:
    """A cluster listed by the user: a nested ``mipmap_cube`` with ``shapes``.

    What is None is left to the integrator, or to where the shapes are.
    """

    name: str
    shapes: tuple[str, ...]
    distance_ratio: float | None = None
    center: tuple[float, ...] | None = None
    resolution: int | None = None


def listed_clusters(
    points: SurfacePoints,
    space: np.ndarray,
    scene: mi.Scene,
    requests: tuple[ClusterRequest, ...],
    distance_ratio: float,
) -> tuple[list[Cluster], np.ndarray]:
    """The clusters that the user listed, and the cluster of every surface point [N], -1 if none.

    Left out with a warning: one whose cube holds the whole scene, so that there is nothing to map,
    and one without surface points, so that nothing would look its map up: empty, too small to be
    found, or of mirrors and glass, which are traced. Of shapes in several spaces, only what lies in
    the one where most is seen belongs to it.
    Raises ``ValueError`` if a shape isn't in the scene or is listed twice.
    """
    clusters = []
    cluster_of_point = np.full(len(points), -1)
    listed: list[str] = []
    for request in requests:
        owner = f'mipmap_cube "{request.name}"'
        members = shapes_named(scene, request.shapes, owner)
        for shape_id in request.shapes:
            if shape_id in listed:
                raise ValueError(f'{owner}: shape "{shape_id}" is listed twice; list it once')
            listed.append(shape_id)
        member = np.isin(points.object_id, members)
        if not member.any():
            mi.Log(
                mi.LogLevel.Warn,
                f"{owner}: no surface that could use a map was found on "
                f"{_some(request.shapes)}, so there is none; mirrors and glass are traced "
                'unless "mirrors" is "map"',
            )
            continue
        if (space[member] >= 0).any():
            member &= space == np.bincount(space[member & (space >= 0)]).argmax()
        ratio = request.distance_ratio or distance_ratio
        cluster = _cluster(request.name, points.position[member], ratio, request.center)
        box = scene.bbox()  # The sensors may have seen a part of it only.
        if holds(cluster, *points.box) and holds(cluster, box.min, box.max):
            mi.Log(
                mi.LogLevel.Warn,
                f"{owner}: its cube holds the whole scene, so there is nothing to map; set a "
                f'"distance_ratio" below {ratio:g}'
                + (', or move its "center" to its shapes' if request.center else ""),
            )
            continue
        cluster_of_point[member] = len(clusters)
        clusters.append(cluster)
    return clusters, cluster_of_point


def shapes_named(scene: mi.Scene, names: tuple[str, ...], owner: str) -> np.ndarray:
    """Lasting ids of the shapes of a scene that have one of these names.

    Raises ``ValueError``, in the name of ``owner``, if one isn't in the scene.
    """
    shapes = ordered_shapes(scene)
    ids = [shape.id() for shape in shapes]
    for name in names:
        if name not in ids:
            known = [id_ for id_ in ids if id_]
            nearest = get_close_matches(name, known, MOST_NAMES, ALIKE)
            known = list(dict.fromkeys([*nearest, *known]))
            # The command line doesn't merge where shapes are named.
            merged = any(shape.class_name() == "Mesh" and not shape.id() for shape in shapes)
            raise ValueError(
                f'{owner}: the scene has no shape "{name}"; it has {_some(known) or "no ids"}'
                + (
                    " (load with optimize=False: Mitsuba merges meshes that share a material)"
                    if merged
                    else ""
                )
            )
    return lasting_ids(shapes)[np.isin(ids, names)]


def find_clusters(
    points: SurfacePoints,
    space: np.ndarray,
    distance_ratio: float,
    excluded: np.ndarray | bool = False,
) -> tuple[list[Cluster], np.ndarray]:
    """Group the contents of each space, as far as the scene's sensors see them, into clusters.

    Points that are ``excluded`` [N] belong to none.
    Returns the clusters and the cluster of every surface point [N], -1 if it belongs to none.
    """
    cluster_of_point = np.full(len(points), -1)
    if not points.seen.any():
        return [], cluster_of_point
    extent = points.extent
    surroundings = _on_large_plane(points, extent) | excluded
    contents = np.flatnonzero((space >= 0) & ~surroundings)
    if len(contents) == 0:
        return [], cluster_of_point

    # ---- Voxels of what isn't surroundings ----
    cell = np.floor(points.position[contents] / (VOXEL * extent))
    voxel = grouped(_joined((*cell.T, space[contents]))).index
    seen = np.bincount(voxel, weights=points.seen[contents] > 0)
    n_points = np.bincount(voxel)
    # Too far apart for a group along a fourth axis if in several spaces.
    place = *points.position[contents].T, space[contents] * extent
    centre = np.stack([np.bincount(voxel, weights=x) / n_points for x in place], axis=1)
    kept = np.flatnonzero(seen > 0)
    kept = kept[np.argsort(-seen[kept], kind="stable")][:MAX_VOXELS]
    if len(kept) == 0:
        return [], cluster_of_point

    # ---- Groups of limited diameter ----
    group = np.ones(1, dtype=int)
    if len(kept) > 1:
        group = fcluster(linkage(centre[kept], "complete"), DIAMETER * extent, "distance")
    share = np.bincount(group, weights=seen[kept]) / (points.seen > 0).sum()
    best = [g for g in np.argsort(-share, kind="stable") if share[g] >= MIN_SEEN][:MAX_CLUSTERS]

    clusters = []
    for g in best:
        member = contents[np.isin(voxel, kept[group == g])]
        cluster = _cluster(f"cluster{len(clusters)}", points.position[member], distance_ratio)
        if not holds(cluster, *points.box):
            cluster_of_point[member] = len(clusters)
            clusters.append(cluster)
    return clusters, cluster_of_point


def benefit(
    points: SurfacePoints, escaped_share: np.ndarray, mapped: np.ndarray | bool = True
) -> float:
    """Part of the variance of what the sensors see that maps take off at most.

    Maps are for the surface points that are ``mapped`` [N]. That rays are shorter spares nothing:
    in a hierarchy of bounding volumes they take about as long as longer ones. What a map has ahead
    of tracing is that it has averaged light that comes through mirrors and glass, which single
    paths seldom find. ``escaped_share`` [N] says for every surface point what part of the variance
    that is at most.
    """
    seen = points.seen > 0
    return float(escaped_share[seen & mapped].sum() / max(seen.sum(), 1))


def worthwhile(benefit: float) -> bool:
    """Do maps spare more than they cost?

    They take variance off where the sensors see a cluster, and their cost is added everywhere.
    """
    return benefit > LOOK_UP_COST


def cluster_of_cell(n_clusters: int, cluster_of_point: np.ndarray, mesh: CoarseMesh) -> np.ndarray:
    """Cluster of every large cell [C] of a coarse mesh, ``n_clusters`` where it belongs to none.

    A cell belongs to the cluster that most of its surface points belong to, if there are any.
    """
    cell_of_point, n_cells = mesh.cell_of_point, dr.width(mesh.patches.levels)
    known = cell_of_point >= 0
    cluster = np.where(cluster_of_point < 0, n_clusters, cluster_of_point)
    slot = (n_clusters + 1) * cell_of_point[known] + cluster[known]
    votes = np.bincount(slot, minlength=n_cells * (n_clusters + 1)).reshape(n_cells, -1)
    membership = np.where(votes.any(axis=1), votes.argmax(axis=1), n_clusters)
    return membership.astype(np.uint32)


def _on_large_plane(points: SurfacePoints, extent: float) -> np.ndarray:
    """Which points [N] lie on flat pieces that are large compared to the scene."""
    offset = (points.position * points.normal).sum(axis=1)
    # Shifted bins: normals and offsets of buildings sit on round numbers.
    normal = np.floor(points.normal * 8 + 0.377)
    bins = (*normal.T, np.floor(offset * (200 / extent) + 0.377), points.object_id)
    planes = grouped(_joined(bins))
    diagonal = np.zeros(len(planes.keys))
    for x in points.position.T:
        lowest, highest = planes.ends(x)
        diagonal += (highest - lowest) ** 2
    return (diagonal > (LARGEST_PLANE * extent) ** 2)[planes.index]


def _joined(columns) -> np.ndarray:
    """One integer [N] in place of several [K, N]: sorting whole rows takes ten times as long."""
    key = np.zeros(len(columns[0]), dtype=np.int64)
    for column in columns:
        column = column.astype(np.int64)
        column -= column.min()
        key = key * (int(column.max()) + 1) + column
    return key


def _cluster(
    name: str,
    position: np.ndarray,
    distance_ratio: float,
    center: tuple[float, ...] | None = None,
) -> Cluster:
    low, high = position.min(axis=0), position.max(axis=0)
    centre = (low + high) / 2 if center is None else np.array(center)
    radius = max(float(np.maximum(high - centre, centre - low).max()), 1e-30)
    return Cluster(name, centre, radius, distance_ratio * radius)


def holds(cluster: Cluster, low, high) -> bool:
    """Does the cube hold the whole box [3], so that nothing is left for a map?"""
    inside = (cluster.centre - cluster.half_width <= np.ravel(low)) & (
        cluster.centre + cluster.half_width >= np.ravel(high)
    )
    return bool(inside.all())


def _some(names) -> str:
    listed = ", ".join(f'"{name}"' for name in names[:MOST_NAMES])
    return listed + (f", … ({len(names)} in all)" if len(names) > MOST_NAMES else "")
