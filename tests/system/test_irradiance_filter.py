"""Pictures whose pixels share what they gather: less noise, the same light, any film."""

from __future__ import annotations

import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import convolve, median_filter

from compare.metrics import error_floor, rel_mse
from envmap_integrator.imaging import film as film_module
from envmap_integrator.imaging.denoiser import denoise
from tests.helpers import (
    SCENES,
    Description,
    at,
    block,
    box,
    camera,
    colour,
    emitting,
    film,
    grey,
    integrator,
    load,
    load_scene,
    picture,
    room,
    scaled,
)

pytestmark = pytest.mark.usefixtures("variant")

KINDS = ("envmap_hybrid", "one_level_path")
SEEDS = 6


@pytest.fixture(scope="module")
def tiled(variant):
    """A room with chequered walls."""
    tiles = {
        "type": "checkerboard",
        "color0": colour(0.1, 0.2, 0.6),
        "color1": colour(0.7, 0.5, 0.3),
        "to_uv": scaled(6),
    }
    walls = box(2.0) | {"bsdf": {"type": "diffuse", "reflectance": tiles}}
    return load(room(walls=walls, sensor=camera(96, 72)))


@pytest.fixture(scope="module")
def reference(tiled):
    path = mi.load_dict({"type": "path"})
    return [picture(tiled, path, 1024, seed) for seed in (100, 101, 102)]


def pictures(scene, spp=64, kind="one_level_path", seeds=SEEDS, **settings):
    ours = integrator(kind, sampler="coherent", **settings)
    return [picture(scene, ours, spp, seed) for seed in range(seeds)]


@pytest.mark.parametrize("kind", KINDS)
def test_less_error_with_textures_and_contacts(tiled, reference, kind):
    """By far less noise, for a bias that is small against it."""
    shared = pictures(tiled, kind=kind, irradiance_filter=True)
    apart = pictures(tiled, kind=kind)
    errors = [np.mean([rel_mse(p, reference) for p in some]) for some in (shared, apart)]
    assert errors[0] < errors[1] / 3
    floors = [error_floor(some, reference) for some in (shared, apart)]
    assert floors[0] < floors[1] + 1e-4


def chequered(low: float, high: float) -> Description:
    tiles = {"type": "checkerboard", "to_uv": scaled(12)}
    return tiles | {"color0": colour(low, low, low), "color1": colour(high, high, high)}


#: Materials whose wide lobes aren't in proportion to what is called their diffuse reflectance.
TEXTURED = {
    "gloss": lambda: {
        "type": "roughplastic",
        "nonlinear": False,
        "diffuse_reflectance": chequered(0.1, 1),
    },
    "varnish": lambda: {
        "type": "plastic",
        "nonlinear": True,
        "diffuse_reflectance": chequered(0.1, 0.9),
    },
    "blend": lambda: {
        "type": "blendbsdf",
        "weight": chequered(0.1, 0.9),
        "paint": grey(0.7)["bsdf"],
        "metal": {"type": "roughconductor", "alpha": 0.3},
    },
    "mask": lambda: {"type": "mask", "opacity": chequered(0.2, 1), "paint": grey(0.6)["bsdf"]},
    "metal": lambda: {
        "type": "principled",
        "metallic": chequered(0, 0.8),
        "roughness": 0.4,
        "base_color": colour(0.7, 0.7, 0.7),
    },
}


@pytest.mark.parametrize("name", TEXTURED)
def test_textures_of_any_material_stay_sharp(variant, name):
    """Neither dark nor bright texels take their neighbours' light."""
    scene = load(room(walls=box(2.0) | {"bsdf": TEXTURED[name]()}, sensor=camera(48, 36)))
    assert_texels_stay(scene)


