"""The pre-passes in order: scene → coarse mesh → irradiance cache → clusters → maps."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lookup.cube_map import CubeMap
from ..lookup.lookup import Lookup
from ..system.memory import check_memory
from ..system.progress import stage
from ..transport.camera import camera_radiance
from ..transport.rules import as_baked
from .baked_state import BakedState, Settings, StateKey
from .coarse_mesh.build import build_mesh
from .coarse_mesh.patch_points import only_standing
from .coarse_mesh.spaces import find_spaces, separate
from .coarse_mesh.surface_points import scatter_points
from .maps.bake import bake_maps
from .maps.clusters import (
    benefit,
    cluster_of_cell,
    find_clusters,
    listed_clusters,
    shapes_named,
    worthwhile,
)
from .radiosity.direct_light import choose_emitters, survey_direct_light
from .radiosity.evenness import sort_out_uneven
from .radiosity.irradiance import solve_irradiance
from .scene_state import SceneState
from .views import usual_service, view_name

#: How often patches that turn out to be too large are halved.
MOST_DIVISIONS = 2
#: Surface points per patch of the budget.
POINTS_PER_PATCH = 24
#: Memory [bytes] taken at most by a patch of the budget, by each of its gather rays, and by each of
#: the finest texels of a map, while they are made (measured).
PATCH_MEMORY, RAY_MEMORY, TEXEL_MEMORY = 10000, 40, 130


@stage("Preparing")
def prepare(
    scene: mi.Scene,
    state: SceneState,
    asked: Settings,
    settings: Settings,
    sensors: list[mi.Sensor],
    owner: str,
    kept: tuple[CubeMap, ...] = (),
) -> BakedState:
    """Run the pre-passes for the views of some sensors.

    ``state`` is that of the scene; ``settings`` are those ``asked`` for, ``for_render``. Maps that
    are ``kept`` aren't baked again for the clusters of their names. Raises
    ``ValueError``, in the name of ``owner``, if there is too little memory for them.
    """
    check_memory(
        owner,
        f"{settings.patches} patches with {settings.patch_samples} samples each",
        settings.patches * (PATCH_MEMORY + RAY_MEMORY * settings.patch_samples)
        + settings.more_rays * RAY_MEMORY,
        'lower "patches" or "patch_samples"',
    )
    times: dict[str, float] = {}

    with _timed(times, "coarse mesh"):
        points = scatter_points(
            scene, state.ids, POINTS_PER_PATCH * settings.patches, sensors, settings.map_mirrors
        )
    divided = None
    for divisions in range(MOST_DIVISIONS + 1):
        with _timed(times, "coarse mesh"):
            mesh = only_standing(build_mesh(points, state.ids, settings.patches, divided))
            mesh = separate(scene, state.ids, find_spaces(scene, mesh))

        with _timed(times, "direct light"):
            light = survey_direct_light(scene, state.emitters, mesh)
            choice = choose_emitters(state.emitters, light, mesh)
            mesh = sort_out_uneven(light, mesh)

        with _timed(times, "irradiance cache"):
            lookup = Lookup(mesh.patches, state.ids, choice)
            solution = solve_irradiance(
                scene,
                lookup,
                mesh,
                settings.patch_samples,
                settings.more_rays,
                may_divide=divisions < MOST_DIVISIONS,
                members=light.members.only(mesh),
            )
        if not solution.steep.any():
            break
        divided = solution.steep.astype(int) + (0 if divided is None else divided)

    maps, membership = (), None
    if settings.maps:
        with _timed(times, "clusters"):
            clusters, cluster_of_point = _clusters(scene, mesh, solution, settings, owner)
            membership = cluster_of_cell(len(clusters), cluster_of_point, mesh)
        with _timed(times, "maps"):
            members = [points.take(cluster_of_point == i) for i in range(len(clusters))]
            lookup = replace(lookup, cache=solution.cache)
            maps = _baked(scene, lookup, clusters, members, settings, owner, kept)
    return BakedState(
        StateKey(state.fingerprint, asked),
        solution.cache,
        choice.table,
        choice.row_of_cell,
        tuple(map(view_name, sensors)),
        usual_service(mesh, solution.relative_error),
        solution.relative_error,
        solution.size_error,
        maps,
        membership,
        times,
    )


def _clusters(scene, mesh, solution, settings, owner):
    """Those that are listed, or those found whose maps would pay: see ``find_clusters``."""
    points, space = mesh.points, mesh.space_of_point
    excluded = shapes_named(scene, settings.no_cluster, f'{owner}: "no_cluster"')
    excluded = np.isin(points.object_id, excluded)
    share = np.where(mesh.patch_of_point >= 0, solution.escaped_share[mesh.patch_of_point], 0)
    if settings.requests:
        found = listed_clusters(points, space, scene, settings.requests, settings.distance_ratio)
    # Clusters are only looked for if they would pay at least if everything belonged to one.
    elif settings.map_always or worthwhile(benefit(points, share)):
        found = find_clusters(points, space, settings.distance_ratio, excluded)
    else:
        found = [], np.full(len(points), -1)
    clusters, cluster_of_point = found
    clusters = [
        replace(cluster, benefit=benefit(points, share, cluster_of_point == i))
        for i, cluster in enumerate(clusters)
    ]
    pays = worthwhile(sum(cluster.benefit for cluster in clusters))
    if not (settings.requests or settings.map_always or pays):
        return [], np.full(len(points), -1)
    return clusters, cluster_of_point


def _baked(scene, lookup, clusters, members, settings, owner, kept) -> tuple[CubeMap, ...]:
    asked = {request.name: request.resolution for request in settings.requests}
    resolutions = [asked.get(c.name) or settings.map_resolution for c in clusters]
    rules = as_baked(settings.map_shadow_samples)

    def radiance_distance(sampler, ray, active):
        found = camera_radiance(scene, lookup, rules, sampler, ray, active)
        return found.radiance, found.distance

    had = {cube_map.cluster.name: cube_map for cube_map in kept}
    maps = {i: had[c.name] for i, c in enumerate(clusters) if c.name in had}
    missing = [i for i in range(len(clusters)) if i not in maps]
    for resolution in sorted({resolutions[i] for i in missing}):
        chosen = [i for i in missing if resolutions[i] == resolution]
        check_memory(
            owner,
            f"{len(chosen)} maps of {resolution} x {resolution} texels a face",
            len(chosen) * 6 * resolution**2 * TEXEL_MEMORY,
            'lower "map_resolution" or list fewer clusters',
        )
        baked = bake_maps(
            scene,
            radiance_distance,
            [clusters[i] for i in chosen],
            [members[i] for i in chosen],
            resolution,
            settings.map_samples,
            seed=1,
        )
        maps |= zip(chosen, baked, strict=True)
    return tuple(maps[i] for i in range(len(clusters)))


@contextmanager
def _timed(times: dict[str, float], name: str):
    begin = time.perf_counter()
    with stage(name.capitalize()):
        yield
        dr.sync_thread()
    times[name] = times.get(name, 0.0) + time.perf_counter() - begin
