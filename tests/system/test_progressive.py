"""Pictures that get better: as good as those made at once, with an error that is true."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.cli import main
from envmap_integrator.imaging.progress_file import Progress
from envmap_integrator.imaging.progressive import improve
from tests.helpers import (
    ROOT,
    SCENES,
    camera,
    integrator,
    load,
    load_scene,
    open_scene,
    picture,
    room,
)

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


def test_pre_passes_may_be_for_fewer_samples(scene):
    """Nobody knows how many there is time for, and a first picture mustn't wait for the most."""
    plugin = mi.load_dict({"type": "envmap_hybrid"})
    few = last(plugin.progressive(scene, spp=8, total=8))
    many = plugin.progressive(scene, spp=8, total=1 << 14, planned=8)
    assert next(many).state.cache is few.state.cache
    many.close()


def test_with_a_time_they_are_for_the_samples_of_the_scene(tmp_path, monkeypatch):
    asked = {}

    def progressive(self, *args, **settings):
        asked.update(settings)
        return given(self, *args, **settings)

    plugin = type(ours())
    given = plugin.progressive
    monkeypatch.setattr(plugin, "progressive", progressive)
    room_file = str(SCENES / "paper_room.xml")
    command = ["render", room_file, "--integrator", "envmap_hybrid", "-o", str(tmp_path / "a.exr")]
    small = ["-D", "resx=32", "-D", "resy=24", "-D", "spp=8", "--quiet"]
    for end, planned in (("--time=1", 8), ("--target-error=0.1", 0)):
        assert main([*command, *small, end]) == 0
        assert asked["planned"] == planned


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
    pictures = np.stack([array(improving) for improving in found]).astype(np.float64)
    # By the mean of the others, which knows nothing of the bright samples of one.
    others = (pictures.sum(axis=0) - pictures) / (len(pictures) - 1)
    scale = others**2 + 0.01 * pictures.mean() ** 2
    true = np.mean((pictures - others) ** 2 / scale) * (1 - 1 / len(pictures))
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


def test_a_slow_first_pass_is_forgotten():
    """It may have compiled kernels; the next ones take as long as they take."""

    def render(passes):
        for index, _ in enumerate(passes):
            time.sleep(0 if index else 0.5)
            yield [mi.Float(index % 2)]

    passes = improve(
        render,
        lambda sums, samples: mi.TensorXf(sums[0] / samples, (1, 1, 1)),
        lambda: None,
        Progress.none(64),
        seed=0,
        spp=1,
        total=8,
        deadline=np.inf,
        target=0.0,
        state=None,
    )
    first, *_, end = passes
    assert first.pace > 0.4 and end.pace < 0.02 and end.spp == 8


def test_samplers_that_end(scene):
    with pytest.raises(ValueError, match='"sampler" multijitter has no end of samples'):
        ours(sampler="multijitter").progressive(scene)


@pytest.mark.parametrize(
    "asked",
    [
        {"spp": 0},
        {"total": 0},
        {"total": -5},
        {"seconds": 0},
        {"seconds": -1},
        {"seconds": np.nan},
        {"target_error": -1},
    ],
    ids=str,
)
def test_numbers_that_ask_for_no_picture(scene, asked):
    ((name, value),) = asked.items()
    with pytest.raises(ValueError, match=f'^envmap_hybrid: "{name}" .*must be .*, not {value}$'):
        ours().progressive(scene, **asked)


def test_sensors_are_counted_from_0(scene):
    plugin = ours()
    for action in (plugin.progressive, plugin.render, plugin.prepare):
        for sensor in (7, -1):
            with pytest.raises(ValueError, match=f"there is no sensor {sensor} .*; count from 0"):
                action(scene, sensor)
        with pytest.raises(ValueError, match="the scene has no sensor; add one"):
            action(load(room(sensor=None)), 0)


