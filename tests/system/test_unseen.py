"""Rooms, views and light that nobody has tuned for: as bright as with ``path``, or a warning."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation import pipeline
from tests.helpers import (
    Description,
    Estimate,
    assert_agree,
    at,
    camera,
    colour,
    emitting,
    grey,
    lamp,
    load,
    measure,
    picture,
    room,
    scaled,
)

pytestmark = pytest.mark.usefixtures("variant")


def hybrid(**settings) -> mi.Integrator:
    return mi.load_dict({"type": "envmap_hybrid"} | settings)


def path() -> mi.Integrator:
    return mi.load_dict({"type": "path"})


def box(x0, y0, z0, x1, y1, z1) -> Description:
    """A block between two corners, grey on both sides."""
    low, high = np.array([x0, y0, z0]), np.array([x1, y1, z1])
    place = at(*((low + high) / 2).tolist()) @ scaled_by(*((high - low) / 2).tolist())
    return {"type": "cube", "to_world": place} | paint(0.7)


def paint(reflectance: float) -> Description:
    return {"bsdf": {"type": "twosided"} | grey(reflectance)}


def scaled_by(*factors: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().scale(factors)


# ---------------------- Contacts ----------------------


def contacts() -> Description:
    """Stairs, a block and posts on the floor of a room, beside a bright wall."""
    steps = {f"step{i}": box(-2, -2 + 0.3 * i, -2, 2, 2, -1.85 + 0.15 * i) for i in range(4, 8)}
    posts = {f"post{i}": box(x, 0.2, -2, x + 0.06, 0.26, -1) for i, x in enumerate((-1.94, -0.9))}
    window = lamp(half_width=0.7, power=20)
    window["to_world"] = at(-1.98, 0, -0.9) @ mi.ScalarTransform4f().rotate([0, 1, 0], 90)
    window["to_world"] = window["to_world"] @ scaled(0.7)
    sensor = camera(64, 48, origin=(1.7, -1.7, -0.6), target=(-1, 0.4, -1.8))
    parts = {"block": box(-1.2, -0.6, -2, -0.7, -0.1, -1.5), "lamp": window, "sensor": sensor}
    return room(ball=None, **steps, **posts, **parts)


def test_light_at_contacts(caches):
    """Patches are larger than the distance to what stands on them: tile by tile.

    On average over caches, whose own noise is stated.
    """
    scene, pictures = load(contacts()), []
    for seed in range(6):
        caches(seed)
        pictures.append(picture(scene, hybrid(), 256, seed).mean(axis=-1).astype(np.float64))
    ours = Estimate(np.mean(pictures, axis=0), np.var(pictures, axis=0, ddof=1) / 6).tiles(8)
    reference = measure(scene, path(), spp=2048).tiles(8)
    assert_agree(ours, reference, allowed=0.01, precision=0.05)


def boards() -> Description:
    """Thin bright boards and posts close together on a floor: contacts all over the picture."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    source = {"type": "rectangle", "to_world": at(0, 0, 1.98) @ turned @ scaled(0.5)}
    shelf = {
        "type": "scene",
        "shell": box(-2, -2, -2, 2, 2, 2) | paint(0.6),
        "lamp": source | paint(0) | emitting(10),
        "sensor": camera(64, 48, origin=(1.7, -1.7, -0.2), target=(-0.5, 0.5, -1.7), fov=55),
    }
    for i in range(8):
        x = -1.9 + 0.25 * i
        shelf[f"board{i}"] = box(x, -0.9, -2, x + 0.02, 1.9, -1.9) | paint(0.9)
    for i in range(5):
        x = -1.5 + 0.5 * i
        shelf[f"post{i}"] = box(x, -1.5, -2, x + 0.08, -1.42, -1.6) | paint(0.9)
    return shelf


def test_light_between_boards():
    """Hits nearer than a patch is large that the cache serves show in the tiles' mean square.

    (0.4 % where it served them, 0.2 % where it doesn't.)
    """
    scene = load(boards())
    ours = measure(scene, hybrid(), spp=256).tiles(8)
    reference = measure(scene, path(), spp=2048).tiles(8)
    assert_agree(ours, reference, allowed=0.008, precision=0.01)
    noise = (ours.variance + reference.variance) / reference.mean**2
    square = np.square(ours.mean / reference.mean - 1) - noise
    assert np.sqrt(noise.mean()) < 0.0015
    assert square.mean() < 0.003**2


