"""Scale and place, films and sensors; scenes that are hard are in ``test_gallery``."""

from __future__ import annotations

from functools import cache

import mitsuba as mi
import numpy as np
import pytest

from compare.gallery import INTEGRATORS
from compare.scene_kit import camera, cluster, film, open_scene, placed, room
from tests.helpers import (
    QUANTILE,
    assert_agree,
    integrator,
    load,
    measure,
    picture,
)
from tests.unit.kit import mesh

pytestmark = pytest.mark.usefixtures("variant")

SKY = {"type": "constant", "radiance": 1.0}

# ---------------------- Broken meshes ----------------------


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize("material", ["dielectric", "thindielectric", "plastic", "conductor"])
def test_no_sky_shines_into_closed_rooms(tmp_path, name, material):
    """From shading normals that are no numbers: rays along them hit nothing."""
    corners = [[x, y, z] for x in (-0.4, 0.4) for y in (-0.4, 0.4) for z in (-1.9, -1.1)]
    tetrahedron = [[0, 3, 5], [0, 6, 3], [0, 5, 6], [3, 6, 5]]
    mesh(corners, tetrahedron, np.zeros((8, 3))).write_ply(str(tmp_path / "broken.ply"))
    broken = {"type": "ply", "filename": str(tmp_path / "broken.ply"), "bsdf": {"type": material}}
    scene = load(room(lamp=None, block=None, ball=broken, sky=SKY))
    found = np.array(mi.render(scene, integrator=integrator(name), spp=64))
    assert not (found > 0).any()


# ---------------------- Scale and place ----------------------

#: Scale of the room, and how far away it is moved.
PLACES = {
    "1/10,000": (1e-4, (0, 0, 0)),
    "1/100": (1e-2, (0, 0, 0)),
    "1,000": (1e3, (0, 0, 0)),
    "100,000": (1e5, (0, 0, 0)),
    "10,000 rooms away": (1.0, (4e4, 0, 0)),
}
#: Relative error of a tile that a coarse mesh may leave which lies elsewhere on the surfaces.
MESH = {"source_selection": 0.04}


@pytest.fixture(scope="module")
def tiles(variant):
    """``tiles(integrator, scale, offset)``: means over parts of the room's picture."""

    @cache
    def measured(name, scale=1.0, offset=(0, 0, 0)):
        maps = {"desk": cluster()} if name == "envmap_hybrid" else {}
        scene = load(placed(room(sensor=camera()), scale, offset))
        return measure(scene, integrator(name, **maps), spp=256).tiles(8)

    return measured


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize("place", PLACES)
def test_pictures_depend_neither_on_scale_nor_on_place(tiles, place, name):
    """But for what rounding and Mitsuba's distance between rays and surfaces, 1e-4 at any scale,
    do to ``path``, too.
    """
    here, there = tiles(name), tiles(name, *PLACES[place])
    path_here, path_there = tiles("path"), tiles("path", *PLACES[place])
    change = there.mean / here.mean - path_there.mean / path_here.mean
    variance = sum(x.variance / x.mean**2 for x in (here, there, path_here, path_there))
    noise = QUANTILE * np.sqrt(variance)
    assert noise.max() <= 0.05
    assert (np.abs(change) <= MESH.get(name, 0.01) + noise).all()


# ---------------------- Films and sensors ----------------------


@pytest.fixture(scope="module")
def hybrid(variant):
    return integrator("envmap_hybrid", desk=cluster())


@pytest.fixture(scope="module")
def whole(hybrid):
    return measure(load(room()), hybrid, spp=128)


def test_film_of_one_pixel(hybrid, whole):
    one = measure(load(room(sensor=camera(1, 1))), hybrid, spp=8192)
    square = whole.mean[:, 4:28].mean()  # the field of view is that of the width
    assert one.mean.item() == pytest.approx(square, rel=0.5)
    assert picture(load(room(sensor=camera(1, 1))), hybrid, spp=1).shape == (1, 1, 3)


def test_crop_window(hybrid, whole):
    crop = {"crop_offset_x": 8, "crop_offset_y": 4, "crop_width": 16, "crop_height": 12}
    scene = load(room(sensor=camera() | {"film": film(32, 24, **crop)}))
    ours = measure(scene, hybrid, spp=128)
    assert ours.mean.shape == (12, 16)
    window = type(whole)(whole.mean[4:16, 8:24], whole.variance[4:16, 8:24])
    assert_agree(ours.tiles(4), window.tiles(4), precision=0.1)


@pytest.mark.parametrize("spp", [1, 3, 100])
def test_any_number_of_samples(hybrid, whole, spp):
    seeds = 4 if spp > 3 else 64
    ours = measure(load(room()), hybrid, spp, seeds).overall()
    assert_agree(ours, whole.overall(), allowed=0.005, precision=0.05)


def test_several_sensors_agree(hybrid, whole):
    scene = load(room(second=camera()))
    assert np.array_equal(picture(scene, hybrid, sensor=0), picture(scene, hybrid, sensor=1))


def test_several_secondary_samples(whole):
    several = integrator("envmap_hybrid", desk=cluster(), secondary_samples=4, shadow_samples=4)
    assert_agree(measure(load(room()), several).overall(), whole.overall(), allowed=0.01)


def test_inside_the_aov_integrator(hybrid):
    scene = load(room())
    aov = mi.load_dict({"type": "aov", "aovs": "depth:depth", "hybrid": hybrid})
    pixels = np.array(mi.render(scene, integrator=aov, spp=4))
    assert pixels.shape == (24, 32, 4)
    assert np.isfinite(pixels).all() and pixels[..., 3].min() > 0
    assert pixels[..., :3].mean() == pytest.approx(picture(scene, hybrid, spp=4).mean(), rel=0.1)


def test_alpha():
    scene = open_scene(floor=None, sky=SKY)
    scene["sensor"]["film"]["pixel_format"] = "rgba"
    hidden = integrator("envmap_hybrid", hide_emitters=True)
    ours, path = (
        picture(load(scene), renderer, spp=64)[..., 3]
        for renderer in (hidden, integrator("path", hide_emitters=True))
    )
    assert np.abs(ours - path).max() < 0.3 and ours.mean() == pytest.approx(path.mean(), abs=0.01)
