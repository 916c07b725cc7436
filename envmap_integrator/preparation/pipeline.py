"""The pre-passes in order: scene → coarse mesh → irradiance cache → clusters → maps."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lookup.emitter_choice import Emitters
from ..lookup.ids import ObjectIds
from ..system.memory import check_memory
from ..transport.path import Transport
from .baked_state import Prepared, Settings
from .coarse_mesh.build import build_patches
from .coarse_mesh.patch_points import only_standing
from .coarse_mesh.spaces import find_spaces, separate
from .coarse_mesh.surface_points import scatter_points
from .coarse_mesh.views import usual_service, view_name
from .maps.clusters import cluster_of_cell, find_clusters, listed_clusters, worthwhile
from .radiosity.direct_light import choose_sources, survey_direct_light
from .radiosity.evenness import sort_out_uneven
from .radiosity.irradiance import solve_irradiance

#: How often patches that turn out to be too large are halved.
MOST_DIVISIONS = 2
#: Surface points per patch of the budget.
POINTS_PER_PATCH = 24
#: Memory [bytes] taken at most by a patch of the budget, by each of its gather rays, and by each of
#: the finest texels of a map, while they are made (measured).
PATCH_MEMORY, RAY_MEMORY, TEXEL_MEMORY = 10000, 40, 130


def prepare(
    scene: mi.Scene,
    key: str,
    settings: Settings,
    sensors: list[mi.Sensor],
    owner: str,
    baker=None,
) -> Prepared:
    """Run the pre-passes for the views of some sensors.

    ``settings`` are those ``for_render``; ``baker`` is the ``envmap_bake`` that fills the maps.
    Raises ``ValueError``, in the name of ``owner``, if there is too little memory for the settings.
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
        object_ids, emitters = ObjectIds(scene), Emitters(scene)
        points = scatter_points(
            scene, object_ids, POINTS_PER_PATCH * settings.patches, sensors, settings.map_mirrors
        )
    divided = None
    for divisions in range(MOST_DIVISIONS + 1):
        with _timed(times, "coarse mesh"):
            patches, patch_of_point, cell_of_point = build_patches(
                points, object_ids, settings.patches, divided
            )
            patch_of_point = only_standing(points, patches, patch_of_point)
            space = find_spaces(scene, points, patch_of_point)
            patches, patch_of_point, cell_of_point = separate(
                scene, object_ids, patches, points, patch_of_point, cell_of_point, space
            )

        with _timed(times, "direct light"):
            light = survey_direct_light(scene, emitters, points, patch_of_point, patches.count)
            sources = choose_sources(emitters, light, points, cell_of_point, patches)
            patches, patch_of_point = sort_out_uneven(light, patches, patch_of_point)

        with _timed(times, "irradiance cache"):
            solution = solve_irradiance(
                scene,
                Transport(patches, object_ids, sources),
                points,
                patch_of_point,
                cell_of_point,
                settings.patch_samples,
                settings.more_rays,
                may_divide=divisions < MOST_DIVISIONS,
            )
        if not solution.steep.any():
            break
        divided = solution.steep.astype(int) + (0 if divided is None else divided)

    prepared = Prepared(
        key,
        solution.cache,
        sources.table,
        sources.row_of_cell,
        tuple(map(view_name, sensors)),
        usual_service(points, patch_of_point),
        solution.relative_error,
        stage_times=times,
    )
    if not settings.maps:
        return prepared

    with _timed(times, "clusters"):
        if settings.requests:
            clusters, cluster_of_point = listed_clusters(
                points, space, scene, settings.requests, settings.distance_ratio
            )
        else:
            share = solution.escaped_share[patch_of_point]
            share = np.where(patch_of_point >= 0, share, 0)
            clusters, cluster_of_point = _paying_clusters(points, space, settings, share)
        membership = cluster_of_cell(
            len(clusters), cluster_of_point, cell_of_point, dr.width(patches.levels)
        )

    resolution = settings.map_resolution
    check_memory(
        owner,
        f"{len(clusters)} maps of {resolution} x {resolution} texels a face",
        len(clusters) * 6 * resolution**2 * TEXEL_MEMORY,
        'lower "map_resolution" or list fewer clusters',
    )
    with _timed(times, "maps"):
        members = [points.take(np.flatnonzero(cluster_of_point == i)) for i in range(len(clusters))]
        maps = baker.bake(scene, prepared, clusters, members, resolution)
    return replace(prepared, maps=maps, cluster_of_cell=membership)


def _paying_clusters(points, space, settings, escaped_share):
    """As ``find_clusters``; none if their maps wouldn't pay."""
    none = [], np.full(len(points), -1)
    # Clusters are only looked for if they would pay at least if everything belonged to one.
    if not (settings.map_always or worthwhile(points, escaped_share)):
        return none
    found = find_clusters(points, space, settings.distance_ratio)
    if not (settings.map_always or worthwhile(points, escaped_share, found[1] >= 0)):
        return none
    return found


@contextmanager
def _timed(times: dict[str, float], name: str):
    begin = time.perf_counter()
    yield
    dr.sync_thread()
    times[name] = times.get(name, 0.0) + time.perf_counter() - begin
