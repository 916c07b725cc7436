"""The map as an emitter by itself: evaluation, sampling, files, bad parameters."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose

from envmap_integrator.lookup.cube import (
    direction_to_face,
    face_to_direction,
    n_levels,
    solid_angles,
)
from envmap_integrator.lookup.cube_map import Cluster, CubeMap, from_stored, to_parts
from envmap_integrator.preparation.maps.clusters import ClusterRequest
from envmap_integrator.preparation.maps.mipmap import build_levels
from envmap_integrator.system.storage import read, write
from tests.helpers import (
    assert_agree,
    at,
    camera,
    cluster,
    exactly,
    grey,
    integrator,
    load,
    measure,
    picture,
    room,
    scaled,
)
from tests.unit.kit import mean_of

pytestmark = pytest.mark.usefixtures("variant")

RESOLUTION = 8


def map_of(radiance: np.ndarray, name: str = "cluster") -> CubeMap:
    """A map of radiance [6, R, R, C], everything at a distance of 2."""
    distance = np.full((*radiance.shape[:-1], 1), 0.5)
    levels = build_levels(np.concatenate([radiance, distance], -1), np.ones(radiance.shape[:-1]))
    cluster = Cluster(name, np.array([0.1, 0.2, 0.3]), 0.4, 0.8)
    return CubeMap(cluster, [level.astype(np.float32) for level in levels])


def random_radiance(channels: int = 3, sparse: bool = False) -> np.ndarray:
    random = np.random.default_rng(9)
    radiance = random.uniform(0.5, 2, (6, RESOLUTION, RESOLUTION, channels))
    return radiance * (random.uniform(size=radiance.shape[:-1] + (1,)) < (0.1 if sparse else 1))


def constant_radiance(value: float = 1.0) -> np.ndarray:
    return np.full((6, RESOLUTION, RESOLUTION, 3), value)


def save(path, *maps: CubeMap) -> str:
    """A file as baking leaves it."""
    parts, metadata = {}, []
    for index, cube_map in enumerate(maps):
        map_parts, map_metadata = to_parts(cube_map, prefix=f"map{index}/")
        parts |= map_parts
        metadata.append(map_metadata)
    write(path, parts or {"none": {"Y": np.zeros((1, 1), np.float32)}}, {"maps": metadata})
    return str(path)


@pytest.fixture
def emitter(tmp_path):
    """``emitter(radiance, **parameters)``: the plugin, with a map from a file."""

    def make(radiance: np.ndarray, **parameters) -> mi.Emitter:
        filename = save(tmp_path / "map.exr", map_of(radiance))
        return mi.load_dict({"type": "mipmap_cube", "filename": filename} | parameters)

    return make


def directions(count: int = 100_000) -> mi.Vector3f:
    u = np.random.default_rng(10).uniform(size=(2, count)).astype(np.float32)
    return mi.warp.square_to_uniform_sphere(mi.Point2f(u))


def seen(emitter, d: mi.Vector3f) -> np.ndarray:
    """Radiance [N, C] from directions."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
    si.wi = -d
    return emitter.eval(si, True).numpy().T


# ---------------------- Files ----------------------


@pytest.mark.parametrize("channels", [1, 3])
def test_a_reloaded_map_is_identical(tmp_path, channels):
    ours = [map_of(random_radiance(channels), name) for name in ("a", "b")]
    maps = read(save(tmp_path / "map.exr", *ours), "").entries("maps")
    for index, original in enumerate(ours):
        reloaded = from_stored(maps[index], prefix=f"map{index}/")
        assert np.array_equal(reloaded.texels(), original.texels())
        assert reloaded.masked == original.masked
        assert reloaded.cluster.name == original.cluster.name
        assert np.array_equal(reloaded.cluster.centre, original.cluster.centre)
        assert reloaded.cluster.half_width == original.cluster.half_width


def test_a_map_is_chosen_by_name(tmp_path):
    maps = (map_of(constant_radiance(value), f"map {value}") for value in (1, 2))
    filename = save(tmp_path / "map.exr", *maps)
    for options, expected in (({}, 1), ({"map": "map 2"}, 2)):
        emitter = mi.load_dict({"type": "mipmap_cube", "filename": filename} | options)
        assert_allclose(seen(emitter, directions(10)), expected, rtol=1e-6)


# ---------------------- Evaluation ----------------------


