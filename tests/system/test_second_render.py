"""Later renders launch what the first has recorded, and give the pictures that they should."""

from __future__ import annotations

from collections.abc import Callable
from unittest.mock import patch

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.imaging import film as film_module
from envmap_integrator.system.recording import Recorder
from tests.helpers import ball, camera, grey, integrator, lamp, load, room

pytestmark = pytest.mark.usefixtures("variant")

SETTINGS = {"patches": 256, "patch_samples": 32, "sampler": "coherent"}
KINDS = {
    "one_level_path": {"irradiance_filter": True},
    "source_selection": {},
    "envmap_hybrid": {"maps": "always", "residual_probability": 0.5},
}


def new(kind: str = "one_level_path", **settings) -> mi.Integrator:
    all_settings = SETTINGS | KINDS[kind] | settings
    return integrator(kind, **{name: v for name, v in all_settings.items() if v is not None})


def picture(scene: mi.Scene, renderer: mi.Integrator, sensor=0, seed: int = 1, spp: int = 4):
    return np.array(mi.render(scene, integrator=renderer, sensor=sensor, seed=seed, spp=spp))


def traced(scene: mi.Scene, renderer: mi.Integrator, **settings) -> np.ndarray:
    """The same with kernels traced anew."""
    with patch.object(Recorder, "__call__", lambda self, key, function, *inputs: function(*inputs)):
        return picture(scene, renderer, **settings)


@pytest.fixture
def recordings(monkeypatch) -> Callable[[], int]:
    """How many kernels of renders Dr.Jit has traced so far."""
    traced = []
    original = film_module._lane_per_pixel

    def counted(*arguments):
        traced.append(1)
        return original(*arguments)

    monkeypatch.setattr(film_module, "_lane_per_pixel", counted)
    return lambda: len(traced)


@pytest.mark.parametrize("kind", KINDS)
def test_other_seeds_and_samples_and_views_record_nothing(kind, recordings, monkeypatch):
    monkeypatch.setattr(film_module, "MIN_LANES", 1)  # A lane takes all samples of its pixel.
    scene, renderer = load(room()), new(kind)
    first = picture(scene, renderer)
    assert np.array_equal(picture(scene, renderer), first)
    different = [picture(scene, renderer, seed=2)]
    if kind != "envmap_hybrid":  # Maps are others.
        different.append(picture(scene, renderer, spp=6))
    parameters = mi.traverse(scene.sensors()[0])
    key = next(name for name in parameters.keys() if name.endswith("to_world"))
    parameters[key] = mi.Transform4f().translate([0.1, 0, 0]) @ parameters[key]
    parameters.update()
    moved = picture(scene, renderer)
    assert recordings() == 1

    assert not any(np.array_equal(first, other) for other in (*different, moved))
    assert np.array_equal(traced(scene, renderer), moved)
    assert np.array_equal(picture(load(room()), new(kind), seed=2), different[0])
    if kind != "envmap_hybrid":
        assert np.array_equal(picture(load(room()), new(kind), spp=6), different[1])


def test_passes_of_a_picture_that_gets_better_are_recorded_once(recordings):
    renderer = new()
    list(renderer.progressive(load(room()), spp=4, total=24))
    assert recordings() == 1


def test_renders_between_passes_change_nothing():
    """Of the same scene, with a coarser cache."""
    scene, renderer = load(room()), new(patches=None)
    alone = new(patches=None).progressive(load(room()), spp=4, total=512)
    disturbed = renderer.progressive(scene, spp=4, total=512)
    for _ in range(2):
        assert np.array_equal(next(disturbed).picture, next(alone).picture)
        mi.render(scene, integrator=renderer, spp=4)


# ---------------------- What is recorded anew ----------------------


def edit(**changes) -> Callable:
    """Changes parameters of the scene."""

    def change(scene, renderer):
        parameters = mi.traverse(scene)
        for ending, value in changes.items():
            key = next(name for name in parameters.keys() if name.endswith(ending))
            before = parameters[key]
            parameters[key] = value(before) if callable(value) else type(before)(value)
        parameters.update()

    return change


def set_attribute(**changes) -> Callable:
    def change(scene, renderer):
        vars(renderer).update(changes)

    return change


CHANGES = {
    "material": edit(**{"ball.bsdf.reflectance.value": [0.8, 0.1, 0.1]}),
    "emitter": edit(**{"emitter.radiance.value": [3.0, 1.0, 1.0]}),
    "near clip": edit(near_clip=1.5),
    "field of view": edit(x_fov=20.0),
    "film": edit(**{"film.size": [20, 12], "film.crop_size": [20, 12]}),
    "crop": edit(**{"film.crop_size": [8, 8], "film.crop_offset": [2, 3]}),
    "shadow samples": set_attribute(shadow_samples=5),
    "clamp": set_attribute(clamp_indirect=0.01),
    "no sharing": set_attribute(irradiance_filter=False),
    "AOVs": set_attribute(indirect_aovs=True),
    "finer": set_attribute(patches=1024),
    "residuals": set_attribute(residual_probability=0.5),
}


