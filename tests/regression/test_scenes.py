"""Our scenes and well-known ones, without any parameter: as bright as with ``path``."""

from __future__ import annotations

import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

from compare.gallery import DEFAULT_BIAS, SEEDS, relative_difference
from tests.helpers import SCENES, assert_agree, exactly, load_scene, measure

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 64, 48
#: Scenes of the folder, with parameters that keep the reference free of fireflies.
OURS = {
    "paper_room": {},
    "desk": {},
    "door_ajar": {},
    "open": {"glass": "white-glaze"},
}
#: Third-party scenes, and the relative error that their pictures' means may have.
OTHERS = {"cornell-box": 0.02, "staircase2": 0.02, "veach-ajar": 0.05, "living-room-2": 0.05}


def assert_like_path(scene, allowed: float = 0.02, spp: int = 256, precision: float = 0.03):
    hybrid, path = (mi.load_dict({"type": name}) for name in ("envmap_hybrid", "path"))
    ours = measure(scene, hybrid, spp).overall()
    assert_agree(ours, measure(scene, path, spp).overall(), allowed, precision)


@pytest.mark.parametrize("name", OURS)
def test_our_scenes(name):
    assert_like_path(load_scene(SCENES / f"{name}.xml", WIDTH, HEIGHT, **OURS[name]))


def test_furnace():
    scene = load_scene(SCENES / "furnace.xml", WIDTH, HEIGHT)
    ours = measure(scene, mi.load_dict({"type": "envmap_hybrid"}), spp=128)
    assert_agree(ours.tiles(8), exactly(1), allowed=0.005)


def test_atrium(tmp_path):
    made_by("make_atrium.py", "--triangles", 10000, "--out", tmp_path)
    assert_like_path(load_scene(SCENES / "atrium.xml", WIDTH, HEIGHT, data=str(tmp_path)))


@pytest.mark.parametrize("scattered", [[], ["--scattered"]], ids=["ceiling", "scattered"])
def test_many_lamps(tmp_path, scattered):
    made_by("make_lamps.py", "--lamps", 200, "--out", tmp_path, *scattered)
    (path,) = tmp_path.iterdir()
    assert_like_path(load_scene(path, WIDTH, HEIGHT), allowed=0.01)


def test_sunlit(tmp_path):
    made_by("make_sunlit.py", "--metals", "steel", "--out", tmp_path)
    (path,) = tmp_path.iterdir()
    assert_like_path(load_scene(path, WIDTH, HEIGHT), precision=0.05)


def made_by(script: str, *arguments) -> None:
    subprocess.run([*map(str, (sys.executable, SCENES / script, *arguments))], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_third_party_scenes(third_party_scene, name):
    path = third_party_scene(name)
    scene = mi.load_file(str(path), resx=WIDTH, resy=HEIGHT)
    assert_like_path(scene, OTHERS[name], spp=512, precision=0.05)


def rendered(scene, integrator, spp: int, seed: int) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))


@pytest.mark.slow
@pytest.mark.variants("llvm_ad_spectral")
@pytest.mark.parametrize("name", ["paper_room", "desk", *OTHERS])
def test_spectral(name, third_party_scene):
    """Negative colours are possible there, of light that no screen can show."""
    path = third_party_scene(name) if name in OTHERS else SCENES / f"{name}.xml"
    scene = mi.load_file(str(path), resx=WIDTH, resy=HEIGHT)
    kinds = (mi.load_dict({"type": "envmap_hybrid"}), 128), (mi.load_dict({"type": "path"}), 256)
    ours, reference = (
        np.stack([rendered(scene, one, spp, seed) for seed in range(SEEDS)]) for one, spp in kinds
    )
    assert np.isfinite(ours).all()
    off, margin = relative_difference(ours[..., :3], reference[..., :3])
    assert margin < 0.03 and abs(off) <= DEFAULT_BIAS + margin