@pytest.mark.parametrize("level", [0.0, 1.0, 1.5, 3.0, 9.0])
def test_a_constant_map_is_constant_at_any_level(emitter, level):
    assert_allclose(seen(emitter(constant_radiance(), level=level), directions()), 1, rtol=1e-6)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_texels_show_at_their_centres(emitter, level):
    radiance = random_radiance()
    size = RESOLUTION >> level
    face, y, x = (i.ravel() for i in np.indices((6, size, size)))
    uv = mi.Point2f((2 * np.stack([x, y]) + 1) / size - 1)
    d = dr.normalize(face_to_direction(mi.UInt32(face), uv))
    expected = map_of(radiance).levels[level][..., :3].reshape(-1, 3)
    assert_allclose(seen(emitter(radiance, level=float(level)), d), expected, rtol=1e-4)


def test_fractional_levels_blend(emitter):
    ours = emitter(random_radiance())
    fine, coarse, between = (ours.eval_level(directions(), level).numpy() for level in (0, 1, 0.25))
    assert_allclose(between, 0.75 * fine + 0.25 * coarse, rtol=1e-5)


@pytest.mark.parametrize("level", [0.0, 1.0, 2.0])
def test_there_are_no_seams(emitter, level):
    """Across the edges between faces the map is as continuous as within them."""
    ours = emitter(random_radiance(), level=level)
    along = np.random.default_rng(11).uniform(-0.99, 0.99, 500).astype(np.float32)
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for sign in (1, -1):
            sides = []
            for step in (1e-5, -1e-5):
                d = np.zeros((3, len(along)), np.float32)
                d[a], d[b], d[c] = 1 + step, sign * (1 - step), along
                sides.append(seen(ours, dr.normalize(mi.Vector3f(d))))
            assert_allclose(sides[0], sides[1], atol=1e-3)


def turned() -> mi.ScalarTransform4f:
    """About an axis across all others."""
    axis = dr.normalize(mi.ScalarVector3f(1, -2, 0.5))
    return mi.ScalarTransform4f().rotate(axis, 70)


def test_a_map_can_be_turned_and_scaled(emitter):
    radiance, d = random_radiance(), directions(1000)
    matrix = mi.Matrix3f(np.array(turned().matrix)[:3, :3])
    expected = 0.25 * seen(emitter(radiance), d)
    # Where it is and how large doesn't matter to what is infinitely far.
    for to_world in (turned(), at(5, 0, 1) @ scaled(2) @ turned()):
        ours = seen(emitter(radiance, to_world=to_world, scale=0.25), matrix @ d)
        assert_allclose(ours, expected, rtol=2e-3)


# ---------------------- Sampling ----------------------


class CubeDomain:
    """The six faces side by side in a plane, where the density is constant in each texel."""

    def bounds(self):
        return mi.ScalarBoundingBox2f([-1, -1], [11, 1])

    def aspect(self):
        return 1 / 6

    def map_forward(self, p):
        face = mi.UInt32(dr.clip((p.x + 1) * 0.5, 0, 5))
        return face_to_direction(face, mi.Point2f(p.x - 2 * mi.Float(face), p.y))

    def map_backward(self, d):
        face, uv = direction_to_face(d)
        return mi.Vector2f(uv.x + 2 * mi.Float(face), uv.y)


def sampled(emitter, u: mi.Point2f) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    it = dr.zeros(mi.Interaction3f, dr.width(u))
    return emitter.sample_direction(it, u, True)


def density(emitter, d: mi.Vector3f) -> mi.Float:
    ds = dr.zeros(mi.DirectionSample3f, dr.width(d))
    ds.d = d
    return emitter.pdf_direction(dr.zeros(mi.Interaction3f, dr.width(d)), ds, True)


@pytest.mark.parametrize(
    ("radiance", "level"),
    [
        (constant_radiance(), 0.0),
        (random_radiance(), 0.0),
        (random_radiance(sparse=True), 0.0),
        (random_radiance(), 1.0),
    ],
    ids=["constant", "random", "sparse", "coarse"],
)
def test_directions_are_sampled_with_their_density(emitter, radiance, level):
    ours = emitter(radiance, level=level)

    def density_in_plane(d):
        """Of the point on the faces; d isn't normalised, its largest component is one."""
        return density(ours, dr.normalize(d)) / dr.norm(d) ** 3

    test = mi.chi2.ChiSquareTest(
        domain=CubeDomain(),
        sample_func=lambda u: sampled(ours, mi.Point2f(u))[0].d,
        pdf_func=density_in_plane,
        sample_count=200_000,
        res=RESOLUTION,
    )
    assert test.run(significance_level=0.001, quiet=True), test.messages


def test_the_density_integrates_to_one(emitter):
    ours = emitter(random_radiance(sparse=True))
    values = density(ours, directions(200_000)).numpy() * 4 * np.pi
    assert_agree(mean_of(values), exactly(1.0), precision=0.05)