# ---------------------- Views ----------------------


def house(extent: float, *sensors: Description) -> Description:
    """A room with a window, on a ground of that half width under sky and sun."""
    parts = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": colour(3)},
        "sun": {"type": "directional", "direction": [0.35, -0.8, -0.6], "irradiance": colour(20)},
        "ground": {"type": "rectangle", "to_world": at(0, 0, -0.1) @ scaled(extent)} | paint(0.3),
        "floor": box(-2, -2, -0.1, 2, 2, 0),
        "ceiling": box(-2, -2, 2.6, 2, 2, 2.7),
        "left": box(-2.1, -2, 0, -2, 2, 2.6),
        "right": box(2, -2, 0, 2.1, 2, 2.6),
        "behind": box(-2, -2.1, 0, 2, -2, 2.6),
        "sill": box(-2, 2, 0, 2, 2.1, 0.9),
        "lintel": box(-2, 2, 2.1, 2, 2.1, 2.6),
        "beside": box(-2, 2, 0.9, -0.8, 2.1, 2.1),
        "besides": box(0.8, 2, 0.9, 2, 2.1, 2.1),
    }
    return parts | {f"sensor{i}": sensor for i, sensor in enumerate(sensors)}


INSIDE = {"origin": (-1.6, -1.6, 1.5), "target": (0.5, 1.4, 0.8)}


def inside() -> Description:
    return camera(48, 32, **INSIDE)


def measured_from(scene, sensor, integrator, spp: int) -> Estimate:
    pictures = np.stack(
        [
            np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed))
            for seed in range(3)
        ]
    ).mean(axis=-1)
    return Estimate(pictures.mean(axis=0), pictures.var(axis=0, ddof=1) / 3)


@pytest.mark.parametrize(
    ("extent", "held"),
    [
        (30.0, "none"),
        (30.0, "one outside"),
        (1000.0, "one outside"),
        (1e5, "the sensor"),
        (1e5, "none"),
    ],
)
def test_a_house_on_a_plain(extent, held):
    """Seen from inside, by a sensor that the scene holds or not."""
    outside = camera(48, 32, origin=(12, 14, 5), target=(0, 0, 1))
    sensors = {"the sensor": [inside()], "none": [], "one outside": [outside]}[held]
    scene = load(house(extent, *sensors))
    sensor = scene.sensors()[0] if held == "the sensor" else mi.load_dict(inside())
    ours = measured_from(scene, sensor, hybrid(), 128)
    reference = measured_from(scene, sensor, path(), 512)
    assert_agree(ours.overall(), reference.overall(), allowed=0.01)
    assert_agree(ours.tiles(8), reference.tiles(8), allowed=0.04, precision=0.15)


