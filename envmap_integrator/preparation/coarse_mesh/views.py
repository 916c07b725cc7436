"""Which views a coarse mesh serves: patches lie where the sensors it was made for ask for them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ...lookup.ids import ObjectIds
from ...lookup.patches import Patches
from .mesh import CoarseMesh
from .surface_points import walk_from

#: Rays of the walks that test a new view.
RAYS = 4096
#: How much less often than a view that the mesh was made for another one may find a patch, and what
#: part of the number of patches must share what it asks for: half as fine along either edge.
MISSED, FINENESS = 0.05, 0.25


@dataclass(frozen=True)
class Service:
    """How well a coarse mesh serves what secondary rays meet in a view.

    found     [1]  part of them that has a patch
    patches   [1]  among how many patches they are shared, as if each had equally many
    """

    found: float
    patches: float

    def suffices(self, usual: Service) -> bool:
        """Is a view served about as well as those that the mesh was made for?"""
        return self.found >= usual.found - MISSED and self.patches >= FINENESS * usual.patches


UNKNOWN = Service(1.0, 1e30)
"""What a mesh that was made for no view does for it: no view is served as well."""


def view_name(sensor: mi.Sensor) -> str:
    """A hash of where a sensor looks."""
    values = (f"{name}={value}" for name, value in mi.traverse(sensor))
    text = "\n".join([sensor.class_name(), *values])
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def usual_service(mesh: CoarseMesh) -> Service:
    """The least that a mesh does for any of the sensors whose walks it was made of."""
    points, later = mesh.points, mesh.points.bounce > 0
    each = [
        _service(mesh.patch_of_point[later & (points.seen == sensor)])
        for sensor in points.sensors(later)
    ]
    if not each:
        return UNKNOWN
    return Service(min(s.found for s in each), min(s.patches for s in each))


def service(scene: mi.Scene, object_ids: ObjectIds, patches: Patches, sensor: mi.Sensor) -> Service:
    """What a mesh does for another sensor."""
    points = walk_from(scene, object_ids, sensor, RAYS)
    points = points.take(np.flatnonzero(points.bounce > 0))
    if len(points) == 0:
        return Service(1.0, np.inf)  # Nothing is asked for.
    place = points.places()
    patch = patches.find(*place, patches.locate(*place))
    return _service(np.where(patch.found.numpy(), patch.index.numpy().astype(np.int64), -1))


def _service(patch: np.ndarray) -> Service:
    """How well a mesh serves rays, by the patches [N] of what they meet, -1 where there is none."""
    if len(patch) == 0:
        return Service(1.0, np.inf)
    found = patch[patch >= 0]
    count = np.bincount(found)
    alike = float(np.sum(count * (count - 1.0)))  # Pairs in the same patch, without bias.
    return Service(len(found) / len(patch), len(found) * (len(found) - 1.0) / max(alike, 1.0))
