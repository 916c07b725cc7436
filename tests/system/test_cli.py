"""``envmap-render`` from its arguments to its files, messages and exit codes."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envmap_integrator.cli import RENDER_EXAMPLES, main
from envmap_integrator.cli.output import write_bitmap
from envmap_integrator.imaging.denoiser import denoise
from envmap_integrator.system import progress
from envmap_integrator.system.atomic import StorageError
from envmap_integrator.system.scene_file import SceneFile
from envmap_integrator.system.storage import read
from tests.helpers import at_most, unprivileged

SCENE = """
<scene version="3.0.0">
    <default name="radiance" value="1"/>
    {integrator}
    <sensor type="perspective">
        <transform name="to_world"> <lookat origin="0,0,4" target="0,0,0" up="0,1,0"/> </transform>
        <film type="hdrfilm">
            <integer name="width" value="16"/> <integer name="height" value="12"/>
            <integer name="crop_width" value="8"/>
        </film>
        <sampler type="independent"> <integer name="sample_count" value="4"/> </sampler>
    </sensor>
    <shape type="sphere"> <bsdf type="diffuse"/> </shape>
    <emitter type="constant"> <float name="radiance" value="$radiance"/> </emitter>
</scene>
"""
PATH = '<integrator type="path"> <integer name="max_depth" value="2"/> </integrator>'
PAIR = """<bsdf type="diffuse" id="grey"/>
    <shape type="rectangle" id="left"> <ref id="grey"/> </shape>
    <shape type="rectangle" id="right"> <ref id="grey"/> </shape>"""
UNKNOWN = '<integrator type="no_such_plugin"> <float name="strange" value="1"/> </integrator>'


@pytest.fixture
def scene(tmp_path) -> Path:
    return write_scene(tmp_path, PATH)


def write_scene(folder: Path, integrator: str) -> Path:
    path = folder / "ball.xml"
    path.write_text(SCENE.format(integrator=integrator))
    return path


def pixels(path: Path) -> np.ndarray:
    return np.array(mi.Bitmap(str(path)))


def header(path: Path) -> dict:
    with OpenEXR.File(str(path), header_only=True) as file:
        return dict(file.header())  # which closing empties


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_render_writes_picture_and_header(scene, capsys):
    assert run("render", scene, "--spp", 2, "--seed", 3, "--png", "-D", "radiance=5") == 0
    picture = scene.with_suffix(".exr")
    assert pixels(picture).shape == (12, 8, 3)
    assert pixels(picture)[0, 0] == pytest.approx(5)

    settings = json.loads(header(picture)["settings"])
    assert settings["integrator"] == "path"
    assert settings["integrator_settings"] == {"max_depth": 2, "rr_depth": 5}
    assert (settings["spp"], settings["seed"]) == (2, 3)
    assert settings["defines"] == {"radiance": "5"}
    assert set(json.loads(header(picture)["stage_times"])) == {"load", "render"}

    assert pixels(scene.with_suffix(".png")).dtype == np.uint8
    assert sorted(path.suffix for path in scene.parent.iterdir()) == [".exr", ".png", ".xml"]
    told = capsys.readouterr().out
    assert "render" in told
    assert f"wrote {picture}\nwrote {scene.with_suffix('.png')}\n" in told


def test_quiet(scene, capfd):
    assert run("render", scene, "--quiet") == 0
    assert capfd.readouterr() == ("", "")
    assert scene.with_suffix(".exr").exists()


@pytest.mark.parametrize("before", [False, True])
def test_quiet_is_for_one_command(scene, monkeypatch, before):
    """A program that wants no progress bars gets none afterwards, others do."""
    monkeypatch.setattr(progress, "quiet", before)
    for options in ((), ("--quiet",)):
        assert run("render", scene, *options) == 0
        assert progress.quiet == before


@pytest.mark.parametrize("command", ["render", "inspect"])
def test_terminals_show_what_goes_on(tmp_path, capsys, monkeypatch, command):
    """From loading on; to others nothing is shown."""
    scene = write_scene(tmp_path, "")
    monkeypatch.setattr(progress, "Timer", AtOnce)
    options = (scene, "--spp", 4, "--set", "patches=256")
    assert run(command, *options) == 0
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("ENVMAP_PROGRESS", "1")
    assert run(command, *options) == 0
    shown = capsys.readouterr().err
    for stage in ("Loading the scene", "Preparing", "Coarse mesh", "Irradiance cache", "Rendering"):
        assert stage in shown
    assert ("Inspecting" in shown) == (command == "inspect")
    assert run(command, *options, "--quiet") == 0
    assert capsys.readouterr().err == ""


class AtOnce:
    """A timer that doesn't wait."""

    def __init__(self, delay: float, function):
        self.start = function

    def cancel(self) -> None:
        pass

    join = cancel


