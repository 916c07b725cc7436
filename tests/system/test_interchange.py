"""Maps from and for other tools: rendered by another integrator, exported, shown by Mitsuba."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envmap_integrator.cli import main
from tests.helpers import (
    Estimate,
    assert_agree,
    at,
    ball,
    box,
    camera,
    cluster,
    film,
    grey,
    integrator,
    load,
    measure,
    open_scene,
    picture,
    room,
    scaled,
)

pytestmark = pytest.mark.usefixtures("variant")

RESOLUTION = 64
CENTRE, HALF_WIDTH = (0.2, -0.1, 0.3), 0.6
X, Y, Z = np.eye(3)
#: Faces of a cube as ImfEnvmap.h of OpenEXR draws them: outwards, and up in the picture.
FACES = ((X, Y), (-X, Y), (Y, Z), (-Y, -Z), (Z, Y), (-Z, Y))


def hall(**more) -> mi.Scene:
    """A room of many colours, lit from points, around a ball that is a cluster."""
    pieces = {
        f"block{i}": {"type": "cube", "to_world": at(*place) @ scaled(0.5)} | grey(*colour)
        for i, (place, colour) in enumerate(
            (
                ((1.5, 0, -0.5), (0.8, 0.2, 0.2)),
                ((-1.5, 1, 0.5), (0.2, 0.8, 0.2)),
                ((0.3, 1.5, 1.2), (0.2, 0.2, 0.8)),
                ((-0.4, -1.5, -1), (0.8, 0.8, 0.1)),
                ((0.6, 0.2, 1.6), (0.1, 0.8, 0.8)),
                ((0.3, -0.4, -1.6), (0.8, 0.1, 0.8)),
            )
        )
    }
    lights = {
        f"light{i}": {"type": "point", "position": p, "intensity": {"type": "rgb", "value": 3}}
        for i, p in enumerate(([-1.2, -0.5, 1.5], [1.2, -1.2, 0.8]))
    }
    globe = {"ball": ball(*CENTRE, HALF_WIDTH / 2) | grey(0.5)}
    changes = {"lamp": None, "block": None, "walls": box(2.0) | grey(0.4)}
    return load(room(**changes | pieces | lights | globe | more))


def perspectives() -> np.ndarray:
    """The six faces by ``path``, [6 N, N, 3], from the cluster's cube outwards.

    The centres of the outer pixels lie on the edges of the cube, as OpenEXR has it, so that the
    field of view is a little wider than 90 degrees.
    """
    sensor = {
        "type": "perspective",
        "fov": 2 * np.degrees(np.arctan(RESOLUTION / (RESOLUTION - 1))),
        "near_clip": HALF_WIDTH,
        "far_clip": 100.0,
        "sampler": {"type": "independent"},
        "film": film(RESOLUTION, RESOLUTION),
    }
    sensors = {
        f"face{i}": sensor
        | {
            "to_world": mi.ScalarTransform4f().look_at(
                CENTRE, (CENTRE + outwards).tolist(), up.tolist()
            )
        }
        for i, (outwards, up) in enumerate(FACES)
    }
    scene = hall(sensor=None, **sensors)
    path = mi.load_dict({"type": "path", "max_depth": 12})
    return np.concatenate([picture(scene, path, spp=128, sensor=i) for i in range(6)])


@pytest.fixture(scope="module")
def maps(variant, tmp_path_factory):
    """Files with the same map: baked by ours, exported, and rendered by ``path``."""
    folder = tmp_path_factory.mktemp("maps")
    names = ("baked", "exported", "latlong", "by_hand")
    files = {name: str(folder / f"{name}.exr") for name in names}
    ours = integrator(
        "envmap_hybrid",
        desk=cluster("ball", distance_ratio=2),
        map_resolution=RESOLUTION,
        patches=8192,  # Errors of the cache are no subject here.
        patch_samples=256,
        baker={"type": "envmap_bake", "samples": 64},
    )
    ours.prepare(hall(), spp=64).save(files["baked"])
    assert main(["export", files["baked"], "-o", files["exported"], "--quiet"]) == 0
    latlong = ["export", files["exported"], "-o", files["latlong"], "--latlong", "--quiet"]
    assert main(latlong) == 0
    by_hand = {"RGB": perspectives().astype(np.float32)}
    header = {"type": OpenEXR.scanlineimage, "envmap": OpenEXR.ENVMAP_CUBE}
    with OpenEXR.File(header, by_hand) as file:
        file.write(files["by_hand"])
    return files


def lit_by(filename: str, kind: str) -> Estimate:
    """A plastic ball and the sky behind it."""
    sensor = camera(width=24, height=24, origin=(0, -3, 0.5), target=(0, 0, 0), fov=80)
    globe = {"type": "sphere", "bsdf": {"type": "plastic"}}
    scene = load(
        {
            "type": "scene",
            "sensor": sensor,
            "globe": globe,
            "sky": {"type": kind, "filename": filename},
        }
    )
    return measure(scene, mi.load_dict({"type": "path", "max_depth": 3}), spp=256)


@pytest.mark.parametrize(
    ("other", "kind", "allowed"),
    [
        ("exported", "mipmap_cube", 0.015),
        ("latlong", "envmap", 0.015),
        ("by_hand", "mipmap_cube", 0.04),  # Of which 0.4 % in the mean, by the cache.
    ],
)
def test_it_does_not_matter_who_has_made_a_map(maps, other, kind, allowed, artefacts):
    """The ball is lit alike, and the sky behind it looks the same."""
    ours, theirs = lit_by(maps["baked"], "mipmap_cube"), lit_by(maps[other], kind)
    artefacts["ours"], artefacts["theirs"] = ours.mean[..., None], theirs.mean[..., None]
    assert_agree(ours.overall(), theirs.overall(), allowed=0.01)
    assert_agree(ours.tiles(6), theirs.tiles(6), allowed=allowed, precision=0.03)


def test_openexr_knows_the_exported_map(maps):
    with OpenEXR.File(maps["exported"]) as file:
        for level, part in enumerate(file.parts):
            size = RESOLUTION >> level
            assert part.header["envmap"] == OpenEXR.ENVMAP_CUBE
            assert part.channels["RGB"].pixels.shape == (6 * size, size, 3)
        assert len(file.parts) == 7
    with OpenEXR.File(maps["latlong"]) as file:
        assert file.header()["envmap"] == OpenEXR.ENVMAP_LATLONG


def test_our_integrators_render_under_a_map(maps):
    """Turned, so that its light comes from where it didn't."""
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 90)
    sky = {"type": "mipmap_cube", "filename": maps["exported"], "to_world": turn, "scale": 5.0}
    scene = load(open_scene(sky=sky))
    ours = measure(scene, integrator("envmap_hybrid", desk=cluster()), spp=128)
    theirs = measure(scene, mi.load_dict({"type": "path", "max_depth": 16}), spp=256)
    assert_agree(ours.overall(), theirs.overall(), allowed=0.01)
    assert_agree(ours.tiles(8), theirs.tiles(8), allowed=0.03, precision=0.1)
