"""Spectral variants: light of each wavelength for itself, as with ``path``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.system import spectrum
from tests.helpers import (
    SCENES,
    Description,
    Estimate,
    assert_agree,
    at,
    box,
    camera,
    exactly,
    integrator,
    load,
    load_scene,
    picture,
    room,
)

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.variants("llvm_ad_spectral")]

#: Period of the metamers' spectra [nm]: ten times the width of the bins, or more.
PERIOD = 90.0
WIDTH, HEIGHT = 32, 24
#: Steps of points that are well spread in three dimensions (Roberts 2018).
R3 = (0.8191725, 0.6710436, 0.5497004)
#: Relative error of each colour that the method may leave: of so deep spectra, the bins' too.
ALLOWED = 0.02
#: Two lines 10 nm wide.
LINES = ((540, 0.0), (545, 30.0), (550, 0.0), (600, 0.0), (605, 30.0), (610, 0.0))
#: These, and a lamp of 2800 K.
EMITTERS = {
    "lines": {"type": "spectrum", "value": [*LINES]},
    "blackbody": {"type": "blackbody", "temperature": 2800.0},
}


def metamers() -> tuple[Description, Description]:
    """Two reflectances, both grey by daylight, of which one is high where the other is low."""
    wavelength = np.arange(360.0, 831.0, 5.0)
    seen = mi.cie1931_xyz(mi.Float(wavelength)).numpy().T
    seen = seen * mi.cie_d65(mi.Float(wavelength)).numpy()[:, None]
    wave = np.cos(2 * np.pi * wavelength / PERIOD)
    wave -= seen @ np.linalg.lstsq(seen, wave, rcond=None)[0]  # What the eye sees of it.
    wave *= 0.4 / np.abs(wave).max()
    pairs = (zip(wavelength, 0.5 + sign * wave, strict=True) for sign in (1, -1))
    return tuple({"type": "spectrum", "value": [(float(x), float(y)) for x, y in p]} for p in pairs)


def painted(reflectance: Description) -> Description:
    return {"bsdf": {"type": "diffuse", "reflectance": reflectance}}


def half(x: float, z: float, reflectance: Description) -> Description:
    place = at(x, 0, z) @ mi.ScalarTransform4f().scale([1, 2, 1])
    bsdf = {"type": "twosided"} | painted(reflectance)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def metamer_room(radiance: Description, **changes) -> mi.Scene:
    """A room with walls of one metamer. The left half of its floor is of the same, the right one of
    the other; all light comes by way of the ceiling, to which a lamp shines from a shelf.
    """
    same, other = metamers()
    place = at(0, 0, 0.8) @ mi.ScalarTransform4f().scale([0.9, 0.9, 1])
    parts = {
        "walls": box(2.0) | painted(same),
        "left": half(-1, -1.99, same),
        "right": half(1, -1.99, other),
        "lamp": {"type": "rectangle", "to_world": place, "emitter": emitting(radiance)},
        "block": None,
        "ball": None,
    }
    return load(room(**parts | changes))


def emitting(radiance: Description) -> Description:
    return {"type": "area", "radiance": radiance}


def floor_x(scene: mi.Scene) -> np.ndarray:
    """Where on the floor [H, W] the middle of each pixel is, along x; NaN elsewhere."""
    y, x = np.indices((HEIGHT, WIDTH), np.float32).reshape(2, -1) + 0.5
    place = mi.Point2f(x / WIDTH, y / HEIGHT)
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, place, mi.Point2f(0.5))
    p = np.array(scene.ray_intersect(mi.Ray3f(ray)).p)
    return np.where(p[2] < -1.9, p[0], np.nan).reshape(HEIGHT, WIDTH)


def colours(scene: mi.Scene, one: mi.Integrator, spp: int, seeds: int = 4) -> list[Estimate]:
    """Mean and variance of each channel, [H, W]."""
    pictures = [np.array(mi.render(scene, integrator=one, spp=spp, seed=s)) for s in range(seeds)]
    pictures = np.stack(pictures).astype(np.float64)
    assert np.isfinite(pictures).all()
    mean, variance = pictures.mean(axis=0), pictures.var(axis=0, ddof=1) / seeds
    return [Estimate(mean[..., i], variance[..., i]) for i in range(mean.shape[2])]


def within(estimate: Estimate, mask: np.ndarray) -> Estimate:
    """Mean over the pixels of a mask."""
    return Estimate(estimate.mean[mask].mean(), estimate.variance[mask].mean() / mask.sum())


# ---------------------- Pictures ----------------------


@pytest.mark.parametrize("emitter", EMITTERS)
def test_metamers(emitter):
    """Grey by daylight alike, they reflect what comes from walls of one of them quite otherwise.

    Also beside the border between them, across which pixels share what they gather.
    """
    scene = metamer_room(EMITTERS[emitter])
    ours, path = (
        colours(scene, mi.load_dict({"type": kind}), spp)[1]  # Of two lamps there is no blue.
        for kind, spp in (("one_level_path", 64), ("path", 512))
    )
    x = floor_x(scene)
    same, other, left, right = x < -0.3, x > 0.3, (x > -0.3) & (x < 0), (x > 0) & (x < 0.3)
    for mask, precision in ((same, 0.1), (other, 0.1), (left, 0.25), (right, 0.25)):
        assert_agree(within(ours, mask), within(path, mask), ALLOWED, precision)
    # As colours, they would be as bright as each other.
    assert within(ours, right).mean < 0.6 * within(ours, left).mean


@pytest.mark.parametrize(
    "kind, settings", [("source_selection", {}), ("envmap_hybrid", {"map_resolution": 16})]
)
def test_furnace(kind, settings):
    """Each colour of a white room of radiance 1 is 1, from the maps too."""
    scene = load_scene(SCENES / "furnace.xml", WIDTH, HEIGHT)
    for channel in colours(scene, integrator(kind, **settings), spp=64, seeds=2):
        assert_agree(channel.overall(), exactly(1), allowed=0.01, precision=0.03)


def test_bands():
    """Any number of them, with AOVs, and no light in one that none is in."""
    bands = {"1": (535, 555), "2": (590, 620), "3": (650, 690), "4": (535, 620)}
    film = {
        name: {"type": "spectrum", "value": [(low, 1.0), (high, 1.0)]}
        for name, (low, high) in bands.items()
    }
    film |= {"type": "specfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    scene = metamer_room(EMITTERS["lines"], sensor=camera() | {"film": film})
    kinds = (
        mi.load_dict({"type": "one_level_path", "aovs": "p:patch"}),
        mi.load_dict({"type": "path"}),
    )
    ours, path = (colours(scene, one, 64, seeds=3) for one in kinds)
    assert len(ours) == len(bands) + len("RGB") and not ours[2].mean.any()
    for channel in (0, 1, 3):
        one, other = ours[channel].overall(), path[channel].overall()
        assert_agree(one, other, ALLOWED, precision=0.1)
    assert 0 < ours[-1].mean.max() <= 1


# ---------------------- What is stored ----------------------


@pytest.fixture(scope="module")
def state(variant, tmp_path_factory):
    """A saved state with maps, and a picture by it."""
    path, ours = tmp_path_factory.mktemp("state") / "state.exr", hybrid()
    scene = load(room())
    ours.prepare(scene).save(path)
    return path, picture(scene, ours)


def hybrid(**settings) -> mi.Integrator:
    return integrator("envmap_hybrid", map_resolution=8, irradiance_filter=True, **settings)


def test_a_state_is_what_it_was(state):
    path, before = state
    assert (picture(load(room()), hybrid(cache_file=str(path))) == before).all()


@pytest.mark.parametrize("there, here", [("llvm_ad_rgb", 0), ("llvm_ad_spectral", 1)])
def test_a_state_of_another_variant_is_refused(state, tmp_path, there, here):
    path = state[0]
    if there == "llvm_ad_rgb":
        mi.set_variant(there)
        path = tmp_path / "rgb.exr"
        hybrid().prepare(load(room())).save(path)
    mi.set_variant(("llvm_ad_spectral", "llvm_ad_rgb")[here])
    with pytest.raises(ValueError, match="made for another scene: it has other variant") as caught:
        hybrid(cache_file=str(path)).prepare(load(room()))
    assert "\n" not in str(caught.value)


def test_a_map_as_an_environment(state):
    """Its spectra are those of its texels, and tools that know no wavelengths get its colours."""
    sky = mi.load_dict({"type": "mipmap_cube", "filename": str(state[0])})
    index = dr.arange(mi.UInt32, 1 << 14)
    u, v, w = (x - dr.floor(x) for x in (mi.Float(index) * step for step in R3))
    direction = mi.warp.square_to_uniform_sphere(mi.Point2f(u, v))
    wavelengths = spectrum.wavelengths_at(w)
    spectra = sky.eval_level(direction, 0, True, wavelengths)
    shown = sky.eval_level(direction, 0)
    seen = mi.Color3f(*spectrum.rgb(spectrum.seen(spectra, wavelengths)))
    np.testing.assert_allclose(dr.mean(seen, axis=1), dr.mean(shown, axis=1), rtol=0.02)


def test_a_packet_has_the_wavelengths_of_its_bins():
    """What rays of a packet find is read at these wavelengths, and only there."""
    for packet in range(spectrum.n_packets()):
        rows = dr.zeros(mi.Float, spectrum.BINS)
        mine = 4 * packet + dr.arange(mi.UInt32, 4)
        dr.scatter(rows, mi.Float(1), mine)
        for u in (0.01, 0.99):
            wavelengths = spectrum.packet_wavelengths(mi.UInt32(packet), mi.Float(u))
            read = spectrum.read_at(rows, lambda p: p, wavelengths)
            assert dr.all(read == 1, axis=None)
    names = spectrum.bin_names()
    assert len(set(names)) == spectrum.BINS and names[:4] == ("367nm", "481nm", "548nm", "620nm")
