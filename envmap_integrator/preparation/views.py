"""Which views a state serves: patches and gather rays lie where the sensors it was made for ask."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..lookup.ids import ObjectIds
from ..lookup.irradiance_cache import IrradianceCache
from .coarse_mesh.mesh import CoarseMesh
from .coarse_mesh.surface_points import WALK_HITS, SurfacePoints, walk_from
from .radiosity.noise import TARGET
from .radiosity.view_error import view_error

#: Walks that test a new view, and hits along each: in a white room, light goes far.
RAYS, HITS = 4096, 16
#: How much less often than a view that the state was made for another one may find a patch, what
#: part of the number of patches must share what it asks for (half as fine along either edge), and
#: how much larger its error may be, if it isn't small.
MISSED, FINENESS, LESS_SURE = 0.05, 0.25, 1.5
#: Number of patches that stands for a state made for no view: none is served as well.
NO_VIEW = 1e30


@dataclass(frozen=True)
class Service:
    """How well a state serves what secondary rays meet in a view.

    found     [1]  part of them that has a patch
    patches   [1]  among how many patches they are shared, as if each had equally many
    error     [1]  of the picture's brightness, by the noise of the cache and the size of patches
    """

    found: float
    patches: float
    error: float

    def suffices(self, usual: Service) -> bool:
        """Is a view served about as well as those that the state was made for?"""
        return (
            self.found >= usual.found - MISSED
            and self.patches >= FINENESS * usual.patches
            and self.error <= LESS_SURE * max(usual.error, TARGET)
        )


def view_name(sensor: mi.Sensor) -> str:
    """A hash of where a sensor looks."""
    values = (f"{name}={value}" for name, value in mi.traverse(sensor))
    text = "\n".join([sensor.class_name(), *values])
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def usual_service(mesh: CoarseMesh, error: float) -> Service:
    """The least that a state does for any of the sensors whose walks its mesh was made of.

    ``error`` is the largest of their pictures.
    """
    points, later = mesh.points, mesh.points.bounce > 0
    each = [
        _service(mesh.patch_of_point[later & (points.seen == sensor)])
        for sensor in points.sensors(later)
    ]
    if not each:
        return Service(1.0, NO_VIEW, error)
    found, patches = zip(*each, strict=True)
    return Service(min(found), min(patches), error)


def walks(scene: mi.Scene, object_ids: ObjectIds, sensor: mi.Sensor) -> SurfacePoints:
    """What secondary rays of a sensor meet; any number of states are asked how they serve it."""
    return walk_from(scene, object_ids, sensor, RAYS, HITS)


def service(points: SurfacePoints, cache: IrradianceCache, size_error: float) -> Service:
    """What a state does for the sensor of ``walks``; ``size_error`` [1] is that by patches' size.

    What their size does to the view isn't known: it counts as for those it was made for.
    """
    if len(points) == 0:
        return Service(1.0, np.inf, 0.0)  # Nothing is asked for.
    place = points.places()
    cell = cache.patches.locate(*place)
    patch = cache.patches.find(*place, cell)
    index = np.where(patch.found.numpy(), patch.index.numpy().astype(np.int64), -1)
    later = (points.bounce > 0) & (points.bounce < WALK_HITS)
    error = view_error(points, cell, index, patch.even.numpy(), cache)
    return Service(*_service(index[later]), float(np.hypot(error, size_error)))


def _service(patch: np.ndarray) -> tuple[float, float]:
    """``found`` and ``patches``, by the patches [N] of what rays meet, -1 where there is none."""
    if len(patch) == 0:
        return 1.0, np.inf
    found = patch[patch >= 0]
    count = np.bincount(found)
    alike = float(np.sum(count * (count - 1.0)))  # Pairs in the same patch, without bias.
    return len(found) / len(patch), len(found) * (len(found) - 1.0) / max(alike, 1.0)
