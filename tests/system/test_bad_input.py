"""Bad input is answered by one line that names the object and what to do, in Python and shell."""

from __future__ import annotations

import re

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.cli import main
from tests.helpers import PATCHES, ball, camera, cluster, integrator, load, room

pytestmark = pytest.mark.usefixtures("variant")

ERRORS = (ValueError, TypeError, RuntimeError)


def complaint(action, *arguments, **settings) -> str:
    """The message of the error that an action ends in."""
    with pytest.raises(ERRORS) as caught:
        action(*arguments, **settings)
    return str(caught.value)


def prepare(scene: dict, **settings) -> None:
    integrator("envmap_hybrid", **settings).prepare(load(scene))


# ---------------------- Parameters ----------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"map_resolutoin": 64}, '"map_resolutoin"; write "map_resolution" or remove it'),
        ({"depth_of_field": 64}, 'there is no parameter "depth_of_field"; remove it'),
        ({"cube": cluster("ball") | {"centre": 1}}, '"centre"; write "center" or remove it'),
        ({"patches": 1}, '"patches" must be at least 16'),
        ({"patches": "many"}, '"patches" must be an integer'),
        ({"patches": 1000.5}, '"patches" must be an integer'),
        ({"patch_samples": 100}, '"patch_samples" must be a power of two, not 100'),
        ({"shadow_samples": 0}, '"shadow_samples" must be at least 1'),
        ({"secondary_samples": -1}, '"secondary_samples" must be at least 1'),
        ({"gather_depth": 0}, '"gather_depth" must be at least 1'),
        ({"map_resolution": 48}, '"map_resolution" must be a power of two, not 48'),
        ({"map_resolution": 4096}, '"map_resolution" must be at least 1 and at most 2048'),
        ({"distance_ratio": 0.5}, '"distance_ratio" must be at least 1'),
        ({"distance_ratio": float("nan")}, '"distance_ratio" must be at least 1'),
        ({"distance_ratio": float("inf")}, '"distance_ratio" must be'),
        ({"mip_bias": 100.0}, '"mip_bias" must be at least -32 and at most 32'),
        ({"mirrors": "maps"}, '"mirrors" must be "trace" or "map", not \'maps\''),
        ({"lookup": True}, '"lookup" must be "corrected" or "plain"'),
        ({"second_hit": "rays"}, '"second_hit" must be "cache" or "shadow_rays"'),
        ({"baker": {"type": "path"}}, '"baker" must be one envmap_bake'),
        ({"cube": {"type": "point"}}, '"cube" must be one envmap_bake or a mipmap_cube'),
        ({"cube": {"type": "mipmap_cube"}}, 'give either "filename"'),
        ({"baker": {"type": "envmap_bake", "samples": 3}}, '"samples" must be a power of two'),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_parameters(settings, message):
    assert message in complaint(integrator, "envmap_hybrid", **settings)


@pytest.mark.parametrize("kind", ["one_level_path", "source_selection", "envmap_bake"])
def test_only_maps_take_nested_plugins(kind):
    for nested in (cluster("ball"), {"type": "envmap_bake"}):
        assert f"{kind}: has no maps, " in complaint(integrator, kind, nested=nested)


# ---------------------- Scenes ----------------------


def medium(albedo: float) -> dict:
    return {"type": "homogeneous", "albedo": albedo, "sigma_t": 1.0}


SCENES = {
    "no-emitters": (lambda: room(lamp=None), "the scene has no emitters"),
    "no-surfaces": (
        lambda: {"type": "scene", "sensor": camera(), "sky": {"type": "constant"}},
        "the scene has no surfaces",
    ),
    "medium": (
        lambda: room(ball=ball(0, 0, 0, 0.5) | {"bsdf": {"type": "null"}, "interior": medium(0.5)}),
        'shape "ball" has a participating medium',
    ),
    "camera-in-a-medium": (
        lambda: room(sensor=camera() | {"medium": medium(0.5)}),
        'sensor "sensor" lies in a participating medium',
    ),
}


