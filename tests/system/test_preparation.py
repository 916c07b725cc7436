"""What is prepared once is used as often as possible, and never when it's out of date."""

from __future__ import annotations

import json
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation.baked_state import Settings
from envmap_integrator.preparation.radiosity import gather
from tests.helpers import ROOT, camera, cluster, integrator, load, picture, room

pytestmark = pytest.mark.usefixtures("variant")

OURS = ("envmap_hybrid", "one_level_path", "source_selection", "envmap_bake")


def two_views() -> mi.Scene:
    return load(room(other=camera(16, 12, origin=(1, -1.5, 1))))


@pytest.fixture(scope="module")
def scene(variant) -> mi.Scene:
    return two_views()


@pytest.fixture(scope="module")
def hybrid(variant) -> mi.Integrator:
    return integrator("envmap_hybrid", desk=cluster("block", "ball"))


# ---------------------- Reuse ----------------------


@pytest.mark.parametrize("name", OURS)
def test_other_views_and_seeds_rebuild_nothing(scene, name):
    renderer = integrator(name)
    prepared = renderer.prepare(scene)
    picture(scene, renderer, seed=1)
    picture(scene, renderer, sensor=1)
    assert renderer.prepare(scene) is prepared


def test_the_same_seed_gives_the_same_picture(scene, hybrid):
    assert np.array_equal(picture(scene, hybrid, seed=3), picture(scene, hybrid, seed=3))


def test_a_picture_does_not_depend_on_what_was_prepared_before(scene):
    """Larger renders have a finer cache; smaller ones after them don't, or they'd differ."""
    renderer = mi.load_dict({"type": "one_level_path"})
    before = picture(scene, renderer, spp=4)
    coarse = renderer.prepare(scene, spp=4)
    fine = renderer.prepare(scene, spp=1 << 20)
    assert dr.width(fine.cache.table) > dr.width(coarse.cache.table)
    assert renderer.prepare(scene, spp=1 << 20) is fine
    assert renderer.prepare(scene, scene.sensors()[1], spp=4) is coarse
    assert np.array_equal(picture(scene, renderer, spp=4), before)


def test_what_is_set_holds_for_renders_of_any_size(scene):
    renderer = integrator("one_level_path", patches=1024, patch_samples=16)
    assert renderer.prepare(scene, spp=1 << 20) is renderer.prepare(scene, spp=1)


@pytest.mark.parametrize(
    ("n_samples", "patches", "patch_samples"),
    [
        (0, 8192, 32),  # no sensor
        (512 * 512, 8192, 32),
        (16 * 512 * 512, 8192, 32),
        (64 * 512 * 512, 11585, 64),
        (256 * 512 * 512, 16384, 256),
        (1024 * 1920 * 1080, 16384, 256),
    ],
)
def test_the_preparation_that_renders_are_worth(n_samples, patches, patch_samples):
    settings = Settings(None, None, 32).for_render(n_samples)
    assert (settings.patches, settings.patch_samples) == (patches, patch_samples)
    assert Settings(512, None, 128).for_render(n_samples).patches == 512
    assert Settings(None, 8, 128).for_render(n_samples).patch_samples == 8


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("ball.bsdf.reflectance.value", [0.1, 0.6, 0.1]),
        ("lamp.emitter.radiance.value", [1, 2, 3]),
        ("block.vertex_positions", np.linspace(-1, 1, 72)),
    ],
)
def test_edits_rebuild(parameter, value):
    scene, renderer = two_views(), integrator("one_level_path")
    before = renderer.prepare(scene)
    parameters = mi.traverse(scene)
    parameters[parameter] = type(parameters[parameter])(value)
    parameters.update()
    after = renderer.prepare(scene)
    assert after is not before
    assert not np.array_equal(before.cache.table.numpy(), after.cache.table.numpy())
    assert renderer.prepare(scene) is after


def test_an_edited_sensor_rebuilds_nothing():
    scene, renderer = two_views(), integrator("one_level_path")
    before = renderer.prepare(scene)
    parameters = mi.traverse(scene)
    parameters["sensor.x_fov"] = 30.0
    parameters.update()
    assert renderer.prepare(scene).cache is before.cache


def test_scenes_of_the_same_content_share_what_is_prepared(scene, hybrid):
    prepared = hybrid.prepare(scene)
    expected = picture(scene, hybrid)
    again = two_views()
    assert hybrid.prepare(again) is prepared
    assert np.array_equal(picture(again, hybrid), expected)
    assert np.array_equal(picture(scene, hybrid), expected)