def test_json(tmp_path, capfd):
    """One object on stdout, and nothing else."""
    scene = write_scene(tmp_path, "")
    options = ("--set", "patches=256", "--spp", 4)
    assert run("render", scene, "--json", *options) == 0
    result = json.loads(capfd.readouterr().out)
    assert result["output"] == str(scene.with_suffix(".exr"))
    seconds = result["seconds"]
    assert {"load", "coarse mesh", "render"} <= seconds.keys()
    assert seconds.pop("total") == pytest.approx(sum(seconds.values()))
    assert result["compilation_s"] >= 0
    assert 0 <= result["cache_error"] < 1
    assert result["settings"]["integrator"] == "envmap_hybrid"
    parameters = result["settings"]["integrator_settings"]
    assert (parameters["patches"], parameters["sampler"]) == (256, "coherent")
    assert (parameters["aovs"], parameters["patch_samples"]) == ("", None)
    assert parameters["baker.samples"] == 8
    assert run("bake", scene, "--json", "-o", tmp_path / "state.exr") == 0
    assert json.loads(capfd.readouterr().out)["output"] == str(tmp_path / "state.exr")


def test_quiet_or_json(scene, capsys):
    with pytest.raises(SystemExit, match="2"):
        run("render", scene, "--quiet", "--json")
    assert "not allowed with" in capsys.readouterr().err


@pytest.mark.parametrize("command", [(), ("render",), ("bake",), ("inspect",), ("export",)])
def test_help_teaches(capsys, command):
    with pytest.raises(SystemExit, match="0"):
        run(*command, "--help")
    shown = capsys.readouterr().out
    assert "exit codes:\n  0    done\n  2    bad input" in shown
    assert not command or f"examples:\n  envmap-render {command[0]} " in shown


def test_exit_codes_of_the_doctor(capsys):
    with pytest.raises(SystemExit, match="0"):
        run("doctor", "--help")
    shown = capsys.readouterr().out
    assert "\n  1    nothing can" in shown and "bad input" not in shown


def test_what_help_proposes_is_for_scenes_of_any_integrator(tmp_path, monkeypatch):
    """The same commands, for a small scene of path, with few samples."""
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path, PATH).rename("room.xml")
    lines = RENDER_EXAMPLES.splitlines()
    examples = [shlex.split(line, comments=True)[1:] for line in lines if "envmap-render" in line]
    progressive = [words for words in examples if "--progressive" in words or "--resume" in words]
    assert len(progressive) == 2
    for words in progressive:
        assert main([*words, "--spp", "17", "--set", "patches=64"]) == 0


