"""Which shapes a cluster is made of: what can be listed to ask for it again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from ..preparation.baked_state import BakedState
from ..preparation.coarse_mesh.surface_points import SurfacePoints
from ..preparation.maps.clusters import ClusterRequest, holds
from ..system.scene_order import lasting_ids, ordered_shapes

#: What a point that sensors don't see counts for: it only decides where they see nothing at all.
UNSEEN = 1e-3
#: Shapes that are less of a cluster aren't worth a word, and such that are less of it all together
#: don't stand for it.
PIECE, LEAST = 0.01, 0.1
#: How far a shape that can be listed may reach from the centre, in radii of the cluster: what
#: sensors don't see of it isn't in the cluster.
REACH = 1.25


@dataclass(frozen=True)
class Members:
    """The shapes of a cluster, those first that it has most of.

    listed    ids of those that ask for it again, none if they are too little of it
    pieces    ids of those of which it has a piece only: listing them would make another cluster
    unnamed   number of those without an id
    share     part of the cluster that can be listed
    request   what has asked for it, None if it's automatic
    """

    listed: tuple[str, ...]
    pieces: tuple[str, ...] = ()
    unnamed: int = 0
    share: float = 1.0
    request: ClusterRequest | None = None


def find_members(
    scene: mi.Scene,
    state: BakedState,
    points: SurfacePoints,
    cluster_of_point: np.ndarray,
    requests: tuple[ClusterRequest, ...],
) -> list[Members]:
    """The shapes of each cluster, told from points all over the scene and the cluster of each [N].

    A shape is listed for the cluster that has most of what is seen of it, if it doesn't reach far
    beyond: so no two clusters list the same, and a wall whose piece is in a cluster isn't listed.
    """
    shapes, n_clusters = ordered_shapes(scene), len(state.maps)
    ids = lasting_ids(shapes)
    order = np.argsort(ids)
    shape = order[np.searchsorted(ids, points.object_id, sorter=order)]
    votes = np.bincount(
        shape * (n_clusters + 1) + cluster_of_point,
        weights=np.where(points.seen > 0, 1, UNSEEN),
        minlength=len(shapes) * (n_clusters + 1),
    ).reshape(len(shapes), -1)
    has_most = votes[:, :-1] > 0.5 * votes.sum(axis=1, keepdims=True)

    asked = {request.name: request for request in requests}
    box = scene.bbox()
    found = []
    for index, cluster in enumerate(cube_map.cluster for cube_map in state.maps):
        if request := asked.get(cluster.name):
            found.append(Members(request.shapes, request=request))
            continue
        # Nor may listing them make a cube that holds the whole scene: there would be no map.
        larger = replace(cluster, half_width=REACH * cluster.half_width)
        reach = cluster.radius * (1 if holds(larger, box.min, box.max) else REACH)
        near = replace(cluster, half_width=reach)
        share = votes[:, index] / max(votes[:, index].sum(), 1e-30)
        listed, pieces, unnamed = {}, [], 0
        for i in np.argsort(-share, kind="stable"):
            name, bounds = shapes[i].id(), shapes[i].bbox()
            whole = has_most[i, index] and holds(near, bounds.min, bounds.max)
            if name and whole:
                listed[name] = share[i]
            elif share[i] > PIECE and name:
                pieces.append(name)
            elif share[i] > PIECE:
                unnamed += 1
        listable = float(sum(listed.values()))
        its = tuple(listed) if listable >= LEAST else ()
        found.append(Members(its, tuple(pieces), unnamed, listable))
    return found
