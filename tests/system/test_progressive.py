"""Pictures that get better: as good as those made at once, with an error that is true."""

from __future__ import annotations

import itertools
import json
import time

import mitsuba as mi
import numpy as np
import pytest

from compare.metrics import rel_mse_of_difference
from envmap_integrator.cli import main
from tests.helpers import SCENES, camera, integrator, load, load_scene, open_scene, picture, room

pytestmark = pytest.mark.usefixtures("variant")

PASSES = (1, 2, 3, 4, 6, 8)
KINDS = ("envmap_hybrid", "one_level_path", "source_selection")


@pytest.fixture(scope="module")
def scene(variant) -> mi.Scene:
    return load(room(sensor=camera(64, 48)))


def ours(kind: str = "envmap_hybrid", **settings) -> mi.Integrator:
    maps = {"maps": "auto"} if kind == "envmap_hybrid" else {}
    shared = {"irradiance_filter": True} if kind != "source_selection" else {}
    return integrator(kind, **({"sampler": "coherent"} | maps | shared | settings))


def last(pictures):
    *_, end = pictures
    return end


def array(improving) -> np.ndarray:
    return np.array(improving.picture)


@pytest.mark.parametrize("kind", KINDS)
def test_passes_add_up(scene, kind):
    """Their number, and a mean that is that of a picture made at once."""
    plugin = ours(kind)
    found = list(plugin.progressive(scene, spp=8, total=64))
    assert [improving.spp for improving in found] == [8 * n for n in PASSES]
    assert found[0].error == np.inf
    assert all(np.isfinite(improving.error) for improving in found[1:])
    assert np.array_equal(array(found[-1]), np.array(scene.sensors()[0].film().develop()))
    at_once = picture(scene, plugin, 64, seed=77)
    assert array(found[-1]).mean() == pytest.approx(at_once.mean(), rel=0.003)


def test_as_little_noise_as_at_once(scene):
    """Passes share the strata of one picture."""
    plugin = ours()
    plugin.prepare(scene, spp=64)
    at_once = [picture(scene, plugin, 64, seed) for seed in range(6)]
    passes = [array(last(plugin.progressive(scene, 0, seed, 8, 64))) for seed in range(6)]

    def variance(pictures) -> float:
        return np.var(pictures, axis=0, ddof=1).mean()

    assert variance(passes) < 1.3 * variance(at_once)


SCENES_OF = {
    "room": lambda: load(room(sensor=camera(64, 48))),
    "open": lambda: load(open_scene(sensor=camera(64, 48), sky={"type": "constant"})),
    "paper_room": lambda: load_scene(SCENES / "paper_room.xml", 64, 48),
    "desk": lambda: load_scene(SCENES / "desk.xml", 64, 48),
    "door_ajar": lambda: load_scene(SCENES / "door_ajar.xml", 64, 48),
}


@pytest.mark.parametrize("name", SCENES_OF)
def test_the_error_is_true(name):
    """The noise of pictures of other seeds, that is: relMSE from their mean."""
    scene, plugin = SCENES_OF[name](), ours()
    found = [last(plugin.progressive(scene, 0, seed, 8, 64)) for seed in range(6)]
    pairs = itertools.combinations(map(array, found), 2)
    # Of a difference, half is the error of one.
    true = np.mean([rel_mse_of_difference(*pair) for pair in pairs]) / 2
    stated = np.mean([improving.error for improving in found])
    assert stated == pytest.approx(true, rel=0.3)


@pytest.mark.parametrize("name", SCENES_OF)
def test_it_ends_with_the_error_asked_for(name):
    scene, plugin = SCENES_OF[name](), ours()
    after_four = [end for end in plugin.progressive(scene, spp=4, total=16)][-1].error
    asked = after_four / 5
    end = last(plugin.progressive(scene, spp=4, total=4096, target_error=asked))
    assert 0.7 * asked <= end.error <= asked


def test_it_ends_in_time(scene):
    plugin = ours()
    last(plugin.progressive(scene, spp=8, total=16))  # compiles
    begin = time.perf_counter()
    end = last(plugin.progressive(scene, spp=8, total=1 << 20, seconds=3))
    assert 2 < time.perf_counter() - begin < 4
    assert end.spp > 16


def test_samplers_that_end(scene):
    with pytest.raises(ValueError, match='"sampler" multijitter has no end of samples'):
        ours(sampler="multijitter").progressive(scene)


def test_no_bias_with_residuals(scene):
    plugin = ours(residual_probability=0.5)
    end = last(plugin.progressive(scene, spp=8, total=128))
    reference = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=1024))
    assert array(end).mean() == pytest.approx(reference.mean(), rel=0.01)


# ---------------------- Command line ----------------------


def run(*options) -> int:
    scene = SCENES / "paper_room.xml"
    size = ("-D", "resx=64", "-D", "resy=48", "--set", "patches=2048")
    return main(["render", str(scene), "--integrator", "envmap_hybrid", *size, *map(str, options)])


def test_path_cannot_go_on(tmp_path, capsys):
    scene, output = str(SCENES / "furnace.xml"), str(tmp_path / "furnace.exr")
    assert main(["render", scene, "--integrator", "path", "--time", "1", "-o", output]) == 2
    assert "pass --integrator envmap_hybrid" in capsys.readouterr().err


def header(path) -> dict:
    metadata = mi.Bitmap(str(path)).metadata()
    return {name: metadata[name] for name in metadata}


def test_better_pictures_are_written(tmp_path, capsys):
    output = tmp_path / "room.exr"
    assert run("--progressive", "--spp", 64, "-o", output, "--png") == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "samples per pixel" in line]
    assert [int(line.split()[0]) for line in lines] == [16, 32, 48, 64]
    assert "noise unknown" in lines[0]
    assert all(" s left" in line for line in lines)
    metadata = header(output)
    assert json.loads(metadata["settings"])["spp"] == 64
    assert 0 < metadata["noise_error"] < 0.1
    assert output.with_suffix(".png").exists()


def test_as_much_noise_as_asked_for(tmp_path, capfd):
    output = tmp_path / "room.exr"
    assert run("--target-error", 1e-3, "-o", output, "--json") == 0
    result = json.loads(capfd.readouterr().out)
    assert 0.7e-3 < result["noise_error"] <= 1e-3
    assert 16 < result["settings"]["spp"] < 512


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--time", "0"), "--time must be above 0"),
        (("--target-error", "-1"), "--target-error must be above 0"),
        (("--time", "1", "--denoise"), "--denoise takes one picture"),
    ],
)
def test_what_cannot_be(tmp_path, capsys, options, message):
    assert run(*options, "-o", tmp_path / "room.exr") == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
