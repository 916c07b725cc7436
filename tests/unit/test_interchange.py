"""Cube maps in OpenEXR's layout, and latitude-longitude maps."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from numpy.testing import assert_allclose

from envmap_integrator.lookup.cube import texel_directions
from envmap_integrator.preparation.maps.interchange import (
    cube_directions,
    latlong_directions,
    read_cube,
    write_cube,
    write_latlong,
)
from envmap_integrator.system.storage import StorageError

pytestmark = pytest.mark.usefixtures("variant")

#: Corners of the cube in the corners of each face, as ImfEnvmap.h draws them: upper left and right,
#: lower left and right. Bits 0, 1, 2 of a corner's number tell whether x, y, z are positive.
CORNERS = ((3, 7, 1, 5), (6, 2, 4, 0), (6, 7, 2, 3), (0, 1, 4, 5), (7, 6, 5, 4), (2, 3, 0, 1))


def light(d: np.ndarray) -> np.ndarray:
    """A smooth radiance [..., 3] that no rotation or reflection maps to itself."""
    x, y, z = np.moveaxis(d / np.linalg.norm(d, axis=-1, keepdims=True), -1, 0)
    return np.stack([2 + x, 2 + y + 0.3 * z * x, 2 + z - 0.5 * x * y], axis=-1).astype(np.float32)


def write_one(path, image: np.ndarray, dtype=np.float32, names="RGB", **header) -> str:
    """A single picture, as another tool leaves it."""
    channels = {name: image[..., i].astype(dtype) for i, name in enumerate(names)}
    with OpenEXR.File({"type": OpenEXR.scanlineimage} | header, channels) as file:
        file.write(str(path))
    return str(path)


def test_corners_of_faces_lie_where_openexr_has_them():
    faces = cube_directions(9).reshape(6, 9, 9, 3)
    for face, corners in zip(faces, CORNERS, strict=True):
        shown = (face[0, 0], face[0, -1], face[-1, 0], face[-1, -1])
        assert [int((d > 0) @ (1, 2, 4)) for d in shown] == list(corners)
        assert (np.abs(shown) == 1).all()


@pytest.mark.parametrize("size", [1, 2, 20, 32, 33])
def test_single_maps_of_any_size_are_read(tmp_path, size):
    image = light(cube_directions(size))
    path = write_one(tmp_path / "map.exr", image, envmap=OpenEXR.ENVMAP_CUBE)
    levels = read_cube(path, "")
    finest = 1 << (size - 1).bit_length()
    assert [level.shape for level in levels] == [
        (6, finest >> i, finest >> i, 3) for i in range(len(levels))
    ]
    assert levels[-1].shape == (6, 1, 1, 3)
    if size > 16:
        assert_allclose(levels[0], light(texel_directions(finest)), atol=0.005)
        assert_allclose(levels[2], light(texel_directions(finest // 4)), atol=0.02)


def test_levels_that_are_there_are_taken_and_others_made(tmp_path):
    levels = [np.full((6 * size, size, 3), size, np.float32) for size in (16, 8, 4)]
    write_cube(tmp_path / "map.exr", levels)
    found = read_cube(tmp_path / "map.exr", "")
    assert [float(level.mean()) for level in found] == [16, 8, 4, 4, 4]


@pytest.mark.parametrize("channels", [1, 3])
def test_what_is_written_is_read(tmp_path, channels):
    write_cube(tmp_path / "map.exr", [light(cube_directions(32))[..., :channels]])
    found = read_cube(tmp_path / "map.exr", "")[0]
    assert_allclose(found, light(texel_directions(32))[..., :channels], atol=0.005)


def test_half_precision_without_the_attribute_and_with_alpha(tmp_path):
    image = np.concatenate([light(cube_directions(32)), np.ones((192, 32, 1))], axis=-1)
    path = write_one(tmp_path / "map.exr", image, np.float16, "RGBA")
    assert_allclose(read_cube(path, "")[0], light(texel_directions(32)), atol=0.01)


@pytest.mark.parametrize("name", ["RLE", "ZIP", "PIZ", "PXR24", "B44A", "DWAB"])
def test_a_map_may_be_compressed_in_any_way(tmp_path, name):
    """One of a single colour becomes far smaller than by Deflate."""
    compression = getattr(OpenEXR, f"{name}_COMPRESSION")
    path = write_one(tmp_path / "a.exr", np.ones((1536, 256, 3)), compression=compression)
    assert_allclose(read_cube(path, "")[0], 1, rtol=1e-3)


def test_values_that_are_no_radiance_are_black(tmp_path):
    image = np.ones((12, 2, 3), np.float32)
    image[:, :, 0], image[:, :, 1], image[:, :, 2] = -1, np.nan, np.inf
    assert not read_cube(write_one(tmp_path / "map.exr", image), "")[0].any()


def test_mitsubas_envmap_shows_a_latitude_longitude_map(tmp_path):
    path = str(tmp_path / "map.exr")
    write_latlong(path, light(latlong_directions(128)))
    envmap = mi.load_dict({"type": "envmap", "filename": path})
    d = np.random.default_rng(3).normal(size=(1000, 3)).astype(np.float32)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(d.T)
    assert_allclose(envmap.eval(si).numpy().T, light(d), atol=0.002)


@pytest.mark.parametrize(
    ("shape", "names", "header"),
    [
        ((10, 2), "RGB", {}),
        ((12, 2), "AZ", {}),
        ((12, 2), "RGB", {"envmap": OpenEXR.ENVMAP_LATLONG}),
    ],
    ids=["size", "channels", "attribute"],
)
def test_other_pictures_are_refused(tmp_path, shape, names, header):
    path = write_one(tmp_path / "a.exr", np.ones((*shape, len(names))), names=names, **header)
    with pytest.raises(StorageError, match='a.exr: holds no cube map, .* emitter "envmap"'):
        read_cube(path, "")
