"""The error that the irradiance cache states of itself."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.lookup.irradiance_cache import IrradianceCache
from envmap_integrator.preparation.coarse_mesh.patch_points import PatchPoints
from envmap_integrator.preparation.radiosity.coarseness import Coarseness
from envmap_integrator.preparation.radiosity.gather import block_mean, gather
from envmap_integrator.preparation.radiosity.incidence import Incidence
from envmap_integrator.preparation.radiosity.irradiance import solve_irradiance
from envmap_integrator.preparation.radiosity.noise import TARGET, Noise
from envmap_integrator.preparation.radiosity.unknowns import Unknowns
from envmap_integrator.preparation.views import service, walks
from tests.helpers import Description, at, box, camera, emitting, grey, load, room
from tests.unit.kit import CoarseMesh, coarse_mesh

pytestmark = pytest.mark.usefixtures("variant")

BUDGET, SAMPLES = 512, 16
BEHIND_THE_WALL = {"origin": (1.5, -1.0, 0), "target": (1, 1.5, -1)}
BEFORE_THE_WALL = {"origin": (-1.5, -1.0, 0), "target": (-1, 1.5, -1)}


def behind_a_wall(*sensors: Description) -> mi.Scene:
    """A room whose lamp shines on the other side of a wall with a gap at one end.

    The camera is behind the wall, unless there are other ``sensors``.
    """
    place = at(0.1, 0.4, 0) @ mi.ScalarTransform4f().rotate([0, 1, 0], 90).scale([2.1, 2.1, 1])
    wall = {"type": "rectangle", "to_world": place, "bsdf": {"type": "twosided"} | grey(0.5)}
    sensors = sensors or (camera(**BEHIND_THE_WALL),)
    lamp = {"type": "sphere", "center": [-1.8, 1.0, 0], "radius": 0.1} | grey(0) | emitting(50)
    return load(
        {"type": "scene", "walls": box(2.0) | grey(0.5), "wall": wall, "lamp": lamp}
        | {f"sensor{i}": sensor for i, sensor in enumerate(sensors)}
    )


def solutions(
    scene: mi.Scene,
    more_rays: int = 0,
    count: int = 16,
    budget=BUDGET,
    samples=SAMPLES,
    view: mi.Sensor | None = None,
):
    """Brightness of what the sensor sees, and the stated error, of caches by other rays.

    What is seen gathers light by rays of its own, always the same, which end in the cache. A
    ``view`` is seen instead of the sensor that the caches are made for.
    """
    coarse = coarse_mesh(scene, budget, points_per_patch=32)
    lookup = coarse.lookup()
    members = PatchPoints(coarse)
    patches = np.arange(len(members.patches))
    incidence = Incidence(coarse.points)
    rays = gather(scene, lookup, Unknowns(members), incidence, patches, 1024, seed=7)
    if view is None:
        points, patch = coarse.points, coarse.patch_of_point
    else:
        points = walks(scene, coarse.object_ids, view)
        index, _, found = coarse.find(points)
        patch = np.where(found, index.astype(int), -1)
    seen = (points.seen > 0) & (points.bounce == 0) & (patch >= 0)
    share = np.bincount(patch[seen], minlength=coarse.patches.count)
    share = share[members.patches] / share.sum()
    own = (rays.direct + rays.escaped).numpy().mean(axis=0)

    brightness, stated = [], []
    for seed in range(count):
        solution = solve_irradiance(
            scene,
            lookup,
            coarse,
            samples,
            more_rays,
            seed=1 << 20 | seed << 12,
        )
        arriving = rays.weight * dr.gather(mi.Spectrum, solution.cache.table, rays.row)
        arriving = block_mean(dr.mean(arriving), rays.samples).numpy()
        brightness.append(share @ (own + arriving))
        chance = solution.noise.chance
        stated.append(error_of(view, coarse, solution.cache) if view else chance)
    return np.array(brightness), np.array(stated)


def error_of(view: mi.Sensor, coarse: CoarseMesh, cache: IrradianceCache) -> float:
    """What a view that the cache wasn't made for is told."""
    return service(walks(coarse.scene, coarse.object_ids, view), cache, 0.0).error


@pytest.mark.parametrize("scene", [lambda: load(room()), behind_a_wall], ids=["room", "gap"])
def test_caches_scatter_as_they_state(scene):
    brightness, stated = solutions(scene())
    scatter = brightness.std(ddof=1) / brightness.mean()
    assert scatter / 2 < stated.mean() < 2 * scatter


def test_caches_scatter_as_is_stated_of_another_view():
    """Which hangs on what the cache's own view hardly looks at."""
    scene = behind_a_wall(camera(**BEFORE_THE_WALL))
    brightness, stated = solutions(scene, view=mi.load_dict(camera(**BEHIND_THE_WALL)))
    scatter = brightness.std(ddof=1) / brightness.mean()
    assert scatter / 2 < stated.mean() < 2 * scatter
    _, of_own_view = solutions(scene)
    assert stated.mean() > 2 * of_own_view.mean()


