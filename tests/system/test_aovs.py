"""What ``aovs`` shows of the cache, the clusters and the rays; nothing else changes by it."""

from __future__ import annotations

from itertools import groupby

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.imaging.aovs import TYPES, UNEVEN, false_colour
from envmap_integrator.transport.vertex import Vertex
from tests.helpers import ball, camera, cluster, integrator, load, open_scene, room

pytestmark = pytest.mark.usefixtures("variant")

ALL = ", ".join(f"{kind}:{kind}" for kind in TYPES)
WIDTH, HEIGHT = 32, 24


@pytest.fixture(scope="module")
def scene(variant) -> mi.Scene:
    return load(room())


def channels(
    scene: mi.Scene, ours: mi.Integrator, sensor: mi.Sensor | int = 0, spp: int = 4
) -> dict[str, np.ndarray]:
    """The picture [H, W, 3] as "", and all AOVs [H, W, 1 or 3] by their names."""
    pixels = np.array(mi.render(scene, sensor=sensor, integrator=ours, spp=spp))
    found, begin = {"": pixels[..., :3]}, 3
    for name, names in groupby(ours.aov_names(), lambda channel: channel.partition(".")[0]):
        end = begin + len(list(names))
        found[name] = pixels[..., begin:end]
        begin = end
    assert begin == pixels.shape[2]
    return found


def centres(scene: mi.Scene, sensor: mi.Sensor) -> tuple[mi.Ray3f, mi.SurfaceInteraction3f]:
    """Rays through the centres of all pixels, row by row, and what they hit."""
    y, x = np.indices((HEIGHT, WIDTH), np.float32).reshape(2, -1) + 0.5
    ray, _ = sensor.sample_ray(0.0, 0.0, mi.Point2f(x / WIDTH, y / HEIGHT), mi.Point2f(0.5))
    return ray, scene.ray_intersect(ray)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("kind", ["envmap_hybrid", "one_level_path"])
def test_the_picture_stays_the_same(scene, kind, shared):
    """To the bit, with AOVs and with those of indirect light beside them."""
    settings = {"irradiance_filter": shared, "sampler": "coherent"}
    plain = channels(scene, integrator(kind, **settings))
    more = channels(scene, integrator(kind, aovs=ALL, **settings))
    assert list(plain) == [""] and list(more) == ["", *TYPES]
    assert np.array_equal(plain[""], more[""])
    both = channels(scene, integrator(kind, aovs=ALL, indirect_aovs=True, **settings))
    assert list(both) == ["", *TYPES, "indirect", "gathered", "albedo"]
    for name in TYPES:
        assert np.array_equal(both[name], more[name])


def test_without_aovs_kernels_know_nothing_of_them(scene):
    def kernels(**settings) -> list[int]:
        ours = integrator("envmap_hybrid", sampler="coherent", **settings)
        ours.prepare(scene, spp=4)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(ours.render(scene, spp=4))
            return [kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])]

    without = kernels()
    assert kernels(aovs="") == without != kernels(aovs="s:served")


def test_values_are_those_that_are_stored(scene):
    """At the very place; pixels at the border of two patches hold a mean."""
    close = mi.load_dict(camera(WIDTH, HEIGHT, fov=20))
    ours = integrator("one_level_path", patches=512, aovs=ALL)
    found = channels(scene, ours, close)
    state = ours.prepare(scene, close, 4)
    lookup, _ = ours._lookup(scene, *ours._ready(scene, close, 4), 4)
    ray, si = centres(scene, close)
    vertex = Vertex.met(lookup, si, ray, mi.Bool(True))
    patch = lookup.patches.find(vertex.si.p, vertex.normal, vertex.object_id, vertex.cell)
    index, known = patch.index.numpy(), patch.found.numpy()[:, None]
    table = state.cache.table.numpy().reshape(-1, 3)
    colour = np.stack([c.numpy() for c in false_colour(patch.index)], axis=-1)
    expected = {
        "irradiance": table[2 * index],
        "indirect_irradiance": table[2 * index + 1],
        "irradiance_error": state.cache.error.numpy()[2 * index][:, None],
        "patch": np.where(patch.even.numpy(), 1, UNEVEN)[:, None] * colour,
    }
    assert known.mean() > 0.9
    for name, values in expected.items():
        shown = found[name].reshape(values.shape)
        alike = np.isclose(shown, np.where(known, values, 0), rtol=1e-4).all(axis=1)
        assert alike.mean() > 0.5 and values.any()
    assert not found["cluster"].any()


def test_colours_of_neighbours_differ():
    colours = np.stack([c.numpy() for c in false_colour(dr.arange(mi.UInt32, 16))], -1)
    assert (colours >= 0).all() and (colours <= 1).all()
    for i in range(15):
        assert np.abs(colours[i + 1] - colours[i]).max() > 0.25


def test_rays_of_a_cluster_end_in_its_map(scene):
    """Elsewhere in the cache; few are traced on from either, and none leave a closed room."""
    sensor = scene.sensors()[0]
    ours = integrator("envmap_hybrid", desk=cluster("ball"), aovs=ALL)
    found = channels(scene, ours, sensor, 16)
    _, si = centres(scene, sensor)
    ball, walls = (
        (si.shape == mi.ShapePtr(shape)).numpy().reshape(HEIGHT, WIDTH)
        for name in ("ball", "walls")
        for shape in scene.shapes()
        if shape.id() == name
    )
    served, mapped = found["served"], found["cluster"].any(axis=-1)
    assert mapped[ball].mean() > 0.9 and mapped[walls].mean() < 0.1
    assert served[ball, 2].mean() > 0.3 > 10 * served[walls, 2].mean()
    assert served[walls, 1].mean() > 0.6
    assert served.sum(axis=-1).max() <= 1 + 1e-5 and served.sum(axis=-1).mean() > 0.95
    near = found["near"][..., 0]  # Part of those that are traced on: where walls meet, above all.
    assert (near <= served[..., 0] + 1e-5).all() and near[ball].mean() < 0.1
    assert near.max() > 0.3 and near.mean() > 0.3 * served[..., 0].mean()


def test_mirrors_show_what_is_seen_in_them():
    """The surfaces that secondary rays start from."""
    mirror = ball(0.4, 0.2, -1.6, 0.4) | {"bsdf": {"type": "conductor"}}
    sensor = mi.load_dict(camera(8, 8, target=(0.4, 0.2, -1.6), fov=5))
    found = channels(load(room(ball=mirror)), integrator("one_level_path", aovs=ALL), sensor)
    assert found["irradiance"].any(axis=-1).mean() > 0.8


def test_within_the_aov_integrator(scene):
    nested = {"type": "envmap_hybrid", "patches": 512, "aovs": "p:patch, s:served"}
    outer = mi.load_dict({"type": "aov", "aovs": "depth:depth", "img": nested})
    alone = np.array(mi.render(scene, integrator=mi.load_dict(nested), spp=4, seed=3))
    both = np.array(mi.render(scene, integrator=outer, spp=4, seed=3))
    np.testing.assert_array_equal(both[..., : alone.shape[2]], alone)
    assert alone.shape[2] == 9 and alone[..., 3:6].any()


def test_nothing_where_nothing_is_seen():
    """But the sky."""
    scene = load(open_scene(floor=None, sky={"type": "constant"}))
    away = mi.load_dict(camera(8, 8, target=(0, -9, 9)))
    found = channels(scene, integrator("envmap_hybrid", aovs=ALL), away)
    assert found[""].all() and not any(found[name].any() for name in TYPES)