@pytest.mark.parametrize("case", SCENES)
def test_scenes(case):
    make, message = SCENES[case]
    error = complaint(prepare, make())
    assert error.startswith("envmap_hybrid") and message in error
    assert "\n" not in error


def test_absorbing_media_are_ignored():
    prepare(room(ball=ball(0, 0, 0, 0.5) | {"bsdf": {"type": "null"}, "interior": medium(0.0)}))


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (("ball", "blok"), 'the scene has no shape "blok"; it has "'),
        (("ball", "ball"), 'shape "ball" is listed twice'),
    ],
    ids=["unknown", "twice"],
)
def test_clusters(shapes, message):
    error = complaint(prepare, room(), desk=cluster(*shapes))
    assert error.startswith('mipmap_cube "') and message in error
    assert "\n" not in error


def test_names_of_shapes_that_are_near_come_first():
    """And what merging has taken is said where something has been merged."""
    parts = {f"part{i}": ball(0, 0, 0, 0.1 + i / 100) for i in range(20)}
    error = complaint(prepare, room(**parts), desk=cluster("blok"))
    assert '"blok"; it has "block", "' in error
    assert error.endswith(" … (24 in all)")
    pane = {"type": "rectangle", "bsdf": {"type": "ref", "id": "grey"}}
    merged = mi.load_dict(room(grey={"type": "diffuse"}, one=pane, two=pane))
    error = complaint(integrator("envmap_hybrid", desk=cluster("one")).prepare, merged)
    assert " (load with optimize=False: Mitsuba merges " in error


# ---------------------- Cache files ----------------------


@pytest.fixture(scope="module")
def saved(variant, tmp_path_factory):
    path = tmp_path_factory.mktemp("state") / "room.exr"
    integrator("envmap_hybrid", desk=cluster()).prepare(load(room())).save(path)
    return path


def truncate(path):
    path.write_bytes(path.read_bytes()[:-1000])


def flip_a_bit(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def replace_by_a_picture(path):
    mi.Bitmap(np.ones((4, 4, 3), np.float32)).write(str(path))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "no such file"),
        (lambda path: path.write_bytes(b""), "damaged or no OpenEXR file"),
        (truncate, "damaged"),
        (flip_a_bit, "damaged"),
        (replace_by_a_picture, "not a file of envmap_integrator"),
    ],
    ids=["missing", "empty", "truncated", "bit-flipped", "picture"],
)
@pytest.mark.parametrize("reader", ["cache_file", "filename"])
def test_damaged_files(saved, tmp_path, damage, message, reader):
    path = tmp_path / "copy.exr"
    path.write_bytes(saved.read_bytes())
    damage(path)
    if reader == "cache_file":
        error = complaint(prepare, room(), desk=cluster(), cache_file=str(path))
        assert error.startswith('envmap_hybrid: "cache_file" ')
        assert "\n" not in error
    else:  # Mitsuba adds where the plugin was loaded.
        error = complaint(mi.load_dict, {"type": "mipmap_cube", "filename": str(path)})
        assert "mipmap_cube: " in error
        # Pictures of other tools may be maps.
        message = message.replace("not a file of envmap_integrator", "holds no cube map")
    assert str(path) in error and message in error and "envmap-render bake" in error


@pytest.mark.parametrize(
    ("scene", "settings", "message"),
    [
        (
            lambda: room(ball=None, block=None, cup=ball(0, 0, 0, 1)),
            {},
            "made for another scene: it has other shapes",
        ),
        (room, {"patches": 999}, f"made with patches={PATCHES}, not patches=999"),
        (room, {"map_resolution": 8}, "made with map_resolution=64, not map_resolution=8"),
    ],
    ids=["scene", "patches", "map_resolution"],
)
def test_file_of_another_scene_or_other_settings(saved, scene, settings, message):
    error = complaint(prepare, scene(), desk=cluster(), cache_file=str(saved), **settings)
    assert f"{saved}: " in error and message in error
    assert error.endswith("; make it again with envmap-render bake")
    assert "\n" not in error


def test_unknown_map_of_a_file(saved):
    wanted = {"type": "mipmap_cube", "filename": str(saved), "map": "chair"}
    assert 'holds no map "chair", only desk' in complaint(mi.load_dict, wanted)