def test_textures_behind_a_pane_stay_sharp(variant):
    """What is mirrored in it, over dark texels most of what is seen, has other light."""
    tiles = {"type": "diffuse", "reflectance": chequered(0.02, 0.8)}
    floor = {"type": "rectangle", "to_world": at(0, 0, -1.9).scale(1.9), "bsdf": tiles}
    tilted = at(0, -1.2, -0.4).rotate([1, 0, 0], 60).scale(1.5)
    pane = {"type": "rectangle", "to_world": tilted, "bsdf": {"type": "thindielectric"}}
    up = {"type": "rectangle", "to_world": at(0, 0, 1) @ scaled(0.5)} | grey(0) | emitting(10)
    sensor = camera(64, 48, target=(0, -0.5, -1.9), fov=50)
    parts = {"floor": floor, "pane": pane, "lamp": up, "sensor": sensor}
    assert_texels_stay(load(room(walls=box(2.0) | grey(0.9), block=None, ball=None, **parts)))


def test_what_is_seen_through_holes_is_shared(variant):
    tilted = at(0, -1.2, -0.4).rotate([1, 0, 0], 60).scale(1.5)
    holes = {"type": "checkerboard", "to_uv": scaled(2)}
    holes |= {"color0": colour(0), "color1": colour(1)}
    cut = {"type": "mask", "opacity": holes, "paint": {"type": "twosided"} | grey(0.5)}
    grid = {"type": "rectangle", "to_world": tilted, "bsdf": cut}
    scene = load(room(grid=grid, sensor=camera(64, 48)))
    apart, shared = (pictures(scene, irradiance_filter=on) for on in (False, True))
    noise = [np.var(some, axis=0)[24:].mean() for some in (apart, shared)]
    assert noise[1] < noise[0] / 3


def assert_texels_stay(scene):
    apart = np.mean(pictures(scene, 256, irradiance_filter=False), axis=0).mean(axis=2)
    shared = np.mean(pictures(scene, 32, irradiance_filter=True), axis=0).mean(axis=2)
    dark, bright = np.quantile(apart, [0.3, 0.7])
    for texels in (apart < dark, apart > bright):
        assert shared[texels].sum() == pytest.approx(apart[texels].sum(), rel=0.025)


def test_bias_falls_with_samples(tiled, reference):
    few, many = (
        error_floor(pictures(tiled, spp, seeds=seeds, irradiance_filter=True), reference)
        for spp, seeds in ((4, 8 * SEEDS), (256, SEEDS))  # Few samples are noisy.
    )
    assert many < few / 2


@pytest.mark.parametrize("kind", KINDS)
def test_the_light_is_the_same(tiled, kind):
    shared = np.mean([p.mean() for p in pictures(tiled, kind=kind, irradiance_filter=True)])
    apart = np.mean([p.mean() for p in pictures(tiled, kind=kind)])
    assert shared == pytest.approx(apart, rel=2e-3)


