"""Every material, on a table top and on a ball on it: as bright as with ``path``.

``pytest -rP tests/system/test_bsdfs.py`` lists the measured errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.helpers import (
    Description,
    at,
    ball,
    camera,
    cluster,
    colour,
    grey,
    lamp,
    load,
    picture,
    scaled,
)

pytestmark = pytest.mark.usefixtures("variant")

#: Relative error allowed beyond what noise explains, and the confidence of the intervals.
ALLOWED, CONFIDENCE = 0.01, 0.99
#: Largest half width of an interval with which a comparison means anything.
PRECISION = 0.02
SEEDS, SPP = 8, 256

# ---------------------- Materials ----------------------

#: A kernel each would take too long to compile: four materials share a room, all share a furnace.
ROOMS = tuple(
    tuple(names.split())
    for names in (
        "diffuse checkerboard twosided normalmap",
        "bumpmap blendbsdf mask plastic",
        "roughplastic-0.05 roughplastic-0.3 principled-metallic principled-clearcoat",
        "conductor roughconductor-0.001 roughconductor-0.1 roughconductor-0.3",
        "roughconductor-1 roughconductor-textured principled-glass principled-textured",
        "dielectric thindielectric roughdielectric-0.05 roughdielectric-0.3",
    )
)
MATERIALS = sum(ROOMS, ())
#: Maps are made whether they pay or not.
OURS = {"type": "envmap_hybrid", "maps": "always", "shadow_samples": 1}
#: Traced in full, so that they need no cube.
PERFECT = ("conductor", "dielectric", "thindielectric")
PARTS = ("table", "ball")


def materials(white: bool = False) -> dict[str, Description]:
    """All materials by name; white ones absorb nothing."""

    def tint(*reflectance):
        return colour(1) if white else colour(*reflectance)

    def metal(alpha):
        rough = {"type": "roughconductor", "alpha": alpha} if alpha else {"type": "conductor"}
        return rough | {"material": "none" if white else "Cu"}

    def glazed(kind, **settings):
        return {"type": kind, "diffuse_reflectance": tint(0.6, 0.3, 0.2)} | settings

    def principled(**settings):
        return {"type": "principled", "base_color": tint(0.7, 0.5, 0.3)} | settings

    def glass(alpha):
        return {"type": "roughdielectric", "alpha": alpha}

    diffuse = {"type": "diffuse", "reflectance": tint(0.3, 0.5, 0.7)}
    board = {"type": "checkerboard", "color0": tint(0.1), "color1": tint(0.9, 0.6, 0.3)}
    return {
        "diffuse": diffuse,
        "checkerboard": {"type": "diffuse", "reflectance": board},
        "twosided": {"type": "twosided", "bsdf": glazed("roughplastic", alpha=0.1)},
        "normalmap": {"type": "normalmap", "normalmap": texture(tilted_normals()), "bsdf": diffuse},
        "bumpmap": {"type": "bumpmap", "map": texture(ripples()), "bsdf": diffuse},
        "blendbsdf": {"type": "blendbsdf", "weight": 0.4, "a": diffuse, "b": metal(0.2)},
        "mask": {"type": "mask", "opacity": 0.5, "bsdf": diffuse},
        "plastic": glazed("plastic"),
        "roughplastic-0.05": glazed("roughplastic", alpha=0.05),
        "roughplastic-0.3": glazed("roughplastic", alpha=0.3),
        "principled-metallic": principled(metallic=0.8, roughness=0.3),
        "principled-clearcoat": principled(specular=0.8, clearcoat=1.0, clearcoat_gloss=0.9),
        "principled-glass": principled(spec_trans=0.8, roughness=0.3),
        "principled-textured": principled(metallic=0.5, roughness=spots(0.1, 0.6)),
        "conductor": metal(0),
        "roughconductor-0.001": metal(0.001),
        "roughconductor-0.1": metal(0.1),
        "roughconductor-0.3": metal(0.3),
        "roughconductor-1": metal(1.0),
        "roughconductor-textured": metal(spots(0.05, 0.4)),
        "dielectric": {"type": "dielectric"},
        "thindielectric": {"type": "thindielectric"},
        "roughdielectric-0.05": glass(0.05),
        "roughdielectric-0.3": glass(0.3),
    }


def texture(values: np.ndarray) -> Description:
    bitmap = mi.Bitmap(np.asarray(values, dtype=np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True}


def spots(low: float, high: float) -> Description:
    return texture(np.where(np.indices((8, 8)).sum(axis=0) % 3 == 0, low, high))


def ripples() -> np.ndarray:
    x = np.linspace(0, 12 * np.pi, 64, endpoint=False)
    return 0.05 * np.sin(x)[:, None] * np.sin(x)[None, :]


def tilted_normals() -> np.ndarray:
    slope = 6 * ripples()
    normals = np.stack([slope, slope.T, np.ones_like(slope)], axis=-1)
    return 0.5 + 0.5 * normals / np.linalg.norm(normals, axis=-1, keepdims=True)


# ---------------------- Scenes ----------------------

#: Half widths of the room and of the table tops, and where the middles of the table tops are.
ROOM, TABLE = 2.0, 0.45
PLACES = tuple((0.95 * x, 0.95 * y, -0.84) for x, y in product((-1, 1), repeat=2))
LAMP_HEIGHT = 1.95
WALLS = {
    (0, 0, -1): (0.4, 0.4, 0.4),
    (0, 0, 1): (0.8, 0.8, 0.8),
    (-1, 0, 0): (0.7, 0.2, 0.1),
    (1, 0, 0): (0.2, 0.6, 0.2),
    (0, -1, 0): (0.7, 0.6, 0.2),
    (0, 1, 0): (0.2, 0.3, 0.7),
}


def room(lamp_size: float = 0.8) -> Description:
    """A closed room of six colours, and a sensor above each table that sees a lamp mirrored in it.

    ``lamp_size`` is the half width of the lamp under the ceiling.
    """
    scene = {"type": "scene", "lamp": lamp(z=LAMP_HEIGHT, half_width=lamp_size, power=3)}
    for i, (side, reflectance) in enumerate(WALLS.items()):
        up = side[1:] + side[:1]
        pose = mi.ScalarTransform4f().look_at([ROOM * x for x in side], [0, 0, 0], up)
        wall = {"type": "rectangle", "to_world": pose @ scaled(ROOM)}
        scene[f"wall{i}"] = wall | grey(*reflectance)
    for i, (x, y, z) in enumerate(PLACES):
        scene[f"sensor{i}"] = view(origin=(1.5 * x, 1.5 * y, 0.2), target=(x, y, z + 0.1), fov=56)
    return scene


def view(width: int = 32, height: int = 24, **settings) -> Description:
    return camera(width, height, sampler={"type": "multijitter"}, **settings)


def tables(bsdfs: Sequence[Description], places=PLACES) -> Description:
    """Floating table tops."""
    scene = {}
    for i, (bsdf, place) in enumerate(zip(bsdfs, places, strict=True)):
        pose = at(*place) @ mi.ScalarTransform4f().scale([TABLE, TABLE, 0.04])
        scene[f"table{i}"] = {"type": "cube", "to_world": pose, "bsdf": bsdf}
    return scene


def balls(bsdfs: Sequence[Description], places=PLACES) -> Description:
    """Balls on the tables, off their middles, so that the views differ."""
    return {
        f"ball{i}": ball(x - 0.14, y - 0.14, z + 0.28, 0.24) | {"bsdf": bsdf}
        for i, (bsdf, (x, y, z)) in enumerate(zip(bsdfs, places, strict=True))
    }


# ---------------------- Regions of pictures ----------------------


def centre_rays(scene: mi.Scene, sensor: int) -> mi.RayDifferential3f:
    """Rays through the centres of all pixels of a sensor."""
    sensor = scene.sensors()[sensor]
    width, height = sensor.film().size()
    index = dr.arange(mi.UInt32, width * height)
    position = mi.Point2f(index % width + 0.5, index // width + 0.5) / mi.Point2f(width, height)
    return sensor.sample_ray_differential(0, 0.5, position, mi.Point2f(0.5))[0]


def hits(scene: mi.Scene, ray: mi.Ray3f, shape_id: str) -> np.ndarray:
    """Which rays hit a shape first, [rays]."""
    shape = next(shape for shape in scene.shapes() if shape.id() == shape_id)
    return (scene.ray_intersect(ray).shape == mi.ShapePtr(shape)).numpy()


def seen(scene: mi.Scene, shape_id: str, sensor: int = 0) -> np.ndarray:
    """Pixels at whose centre a shape is seen, [pixels]."""
    return hits(scene, centre_rays(scene, sensor), shape_id)


def mirrored(scene: mi.Scene, shape_id: str, table: str, sensor: int) -> np.ndarray:
    """Pixels in which a table that were a perfect mirror would show a shape, [pixels]."""
    ray = centre_rays(scene, sensor)
    si = scene.ray_intersect(ray)
    onwards = si.spawn_ray(mi.reflect(-ray.d, si.n))
    return seen(scene, table, sensor) & hits(scene, onwards, shape_id)


# ---------------------- Statistics ----------------------


@dataclass(frozen=True)
class Comparison:
    """Mean radiance of a region by ours and by ``path``, each [SEEDS]."""

    ours: np.ndarray
    path: np.ndarray

    @property
    def bias(self) -> float:
        """Error of ours, relative to ``path``."""
        return self.ours.mean() / self.path.mean() - 1

    @property
    def margin(self) -> float:
        """Half the width of the interval of Welch's t-test around the bias."""
        variances = np.array([self.ours.var(ddof=1), self.path.var(ddof=1)]) / SEEDS
        variances += 1e-14  # All seeds may agree.
        freedom = variances.sum() ** 2 / (variances**2 / (SEEDS - 1)).sum()
        quantile = stats.t.ppf((1 + CONFIDENCE) / 2, freedom)
        return quantile * np.sqrt(variances.sum()) / self.path.mean()

    def __str__(self) -> str:
        return f"{self.bias:+.2%} ± {self.margin:.2%}"