def test_no_bias_with_residuals(scene):
    plugin = ours(residual_probability=0.5)
    end = last(plugin.progressive(scene, spp=8, total=128))
    reference = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=1024))
    assert array(end).mean() == pytest.approx(reference.mean(), rel=0.01)


# ---------------------- Going on later ----------------------


def same(one, other) -> bool:
    return (
        one.spp == other.spp
        and one.error == other.error
        and np.array_equal(*map(array, (one, other)))
    )


@pytest.mark.parametrize("kind", KINDS)
def test_it_goes_on_to_the_bit(scene, kind, tmp_path):
    """By another integrator, of a scene that is loaded anew, as in a new process."""
    file = tmp_path / "room.progress.exr"
    whole = last(ours(kind).progressive(scene, spp=8, total=44))
    for improving in ours(kind).progressive(scene, spp=8, total=44, progress_file=file):
        if improving.spp == 24:
            break
    again = load(room(sensor=camera(64, 48)))
    rest = list(ours(kind).progressive(again, spp=8, total=44, progress_file=file, resume=True))
    assert [improving.spp for improving in rest] == [24, 32, 44]
    assert same(rest[-1], whole)
    (done,) = ours(kind).progressive(again, spp=8, total=44, progress_file=file, resume=True)
    assert same(done, whole)


def test_ctrl_c_loses_no_pass(scene, tmp_path, monkeypatch):
    """After five of eight passes: between pictures, and within a pass."""
    file, plugin = tmp_path / "room.progress.exr", ours()
    whole = last(plugin.progressive(scene, spp=8, total=64))
    send, passes = plugin.sums, []

    def interrupted(*arguments, **more):
        sums = send(*arguments, **more)
        passes.append(sums)
        if len(passes) == 6:
            raise KeyboardInterrupt
        return sums

    monkeypatch.setattr(plugin, "sums", interrupted)
    with pytest.raises(KeyboardInterrupt):
        last(plugin.progressive(scene, spp=8, total=64, progress_file=file))
    monkeypatch.undo()
    rest = list(plugin.progressive(scene, spp=8, total=64, progress_file=file, resume=True))
    assert [improving.spp for improving in rest] == [40, 48, 64]
    assert same(rest[-1], whole)


def test_more_samples_than_planned(scene, tmp_path):
    """They share the strata, also where a pass was cut short, and the cache of the first run."""
    file, plugin = tmp_path / "room.progress.exr", ours()
    first = last(plugin.progressive(scene, spp=16, total=20, progress_file=file))
    more = last(plugin.progressive(scene, spp=16, total=64, progress_file=file, resume=True))
    assert (first.spp, more.spp) == (20, 64)
    assert more.state is first.state
    at_once = last(plugin.progressive(scene, spp=16, total=64))
    # The same samples, but for the noise of strata in those of the pass that was cut short.
    assert more.error == pytest.approx(at_once.error, rel=0.3)


def other_room(**changes):
    return load(room(**{"sensor": camera(64, 48)} | changes))


@pytest.mark.parametrize(
    ("changes", "settings", "seed", "reason"),
    [
        (lambda: {"ball": None}, {}, 0, "made for another scene: it has other shapes"),
        (lambda: {"sensor": camera(64, 48, target=(0, 0.6, -1))}, {}, 0, "made for another sensor"),
        (
            lambda: {"sensor": camera(64, 9)},
            {},
            0,
            r"film.size=\[64, 48\], not film.size=\[64, 9\];",
        ),
        (dict, {"shadow_samples": 4}, 0, "made with shadow_samples=2, not shadow_samples=4"),
        (dict, {"baker": {"type": "envmap_bake", "samples": 4}}, 0, "with baker.samples=8, not"),
        (dict, {"patches": 1024}, 0, "made with patches=2048, not patches=1024"),
        (dict, {}, 1, "made with seed=0, not seed=1"),
    ],
)
def test_it_goes_on_with_nothing_else(scene, tmp_path, changes, settings, seed, reason):
    file = tmp_path / "room.progress.exr"
    last(ours().progressive(scene, spp=8, total=8, progress_file=file))
    other, plugin = other_room(**changes()), ours(**settings)
    with pytest.raises(ValueError, match=reason) as caught:
        plugin.progressive(other, 0, seed, 8, 8, progress_file=file, resume=True)
    message = str(caught.value)
    assert message.startswith(f"{file}: ")
    assert message.endswith("; begin anew, without resume or --resume")
    assert "\n" not in message