def test_a_saved_map_serves_as_an_emitter(saved):
    sky = mi.load_dict({"type": "mipmap_cube", "filename": str(saved), "map": "desk"})
    integrator("path").render(load(room(walls=None, lamp=sky)), spp=1)


# ---------------------- The same from the shell ----------------------

XML = """
<scene version="3.0.0">
    <integrator type="envmap_hybrid">
        <integer name="patches" value="256"/>
        {integrator}
    </integrator>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="4"/> <integer name="height" value="4"/>
        </film>
    </sensor>
    {scene}
</scene>
"""
BALL = '<shape type="sphere" id="ball"> {} </shape>'
SKY = '<emitter type="constant"/>'
FOG = '<medium type="homogeneous" name="interior"> <float name="albedo" value="0.5"/> </medium>'


@pytest.mark.parametrize(
    ("inside", "scene", "message"),
    [
        ('<integer name="patchs" value="1"/>', BALL + SKY, "patchs"),
        ('<float name="distance_ratio" value="0"/>', BALL + SKY, '"distance_ratio" must be at'),
        (
            '<emitter type="mipmap_cube" id="desk"> <string name="shapes" value="bal"/> </emitter>',
            BALL + SKY,
            'mipmap_cube "desk": the scene has no shape "bal"; it has "ball"',
        ),
        ('<string name="cache_file" value="none.exr"/>', BALL + SKY, "none.exr: no such file"),
        ('<emitter type="point"/>', BALL + SKY, "must be one envmap_bake"),
        ("", BALL, "the scene has no emitters"),
        ("", SKY, "the scene has no surfaces"),
        ("", BALL.format(FOG) + SKY, 'shape "ball" has a participating medium'),
    ],
    ids=["misspelt", "range", "shape", "file", "nested", "emitters", "surfaces", "medium"],
)
@pytest.mark.parametrize("command", ["render", "bake"])
def test_shell(tmp_path, capfd, inside, scene, message, command):
    path, output = tmp_path / "scene.xml", tmp_path / "output.exr"
    path.write_text(XML.format(integrator=inside, scene=scene.replace("{}", "")))
    assert main([command, str(path), "-o", str(output)]) == 2
    error = capfd.readouterr().err
    assert message in error
    assert re.fullmatch(r"envmap-render: [^\n]+\n", error)
    assert "Traceback" not in error and len(error) < 400
    assert not output.exists()


EMPTY = {
    "pixels": ('name="height" value="4"', 'name="height" value="0"', 'the film of sensor "'),
    "samples": (
        '<film type="hdrfilm">',
        '<sampler type="independent"> <integer name="sample_count" value="0"/> </sampler>'
        '<film type="hdrfilm">',
        'the sampler of sensor "',
    ),
}


@pytest.mark.parametrize("case", EMPTY)
@pytest.mark.parametrize(
    ("command", "options"),
    [("render", []), ("render", ["--integrator", "path"]), ("bake", []), ("inspect", [])],
    ids=["render", "path", "bake", "inspect"],
)
def test_pictures_of_nothing(tmp_path, capfd, case, command, options):
    old, new, message = EMPTY[case]
    path = tmp_path / "scene.xml"
    output = tmp_path / f"output.{'html' if command == 'inspect' else 'exr'}"
    path.write_text(XML.replace(old, new).format(integrator="", scene=BALL.format("") + SKY))
    assert main([command, str(path), "-o", str(output), *options]) == 2
    error = capfd.readouterr().err
    assert re.fullmatch(r"envmap-render: [^\n]+; set its [^\n]+\n", error) and message in error
    assert not output.exists()


def test_samples_that_are_asked_for_need_no_count():
    sensor = camera(4, 4, sampler={"type": "independent", "sample_count": 0})
    ours, scene = integrator("envmap_hybrid", patches=64), load(room(sensor=sensor))
    ours.render(scene, spp=1)
    assert 'is to take 0 samples per pixel; set its "sample_count"' in complaint(ours.render, scene)