def scene_of() -> mi.Scene:
    return load(room(ball=ball(0, 0, 0, 0.3) | grey(0.5), lamp=lamp(0, 0.5, -0.3)))


@pytest.mark.parametrize("name", CHANGES)
def test_changes_show(name):
    """Of the scene, the sensor, or the integrator."""
    scene, renderer = scene_of(), new()
    before = picture(scene, renderer)
    CHANGES[name](scene, renderer)
    after = picture(scene, renderer)
    assert not np.array_equal(after, before)
    assert np.array_equal(after, traced(scene, renderer))


def test_another_state_of_the_same_scene():
    """Its tables have other sizes, which kernels hold."""
    scene, renderer = load(room()), new(patches=None)
    pictures = [picture(scene, renderer, spp=spp) for spp in (4, 512, 4)]
    assert np.array_equal(pictures[0], pictures[2])
    assert np.array_equal(pictures[1], picture(load(room()), new(patches=None), spp=512))


def test_sensors_and_films_in_turn(recordings):
    scene, renderer = load(room()), new()
    views = [
        mi.load_dict(camera(width, width, origin=(0.3, -0.9, 0)) | {"near_clip": near})
        for width, near in ((8, 0.01), (12, 0.01), (8, 1.2))
    ]
    first = [picture(scene, renderer, view) for view in views]
    assert not np.array_equal(first[0], first[2])
    for _ in range(2):
        before = recordings()  # Dr.Jit takes note of all sensors there are, and of their films.
        for view, expected in zip(views, first, strict=True):
            assert np.array_equal(picture(scene, renderer, view), expected)
    assert recordings() == before


LENSES = {
    "perspective": ({}, {"x_fov": 40.0}),
    "thinlens": ({"aperture_radius": 0.05, "focus_distance": 2.0}, {"focus_distance": 0.5}),
    "orthographic": ({"fov": None}, {"near_clip": 1.0}),
}


@pytest.mark.parametrize("kind", LENSES)
def test_sensors_that_keep_arrays_to_themselves(kind):
    """Dr.Jit doesn't find all that some of Mitsuba's sensors read."""
    settings, changes = LENSES[kind]
    description = camera(16, 12, type=kind) | settings
    scene = load(room(sensor={name: v for name, v in description.items() if v is not None}))
    renderer = new()
    pictures = [picture(scene, renderer), picture(scene, renderer, seed=2)]
    edit(**changes)(scene, renderer)
    pictures.append(picture(scene, renderer))
    assert np.array_equal(pictures[2], traced(scene, renderer))
    move = mi.Transform4f().translate([0.1, 0.2, 0])
    edit(to_world=lambda before: move @ before)(scene, renderer)
    pictures.append(picture(scene, renderer))
    assert np.array_equal(pictures[3], traced(scene, renderer))
    assert not any(np.array_equal(pictures[0], other) for other in pictures[1:])


def test_other_integrators_and_scenes_in_between_change_nothing():
    scene, renderer = load(room()), new()
    first = picture(scene, renderer)
    mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=16)
    another = load(room(lamp=lamp(z=0.5), second=ball(0.5, 0.5, 0, 0.2)))
    assert np.array_equal(picture(scene, renderer), first)
    picture(another, renderer)
    del another
    assert np.array_equal(picture(scene, renderer), first)


def test_gradients_of_parameters_stay():
    scene, renderer = scene_of(), new()
    first = picture(scene, renderer)
    parameters = mi.traverse(scene)
    key = "ball.bsdf.reflectance.value"
    dr.enable_grad(parameters[key])
    dr.set_grad(parameters[key], 2.0)
    parameters.update()
    for _ in range(2):
        with dr.suspend_grad():
            assert np.array_equal(renderer.render(scene, seed=1, spp=4).numpy(), first)
    assert dr.grad_enabled(parameters[key])
    assert np.allclose(dr.grad(parameters[key]).numpy(), 2)


def test_plugins_in_python_are_asked_each_time():
    """What they depend on can't be known."""

    class Half(mi.BSDF):
        level = 0.5

        def __init__(self, props):
            super().__init__(props)
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]
            self.inner = mi.load_dict({"type": "diffuse", "reflectance": 0.5})

        def sample(self, context, si, sample1, sample2, active=True):
            bs, weight = self.inner.sample(context, si, sample1, sample2, active)
            return bs, weight * Half.level

        def eval(self, context, si, wo, active=True):
            return self.inner.eval(context, si, wo, active) * Half.level

        def pdf(self, context, si, wo, active=True):
            return self.inner.pdf(context, si, wo, active)

        def eval_pdf(self, context, si, wo, active=True):
            return self.eval(context, si, wo, active), self.pdf(context, si, wo, active)

        def eval_diffuse_reflectance(self, si, active=True):
            return self.inner.eval_diffuse_reflectance(si, active) * Half.level

    mi.register_bsdf("half", Half)
    scene = load(room(ball=ball(0, 0, 0, 0.3) | {"bsdf": {"type": "half"}}, eye=camera(16, 16)))
    renderer = new()
    first = picture(scene, renderer)
    assert np.array_equal(picture(scene, renderer), first)
    Half.level = 0.1
    assert picture(scene, renderer).mean() < first.mean()