# ---------------------- Command line ----------------------


def run(*options) -> int:
    scene = SCENES / "paper_room.xml"
    size = ("-D", "resx=64", "-D", "resy=48", "--set", "patches=2048")
    return main(["render", str(scene), "--integrator", "envmap_hybrid", *size, *map(str, options)])


def test_path_cannot_go_on(tmp_path, capsys):
    scene, output = str(SCENES / "furnace.xml"), str(tmp_path / "furnace.exr")
    assert main(["render", scene, "--integrator", "path", "--time", "1", "-o", output]) == 2
    assert "pass --integrator envmap_hybrid" in capsys.readouterr().err


def test_a_run_that_was_ended_goes_on(tmp_path, capsys):
    """Three runs give the file of one; the number of samples asked for is met."""
    whole, parts = tmp_path / "whole.exr", tmp_path / "parts.exr"
    assert run("--progressive", "--spp", 52, "-o", whole) == 0
    assert run("--progressive", "--spp", 52, "--time", 1e-3, "-o", parts) == 0
    assert json.loads(header(parts)["settings"])["spp"] == 16
    capsys.readouterr()
    assert run("--resume", "--spp", 52, "-o", parts) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "samples per pixel" in line]
    assert [line.split()[0] for line in lines] == ["16", "32", "48", "52"]
    assert lines[0].endswith("; kept from before") and lines[-1].endswith("; about 0 s left")
    pictures = [np.array(mi.Bitmap(str(path))) for path in (whole, parts)]
    assert np.array_equal(*pictures)
    for name in ("settings", "noise_error", "cache_error"):
        one, other = (header(path)[name] for path in (whole, parts))
        assert one == other
    capsys.readouterr()
    assert run("--resume", "--spp", 52, "--seed", 1, "-o", parts) == 2
    error = capsys.readouterr().err
    assert "parts.progress.exr: made with seed=0, not seed=1" in error and error.count("\n") == 1
    assert run("--resume", "-o", tmp_path / "none.exr") == 2
    assert "none.progress.exr: no such file; begin anew" in capsys.readouterr().err


def test_ctrl_c_in_the_shell(tmp_path):
    """What has been rendered is kept, and the picture is that of an uninterrupted run."""
    whole, parts = tmp_path / "whole.exr", tmp_path / "parts.exr"
    options = ("--progressive", "--spp", 192, "-o")
    program = (
        "import sys; from tests.system.test_progressive import run; sys.exit(run(*sys.argv[1:]))"
    )
    command = [sys.executable, "-uc", program, *map(str, options), str(parts)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    for line in process.stdout:
        if line.startswith("64 samples"):  # The next picture is that of 96.
            break
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 130
    kept = parts.with_suffix(".progress.exr")
    assert set(tmp_path.iterdir()) == {parts, kept}
    assert run("--resume", *options, parts) == 0
    assert run(*options, whole) == 0
    assert np.array_equal(*(np.array(mi.Bitmap(str(path))) for path in (whole, parts)))


def header(path) -> dict:
    metadata = mi.Bitmap(str(path)).metadata()
    return {name: metadata[name] for name in metadata}


def test_better_pictures_are_written(tmp_path, capsys):
    output = tmp_path / "room.exr"
    assert run("--progressive", "--spp", 64, "-o", output, "--png") == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "samples per pixel" in line]
    assert [int(line.split()[0]) for line in lines] == [16, 32, 48, 64]
    assert "noise unknown" in lines[0] and "; at most " in lines[0]
    assert all(line.endswith(" s left") for line in lines)
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