def compare(scene, ours, regions, spp, sensor=0, brightest=np.inf) -> list[Comparison]:
    """Compare regions [R, pixels] of a sensor's picture, no pixel above ``brightest``."""

    def means(integrator, first_seed):
        seeds = range(first_seed, first_seed + SEEDS)
        pictures = np.stack([picture(scene, integrator, spp, seed, sensor) for seed in seeds])
        pixels = pictures.mean(axis=-1, dtype=np.float64).reshape(SEEDS, -1)
        pixels = np.minimum(pixels, brightest)
        return [pixels[:, region].mean(axis=1) for region in regions]

    path = mi.load_dict({"type": "path"})
    pairs = zip(means(ours, 0), means(path, SEEDS), strict=True)
    return [Comparison(*pair) for pair in pairs]


def assert_unbiased(comparison: Comparison, title: str, record_property) -> None:
    print(f"{title:42} {comparison}")
    record_property("bias", comparison.bias)
    record_property("margin", comparison.margin)
    assert comparison.margin <= PRECISION, f"too noisy: {comparison}"
    assert abs(comparison.bias) <= ALLOWED + comparison.margin, f"off by {comparison}"


# ---------------------- In a room ----------------------


@cache
def in_room(names: tuple[str, ...]) -> dict[tuple[str, str], Comparison]:
    every = materials()
    bsdfs = [every[name] for name in names]
    # Caustics of glass are noise: there, the lamp is nearly as large as the ceiling.
    lamp_size = 1.9 if "dielectric" in names else 0.8
    scene = load(room(lamp_size) | tables(bsdfs) | balls(bsdfs))
    ours = mi.load_dict(OURS)
    cubes = [m.cluster for m in ours.prepare(scene).maps]
    below = sum(cube.centre[2] < 0 for cube in cubes)
    assert below == sum(name not in PERFECT for name in names), "tables without a cube"

    found = {}
    for i, name in enumerate(names):
        regions = [seen(scene, f"{part}{i}", sensor=i) for part in PARTS]
        results = compare(scene, ours, regions, SPP, sensor=i)
        found |= {(name, part): result for part, result in zip(PARTS, results, strict=True)}
    return found


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("material", MATERIALS)
def test_room(material, part, record_property):
    names = next(names for names in ROOMS if material in names)
    assert_unbiased(in_room(names)[material, part], f"room {material} {part}", record_property)


