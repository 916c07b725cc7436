"""Clusters by hand, where the automatic choice fails: what is asked for is what is made."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation.maps.bake import bake_maps
from envmap_integrator.system.scene_file import SceneFile
from tests.helpers import cluster, integrator, load, picture, room

pytestmark = pytest.mark.usefixtures("variant")

SMALL = {"patches": 512, "map_resolution": 16}
CENTER = (0.4, 0.2, -1.5)


@pytest.fixture(scope="module")
def scene(variant) -> mi.Scene:
    return load(room())


def clusters(**ball: object) -> dict:
    return {"one": cluster("block"), "two": cluster("ball") | ball}


def test_each_cluster_has_its_own_settings(scene):
    ours = clusters(resolution=8, center=list(CENTER), distance_ratio=2.5)
    one, two = integrator("envmap_hybrid", **SMALL, **ours).prepare(scene).maps
    assert (one.resolution, two.resolution) == (16, 8)
    assert two.cluster.centre == pytest.approx(CENTER)
    assert two.cluster.half_width == pytest.approx(2.5 * two.cluster.radius)


def test_maps_of_several_resolutions_are_baked_and_read_alike(scene):
    """Those of one cluster don't depend on what the other asks for."""
    even, mixed = (
        integrator("envmap_hybrid", **SMALL, **clusters(**changes))
        for changes in ({}, {"resolution": 64})
    )
    first, _ = even.prepare(scene).maps
    same, finer = mixed.prepare(scene).maps
    assert (finer.resolution, same.resolution) == (64, 16)
    # Other bake rays: the mean is the same.
    assert same.levels[-1].mean() == pytest.approx(first.levels[-1].mean(), rel=0.03)
    means = [picture(scene, ours, spp=64).mean() for ours in (even, mixed)]
    assert means[1] == pytest.approx(means[0], rel=0.02)


def test_what_is_excluded_is_left_out_of_automatic_clusters(scene):
    """Block and ball lie side by side, in one cluster; the lamp is another."""
    found = []
    for names in ("lamp", "lamp, ball", "lamp, ball, block"):
        ours = integrator("envmap_hybrid", **SMALL, distance_ratio=1.2, no_cluster=names)
        found.append([cube_map.cluster for cube_map in ours.prepare(scene).maps])
    (both,), (block,), none = found
    assert both.radius > 0.6 and none == []
    assert block.radius == pytest.approx(0.4, abs=0.02)
    assert block.centre == pytest.approx((-0.5, 0.6, -1.5), abs=0.05)


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"two": {"resolution": 8}}, "made without two.resolution, not two.resolution=8"),
        ({"two": {"center": [0, 0, 0]}}, r"not two.center=\[0.0, 0.0, 0.0\]"),
        ({"two": {"distance_ratio": 3}}, "two.distance_ratio=1.5, not two.distance_ratio=3"),
        ({"two": {"shapes": "lamp"}}, r"made with two.shapes=\['ball'\], not two.shapes="),
        ({"no_cluster": "lamp"}, r"made with no_cluster=\[\], not no_cluster=\['lamp'\]"),
        ({"three": cluster("lamp")}, 'made without the cluster "three"'),
        ({"two": None}, 'made with the cluster "two" listed, not without .*--set two.shapes='),
        ({"baker": {"type": "envmap_bake", "samples": 4}}, "made with baker.samples="),
        ({"mirrors": "map"}, "made with mirrors='trace', not mirrors='map'"),
        ({"maps": "auto"}, "made with maps='always', not maps='auto'"),
    ],
)
def test_a_state_for_other_clusters_is_refused(scene, tmp_path_factory, changes, difference):
    path = tmp_path_factory.getbasetemp() / "clusters.exr"
    if not path.is_file():
        integrator("envmap_hybrid", **SMALL, **clusters()).prepare(scene).save(path)
    asked = clusters(**changes.get("two") or {}) | {k: v for k, v in changes.items() if k != "two"}
    if "two" in changes and not changes["two"]:
        del asked["two"]
    reader = integrator("envmap_hybrid", **SMALL | asked, cache_file=str(path))
    with pytest.raises(ValueError, match=difference):
        reader.prepare(scene)


