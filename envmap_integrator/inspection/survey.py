"""What a page shows: the picture at few samples, and what was prepared for it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from itertools import groupby, islice

import drjit as dr
import mitsuba as mi
import numpy as np

from ..imaging.aovs import TYPES
from ..imaging.film import n_pixels_of
from ..lookup.cube_map import Cluster
from ..lookup.ids import ObjectIds
from ..lookup.patches import DROPPED, MARK_BITS, UNEVEN
from ..preparation.baked_state import BakedState
from ..preparation.coarse_mesh.surface_points import scatter_points
from ..system.ray_counts import count_rays
from ..system.scene_order import lasting_ids, ordered_shapes
from ..system.warned import warned
from .members import Members, find_members

#: Samples per pixel of the picture, in two passes, and of the AOVs.
PICTURE_SPP, AOV_SPP = 16, 4
#: Points all over the scene that tell the shapes of clusters.
N_POINTS = 1 << 17


@dataclass(frozen=True)
class ClusterView:
    """A cluster as a sensor sees it.

    cluster   the cluster
    masked    part of its map's texels that no ray of it was seen to reach
    members   what it is made of
    shapes    part of the picture by the ids of its shapes, largest first; 0 for all if none of
              them is seen
    seen      part of the picture that shows it
    served    parts of its secondary rays that were traced on, ended in the cache, and in its map
    near      part of them that were traced on as what they hit was too near for the cache
    """

    cluster: Cluster
    masked: float
    members: Members
    shapes: dict[str, float]
    seen: float
    served: tuple[float, float, float]
    near: float = 0.0


@dataclass(frozen=True)
class View:
    """A prepared state as a sensor sees it.

    state      what was prepared
    aovs       pictures [H, W, 1 or 3] by the types of AOVs
    clusters   those that have a map
    """

    state: BakedState
    aovs: dict[str, np.ndarray]
    clusters: list[ClusterView]


@dataclass(frozen=True)
class Survey:
    """All that a page shows.

    picture, spp  [H, W, 3] linear, and its samples per pixel
    noise         relMSE that is left in it by noise
    timed         samples per pixel of its last pass, and the seconds that it took
    view          what was prepared for the render that is asked for
    mapped        the same if maps were made in any case, None if that is so already
    rays          of each sample of a pixel, by kind: see ``system.ray_counts``
    patches       numbers of patches: in use, of these for indirect light alone, and left out
    patch_samples gather rays of each at least, None if they were sent long ago
    warnings      what Mitsuba has warned of, each once
    """

    picture: np.ndarray
    spp: int
    noise: float
    timed: tuple[int, float]
    view: View
    mapped: View | None
    rays: dict[str, float]
    patches: tuple[int, int, int]
    patch_samples: int | None
    warnings: list[str] = field(default_factory=list)


def survey(
    scene: mi.Scene, sensor: mi.Sensor, integrator: mi.Integrator, spp: int, seed: int
) -> Survey:
    """Look at what a render of ``spp`` samples per pixel by one of ours would use.

    Raises ``ValueError`` as ``integrator.prepare`` does.
    """
    with warned() as warnings:
        each, begin = max(min(PICTURE_SPP, spp) // 2, 1), time.perf_counter()
        for better in islice(integrator.progressive(scene, sensor, seed, each, spp), 2):
            picture, reached, noise = np.array(better.picture), better.spp, better.error
            now = time.perf_counter()
            seconds, begin = now - begin, now
        view = _view(scene, sensor, integrator, spp, seed, tuple(TYPES))
        rays = _rays(scene, sensor, integrator, spp, seed)
        mapped = None
        automatic = getattr(integrator, "maps", "") == "auto" and not integrator.cache_file
        if automatic and not view.state.maps:
            integrator.maps = "always"
            try:
                mapped = _view(scene, sensor, integrator, spp, seed, ("cluster", "served", "near"))
            finally:
                integrator.maps = "auto"
    settings = integrator.settings().for_render(n_pixels_of(sensor.film()) * spp)
    if picture.shape[2] < 3:  # Luminance, and alpha.
        picture = np.repeat(picture[..., :1], 3, axis=2)
    return Survey(
        picture[..., :3],
        reached,
        noise,
        (each, seconds),
        view,
        mapped,
        rays,
        _patches(view.state),
        None if integrator.cache_file else settings.patch_samples,
        list(dict.fromkeys(warnings)),
    )


def _rays(scene, sensor, integrator, spp: int, seed: int) -> dict[str, float]:
    """Rays of each kind for a sample of a pixel; those of the preparation have been sent before."""
    with count_rays() as counts:
        found = next(integrator.progressive(scene, sensor, seed, 1, spp))
        dr.eval(found.picture)
    n_samples = n_pixels_of(sensor.film()) * found.spp
    return {kind: count / n_samples for kind, count in counts.items() if count}


def _patches(state: BakedState) -> tuple[int, int, int]:
    cells = state.cache.patches.cells.numpy()
    cells = cells[cells >> MARK_BITS != 0]
    dropped = cells & DROPPED != 0
    used = cells[~dropped]
    return len(used), int((used & UNEVEN != 0).sum()), int(dropped.sum())


def _view(scene, sensor, integrator, spp, seed, types: tuple[str, ...]) -> View:
    before = integrator.aovs
    integrator.aovs = ", ".join(f"{kind}:{kind}" for kind in types)
    try:
        passes = integrator.progressive(scene, sensor, seed, min(AOV_SPP, spp), spp)
        channels = np.array(next(passes).picture)
        names = integrator.aov_names()
    finally:
        integrator.aovs = before
    aovs, begin = {}, channels.shape[2] - len(names)
    for kind, group in groupby(names, lambda name: name.partition(".")[0]):
        end = begin + len(list(group))
        aovs[kind] = channels[..., begin:end]
        begin = end
    state = integrator.prepare(scene, sensor, spp)
    return View(state, aovs, _clusters(scene, sensor, integrator, state, aovs))


def _clusters(scene, sensor, integrator, state: BakedState, aovs) -> list[ClusterView]:
    """What the rays through the centres of the pixels find of each cluster."""
    if not state.maps:
        return []
    height, width = aovs["served"].shape[:2]
    y, x = np.indices((height, width), np.float32).reshape(2, -1) + 0.5
    place = mi.Point2f(x / width, y / height)
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, place, mi.Point2f(0.5))
    object_ids = ObjectIds.of(scene)
    si = scene.ray_intersect(mi.Ray3f(ray))
    normal = dr.mulsign(si.n, -dr.dot(si.n, ray.d))
    object_id = object_ids(si)
    cluster = _cluster_at(state, si.p, normal, object_id, si.is_valid())
    sensors = scene.sensors()
    if sensor not in sensors:
        sensors = [*sensors, sensor]
    mirrors = integrator.settings().map_mirrors
    points = scatter_points(scene, object_ids, N_POINTS, sensors, mirrors)
    cluster_of_point = _cluster_at(state, *points.places(), mi.Bool(True))
    members = find_members(scene, state, points, cluster_of_point, integrator.requests)
    shapes = ordered_shapes(scene)
    names = {its: shape.id() for its, shape in zip(lasting_ids(shapes), shapes, strict=True)}
    object_id = object_id.numpy()
    served, near = aovs["served"].reshape(-1, 3), aovs["near"].ravel()
    found = []
    for index, (cube_map, its) in enumerate(zip(state.maps, members, strict=True)):
        there = cluster == index
        seen = dict.fromkeys(_ranked(points.object_id[cluster_of_point == index]), 0)
        if there.any():
            seen = _ranked(object_id[there])
        ids: dict[str, float] = {}
        for number, count in seen.items():
            ids[names[number]] = ids.get(names[number], 0.0) + count / len(there)
        found.append(
            ClusterView(
                cube_map.cluster,
                cube_map.masked,
                its,
                ids,
                float(there.mean()),
                tuple(served[there].mean(axis=0).tolist()) if there.any() else (0.0, 0.0, 0.0),
                float(near[there].mean()) if there.any() else 0.0,
            )
        )
    return found


def _cluster_at(state: BakedState, p, normal, object_id, active) -> np.ndarray:
    """Cluster of each surface point; the number of clusters stands for none."""
    cell = state.cache.patches.locate(p, normal, object_id, active)
    cluster = state.cluster_of_cell[cell.index.numpy()]
    return np.where(cell.found.numpy(), cluster, len(state.maps))


def _ranked(ids: np.ndarray) -> dict[int, int]:
    """How often each id comes, the most frequent first."""
    each, count = np.unique(ids, return_counts=True)
    order = np.argsort(-count, kind="stable")
    return {int(each[i]): int(count[i]) for i in order}