def test_without_bias_nothing_is_shared(tiled):
    a, b = (
        picture(tiled, integrator("one_level_path", residual_probability=0.5, irradiance_filter=on))
        for on in (True, False)
    )
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("irradiance_filter", [True, False])
class TestFilms:
    """What Mitsuba's own integrators do with films, ours do."""

    def compare_means(self, sensor, irradiance_filter, **settings):
        scene = load(room(sensor=sensor))
        ours = integrator("one_level_path", irradiance_filter=irradiance_filter, **settings)
        own, path = (picture(scene, i, 256) for i in (ours, mi.load_dict({"type": "path"})))
        assert own.shape == path.shape
        np.testing.assert_allclose(own.mean(axis=(0, 1)), path.mean(axis=(0, 1)), rtol=0.02)
        return own, path

    def test_alpha(self, irradiance_filter):
        film_ = film(32, 24, pixel_format="rgba")
        own, path = self.compare_means(camera(film=film_), irradiance_filter)
        np.testing.assert_allclose(own[..., 3], path[..., 3], atol=1e-5)

    def test_crop_window(self, irradiance_filter):
        window = dict(crop_offset_x=5, crop_offset_y=3, crop_width=17, crop_height=11)
        own, path = self.compare_means(camera(film=film(32, 24, **window)), irradiance_filter)
        assert own.shape[:2] == (11, 17)

    @pytest.mark.parametrize("rfilter", ["gaussian", "mitchell"])
    def test_reconstruction_filter(self, irradiance_filter, rfilter):
        film_ = film(32, 24, rfilter={"type": rfilter}, sample_border=True)
        self.compare_means(camera(film=film_), irradiance_filter)

    def test_thin_lens_and_shutter(self, irradiance_filter):
        lens = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0}
        shutter = {"shutter_open": 0.0, "shutter_close": 1.0}
        self.compare_means(camera() | lens | shutter, irradiance_filter)

    def test_weighted_sensor(self, irradiance_filter):
        """One whose rays don't count as one: irradiance is π times their mean."""
        meter = {"type": "irradiancemeter", "film": film(1, 1), "sampler": {"type": "independent"}}
        plate = {"type": "rectangle", "to_world": at(0, -0.5, 0), "meter": meter}
        scene = load(room(sensor=None, plate=plate | grey(0.5)))
        ours = integrator("one_level_path", irradiance_filter=irradiance_filter)
        own, path = (picture(scene, i, 1 << 16) for i in (ours, mi.load_dict({"type": "path"})))
        np.testing.assert_allclose(own, path, rtol=0.02)

    @pytest.mark.parametrize("sampler", ["coherent", "scene", "multijitter"])
    @pytest.mark.parametrize("min_lanes", [1, 32 * 24 * 8])
    def test_samplers(self, irradiance_filter, sampler, min_lanes, monkeypatch):
        """However many of a pixel's samples a lane takes."""
        monkeypatch.setattr(film_module, "MIN_LANES", min_lanes)
        self.compare_means(camera(), irradiance_filter, sampler=sampler)

    def test_undeveloped(self, irradiance_filter):
        scene = load(room())
        ours = integrator("one_level_path", irradiance_filter=irradiance_filter)
        ours.render(scene, spp=4, develop=False)
        later = np.array(scene.sensors()[0].film().develop())
        np.testing.assert_array_equal(later, picture(scene, ours, 4))


# ---------------------- Rare bright samples ----------------------


@pytest.mark.parametrize("metal", ["steel", "paint"])
def test_sunlit_room(variant, tmp_path, metal):
    """With and without caustics: less error, the same light, and no disc around bright samples."""
    make = [sys.executable, SCENES / "make_sunlit.py", "--out", tmp_path]
    subprocess.run([*map(str, make)], check=True)
    scene = load_scene(tmp_path / f"sunlit-{metal}.xml", 240, 180)
    ours = integrator(
        "one_level_path", sampler="coherent", irradiance_filter=True, indirect_aovs=True
    )
    shared, apart, contrasts = [], [], []
    for seed in range(4):
        channels = np.array(mi.render(scene, integrator=ours, spp=16, seed=seed))
        indirect, gathered, albedo = np.split(channels[..., -9:], 3, axis=2)
        shared.append(channels[..., :3])
        apart.append(channels[..., :3] - indirect + gathered)
        contrasts.extend(around_outliers(indirect, gathered, albedo))
    errors = [rel_mse(some[0], apart[1:]) for some in (shared, apart)]
    assert errors[0] < errors[1] / 4
    assert np.mean(shared) == pytest.approx(np.mean(apart), rel=0.005)
    if metal == "steel":
        assert len(contrasts) > 10
        assert np.median(contrasts) < 1.8  # 2.4 if all of the excess is shared


def around_outliers(indirect, gathered, albedo):
    """How many times as bright sharing makes the eight pixels around each outlier."""
    lit = albedo.min(axis=2) > 0
    shared, apart = (
        np.where(lit, x.sum(axis=2) / np.where(lit, albedo.sum(axis=2), 1), 0)
        for x in (indirect, gathered)
    )
    usual = median_filter(apart, 9)
    outlier = (usual > 0) & (apart > 20 * usual)
    around = np.ones((3, 3)) / 8
    around[1, 1] = 0
    return convolve(shared, around)[outlier] / convolve(apart, around)[outlier]


def test_too_many_samples_for_a_sampler_of_mitsuba(variant, monkeypatch):
    monkeypatch.setattr(film_module, "MAX_LANES", 32 * 24 * 100)
    scene = load(room())
    ours = mi.load_dict({"type": "one_level_path", "sampler": "independent"})
    with pytest.raises(ValueError, match='"sampler" independent takes at most 100 .* not 101;'):
        ours.render(scene, spp=101)
    assert picture(scene, mi.load_dict({"type": "one_level_path"}), 101).any()