@pytest.mark.parametrize("scene", [lambda: load(room()), behind_a_wall], ids=["room", "gap"])
def test_walks_state_what_gather_rays_do(scene):
    coarse = coarse_mesh(scene(), 1024, points_per_patch=32)
    solution = coarse.solution(32)
    (sensor,) = coarse.scene.sensors()
    by_walks = error_of(sensor, coarse, solution.cache)
    assert 0.6 < by_walks / solution.noise.chance < 1.4


def test_irradiance_scatters_as_each_patch_states():
    """Or less: rays are stratified better than pairs of them tell."""
    scene = load(room())
    coarse = coarse_mesh(scene, BUDGET, points_per_patch=32)
    caches = [
        solve_irradiance(scene, coarse.lookup(), coarse, SAMPLES, seed=1 << 20 | seed << 12).cache
        for seed in range(24)
    ]
    scatter = np.std([cache.mean_channel()[::2] for cache in caches], axis=0, ddof=1)
    stated = np.sqrt(np.mean([np.square(cache.error.numpy()[::2]) for cache in caches], axis=0))
    used = scatter > 0
    assert used.sum() > BUDGET / 4 and not stated[~used].any()
    assert 0.5 < np.median(scatter[used] / stated[used]) < 1.1
    assert np.corrcoef(np.log(scatter[used]), np.log(stated[used]))[0, 1] > 0.7


def test_more_rays_lower_the_error_without_a_bias():
    few, stated_of_few = solutions(behind_a_wall())
    many, stated_of_many = solutions(behind_a_wall(), more_rays=1 << 18)
    assert stated_of_few.mean() > 2 * TARGET
    assert stated_of_many.mean() < 0.6 * stated_of_few.mean()
    assert many.std() < 0.75 * few.std()
    error = np.hypot(few.std(ddof=1), many.std(ddof=1)) / np.sqrt(len(few))
    assert abs(few.mean() - many.mean()) < 3 * error


# ---------------------- Where rays are sent ----------------------


def noise(relative_error: float) -> Noise:
    """Of four patches, the last of which hasn't found anything."""
    return Noise(
        chance=relative_error,
        coarseness=Coarseness(bias=0.0, doubt=0.0, steep=np.zeros(1, dtype=bool), steep_bias=0.0),
        scatter=np.array([1.0, 2.0, 3.0, 0.0]) * relative_error,
        stake=np.array([1.0, 1.0, 1.0, 4.0]),
        of_irradiance=np.zeros((4, 2)),
        count=np.ones(4, dtype=np.int64),
        escaped_share=np.zeros(4),
    )


def test_rays_go_where_they_lower_the_error():
    wanted = noise(0.1).blocks_wanted(most=500, samples=16)
    assert 500 <= wanted.sum() <= 504
    assert wanted[0] < wanted[1] < wanted[2]
    assert wanted[3] > 10


def test_no_more_rays_are_sent_than_the_error_asks_for():
    assert not noise(TARGET).blocks_wanted(most=1000, samples=16).any()
    few = noise(2 * TARGET).blocks_wanted(most=1 << 20, samples=1)
    twice = replace(noise(2 * TARGET), scatter=2 * noise(2 * TARGET).scatter)
    assert twice.blocks_wanted(most=1 << 20, samples=1).sum() > 3 * few.sum()


def test_every_patch_gets_new_rays():
    """Those that have asked for them don't count any longer."""
    silent = replace(noise(0.1), stake=np.array([1.0, 1.0, 1.0, 0.0]))
    assert silent.blocks_wanted(most=1000, samples=16)[3] == 1


# ---------------------- Several views ----------------------


def stated_by(*sensors: Description) -> float:
    scene = behind_a_wall(*sensors)
    coarse = coarse_mesh(scene, BUDGET, points_per_patch=32)
    return coarse.solution(SAMPLES).noise.chance


def test_a_bright_view_says_nothing_of_a_dim_one():
    bright = camera(origin=(-1.0, -1.5, 0), target=(-1.8, 1.5, -1))
    dim = camera(origin=(1.5, -1.0, 0), target=(1, 1.5, -1))
    assert stated_by(bright) < stated_by(dim) / 2
    assert stated_by(bright, dim) > stated_by(dim) / 2


def test_what_reflects_nothing_says_nothing():
    """The sunlit outside of one-sided walls, say, is as black as their inside may be bright."""
    coarse = coarse_mesh(behind_a_wall(), BUDGET, points_per_patch=32)
    stated = coarse.solution(SAMPLES).noise.chance
    black = replace(coarse.points, reflects=np.zeros_like(coarse.points.reflects))
    lit = replace(coarse.points, reflects=3 * coarse.points.reflects)
    assert replace(coarse, points=black).solution(SAMPLES).noise.chance == 0
    assert replace(coarse, points=lit).solution(SAMPLES).noise.chance == pytest.approx(stated)