def test_scenes_merged_in_another_order_are_prepared_alike():
    """Mitsuba merges meshes in parallel; shapes and emitters come in another order each time."""
    prepared = []
    for _ in range(3):
        merged = mi.load_file(str(ROOT / "scenes" / "desk.xml"), optimize=True)
        prepared.append(integrator("one_level_path", patches=1024).prepare(merged))
    first, *others = prepared
    for other in others:
        assert other.key == first.key
        assert np.array_equal(other.emitter_table.numpy(), first.emitter_table.numpy())
        assert np.array_equal(other.cache.table.numpy(), first.cache.table.numpy())


def test_scenes_of_other_content_do_not(scene):
    renderer = integrator("one_level_path")
    other = load(room(ball=None))
    assert renderer.prepare(scene) is not renderer.prepare(other)
    expected = picture(other, integrator("one_level_path"))
    assert np.array_equal(picture(other, renderer), expected)


def test_gathering_in_several_launches_changes_only_the_noise(scene, monkeypatch):
    whole = integrator("one_level_path").prepare(scene).cache.table.numpy()
    monkeypatch.setattr(gather, "MAX_LANES", 1 << 16)
    parts = integrator("one_level_path").prepare(scene).cache.table.numpy()
    assert parts.shape == whole.shape
    assert parts.mean() == pytest.approx(whole.mean(), rel=0.02)


# ---------------------- Files ----------------------

LOAD_AND_RENDER = """
import sys
import envmap_integrator
import mitsuba as mi
import numpy as np
mi.set_variant("llvm_ad_rgb")
from tests.helpers import cluster, integrator, picture
from tests.system.test_preparation import two_views
cache_file, output = sys.argv[1:]
hybrid = integrator("envmap_hybrid", desk=cluster("block", "ball"), cache_file=cache_file)
np.save(output, picture(two_views(), hybrid, seed=5))
"""


def test_a_saved_state_renders_the_same_bits_in_a_new_process(scene, hybrid, tmp_path):
    cache_file, output = tmp_path / "state.exr", tmp_path / "picture.npy"
    hybrid.prepare(scene).save(cache_file)
    command = [sys.executable, "-c", LOAD_AND_RENDER, str(cache_file), str(output)]
    subprocess.run(command, check=True, cwd=ROOT)
    assert np.array_equal(np.load(output), picture(scene, hybrid, seed=5))


def test_a_failed_save_leaves_no_file(scene, tmp_path):
    with pytest.raises(ValueError, match="make it first"):
        integrator("one_level_path").prepare(scene).save(tmp_path / "nowhere" / "state.exr")
    assert list(tmp_path.iterdir()) == []


# ---------------------- Kernels ----------------------

#: In a process of its own: virtual calls reach all objects alive, those of other tests too.
COUNT_KERNELS = """
import gc, json
import envmap_integrator
import drjit as dr
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from tests.helpers import ball, box, cluster, grey, integrator, picture, room

dr.set_flag(dr.JitFlag.KernelHistory, True)
known = set()

def new_kernels(seed=0, spp=16, distance_ratio=1.5, radius=0.4, half_width=2.0, **settings):
    gc.collect()
    parts = {"ball": ball(0.4, 0.2, -1.6, radius), "walls": box(half_width) | grey(0.5)}
    # In parallel, shapes come in another order each time, and virtual calls with them.
    scene = mi.load_dict(room(**parts), optimize=False, parallel=False)
    desk = cluster("block", "ball", distance_ratio=distance_ratio)
    renderer = integrator("envmap_hybrid", desk=desk, **settings)
    before = len(known)
    for repetition in range(2):
        picture(scene, renderer, spp, seed + repetition)
    known.update(entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT]))
    return len(known) - before

changes = [{"seed": 5}, {"spp": 64}, {"spp": 4}, {"distance_ratio": 2.25}, {"mip_bias": 0.5}]
# Tables of other sizes, too.
changes += [{"patches": 256}, {"patches": 8192}, {"radius": 0.9}, {"half_width": 5.0}]
print(json.dumps({"first": new_kernels()} | {str(c): new_kernels(**c) for c in changes}))
"""


def test_a_changed_number_compiles_nothing():
    command = [sys.executable, "-c", COUNT_KERNELS]
    result = subprocess.run(command, check=True, cwd=ROOT, capture_output=True, text=True)
    compiled = json.loads(result.stdout)
    assert compiled.pop("first") > 0
    assert not any(compiled.values()), compiled


def test_a_second_render_compiles_nothing(scene):
    renderer = integrator("envmap_hybrid", desk=cluster("block", "ball"))
    renderer.prepare(scene)
    hashes = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for seed in range(2):
            dr.kernel_history_clear()
            picture(scene, renderer, seed=seed)
            hashes.append({entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])})
    assert hashes[0] and hashes[1] <= hashes[0]