def test_one_pixel(variant):
    assert picture(load(room(sensor=camera(1, 1))), mi.load_dict({"type": "envmap_hybrid"})).any()


# ---------------------- AOVs ----------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shared", [True, False])
def test_indirect_light_as_aovs(tiled, kind, shared):
    """The picture is the same; what is gathered is in it, in proportion to the albedo."""
    plain, apart = (
        mi.load_dict({"type": kind, "irradiance_filter": shared, "indirect_aovs": on})
        for on in (False, True)
    )
    channels = np.array(mi.render(tiled, integrator=apart, spp=16))
    fields = tiled.sensors()[0].film().bitmap().struct_()
    assert [field.name for field in fields][-9:] == apart.aov_names()
    np.testing.assert_allclose(channels[..., :3], picture(tiled, plain, 16), rtol=1e-6)
    indirect, gathered, albedo = np.split(channels[..., -9:], 3, axis=2)
    assert np.array_equal(indirect, gathered) != shared
    assert indirect.mean() == pytest.approx(gathered.mean(), rel=0.02)
    direct = channels[..., :3] - indirect
    assert (direct >= -1e-5 * channels[..., :3].max()).all() and direct.max() > indirect.max()
    tiles = np.array([0.1, 0.2, 0.6]), np.array([0.7, 0.5, 0.3])
    on_wall = [np.isclose(albedo, tile, atol=1e-3).all(axis=2) for tile in tiles]
    assert all(wall.sum() > 500 for wall in on_wall)
    a, b = ((indirect[wall] / albedo[wall]).mean() for wall in on_wall)
    assert a == pytest.approx(b, rel=0.1)  # the light on both is much the same


def test_inside_the_aov_integrator(tiled):
    """It renders ours on its own, with a seed that is an array, and adds AOVs of its own."""
    nested = {"type": "one_level_path", "indirect_aovs": True}
    outer = mi.load_dict({"type": "aov", "aovs": "depth:depth", "img": nested})
    channels = np.array(mi.render(tiled, integrator=outer, spp=16, seed=3))
    ours = np.array(mi.render(tiled, integrator=mi.load_dict(nested), spp=16, seed=3))
    np.testing.assert_array_equal(channels[..., : ours.shape[2]], ours)


@pytest.mark.parametrize("kind", KINDS)
def test_the_denoiser_takes_direct_light_apart(tiled, reference, kind):
    """Less error than denoising the picture as a whole, and the same light."""
    plain, ours = (mi.load_dict({"type": kind, "indirect_aovs": on}) for on in (False, True))
    whole, apart = [], []
    for seed in range(4):
        channels = np.array(mi.render(tiled, integrator=ours, spp=16, seed=seed))
        whole.append(denoise(tiled, plain, channels, 16, seed))
        apart.append(denoise(tiled, ours, channels, 16, seed))
    errors = [np.mean([rel_mse(p, reference) for p in some]) for some in (whole, apart)]
    assert errors[1] < 0.9 * errors[0]
    assert np.mean(apart) == pytest.approx(np.mean(reference), rel=0.01)


def test_metal_does_not_shine_over_its_edges(variant):
    """It has next to no diffuse reflectance, and irradiance is over that."""
    gold = {
        "type": "principled",
        "base_color": colour(0.9, 0.6, 0.2),
        "metallic": 1.0,
        "roughness": 0.04,
    }
    scene = load(room(block=block(-0.5, 0.2, -1.4, 0.6) | {"bsdf": gold}, sensor=camera(96, 72)))
    reference = np.mean(pictures(scene, 256), axis=0)
    ours = mi.load_dict({"type": "envmap_hybrid", "indirect_aovs": True})
    channels = np.array(mi.render(scene, integrator=ours, spp=16))
    noisy, clean = channels[:, :, :3], denoise(scene, ours, channels, 16, 0)
    assert np.square(clean - reference).mean() < 0.7 * np.square(noisy - reference).mean()
