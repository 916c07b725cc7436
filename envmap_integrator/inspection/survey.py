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
from ..system.ray_counts import count_rays
from ..system.scene_order import lasting_ids, ordered_shapes
from ..system.warned import warned

#: Samples per pixel of the picture, in two passes, and of the AOVs.
PICTURE_SPP, AOV_SPP = 16, 4
#: Rays that look for the shapes of a cluster that isn't seen.
N_RAYS = 1 << 14


@dataclass(frozen=True)
class ClusterView:
    """A cluster as a sensor sees it.

    cluster   the cluster
    masked    part of its map's texels that no ray of it was seen to reach
    shapes    part of the picture by the ids of its shapes, largest first; 0 for all if none of
              them is seen
    seen      part of the picture that shows it
    served    parts of its secondary rays that were traced on, ended in the cache, and in its map
    near      part of them that were traced on as what they hit was too near for the cache
    """

    cluster: Cluster
    masked: float
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
    warnings      what Mitsuba has logged
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
        warnings,
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
    return View(state, aovs, _clusters(scene, sensor, state, aovs["served"], aovs["near"]))


def _clusters(scene, sensor, state: BakedState, served, near) -> list[ClusterView]:
    """What the rays through the centres of the pixels find of each cluster."""
    if not state.maps:
        return []
    height, width = served.shape[:2]
    y, x = np.indices((height, width), np.float32).reshape(2, -1) + 0.5
    place = mi.Point2f(x / width, y / height)
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, place, mi.Point2f(0.5))
    cluster, object_id = _hit(scene, state, mi.Ray3f(ray))
    shapes = ordered_shapes(scene)
    names = {its: shape.id() for its, shape in zip(lasting_ids(shapes), shapes, strict=True)}
    served, near = served.reshape(-1, 3), near.ravel()
    found = []
    for index, cube_map in enumerate(state.maps):
        there = cluster == index
        seen = _ranked(object_id[there])
        ids = {names[its]: count / len(there) for its, count in seen.items()}
        if not seen:
            its, hit = _hit(scene, state, _rays_at(cube_map.cluster))
            ids = dict.fromkeys((names[i] for i in _ranked(hit[its == index])), 0.0)
        found.append(
            ClusterView(
                cube_map.cluster,
                cube_map.masked,
                ids,
                float(there.mean()),
                tuple(served[there].mean(axis=0).tolist()) if there.any() else (0.0, 0.0, 0.0),
                float(near[there].mean()) if there.any() else 0.0,
            )
        )
    return found


def _hit(scene, state: BakedState, ray: mi.Ray3f) -> tuple[np.ndarray, np.ndarray]:
    """Cluster and shape of what rays hit; the number of clusters stands for none."""
    si = scene.ray_intersect(ray)
    normal = dr.mulsign(si.n, -dr.dot(si.n, ray.d))
    object_id = ObjectIds.of(scene)(si)
    cell = state.cache.patches.locate(si.p, normal, object_id, si.is_valid())
    cluster = state.cluster_of_cell[cell.index.numpy()]
    return np.where(cell.found.numpy(), cluster, len(state.maps)), object_id.numpy()


def _rays_at(cluster: Cluster) -> mi.Ray3f:
    """Rays all through a cluster, for those that no sensor sees."""
    rng, radius = np.random.default_rng(0), cluster.radius
    places = rng.uniform(-1, 1, (2, N_RAYS, 3))
    begin, end = cluster.centre + radius * places
    direction = (end - begin) / np.maximum(np.linalg.norm(end - begin, axis=1, keepdims=True), 1e-9)
    origin, direction = (mi.Point3f(x.T.astype(np.float32)) for x in (begin, direction))
    return mi.Ray3f(origin, mi.Vector3f(direction))


def _ranked(ids: np.ndarray) -> dict[int, int]:
    """How often each id comes, the most frequent first."""
    each, count = np.unique(ids, return_counts=True)
    order = np.argsort(-count, kind="stable")
    return {int(each[i]): int(count[i]) for i in order}
