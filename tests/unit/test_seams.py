"""Seams: between the faces of a map, where objects straddle a cube, where clusters meet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from envmap_integrator.lookup.cube import face_to_direction, n_levels
from envmap_integrator.lookup.cube_map import Cluster, CubeMap
from envmap_integrator.lookup.far_field import far_field
from envmap_integrator.preparation.maps.mipmap import build_levels
from tests.helpers import (
    QUANTILE,
    at,
    box,
    camera,
    cluster,
    film,
    grey,
    integrator,
    load,
    picture,
    scaled,
)
from tests.unit.kit import scene_of

pytestmark = pytest.mark.usefixtures("variant")

RESOLUTION = 64
LEVELS = range(n_levels(RESOLUTION))
#: A step across a border may be this many times as large as those beside it.
LARGEST_STEP = 1.5
GARBAGE = 1e9

# ---------------------- Maps and what the renderer reads from them ----------------------


def texel_directions() -> np.ndarray:
    """Unit directions [6, R, R, 3] of the centres of the finest texels."""
    face, y, x = (i.ravel() for i in np.indices((6, RESOLUTION, RESOLUTION)))
    uv = mi.Point2f((2 * np.stack([x, y]) + 1) / RESOLUTION - 1)
    d = dr.normalize(face_to_direction(mi.UInt32(face), uv)).numpy().T
    return d.reshape(6, RESOLUTION, RESOLUTION, 3)


def levels_of(value: np.ndarray, weight: np.ndarray | float = 1.0) -> list[np.ndarray]:
    """All levels of a grey map of values [6, R, R], everything infinitely far away."""
    texels = np.repeat(value[..., None], 4, axis=-1)
    texels[..., 3] = 0
    levels = build_levels(texels, np.broadcast_to(weight, value.shape))
    return [level.astype(np.float32) for level in levels]


def smooth_maps(count: int = 4) -> list[np.ndarray]:
    """A few spherical harmonics and a lobe, [6, R, R], turned at random."""
    maps = []
    for turn in Rotation.random(count, random_state=16).as_matrix():
        x, y, z = np.moveaxis(texel_directions() @ turn, -1, 0)
        lobe = np.exp(6 * ((2 * x - y + 2 * z) / 3 - 1))
        maps.append(1 + 0.3 * x - 0.2 * y + 0.25 * y * z + 0.15 * (3 * z * z - 1) + 0.5 * lobe)
    return maps


def look_up(levels: list[np.ndarray], level: int, d: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Radiance [N] of a level in directions [N, 3], with random numbers [N, 2] for the texel."""
    cube_map = CubeMap(Cluster("cluster", np.zeros(3), 0.5, 1.0), levels)
    field = far_field(scene_of(), (cube_map,), np.zeros(1, np.uint32), 1, 0.0, True, False)
    # The density of samples each of which stands for a texel of that level.
    uv = d / np.abs(d).max(axis=1, keepdims=True)
    pdf = 0.25 * (RESOLUTION >> level) ** 2 * (uv**2).sum(axis=1) ** 1.5
    radiance, trusted = field.eval(
        mi.UInt32(0),
        mi.Ray3f(mi.Point3f(0), mi.Vector3f(d.T.astype(np.float32))),
        mi.Float(pdf.astype(np.float32)),
        mi.Bool(False),
        mi.Float(0.5),
        mi.Point2f(u.T.astype(np.float32)),
        dr.full(mi.Bool, True, len(d)),
    )
    assert dr.all(trusted)
    return radiance.x.numpy()


