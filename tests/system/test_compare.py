"""The experiments at tiny size, and the harness on answers that are known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from compare import report, variants
from compare.__main__ import EXPERIMENTS, main
from compare.contributions import Ledger
from compare.experiments import error_vs_time, flicker, render
from compare.options import JudgedOptions
from compare.references import Reference, reference
from compare.runs import Task, interleave
from compare.scenes import HYBRID, PAPER_ROOM, PATH, Subject, View

pytestmark = pytest.mark.usefixtures("variant")

#: Smaller than ``--quick``, for each experiment.
COMMON = {"width": 32, "runs": 3}
TINY = {
    "resolution": {"spp": 4, "resolutions": (8, 16), "patches": 256},
    "distance": {"spp": 4, "resolution": 16, "ratios": (1.25, 2.0), "patches": 256},
    "algorithms": {
        "spp": 1,
        "secondary_samples": 4,
        "shadow_samples": 2,
        "default_spp": 4,
        "patches": 256,
    },
    "error-vs-time": {"spp": (1, 4)},
    "complexity": {
        "spp": 4,
        "patches": 256,
        "triangles": (10_000, 20_000),
        "clusters": (0, 1),
        "resolutions": (8, 16),
    },
    "bias": {"spp": 4, "patches": 256, "finer": 4},
    "flicker": {"spp": 4, "frames": 3, "degrees": 1.0},
    "render": {"spp": 4},
    "partition": {"spp": 4},
    "workers": {"spp": 4, "workers": (1,), "sleepers": (2,), "seconds": 0.5},
}


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    """Folder that the references of this module share."""
    return tmp_path_factory.mktemp("references")


# ---------------------- All experiments ----------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", TINY)
def test_experiment(name, tmp_path):
    """Each writes what was asked, with all its numbers, and shows them."""
    module = EXPERIMENTS[name]
    options = module.Options(**COMMON, **TINY[name])
    if isinstance(options, JudgedOptions):
        options = replace(options, reference_spp=16)
    outcomes = list(module.run(options, tmp_path, **_scenes(module)))
    for outcome in outcomes:
        report.show(outcome)
        report.write(outcome, tmp_path)
        check_files(outcome, tmp_path)
    assert outcomes and any(outcome.figures for outcome in outcomes)


def _scenes(module):
    return {"scenes": (PAPER_ROOM,)} if hasattr(module, "SCENES") else {}


def check_files(outcome, folder):
    document = json.loads((folder / f"{outcome.name}.json").read_text(), parse_constant=pytest.fail)
    assert document["schema"] == report.SCHEMA
    assert document["experiment"] == outcome.name
    assert {"title", "settings", "numbers", "findings", "versions", "machine"} <= document.keys()
    assert document["settings"]["seed"] == 0 and document["settings"]["width"] == COMMON["width"]
    assert document["versions"].keys() >= {"envmap_integrator", "mitsuba", "drjit", "llvm"}
    assert document["numbers"] and outcome.tables
    for table in outcome.tables:
        assert table.rows and all(len(row) == len(table.columns) for row in table.rows)
    for run in _runs(document["numbers"]):
        assert {"seed", "prepare_s", "stages_s", "render_s", "compile_s"} <= run.keys()
    for illustration in outcome.figures:
        assert (folder / f"{outcome.name}-{illustration.name}.png").stat().st_size > 1000
    page = (folder / f"{outcome.name}.html").read_text()
    assert page.count("<img") == page.count('src="data:image/png;base64,')  # readable offline
    assert "://" not in page  # Pictures in base 64 may well hold the letters of http.


def _runs(value):
    """All records of runs anywhere in a JSON document."""
    if isinstance(value, dict):
        if "render_s" in value and "seed" in value:
            yield value
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _runs(item)


def test_gallery(tmp_path, capsys):
    """What ``tests/system/test_gallery.py`` doesn't see of it: the files and the table."""
    assert EXPERIMENTS.keys() - TINY.keys() == {"gallery"}
    wanted = "a single triangle|no emitters"
    assert main(["gallery", "--match", wanted, "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "a single triangle" in shown and "the scene has no emitters" in shown
    document = json.loads((tmp_path / "gallery.json").read_text(), parse_constant=pytest.fail)
    assert document["numbers"].keys() == {"a single triangle", "no emitters"}
    for numbers in document["numbers"]["a single triangle"].values():
        assert numbers["highest"] <= numbers["brightest"]
        assert abs(numbers["bias"]) <= numbers["allowed"] + numbers["margin"]
    assert (tmp_path / "gallery-sheet.png").stat().st_size > 1000


def test_gallery_without_a_case(capsys, tmp_path):
    assert main(["gallery", "--match", "no such case", "--out", str(tmp_path)]) == 2
    assert 'no case is called "no such case"' in capsys.readouterr().err


# ---------------------- Known answers ----------------------


def known(spp, runs, **changes):
    return error_vs_time.Options(
        width=96, runs=runs, reference_spp=256, spp=spp, sampler="independent", **changes
    )


@pytest.mark.slow
def test_path_against_itself_is_as_fast(references):
    """Speed-up 1 ± 10 %."""
    options = known((16, 64), runs=9, denoised=())
    view = View(PAPER_ROOM, options.width, sampler=options.sampler)
    judged_by = reference(view, options.reference_spp, references)
    outcome = error_vs_time.compare(view, [PATH, replace(PATH, label="again")], options, judged_by)
    first, again = outcome.numbers["curves"]
    np.testing.assert_array_equal(first["errors"], again["errors"])
    speed_up = outcome.numbers["speed_ups"]["again"]["its last error"]
    assert speed_up.value == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_path_with_twice_the_samples_has_half_the_variance(references):
    options = known((16, 32), runs=5, denoised=())
    # Without the mirror, whose fireflies make errors of few seeds differ by more than that.
    diffuse = {"table": "table-diffuse"}
    view = View(PAPER_ROOM, options.width, diffuse, sampler=options.sampler)
    judged_by = reference(view, options.reference_spp, references)
    outcome = error_vs_time.compare(view, [PATH], options, judged_by)
    few, many = np.mean(outcome.numbers["curves"][0]["errors"], axis=1)
    assert few / many == pytest.approx(2, rel=0.1)


def test_shares_of_known_errors():
    """Noise counts for nothing, whether variants share it or not; shares of steps add up."""
    rng = np.random.default_rng(1)

    def noise(size):
        return size * rng.standard_normal((24, 32, 3))

    flat = np.ones((24, 32, 3))
    left, right = 0.3 * flat, -0.1 * flat
    left[:, 16:] = right[:, :16] = 0
    exact = [flat + noise(0.2) for _ in range(8)]
    without_left = [one + right + noise(0.02) for one in exact]
    default = [one + left + right for one in exact]
    thirds = tuple(flat + noise(0.01) for _ in range(3))
    judged_by = Reference(thirds, 1, [1.0, 1.001, 0.999])
    ledger = Ledger(np.subtract(default, exact), judged_by)

    whole = (0.3**2 + 0.1**2) / 2 / 1.01
    assert ledger.of_pictures(default).rel_mse.value == pytest.approx(whole, abs=3e-3)
    assert ledger.of_pictures(exact).rel_mse.value == pytest.approx(0, abs=3e-3)
    steps = (default, without_left), (without_left, exact)
    found = [ledger.of_errors(np.subtract(*step)) for step in steps]
    for one, share, mean in zip(found, (0.9, 0.1), (0.15, -0.05), strict=True):
        assert one.rel_mse.value == pytest.approx(share * whole, rel=0.02)
        assert one.left.value == pytest.approx((1 - share) * whole, rel=0.02)
        assert one.share.value == pytest.approx(share, abs=0.005)
        assert one.mean_bias.value == pytest.approx(mean, abs=0.002)
    assert sum(one.share.value for one in found) == pytest.approx(1)


def test_flicker_of_known_errors():
    """Noise of references and errors that stay count for nothing; those that change count."""
    rng = np.random.default_rng(1)
    truth = np.linspace(1, 2, 20)[:, None, None, None] * np.ones((20, 64, 80, 3))

    def noisy(size):
        return truth * (1 + size * rng.standard_normal(truth.shape))

    references = noisy(0.2), noisy(0.2)
    errors, changes = flicker.flicker(1.1 * truth, references)
    assert errors.mean() == pytest.approx(0.1**2 / 1.01, rel=0.1)
    assert changes.mean() == pytest.approx(0, abs=1e-4)
    # In averages of 64 pixels; a difference of two has twice the variance.
    errors, changes = flicker.flicker(noisy(0.8), references)
    assert errors.mean() == pytest.approx(0.8**2 / 64, rel=0.1)
    assert changes.mean() == pytest.approx(2 * 0.8**2 / 64, rel=0.1)


def test_replaced_approximations_are_put_back():
    """Outside their contexts nothing is replaced, not even after an error."""

    def replaceable():
        far_field, wide_share = variants.FarField, variants.Lobes.wide_share
        return far_field.eval, far_field._inverse_distance, variants.Patches.find, wide_share

    before = replaceable()
    for variant in variants.variants(patches=256, finer=4).values():
        for replaced in variant.replaced:
            with pytest.raises(KeyError), replaced():
                assert replaceable() != before
                raise KeyError
            assert replaceable() == before


# ---------------------- References ----------------------


def test_references_are_rendered_once(references):
    view = View(PAPER_ROOM, 16)
    first = reference(view, 4, references)
    stored = sorted(references.glob("paper_room-*.exr"))
    again = reference(view, 4, references)
    np.testing.assert_array_equal(first.thirds, again.thirds)
    assert sorted(references.glob("paper_room-*.exr")) == stored
    assert first.part_means == again.part_means


def test_thirds_of_a_reference_are_independent(references):
    judged_by = reference(View(PAPER_ROOM, 16), 4, references)
    assert len(np.unique(judged_by.thirds, axis=0)) == 3
    assert judged_by.rel_mse > 0


@pytest.mark.parametrize(
    "change",
    [{"width": 17}, {"sampler": "independent"}, {"parameters": {"table": "table-specular"}}],
)
def test_other_content_is_another_reference(change):
    view = View(PAPER_ROOM, 16)
    assert replace(view, **change).content_hash() != view.content_hash()


def test_changed_mesh_is_another_reference(tmp_path):
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><shape type="ply">'
        '<string name="filename" value="mesh.ply"/></shape></scene>'
    )
    view = View(tmp_path / "scene.xml", 16)
    hashes = []
    for content in ("one", "two"):
        (tmp_path / "mesh.ply").write_text(content)
        hashes.append(view.content_hash())
    assert hashes[0] != hashes[1]


# ---------------------- Runs ----------------------


def test_each_run_has_a_preparation():
    scene = View(PAPER_ROOM, 16).load()
    small = replace(HYBRID, settings={"patches": 512, "map_resolution": 8})
    measured = interleave([Task(scene, small, 1), Task(scene, small, 2)], 3, seed=5)
    one, two = (measurements.runs for measurements in measured)
    assert [run.seed for run in one] == [5, 6, 7]
    assert len({run.prepare_s for run in (*one, *two)}) == 6
    stages = ["coarse mesh", "direct light", "irradiance cache", "clusters", "maps"]
    assert list(one[0].stages_s) == stages


def test_compilation_is_apart():
    """A kernel that is new has its compilation in the first run, and not in its time."""
    scene = View(PAPER_ROOM, 19).load()
    (measurements,) = interleave([Task(scene, PATH, 3)], 3, seed=0)
    assert measurements.runs[1].compile_s == measurements.runs[2].compile_s == 0
    assert measurements.runs[0].render_s < 20 * measurements.median("render_s")


@pytest.mark.parametrize("equal", ["spp", "time"])
def test_pictures_are_there_before_the_reference(tmp_path, monkeypatch, capsys, equal):
    """A reference takes longer than all pictures together."""
    shown = []

    def judged_by(view, spp, folder):
        shown.append(sorted(path.name for path in tmp_path.glob("*.png")))
        return reference(view, spp, folder)

    monkeypatch.setattr(render, "reference", judged_by)
    ours = "envmap_hybrid:patches=256"
    options = render.Options(**COMMON, spp=4, reference_spp=16, integrators=(ours,), equal=equal)
    list(render.run(options, tmp_path))
    names = ["paper_room-envmap_hybrid-patches-256.png", "paper_room-path.png"]
    assert shown == [names]
    printed = capsys.readouterr().out
    assert all(f"wrote {tmp_path / name}: " in printed for name in names)


# ---------------------- Command line ----------------------


def test_unknown_scene(capsys):
    assert main(["render", "none.xml", "--quick"]) == 2
    assert 'compare: scene "none.xml" does not exist' in capsys.readouterr().err


def test_too_few_runs(capsys):
    assert main(["render", "--runs", "2"]) == 2
    assert "--runs must be at least 3" in capsys.readouterr().err


def test_unknown_plugin(capsys, tmp_path):
    assert main(["render", "--quick", "--integrators", "none", "--out", str(tmp_path)]) == 2
    assert "none" in capsys.readouterr().err


def test_settings_reach_the_integrator():
    subject = Subject("one_level_path", {"shadow_samples": 3}, label="three")
    assert subject.name == "three"
    assert "shadow_samples = 3" in str(subject.make())


def test_subjects_are_named_with_their_settings():
    assert Subject.parse("path") == PATH
    text = "envmap_hybrid:residual_probability=0.5,patches=4096,lookup=plain,hide_emitters=true"
    subject = Subject.parse(text)
    assert subject.name == text
    assert subject.settings == {
        "residual_probability": 0.5, "patches": 4096, "lookup": "plain", "hide_emitters": True,
    }  # fmt: skip
    assert "residual_probability = 0.5" in str(subject.make())


def test_settings_without_a_value(capsys):
    assert main(["render", "--quick", "--integrators", "envmap_hybrid:patches"]) == 2
    assert "give settings as envmap_hybrid:name=value" in capsys.readouterr().err