@pytest.mark.parametrize(
    "asked, answers",
    [
        ("--de", ["--debug", "--define", "--denoise"]),
        ("--integrator e", ["envmap_hybrid"]),
        ("-m llvm_ad_s", ["llvm_ad_spectral"]),
    ],
)
def test_shells_can_complete(tmp_path, asked, answers):
    """As bash asks: what could follow ``envmap-render render --de``?"""
    line = f"envmap-render render {asked}"
    answer = tmp_path / "answer"
    environment = os.environ | {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
        "_ARGCOMPLETE_IFS": "\n",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    code = "from envmap_integrator.cli import main; main()"
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    words = sorted(word.strip() for word in answer.read_text().split("\n"))
    assert words == answers


def test_integrator_of_the_scene_need_not_exist(tmp_path):
    scene = write_scene(tmp_path, UNKNOWN)
    output = tmp_path / "picture.exr"
    options = ("--integrator", "direct", "--set", "hide_emitters=true", "--set", "bsdf_samples=2")
    assert run("render", scene, "-o", output, *options) == 0
    assert json.loads(header(output)["settings"])["integrator_settings"]["bsdf_samples"] == 2
    assert pixels(output)[0, 0] == pytest.approx(0)


def test_a_scene_without_integrator_gets_ours(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    scene_file = SceneFile(write_scene(tmp_path, ""))
    assert scene_file.integrator.plugin_name() == "envmap_hybrid"


def test_listed_clusters_keep_the_ids_of_shapes(tmp_path):
    """Meshes that share a material are merged otherwise, and the merged mesh has no id."""
    integrator = """<integrator type="envmap_hybrid">
            <integer name="patches" value="256"/>
            <emitter type="mipmap_cube" id="pair">
                <string name="shapes" value="left, right"/>
            </emitter>
        </integrator>"""
    scene = write_scene(tmp_path, PAIR + integrator)
    assert run("bake", scene, "-o", tmp_path / "state.exr", "--set", "map_resolution=8") == 0

    scene_file = SceneFile(scene)
    assert {"left", "right"} <= {shape.id() for shape in scene_file.load().shapes()}
    scene_file.configure_integrator("path")
    assert not {"left", "right"} & {shape.id() for shape in scene_file.load().shapes()}


def test_a_baked_state_serves_later_renders(tmp_path):
    """Merging puts the shapes in another order each time."""
    scene = write_scene(tmp_path, PAIR)
    state = tmp_path / "state.exr"
    options = ("--integrator", "source_selection", "--set", "patches=256")
    assert run("bake", scene, "-o", state, *options) == 0
    for _ in range(3):
        assert run("render", scene, "--spp", 1, *options, "--set", f"cache_file={state}") == 0


@pytest.mark.parametrize("more", [[], ["--time", 9]], ids=["at-once", "progressive"])
def test_the_time_of_a_baked_state_is_that_of_reading_it(tmp_path, capfd, more):
    scene, state = write_scene(tmp_path, ""), tmp_path / "state.exr"
    assert run("bake", scene, "-o", state, "--set", "patches=256", "--quiet") == 0
    options = ("--set", "patches=256", "--set", f"cache_file={state}", "--json", "--spp", 1)
    assert run("render", scene, *options, *more) == 0
    seconds = json.loads(capfd.readouterr().out)["seconds"]
    assert list(seconds) == ["load", f"read from {state}", "render", "total"]
    total = seconds.pop("total")
    assert total == pytest.approx(sum(seconds.values())) and min(seconds.values()) > 0
    kept = json.loads(header(scene.with_suffix(".exr"))["stage_times"])
    assert list(kept) == ["load", f"read from {state}", "render"]


def test_a_picture_can_be_denoised(scene, tmp_path):
    """As by the denoiser called by hand, on a film with a box filter."""
    output = tmp_path / "denoised.exr"
    assert run("render", scene, "-o", output, "--spp", 4, "--denoise", "--png") == 0
    assert json.loads(header(output)["stage_times"])["denoise"] > 0
    assert json.loads(header(output)["settings"])["denoised"]
    scene_file = SceneFile(scene)
    scene_file.configure_reconstruction_filters("box")
    loaded = scene_file.load()
    noisy = np.array(mi.render(loaded, spp=4, seed=0))[..., :3]
    expected = denoise(loaded, loaded.integrator(), noisy, 4, 0)
    np.testing.assert_allclose(pixels(output)[..., :3], expected, atol=2e-3)
    assert np.abs(expected - noisy).max() > 0.01


def test_indirect_light_is_denoised_apart(scene, tmp_path):
    """For ours, without AOVs in the file that nobody asked for."""
    output, kept = tmp_path / "denoised.exr", tmp_path / "kept.exr"
    options = ("--integrator", "one_level_path", "--spp", 4, "--denoise")
    assert run("render", scene, "-o", output, *options) == 0
    assert run("render", scene, "-o", kept, *options, "--set", "indirect_aovs=true") == 0
    assert pixels(output).shape[2] == pixels(kept).shape[2] - 9
    asked = tmp_path / "asked.exr"
    assert run("render", scene, "-o", asked, *options, "--set", "aovs=s:served") == 0
    assert pixels(asked).shape[2] == pixels(kept).shape[2] + 3
    scene_file = SceneFile(scene)
    scene_file.configure_reconstruction_filters("box")
    loaded = scene_file.load()
    ours = mi.load_dict({"type": "one_level_path", "indirect_aovs": True})
    noisy = np.array(mi.render(loaded, integrator=ours, spp=4, seed=0))
    expected = denoise(loaded, ours, noisy, 4, 0)
    for path in (output, kept):
        np.testing.assert_allclose(pixels(path)[..., :3], expected, atol=2e-3)
    by_name = noisy[..., [-3, -2, -1, -6, -5, -4, -9, -8, -7]]  # as in files
    np.testing.assert_allclose(pixels(kept)[..., -9:], by_name, atol=2e-3)
    assert json.loads(header(output)["settings"])["integrator"] == "one_level_path"


def test_films_can_be_resized(scene):
    mi.set_variant("llvm_ad_rgb")
    scene_file = SceneFile(scene)
    scene_file.configure_films(6, 5)
    first, second = scene_file.load(), scene_file.load()
    film = first.sensors()[0].film()
    assert tuple(film.crop_size()) == (6, 5)
    assert film.rfilter().radius() == 0.5
    assert first.integrator() is not second.integrator()
    assert scene_file.film_size == (6, 5)


def test_samplers_can_be_replaced(scene):
    mi.set_variant("llvm_ad_rgb")
    scene_file = SceneFile(scene)
    before = scene_file.load().sensors()[0].sampler().sample_count()
    scene_file.configure_samplers("ldsampler")
    sampler = scene_file.load().sensors()[0].sampler()
    assert sampler.class_name() == "LowDiscrepancySampler"
    assert sampler.sample_count() == before


def test_parameters_of_the_integrator_can_be_kept_or_dropped(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    deep = '<integrator type="path"><integer name="max_depth" value="7"/></integrator>'
    scene_file = SceneFile(write_scene(tmp_path, deep))
    scene_file.configure_integrator("path", {"rr_depth": 9})
    assert "max_depth" in scene_file.integrator
    scene_file.configure_integrator("path", keep=False)
    assert "max_depth" not in scene_file.integrator and "rr_depth" not in scene_file.integrator


@pytest.fixture
def preparing_integrator():
    """An integrator with a pre-pass, as ours have; its state saves itself as text."""
    mi.set_variant("llvm_ad_rgb")

    class Preparing(mi.SamplingIntegrator):
        def prepare(self, scene, sensor=0, spp=0):
            return SimpleNamespace(
                stage_times={"radiosity": 1.25},
                relative_error=0.25,
                maps=(SimpleNamespace(cluster=SimpleNamespace(name="desk"), resolution=8),),
                save=lambda path: path.write_text("baked"),
            )

        def sample(self, scene, sampler, ray, medium=None, active=True):
            return mi.Spectrum(0.5), mi.Bool(True), []

        def to_string(self):
            return "Preparing[]"

    mi.register_integrator("cli_test_preparing", Preparing)
    return "cli_test_preparing"


def test_stage_times_of_the_pre_pass_are_reported(scene, preparing_integrator, capsys):
    assert run("render", scene, "--integrator", preparing_integrator) == 0
    times = json.loads(header(scene.with_suffix(".exr"))["stage_times"])
    assert times["radiosity"] == 1.25
    told = capsys.readouterr().out
    assert "radiosity" in told and f"by {preparing_integrator} with " in told


def test_bake_saves_the_state(scene, preparing_integrator, tmp_path, capsys):
    output = tmp_path / "state.exr"
    assert run("bake", scene, "-o", output, "--integrator", preparing_integrator) == 0
    assert output.read_text() == "baked"
    assert "maps: desk (8 x 8)" in capsys.readouterr().out


def test_bake_leaves_other_clusters_as_they_are(tmp_path):
    apart = PAIR
    for name, y in (("left", -1), ("right", 1.2)):
        move = f'<transform name="to_world"> <translate x="-1.2" y="{y}" z="0.1"/> </transform>'
        apart = apart.replace(f'id="{name}">', f'id="{name}"> {move}')
    scene, state = write_scene(tmp_path, apart), tmp_path / "state.exr"
    options = [scene, "-o", state, "--integrator", "envmap_hybrid"]
    for setting in ("patches=256", "map_resolution=4", "a.shapes=left", "b.shapes=right"):
        options += ["--set", setting]
    assert run("bake", *options) == 0
    before = read(state, "").parts
    assert run("bake", *options, "--set", "b.resolution=8", "--clusters", "b") == 0
    after = read(state, "").parts
    assert after["map1/level0"]["inverse_distance"].shape == (8, 48)
    for part in before.keys() - {name for name in before if name.startswith("map1/")}:
        for channel, image in before[part].items():
            np.testing.assert_array_equal(after[part][channel], image)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("-m", "llvm_rgb"), 'unknown variant "llvm_rgb"'),
        (("-D", "radiance"), 'expected KEY=VALUE, got "radiance"'),
        (("-D", "radiant=3"), "remove -D radiant"),
        (("--set", "max_dept=3"), "max_dept"),
        (("--set", "max_depth=deep"), "give it as integer"),
        (("--set", "cache_file=state.exr"), "path has no such parameter: pass --integrator envmap"),
        (("--integrator", "no_such_plugin"), '"no_such_plugin" not found'),
        (("-s", "1"), "there is no sensor 1 (-s/--sensor): the scene has 1; count from 0"),
        (("--sp", "3"), "unrecognized arguments: --sp 3"),
        (("-t", "0"), "-t/--threads must be at least 1"),
        (("--spp", "-1"), "--spp must not be negative"),
        (("-o", "picture.png"), "must end in .exr"),
        (("-o", "nowhere/picture.exr"), "there is no folder nowhere; make it first"),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2(scene, capsys, options, message):
    try:
        code = run("render", scene, *options)
    except SystemExit as exit:
        code = exit.code
    error = capsys.readouterr().err
    assert code == 2
    assert message in error
    assert error.count("\n") == 1
    assert not scene.with_suffix(".exr").exists()


def test_a_folder_that_is_not_writable(public_folder, capsys):
    """Noticed before the work starts."""
    scene = write_scene(public_folder, PATH)
    public_folder.chmod(0o555)
    with unprivileged():
        assert run("render", scene) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"envmap-render: {scene.with_suffix('.exr')}: the folder ")
    assert "isn't writable; change its permissions" in error and error.count("\n") == 1


@pytest.mark.parametrize("suffix", [".exr", ".png"])
def test_a_disk_that_is_full(tmp_path, suffix):
    """Wherever in the picture the room ends."""
    mi.set_variant("llvm_ad_rgb")
    path = tmp_path / f"picture{suffix}"
    pixels = np.random.default_rng(1).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    bitmap = mi.Bitmap(pixels)
    if suffix == ".exr":
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32)
    write_bitmap(path, bitmap)
    before = path.read_bytes()
    for limit in (0, 100, len(before) // 2, len(before) - 1):
        with at_most(limit), pytest.raises(StorageError, match=f"^{path}: can't be written: File"):
            write_bitmap(path, bitmap)
        assert path.read_bytes() == before
        assert list(tmp_path.iterdir()) == [path]


def test_missing_scene(tmp_path, capsys):
    assert run("render", tmp_path / "none.xml") == 2
    assert "none.xml" in capsys.readouterr().err


def test_denoising_without_the_denoiser(scene, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    assert run("render", scene, "--spp", 1, "--denoise") == 2
    assert "pip install mitsuba-oidn" in capsys.readouterr().err


def test_bake_without_pre_pass(scene, tmp_path, capsys):
    assert run("bake", scene, "-o", tmp_path / "state.exr") == 2
    assert '"path" has nothing to bake' in capsys.readouterr().err


def test_doctor_finds_this_machine_fit(capsys):
    assert main(["doctor"]) == 0
    report = capsys.readouterr().out
    assert "libLLVM" in report and "llvm_ad_rgb" in report