@pytest.mark.parametrize("parameters", [{}, {"level": 1.0}, {"to_world": "turned", "scale": 3.0}])
def test_samples_agree_with_the_other_queries(emitter, parameters):
    if "to_world" in parameters:
        parameters = parameters | {"to_world": turned()}
    ours = emitter(random_radiance(sparse=True), **parameters)
    u = mi.Point2f(np.random.default_rng(12).uniform(size=(2, 100_000)).astype(np.float32))
    ds, weight = sampled(ours, u)
    assert_allclose(dr.norm(ds.d).numpy(), 1, rtol=1e-6)
    value = seen(ours, ds.d)
    # At the border of two texels rounding may tell them apart.
    same = np.isclose(density(ours, ds.d).numpy(), ds.pdf.numpy(), rtol=1e-4)
    assert same.mean() > 0.9999
    assert_allclose(weight.numpy().T, value / ds.pdf.numpy()[:, None], rtol=1e-4)

    light = mean_of(weight.numpy().mean(axis=0))
    assert_agree(light, mean_of(4 * np.pi * seen(ours, directions()).mean(axis=1)), precision=0.1)


def test_no_light_is_missed(emitter):
    """Bilinear filtering spreads light into texels that are black themselves."""
    radiance = np.zeros((6, RESOLUTION, RESOLUTION, 3))
    radiance[3, 2, 5] = 100
    ours = emitter(radiance)
    d = directions(20_000)
    lit = seen(ours, d).max(axis=1) > 0
    assert lit.any()
    assert (density(ours, d).numpy()[lit] > 0).all()


def test_a_black_map_gives_no_light_and_no_nan(emitter):
    ds, weight = sampled(emitter(constant_radiance(0)), mi.Point2f([0.1, 0.9], [0.5, 0.2]))
    assert not weight.numpy().any()
    assert np.isfinite(ds.pdf.numpy()).all()


# ---------------------- In a scene ----------------------


@pytest.fixture
def ball_under(tmp_path):
    """``ball_under(environment, material)``: a ball that fills the middle of the picture."""

    def make(environment: dict, material: dict) -> mi.Scene:
        sensor = camera(width=8, height=8, origin=(0, -3, 0), target=(0, 0, 0), fov=10)
        parts = {"type": "scene", "sensor": sensor, "ball": {"type": "sphere"} | material}
        return load(parts | {"sky": environment})

    return make


PATH = {"type": "path", "max_depth": 4}
PLASTIC = {"bsdf": {"type": "plastic"}}


def test_a_diffuse_ball_under_a_constant_map(tmp_path, ball_under):
    sky = {"type": "mipmap_cube", "filename": save(tmp_path / "m.exr", map_of(constant_radiance()))}
    ours = measure(ball_under(sky, grey(0.6)), mi.load_dict(PATH), spp=64, seeds=4).overall()
    assert_agree(ours, exactly(0.6))


def test_a_plastic_ball_is_lit_as_by_mitsubas_own_environment(tmp_path, ball_under):
    radiance = random_radiance()
    emitter = {"type": "mipmap_cube", "filename": save(tmp_path / "m.exr", map_of(radiance))}
    moved = {"to_world": turned(), "scale": 2.0}
    ours = measure(ball_under(emitter | moved, PLASTIC), mi.load_dict(PATH), spp=256).overall()
    theirs = ball_under(latitude_longitude(mi.load_dict(emitter)) | moved, PLASTIC)
    reference = measure(theirs, mi.load_dict(PATH), spp=256).overall()
    assert_agree(ours, reference, allowed=0.005, precision=0.02)


def latitude_longitude(emitter: mi.Emitter) -> dict:
    """The same environment as Mitsuba's ``envmap`` (whose y axis is up)."""
    width, height = 512, 256
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (np.arange(width) + 0.5) / width * 2 * np.pi
    theta, phi = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    d = [np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)]
    pixels = seen(emitter, mi.Vector3f(np.array(d, np.float32))).reshape(height, width, 3)
    bitmap = mi.Bitmap(pixels.astype(np.float32))
    return {"type": "envmap", "bitmap": bitmap, "mis_compensation": False}


def test_the_background_shows_the_map(tmp_path):
    filename = save(tmp_path / "map.exr", map_of(constant_radiance(3)))
    sky = {"type": "mipmap_cube", "filename": filename}
    scene = load({"type": "scene", "sensor": camera(width=4, height=4), "sky": sky})
    assert_allclose(mi.render(scene, integrator=mi.load_dict(PATH), spp=4).numpy(), 3, rtol=1e-6)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4, 1e7, 1e9])