# ---------------------- In a white furnace ----------------------

#: Adds light by itself: Mitsuba puts the coat on top without dimming what is below.
GAINS = ("principled-clearcoat",)
EPSILON = 0.005
#: In a furnace all is 1. Samples of rough glass may weigh thousands, with ``path`` as with ours:
#: what a mirror beside it makes of one in a million would drown what is measured.
BRIGHTEST = 2.0


@cache
def in_furnace() -> dict[tuple[str, str], Comparison]:
    """White materials under a sky of radiance one on all sides."""
    every = materials(white=True)
    bsdfs = [every[name] for name in MATERIALS]
    places = [(1.2 * (i % 6 - 2.5), 1.2 * (i // 6 - 1.5), 0) for i in range(len(bsdfs))]
    scene = load(
        {
            "type": "scene",
            "sky": {"type": "constant", "radiance": 1.0},
            "sensor": view(120, 80, origin=(0, -6, 8), target=(0, 0, 0), fov=40),
        }
        | tables(bsdfs, places)
        | balls(bsdfs, places)
    )
    regions = [seen(scene, f"{part}{i}") for i in range(len(bsdfs)) for part in PARTS]
    ours = mi.load_dict(OURS)
    results = compare(scene, ours, regions, SPP, 0, BRIGHTEST)
    return dict(zip(product(MATERIALS, PARTS), results, strict=True))


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("material", MATERIALS)
def test_furnace(material, part, record_property):
    comparison = in_furnace()[material, part]
    assert_unbiased(comparison, f"furnace {material} {part}", record_property)
    assert comparison.ours.mean() <= 1 + EPSILON or material in GAINS


# ---------------------- A lamp in glossy tables ----------------------

ALPHAS = (0.05, 0.1, 0.2, 0.3)


@pytest.fixture(scope="module")
def glossy_tables(variant):
    metals = [{"type": "roughconductor", "material": "Al", "alpha": alpha} for alpha in ALPHAS]
    return load(room() | tables(metals))


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((2.0, False), id="lamp-beyond-the-cubes"),
        pytest.param((6.4, True), id="lamp-in-the-cubes"),
    ],
)
def ours(request, glossy_tables):
    """With a cube around each table."""
    distance_ratio, lamp_inside = request.param
    requests = {
        f"cube{i}": cluster(f"table{i}", distance_ratio=distance_ratio) for i in range(len(ALPHAS))
    }
    result = mi.load_dict({"type": "envmap_hybrid"} | requests)
    for cube in (m.cluster for m in result.prepare(glossy_tables).maps):
        away = np.abs(cube.centre - [0, 0, LAMP_HEIGHT]).max()
        assert (away < cube.half_width) == lamp_inside
    return result


@pytest.mark.parametrize("alpha", ALPHAS)
def test_highlight(glossy_tables, ours, alpha, request, record_property):
    i = ALPHAS.index(alpha)
    highlight = mirrored(glossy_tables, "lamp", f"table{i}", sensor=i)
    (comparison,) = compare(glossy_tables, ours, [highlight], spp=64, sensor=i)
    assert_unbiased(comparison, f"highlight {request.node.callspec.id}", record_property)