def expectation(levels, level, d: np.ndarray) -> np.ndarray:
    """Mean [...] over the random texel in directions [..., 3]."""
    u = qmc.Sobol(2, seed=1).random_base2(11)
    each = look_up(levels, level, d.reshape(-1, 3).repeat(len(u), 0), np.tile(u, (d.size // 3, 1)))
    return each.reshape(-1, len(u)).mean(axis=1, dtype=np.float64).reshape(d.shape[:-1])


def nearest(levels, level, d: np.ndarray) -> np.ndarray:
    """The texel around each direction, as if nothing were random."""
    middle = np.full((d.size // 3, 2), 0.5)
    return look_up(levels, level, d.reshape(-1, 3), middle).reshape(d.shape[:-1])


# ---------------------- Constant maps ----------------------


@pytest.fixture
def random():
    return np.random.default_rng(15)


def directions_on_all_faces(random, count: int = 1000) -> np.ndarray:
    """[6 * count, 3] spread over the faces, and those of all edges and corners."""
    face = mi.UInt32(np.repeat(np.arange(6), count))
    uv = mi.Point2f(random.uniform(-1, 1, (2, 6 * count)).astype(np.float32))
    special = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    special = special[np.abs(special).sum(axis=1) > 0]
    return np.concatenate([face_to_direction(face, uv).numpy().T, special])


@pytest.mark.parametrize("level", LEVELS)
def test_the_level_is_the_one_asked_for(random, level):
    levels = levels_of(np.zeros((6, RESOLUTION, RESOLUTION)))
    for number, texels in enumerate(levels):
        texels[..., :3] = number
    d = directions_on_all_faces(random)
    assert (look_up(levels, level, d, random.uniform(size=(len(d), 2))) == level).all()


@pytest.mark.parametrize("masked", [0.0, 0.3, 0.99])
@pytest.mark.parametrize("level", LEVELS)
def test_a_constant_map_is_constant_on_every_face(random, level, masked):
    """Also where most texels are masked and hold garbage."""
    trusted = random.uniform(size=(6, RESOLUTION, RESOLUTION)) >= masked
    levels = levels_of(np.where(trusted, np.pi, GARBAGE), trusted)
    assert_allclose(levels[level][..., :3], np.pi, rtol=1e-6)
    d = directions_on_all_faces(random)
    for u in (random.uniform(size=(len(d), 2)), random.integers(2, size=(len(d), 2))):
        assert_allclose(look_up(levels, level, d, u), np.pi, rtol=1e-6)


# ---------------------- Borders between faces ----------------------

#: Points on either side of a border at which a map is read.
N_BESIDE = 3
#: Distances of these points, in texels. At the small one the look-up has to be continuous; at the
#: large one the texels have to fit together.
NEAR, FAR = 1 / 64, 1.0


def crossings(random, place: str, level: int, spacing: float, count: int = 64) -> np.ndarray:
    """Points [count, 2 * N_BESIDE, 3] on great circles that cross borders between faces.

    The border lies half way along each. They cross anywhere on the edges, or where ``place`` is
    "corner" within half a texel of their ends.
    """
    size = RESOLUTION >> level
    axis = random.integers(3, size=count)  # along the edge
    e = np.eye(3)
    first, second, along = (e[(axis + i) % 3] for i in (1, 2, 0))
    first, second = (v * random.choice([-1, 1], (count, 1)) for v in (first, second))
    v = random.uniform(-1, 1, (count, 1))
    if place == "corner":
        v = np.sign(v) * (1 - np.abs(v) / size)
    p = first + second + v * along
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    across = (first - second) / np.sqrt(2)
    aside = np.cross(p, across)
    slant = random.uniform(-np.pi / 4, np.pi / 4, (count, 1))
    w = np.cos(slant) * across + np.sin(slant) * aside
    # An edge of a texel at the border, seen from the centre.
    texel = 2 / size * np.sqrt(1 + v * v) / (2 + v * v)
    angle = spacing * texel * (np.arange(2 * N_BESIDE) + 0.5 - N_BESIDE)
    return np.cos(angle)[..., None] * p[:, None] + np.sin(angle)[..., None] * w[:, None]


def step_ratio(values: list[np.ndarray]) -> float:
    """Steps across borders over those beside them, rms, of values [..., 2 * N_BESIDE]."""
    steps = np.diff(np.concatenate(values), axis=1)
    across = steps[:, N_BESIDE - 1]
    beside = np.delete(steps, N_BESIDE - 1, axis=1)
    return float(np.sqrt((across**2).mean() / (beside**2).mean()))


@pytest.mark.parametrize("spacing", [NEAR, FAR], ids=["look-up", "texels"])
@pytest.mark.parametrize("place", ["edge", "corner"])
@pytest.mark.parametrize("level", LEVELS)
def test_maps_have_no_seams(random, level, place, spacing):
    values = [
        expectation(levels_of(texels), level, crossings(random, place, level, spacing))
        for texels in smooth_maps()
    ]
    assert step_ratio(values) <= LARGEST_STEP


@pytest.mark.parametrize("place", ["edge", "corner"])
@pytest.mark.parametrize("level", LEVELS)
def test_a_look_up_of_the_nearest_texel_would_show_seams(random, level, place):
    values = [
        nearest(levels_of(texels), level, crossings(random, place, level, NEAR))
        for texels in smooth_maps()
    ]
    assert step_ratio(values) > LARGEST_STEP


@pytest.mark.parametrize("place", ["edge", "corner"])
@pytest.mark.parametrize("level", [level for level in LEVELS if RESOLUTION >> level >= 8])
def test_a_brighter_face_would_show_a_seam(random, level, place):
    """By a tenth; on coarser levels texels differ by more than that from each other."""
    values = []
    for texels in smooth_maps():
        texels[4] *= 1.1
        d = crossings(random, place, level, FAR, count=192)
        on_face = (np.abs(d).argmax(axis=-1) == 2) & (d[..., 2] > 0)
        enters = on_face[:, N_BESIDE - 1] != on_face[:, N_BESIDE]
        values.append(expectation(levels_of(texels), level, d[enters]))
    assert step_ratio(values) > LARGEST_STEP


# ---------------------- Borders in pictures ----------------------

#: Strips that a picture is averaged over, and pixels across each.
STRIPS, STRIP = 8, 16
SEEDS = 8


@dataclass(frozen=True)
class Steps:
    """Steps from strip to strip along a picture, and their standard errors, [STRIPS - 1]."""

    mean: np.ndarray
    error: np.ndarray

    def ratios(self, border: slice) -> tuple[np.ndarray, float]:
        """Steps at a border over the two on either side, and half their confidence interval."""
        beside = np.r_[self.mean[: border.start][-2:], self.mean[border.stop :][:2]]
        typical = np.sqrt((beside**2).mean())
        ratios = self.mean[border] * np.sign(beside.sum()) / typical
        return ratios, QUANTILE * self.error[border].max() / typical


def measure_steps(scene: mi.Scene, integrator: mi.Integrator, axis: int) -> Steps:
    """Of a picture's strips, from row to row (0) or from column to column (1)."""
    pictures = [picture(scene, integrator, spp=64, seed=seed) for seed in range(SEEDS)]
    lines = np.mean(pictures, axis=(2 - axis, 3), dtype=np.float64)
    steps = np.diff(lines.reshape(SEEDS, STRIPS, STRIP).mean(axis=2), axis=1)
    return Steps(steps.mean(axis=0), steps.std(axis=0, ddof=1) / np.sqrt(SEEDS))


def assert_no_seam(steps: Steps, border: slice) -> None:
    """Where brightness grows steadily, a step that is too small is as visible as a large one."""
    ratios, half_width = steps.ratios(border)
    assert half_width <= 0.5, f"too noisy: ± {half_width:.2f}"
    assert ratios.max() <= LARGEST_STEP + half_width, f"{ratios} ± {half_width:.2f}"
    assert ratios.min() >= 1 / LARGEST_STEP - half_width, f"{ratios} ± {half_width:.2f}"


def hybrid_with(**settings) -> mi.Integrator:
    """With little noise in the cache and in the maps: it's the same in all pictures."""
    baker = {"type": "envmap_bake", "samples": 64}
    return integrator("envmap_hybrid", patch_samples=512, baker=baker, **settings)


def seen_from(origin, target, up, width: int, height: int, half_width: float) -> dict:
    """A sensor with parallel rays."""
    pose = mi.ScalarTransform4f().look_at(origin, target, up) @ scaled(half_width)
    sensor = camera() | {"type": "orthographic", "to_world": pose, "film": film(width, height)}
    return {name: value for name, value in sensor.items() if name not in ("fov", "near_clip")}


def cuboid(centre, half_edges, *reflectance: float) -> dict:
    transform = at(*centre) @ mi.ScalarTransform4f().scale(list(half_edges))
    return {"type": "cube", "to_world": transform} | grey(*reflectance)


def lit_room(x: float, y: float, **parts) -> mi.Scene:
    """A room with a spot light that shines at the ceiling: what is seen is lit indirectly."""
    pose = mi.ScalarTransform4f().look_at([x, y, 1], [x, y, 2], [0, 1, 0])
    spot = {"type": "spot", "to_world": pose, "intensity": 10.0, "cutoff_angle": 60.0}
    return load({"type": "scene", "walls": box(2) | grey(0.5), "spot": spot} | parts)


@pytest.fixture(scope="module")
def shelf(variant) -> mi.Scene:
    """Two boards side by side, from above: they meet in the middle. A plank stands behind them."""
    return lit_room(
        1.2,
        0.4,
        sensor=seen_from((0, 0, 0.5), (0, 0, -1), (0, 1, 0), STRIPS * STRIP, 32, 0.8),
        left=cuboid((-0.6, 0, -1.2), (0.6, 0.4, 0.2), 0.6),
        right=cuboid((0.6, 0, -1.2), (0.6, 0.4, 0.2), 0.6),
        plank=cuboid((0.3, 0.7, -0.8), (0.9, 0.05, 0.5), 0.8, 0.6, 0.4),
    )


MIDDLE = slice(STRIPS // 2 - 1, STRIPS // 2)
SHELF_CLUSTERS = {
    "the-cube-ends-at-the-border": {"a": cluster("left", distance_ratio=1.0)},
    "the-cube-reaches-beyond-it": {"a": cluster("left", distance_ratio=1.5)},
    "the-plank-straddles-the-cube": {"a": cluster("left", "right", distance_ratio=1.0)},
    "cubes-that-touch": {
        "a": cluster("left", distance_ratio=1.0),
        "b": cluster("right", distance_ratio=1.0),
    },
    "cubes-that-overlap": {
        "a": cluster("left", distance_ratio=1.5),
        "b": cluster("right", distance_ratio=1.5),
    },
    "a-large-and-a-small-cube": {
        "a": cluster("left", distance_ratio=1.2),
        "b": cluster("right", distance_ratio=2.5),
    },
}


def test_path_shows_no_seam_on_the_shelf(shelf):
    assert_no_seam(measure_steps(shelf, integrator("path"), axis=1), MIDDLE)


@pytest.mark.parametrize("case", SHELF_CLUSTERS)
def test_clusters_meet_without_a_seam(shelf, case):
    clusters = SHELF_CLUSTERS[case]
    hybrid = hybrid_with(**clusters)
    assert len(hybrid.prepare(shelf).maps) == len(clusters)
    assert_no_seam(measure_steps(shelf, hybrid, axis=1), MIDDLE)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_darker_or_brighter_map_would_show_a_seam(shelf, tmp_path, factor):
    clusters = SHELF_CLUSTERS["the-cube-reaches-beyond-it"]
    prepared = hybrid_with(**clusters).prepare(shelf)
    scale = np.array([factor, factor, factor, 1], np.float32)
    changed = replace(prepared.maps[0], levels=[x * scale for x in prepared.maps[0].levels])
    file = str(tmp_path / "state.exr")
    replace(prepared, maps=(changed,)).save(file)
    steps = measure_steps(shelf, hybrid_with(cache_file=file, **clusters), axis=1)
    with pytest.raises(AssertionError, match=r"\] ±"):
        assert_no_seam(steps, MIDDLE)


# ---- What a mirror shows of an object that straddles the cube around it ----


@pytest.fixture(scope="module")
def mirror(variant) -> mi.Scene:
    """A mirror on the floor, from above; in it a screen, whose rows lie below each other.

    The cube around the mirror ends at z = 0: the screen is seen from z = -0.5 to z = 0.4.
    """
    glass = {"type": "rectangle", "to_world": at(0, 0, -1) @ scaled(0.5)}
    return lit_room(
        0,
        0.4,
        sensor=seen_from((0, -1, 0), (0, 0, -1), (0, 0, 1), 32, STRIPS * STRIP, 0.08),
        mirror=glass | {"bsdf": {"type": "conductor"}},
        screen=cuboid((0, 1, 0), (0.8, 0.05, 1.5), 0.8, 0.6, 0.4),
    )


#: Where rays go over from tracing to the map: up to z = 0.1, for what they are traced farther.
HANDED_OFF = slice(3, 6)


def test_path_shows_no_seam_in_the_mirror(mirror):
    assert_no_seam(measure_steps(mirror, integrator("path"), axis=0), HANDED_OFF)


def test_an_object_that_straddles_a_cube_shows_no_seam(mirror):
    desk = cluster("mirror", distance_ratio=2.0)
    hybrid = hybrid_with(mirrors="map", desk=desk)
    assert len(hybrid.prepare(mirror).maps) == 1
    assert_no_seam(measure_steps(mirror, hybrid, axis=0), HANDED_OFF)
