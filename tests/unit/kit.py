"""Surfaces and small steps that several unit tests share."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from envmap_integrator.lookup.emitter_choice import Emitters
from envmap_integrator.lookup.ids import ObjectIds
from envmap_integrator.lookup.irradiance_cache import IrradianceCache
from envmap_integrator.lookup.lookup import Lookup
from envmap_integrator.preparation.coarse_mesh import build
from envmap_integrator.preparation.coarse_mesh.surface_points import SurfacePoints, scatter_points
from envmap_integrator.preparation.radiosity.alias_tables import by_weight
from envmap_integrator.preparation.radiosity.irradiance import Solution, solve_irradiance
from tests.helpers import Estimate

WALL = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]
"""Vertices and faces of a square of two triangles in the plane z = 0."""


def mesh(vertices, faces, normals=None) -> mi.Mesh:
    """A triangle mesh; its vertices [V, 3], faces [F, 3] and perhaps normals [V, 3]."""
    result = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=normals is not None)
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    if normals is not None:
        parameters["vertex_normals"] = np.ravel(normals).astype(np.float32)
    parameters.update()
    return result


def scene_of(*shapes, **others) -> mi.Scene:
    """A scene without sensors, unless one is given: points come from global lines alone."""
    parts = {f"shape{i}": shape for i, shape in enumerate(shapes)}
    return mi.load_dict({"type": "scene"} | parts | others, optimize=False)


@dataclass(frozen=True)
class CoarseMesh(build.CoarseMesh):
    """The coarse mesh of a scene and what it was built from."""

    scene: mi.Scene
    object_ids: ObjectIds

    @property
    def n_used(self) -> int:
        """Patches that hold points; the others are free places in the hash table."""
        return len(np.unique(self.patch_of_point[self.patch_of_point >= 0]))

    def find(self, points: SurfacePoints, u=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Patch of each point, its size, and whether there is one; jittered by ``u`` [2, N]."""
        p, normal, object_id = (
            mi.Point3f(points.position.T.astype(np.float32)),
            mi.Normal3f(points.normal.T.astype(np.float32)),
            mi.UInt32(points.object_id),
        )
        u = u if u is None else mi.Point2f(u.astype(np.float32))
        cell = self.patches.locate(p, normal, object_id)
        patch = self.patches.find(p, normal, object_id, cell, u=u)
        return patch.index.numpy(), cell.patch_size.numpy(), patch.found.numpy()

    def solve(self, samples: int = 64) -> IrradianceCache:
        return self.solution(samples).cache

    def solution(self, samples: int) -> Solution:
        return solve_irradiance(self.scene, self.lookup(), self, samples)

    def lookup(self) -> Lookup:
        """What paths look up while there is no cache."""
        return Lookup(self.patches, self.object_ids, by_weight(Emitters.of(self.scene)))


def coarse_mesh(scene: mi.Scene, budget: int = 1024, points_per_patch: int = 128) -> CoarseMesh:
    points = scatter_points(scene, ObjectIds.of(scene), points_per_patch * budget, scene.sensors())
    return coarse_mesh_over(scene, points, budget)


def coarse_mesh_over(scene: mi.Scene, points: SurfacePoints, budget: int) -> CoarseMesh:
    object_ids = ObjectIds.of(scene)
    built = build.build_mesh(points, object_ids, budget)
    return CoarseMesh(**vars(built), scene=scene, object_ids=object_ids)


def surface_points(position: np.ndarray, normal, object_id=0, seen=1.0) -> SurfacePoints:
    """Points [N, 3] by hand; the rest is broadcast to them."""
    normal = np.broadcast_to(normal, position.shape).astype(np.float32)
    return SurfacePoints(
        np.asarray(position, np.float32),
        normal,
        normal,
        np.broadcast_to(np.uint32(object_id), len(position)),
        np.zeros(len(position), np.uint32),
        np.broadcast_to(np.float32(seen), len(position)),
        np.zeros(len(position), bool),
        np.zeros(len(position), np.uint32),
        np.ones(len(position), np.float32),
        np.ones(len(position), bool),
        np.zeros(len(position), np.int64),
    )


def mean_of(samples: np.ndarray) -> Estimate:
    """The mean of independent samples [N, ...], with its variance."""
    samples = np.asarray(samples, np.float64)
    return Estimate(samples.mean(axis=0), samples.var(axis=0, ddof=1) / len(samples))