def two_rooms() -> Description:
    """Two closed rooms, a bright one, in which the camera is, and a dim one."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    lights = {
        name: {"type": "rectangle", "to_world": at(x, 0, 2.55) @ turned @ scaled(size)}
        | paint(0)
        | emitting(power)
        for name, x, size, power in (("bright", -2.0, 0.4, 8.0), ("dim", 3.0, 0.1, 30.0))
    }
    walls = {"shell": box(-4, -2, 0, 4, 2, 2.6), "wall": box(-0.05, -2, 0, 0.05, 2, 2.6)}
    sensor = camera(48, 32, origin=(-0.6, -1.7, 1.5), target=(-2.2, 0.6, 0.8))
    return {"type": "scene", "sensor": sensor} | walls | lights


def test_a_camera_that_moves_to_another_room():
    scene, renderer = load(two_rooms()), hybrid()
    before = renderer.prepare(scene, spp=256)
    parameters = mi.traverse(scene)
    there = mi.ScalarTransform4f().look_at([0.5, -1.7, 1.5], [2.5, 0.6, 0.8], [0, 0, 1])
    parameters["sensor.to_world"] = mi.Transform4f(there.matrix)
    parameters.update()
    ours = measure(scene, renderer, spp=256, seeds=3).tiles(8)
    assert renderer.prepare(scene, spp=256) is not before
    assert_agree(ours, measure(scene, path(), spp=1024).tiles(8), allowed=0.03, precision=0.06)


def test_a_sensor_among_many_is_not_prepared_for_again():
    scene, renderer = load(two_rooms()), hybrid()
    states = set()
    for x in (-0.6, -0.7, -0.8):
        view = camera(48, 32, origin=(x, -1.7, 1.5), target=(-2.2, 0.6, 0.8))
        states.add(id(renderer.prepare(scene, mi.load_dict(view), spp=64).cache))
    assert len(states) == 1


def test_a_cache_file_of_another_room_is_refused(tmp_path):
    scene = load(two_rooms())
    hybrid().prepare(scene, spp=64).save(tmp_path / "state.exr")
    renderer = hybrid(cache_file=str(tmp_path / "state.exr"))
    renderer.prepare(scene)
    there = mi.load_dict(camera(48, 32, origin=(0.5, -1.7, 1.5), target=(2.5, 0.6, 0.8)))
    with pytest.raises(ValueError, match="made for other views"):
        renderer.prepare(scene, there)


def test_a_camera_that_sees_nothing_but_the_sky():
    away = camera(8, 8, origin=(0, 0, 5), target=(0, 1, 9))
    scene = load(house(30.0, away))
    seen, expected = (np.array(mi.render(scene, integrator=i, spp=4)) for i in (hybrid(), path()))
    assert np.allclose(seen, expected)


def test_within_another_integrator_a_scene_needs_a_sensor():
    scene = load(house(30.0))
    within = mi.load_dict({"type": "aov", "aovs": "d:depth", "child": {"type": "envmap_hybrid"}})
    with pytest.raises(RuntimeError):
        mi.render(scene, sensor=mi.load_dict(inside()), integrator=within, spp=1)


# ---------------------- Rare light ----------------------


def zigzag() -> Description:
    """Light that comes around four walls."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    source = {"type": "rectangle", "to_world": at(0, 11, 2.45) @ turned @ scaled(0.4)}
    corridor = {
        "type": "scene",
        "shell": box(-1, 0, 0, 1, 12, 2.5) | paint(0.8),
        "lamp": source | paint(0) | emitting(3000),
        "sensor": camera(24, 18, origin=(0, 0.3, 1.5), target=(0.1, 3, 1.2), fov=75),
    }
    for i in range(4):
        low, high = (-1.0, 0.4) if i % 2 else (-0.4, 1.0)
        wall = box(low, 2 + 2.2 * i, 0, high, 2.05 + 2.2 * i, 2.5)
        corridor[f"wall{i}"] = wall | paint(0.8)
    return corridor


def gap() -> Description:
    """A dark room lit through a gap of 2 cm under a wall."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    source = {"type": "rectangle", "to_world": at(2.5, 0, 2.55) @ turned @ scaled(0.4)}
    return {
        "type": "scene",
        "shell": box(-4, -2, 0, 4, 2, 2.6),
        "wall": box(0.30, -2, 0.02, 0.33, 2, 2.6),
        "lamp": source | paint(0) | emitting(30),
        "sensor": camera(32, 24, origin=(-3.6, -1.6, 1.6), target=(0.3, 0.9, 0.5), fov=75),
    }


def slot() -> Description:
    """A room lit through a slot between the ceiling and a disk: steep indirect light beside it."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    source = {"type": "rectangle", "to_world": at(-0.3, 0, 2.55) @ turned @ scaled(0.4)}
    return {
        "type": "scene",
        "shell": box(-2, -2, 0, 2, 2, 2.6),
        "lamp": source | paint(0) | emitting(8),
        "disk": {"type": "disk", "to_world": at(-0.3, -0.2, 2.3) @ scaled(1.2)} | paint(0.8),
        "sensor": camera(48, 36, origin=(1.2, -1.7, 1.5), target=(-0.2, 0.6, 0.8), fov=70),
    }


#: Means of ``path`` with 10⁵ samples per pixel and more, and their standard errors.
RARE = {
    "zigzag": (zigzag, 0.1330, 0.0010),
    "gap": (gap, 0.001488, 0.00001),
    "slot": (slot, 0.03313, 0.00008),
}


@pytest.fixture
def caches(monkeypatch):
    """Make pre-passes draw other random numbers: ``caches(seed)``."""
    steps = ("scatter_points", "find_spaces", "separate", "survey_direct_light", "solve_irradiance")
    originals = {name: getattr(pipeline, name) for name in steps}

    def choose(seed: int) -> None:
        for name, step in originals.items():

            def seeded(*args, step=step, **settings):
                return step(*args, **{"seed": 1000 * seed} | settings)

            monkeypatch.setattr(pipeline, name, seeded)

    return choose