def test_scenes_of_any_size_hide_and_see_the_map(tmp_path, scale):
    """Shadow rays to the map end beyond all surfaces, and still point where they should."""
    sky = {"type": "mipmap_cube", "filename": save(tmp_path / "m.exr", map_of(constant_radiance()))}
    ball = {"type": "sphere", "radius": scale} | grey(0.6)
    sensor = camera(width=8, height=8, origin=(0, -3 * scale, 0), target=(0, 0, 0), fov=10)
    sensor |= {"near_clip": 0.01 * scale, "far_clip": 100 * scale}
    scene = {"type": "scene", "sensor": sensor, "ball": ball, "sky": sky}
    direct = mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0})
    assert_agree(measure(load(scene), direct, spp=512).overall(), exactly(0.6), precision=0.02)

    walls = {"type": "cube", "to_world": scaled(5 * scale), "flip_normals": True} | grey(0.5)
    assert not picture(load(scene | {"walls": walls}), direct).any()


# ---------------------- Bad parameters ----------------------


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, 'give either "filename" .* or "shapes"'),
        ({"filename": "map.exr", "shapes": "ball"}, 'give either "filename" .* or "shapes"'),
        ({"filename": "none.exr"}, "none.exr: no such file; make it with envmap-render bake"),
        ({"filename": "notes.exr"}, "notes.exr: damaged or no OpenEXR file"),
        ({"filename": "empty.exr"}, 'empty.exr: holds no maps, .*; set "maps" to'),
        ({"filename": "map.exr", "map": "sofa"}, 'holds no map "sofa", only cluster'),
        ({"filename": "map.exr", "level": -1.0}, '"level" must be at least 0, not -1.0'),
        ({"filename": "map.exr", "level": "fine"}, "\"level\" must be a number, not 'fine'"),
        ({"filename": "map.exr", "levels": 1.0}, "levels"),
        ({"filename": "map.exr", "scale": -1.0}, '"scale" must be at least 0'),
        ({"filename": "map.exr", "center": "0, 0, 0"}, "center"),
        ({"shapes": "ball", "center": "0, 0"}, "\"center\" must be three numbers, not '0, 0'"),
        ({"shapes": "ball", "resolution": 48}, '"resolution" must be a power of two, not 48'),
        ({"shapes": "ball", "scale": 2.0}, "scale"),
        ({"filename": "map.exr", "distance_ratio": 2.0}, "distance_ratio"),
        ({"shapes": " , "}, "\"shapes\" must list ids, not ' , '"),
        ({"shapes": "ball", "distance_ratio": 0.5}, '"distance_ratio" must be at least 1'),
    ],
)
def test_bad_parameters_are_named(tmp_path, parameters, message):
    save(tmp_path / "map.exr", map_of(constant_radiance()))
    save(tmp_path / "empty.exr")
    (tmp_path / "notes.exr").write_text("no picture")
    if "filename" in parameters:
        parameters = parameters | {"filename": str(tmp_path / parameters["filename"])}
    with pytest.raises((RuntimeError, ValueError, TypeError), match=message):
        mi.load_dict({"type": "mipmap_cube"} | parameters)


@pytest.mark.parametrize("other", ["llvm_ad_mono"])
def test_a_map_of_another_variant_is_refused(tmp_path, other):
    filename = save(tmp_path / "map.exr", map_of(constant_radiance()))
    mi.set_variant(other)
    with pytest.raises(RuntimeError, match=f"3 colour channels, variant {other} needs 1"):
        mi.load_dict({"type": "mipmap_cube", "filename": filename})


@pytest.mark.parametrize("kind", ["path", "direct", "envmap_hybrid", "source_selection"])
def test_a_cluster_at_scene_level_is_refused(kind):
    scene = load(room(desk=cluster("ball")))
    with pytest.raises(RuntimeError) as raised:
        picture(scene, integrator(kind))
    message = 'mipmap_cube "desk" lists "shapes" and emits nothing; put it inside the integrator'
    assert message in str(raised.value.__cause__)


def test_a_cluster_keeps_its_shapes():
    described = {"type": "mipmap_cube", "id": "desk", "shapes": "table, ball ,"}
    assert mi.load_dict(described).request == ClusterRequest("desk", ("table", "ball"))
    described |= {"distance_ratio": 3, "center": [0, 1, 0.5], "resolution": 8}
    request = ClusterRequest("desk", ("table", "ball"), 3, (0, 1, 0.5), 8)
    assert mi.load_dict(described).request == request
    assert mi.load_dict(described | {"center": "0, 1, 0.5"}).request == request


def test_sizes_of_the_file(tmp_path):
    """One part a level, the six faces side by side: what a viewer shows."""
    parts = read(save(tmp_path / "map.exr", map_of(random_radiance())), "").parts
    shapes = [parts[f"map0/level{level}"]["R"].shape for level in range(n_levels(RESOLUTION))]
    assert shapes == [(size, 6 * size) for size in (8, 4, 2, 1)]
    assert solid_angles(RESOLUTION).shape == shapes[0][:1] * 2