def test_a_state_for_another_integrator_is_refused(scene, tmp_path):
    path, kinds = tmp_path / "state.exr", ("envmap_hybrid", "one_level_path", "source_selection")
    reasons = {}
    for made in kinds:
        integrator(made, patches=64).prepare(scene).save(path)
        for asked in kinds:
            reader = integrator(asked, patches=64, cache_file=str(path))
            if asked == made:
                reader.prepare(scene)
                continue
            with pytest.raises(
                ValueError, match="made for .* integrator.*; make it again"
            ) as caught:
                reader.prepare(scene)
            reasons[made, asked] = str(caught.value)
    assert "with maps (use envmap_hybrid)" in reasons["envmap_hybrid", "one_level_path"]
    assert "without maps" in reasons["one_level_path", "envmap_hybrid"]


# ---------------------- From the shell ----------------------

XML = """<scene version="3.0.0"> <sensor type="perspective"/> <bsdf type="diffuse" id="grey"/>
    <integrator type="envmap_hybrid"> {nested} </integrator>
    <shape type="rectangle" id="left"> <ref id="grey"/> </shape>
    <shape type="rectangle" id="right"> <ref id="grey"/> </shape>
    <emitter type="constant"/> </scene>"""
DESK = """<emitter type="mipmap_cube" id="desk"> <string name="shapes" value="left"/>
    <integer name="resolution" value="8"/> </emitter>"""


def scene_file(folder, nested: str = "", **settings: object) -> SceneFile:
    path = folder / "scene.xml"
    path.write_text(XML.format(nested=nested))
    described = SceneFile(path)
    described.configure_integrator(settings={k.replace("__", "."): v for k, v in settings.items()})
    return described


def test_a_cluster_is_made_by_its_shapes(tmp_path):
    described = scene_file(
        tmp_path, desk__center="0, 0, 1", desk__resolution=32, desk__shapes="left, right"
    )
    loaded = described.load()
    (request,) = loaded.integrator().requests
    assert (request.name, request.shapes) == ("desk", ("left", "right"))
    assert (request.center, request.resolution) == ((0, 0, 1), 32)
    assert {"left", "right"} <= {shape.id() for shape in loaded.shapes()}


def test_settings_of_a_cluster_in_the_scene_are_changed(tmp_path):
    described = scene_file(tmp_path, DESK, desk__distance_ratio=3.0)
    (request,) = described.load().integrator().requests
    assert (request.shapes, request.resolution, request.distance_ratio) == (("left",), 8, 3)


def test_shapes_that_are_excluded_keep_their_ids(tmp_path):
    loaded = scene_file(tmp_path, no_cluster="right").load()
    assert loaded.integrator().no_cluster == ("right",)
    assert {"left", "right"} <= {shape.id() for shape in loaded.shapes()}


def test_a_child_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match='holds no "tabel", only desk; set "tabel.shapes" too'):
        scene_file(tmp_path, DESK, tabel__resolution=8)


# ---------------------- Baked anew ----------------------


def test_one_map_is_baked_anew_and_all_else_stays(scene, tmp_path):
    """What comes out is what baking everything makes, and fits where that would."""
    path = tmp_path / "state.exr"
    was = integrator("envmap_hybrid", **SMALL, **clusters())
    was.prepare(scene).save(path)
    ours = integrator("envmap_hybrid", **SMALL, **clusters(resolution=32))
    anew = ours.rebake(scene, path, ["two"])
    anew.save(path)
    whole = integrator("envmap_hybrid", **SMALL, **clusters(resolution=32)).prepare(scene)
    settings = SMALL | {"cache_file": str(path)}
    read = integrator("envmap_hybrid", **settings, **clusters(resolution=32)).prepare(scene)
    for state in (anew, read):
        assert state.cache.same_as(whole.cache)
        assert np.array_equal(state.cluster_of_cell, whole.cluster_of_cell)
        for ours, theirs in zip(state.maps, whole.maps, strict=True):
            assert ours.cluster.name == theirs.cluster.name
            for level, expected in zip(ours.levels, theirs.levels, strict=True):
                assert np.array_equal(level, expected)
    with pytest.raises(ValueError, match=r"made with two.resolution=32, not without \("):
        integrator("envmap_hybrid", **settings, **clusters()).prepare(scene)


def test_maps_that_stay_are_not_baked(scene, tmp_path, monkeypatch):
    path = tmp_path / "state.exr"
    ours = integrator("envmap_hybrid", **SMALL, **clusters())
    ours.prepare(scene).save(path)
    baked = []

    def bake(scene, radiance_distance, clusters, *rest, **more):
        baked.extend(cluster.name for cluster in clusters)
        return bake_maps(scene, radiance_distance, clusters, *rest, **more)

    monkeypatch.setattr("envmap_integrator.preparation.pipeline.bake_maps", bake)
    ours.rebake(scene, path, ["two"])
    assert baked == ["two"]