def test_a_view_is_prepared_for_if_too_little_is_known_of_its_light():
    """Its walls have patches, as light that is seen has passed them, but few rays have found it."""

    def view(x: float, y: float) -> Description:
        return camera(24, 18, origin=(0, 2.6, 1.5), target=(x, y, 1.2), fov=75)

    scene, renderer = load(zigzag() | {"sensor": view(0.1, 6)}), hybrid()
    own = renderer.prepare(scene, spp=16)
    assert own.relative_error < 0.01
    beside = renderer.prepare(scene, mi.load_dict(view(0.15, 6)), spp=16)
    assert beside.cache is own.cache
    assert beside.relative_error == pytest.approx(own.relative_error, rel=0.5)
    assert beside.relative_error != own.relative_error
    back = renderer.prepare(scene, mi.load_dict(view(0.1, 0)), spp=16)
    assert back.cache is not own.cache and back.relative_error < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", RARE)
def test_rare_light(name, caches):
    """Right on average over caches, each within what it states, and it states no more than that."""
    description, expected, error = RARE[name]
    scene, means, stated = load(description()), [], []
    for seed in range(10):
        caches(seed)
        renderer = hybrid()
        stated.append(renderer.prepare(scene, spp=1024).relative_error)
        means.append(np.mean(np.array(mi.render(scene, integrator=renderer, spp=1024, seed=seed))))
    assert_agree(
        Estimate(np.mean(means), np.var(means, ddof=1) / len(means)),
        Estimate(np.float64(expected), np.float64(error**2)),
        allowed=0.01,
        precision=0.06,
    )
    wrong = np.sqrt(np.mean(np.square(np.array(means) / expected - 1)))
    assert 0.005 < np.mean(stated) < 0.05
    assert wrong / 3 < np.mean(stated) < 3 * wrong  # Of ten caches: chance alone keeps within that.


def test_ordinary_rooms_have_little_doubt():
    assert hybrid().prepare(load(room()), spp=256).relative_error < 0.003


# ---------------------- Bumps ----------------------


def bumpy(wall: Description) -> Description:
    return {
        "type": "scene",
        "shell": box(-2, -2, 0, 2, 2, 2.6) | {"bsdf": {"type": "twosided", "bsdf": wall}},
        "lamp": lamp(z=2.55, half_width=0.4, power=8),
        "sensor": camera(48, 36, **INSIDE),
    }


def noise(*channels: int) -> mi.Bitmap:
    texels = np.random.default_rng(1).random((32, 32, *channels))
    if channels == (3,):  # A normal map: turned by up to half a right angle.
        texels = np.concatenate([0.2 + 0.6 * texels[..., :2], 0.85 + 0 * texels[..., 2:]], axis=-1)
    return mi.Bitmap(texels.astype(np.float32))


def bitmap(image: mi.Bitmap, **settings) -> Description:
    return {"type": "bitmap", "bitmap": image, "raw": True} | settings


@pytest.mark.parametrize("kind", ["bumpmap", "normalmap"])
def test_turned_normals(kind):
    if kind == "bumpmap":
        texture = bitmap(noise(1), to_uv=scaled_by(2, 2, 1))
        wall = {"type": "bumpmap", "texture": texture, "scale": 0.4} | grey(0.7)
    else:
        nested = {"type": "principled", "base_color": colour(0.7), "roughness": 0.8}
        wall = {"type": "normalmap", "normalmap": bitmap(noise(3)), "bsdf": nested}
    scene = load(bumpy(wall))
    ours = measure(scene, hybrid(), spp=256, seeds=3).overall()
    assert_agree(ours, measure(scene, path(), spp=1024).overall(), allowed=0.008)


# ---------------------- Shapes that hide a lamp ----------------------


def test_a_lamp_behind_a_disk():
    """All light leaves through the slot between the disk and the ceiling."""
    place = at(-0.3, -0.2, 1.6) @ scaled(1.2)
    scene = load(room(disk={"type": "disk", "to_world": place} | paint(0.8), ball=None))
    ours = measure(scene, hybrid(), spp=512).overall()
    assert_agree(ours, measure(scene, path(), spp=4096).overall(), allowed=0.01, precision=0.02)
