"""``envmap-render inspect``: the page, and what it is made of."""

from __future__ import annotations

import base64
import html
import itertools
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.cli import main
from envmap_integrator.inspection.advice import about_cluster, as_flags, as_xml, in_short, without
from envmap_integrator.inspection.members import Members
from envmap_integrator.inspection.page import inspect as write_page
from envmap_integrator.inspection.page import scene_name
from envmap_integrator.inspection.pictures import RAMP, embedded, on_ramp, shrunk, tone_mapped
from envmap_integrator.inspection.survey import ClusterView, survey
from envmap_integrator.inspection.unfolded import MASKED, SKY, Faces, unfolded
from envmap_integrator.inspection.wires import labels, wires
from envmap_integrator.lookup.cube import face_to_direction
from envmap_integrator.lookup.cube_map import Cluster, CubeMap
from envmap_integrator.preparation.maps.clusters import ClusterRequest
from envmap_integrator.system.warned import warned
from tests.helpers import block, camera, cluster, colour, grey, integrator, load, room

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 32, 24
SCENE = """<scene version="3.0.0">
    <integrator type="path"/>
    <sensor type="perspective"> <float name="fov" value="80"/>
        <transform name="to_world"> <lookat origin="0,-1.8,0.4" target="0,0.5,-1" up="0,0,1"/>
        </transform> <sampler type="independent"> <integer name="sample_count" value="8"/>
        </sampler> <film type="hdrfilm"> <integer name="width" value="32"/>
        <integer name="height" value="24"/> </film> </sensor>
    <shape type="cube" id="walls"> <transform name="to_world"> <scale value="2"/> </transform>
        <boolean name="flip_normals" value="true"/> </shape>
    <shape type="rectangle" id="lamp"> <transform name="to_world"> <scale value="0.5"/>
        <rotate x="1" angle="180"/> <translate z="1.9"/> </transform>
        <emitter type="area"> <rgb name="radiance" value="9"/> </emitter> </shape>
    <shape type="sphere" id="ball &amp; co"> <point name="center" x="0.4" y="0.2" z="-1.6"/>
        <float name="radius" value="0.4"/> </shape>
    {more}
</scene>"""
LISTED = """<integrator type="envmap_hybrid"> <emitter type="mipmap_cube" id="desk">
    <string name="shapes" value="ball &amp; co"/> </emitter> </integrator>"""
PARTS = ["picture", "served", "cache", "clusters", "maps", "settings"]


def inspect(folder: Path, more: str = "", *options: object) -> str:
    path = folder / "room.xml"
    path.write_text(SCENE.format(more=more).replace('<integrator type="path"/>', more and ""))
    arguments = ("inspect", path, "--set", "patches=512", "--quiet", *options)
    assert main([str(argument) for argument in arguments]) == 0
    return path.with_suffix(".html").read_text(encoding="utf-8")


def pictures(text: str) -> dict[str, np.ndarray]:
    """The pictures on a page by what they show."""
    found = {}
    for uri, shown in re.findall(r'<img[^>]* src="(data:.*?)" alt="(.*?)"', text):
        assert shown not in found
        found[shown] = decoded(uri)
    return found


def decoded(uri: str) -> np.ndarray:
    stream = mi.MemoryStream()
    stream.write(base64.b64decode(uri.removeprefix("data:image/png;base64,")))
    stream.seek(0)
    return np.array(mi.Bitmap(stream))


def test_a_page_has_all_parts_and_needs_nothing_else(tmp_path):
    text = inspect(tmp_path, LISTED)
    assert re.findall(r'<h2 id="(\w+)">', text) == PARTS
    sources = re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?(.{5})""", text)
    assert set(sources) == {"data:"}
    assert "<script" not in text and "http" not in re.sub('base64,[^"]*', "", text)
    found = pictures(text)
    views = [shown for shown in found if "around" not in shown]
    assert len(views) == 7
    for shown in views:
        assert found[shown].shape == (HEIGHT, WIDTH, 3)
        assert found[shown].any()
    # From 64 x 64 texels a face down to one, side by side.
    for shown in ("radiance around desk", "distances around desk"):
        assert found[shown].shape == (3 * 64, 4 * 127, 4)
    assert "They were made." in text and "weren't made" not in text
    assert "ball &amp; co" in text and "<polyline" in text
    for stage in ("coarse mesh", "direct light", "irradiance cache", "clusters", "maps"):
        assert f"<td>{stage}</td>" in text
    assert "<title>room — what envmap_hybrid does</title>" in text and "<details>" not in text
    assert "integrator: envmap_hybrid" in text and "patches = 512" in text


def test_maps_that_were_not_made_are_shown(tmp_path):
    """For a scene without one of our integrators."""
    text = inspect(tmp_path)
    assert "They weren&#39;t made." in text
    assert "where secondary rays would end with maps" in pictures(text)
    assert "maps = auto" in text


SHARED = """<shape type="cylinder" id="bar"> <point name="p0" x="-1.8" y="1" z="-1.2"/>
    <point name="p1" x="1.8" y="1" z="-1.2"/> <float name="radius" value="0.2"/> </shape>
    <shape type="sphere"> <point name="center" x="0.9" y="0.6" z="-1.7"/>
    <float name="radius" value="0.3"/> </shape>
    <shape type="sphere" id="left"> <point name="center" x="-1.5" y="0.6" z="-1.7"/>
    <float name="radius" value="0.3"/> </shape>"""


def test_what_is_given_to_paste_is_accepted(tmp_path):
    """Each cluster alone and all together, of shapes that clusters share and such without id."""
    text = html.unescape(inspect(tmp_path, SHARED, "--set", "maps=always"))
    flags = re.findall(r"<pre>(--set .*\.shapes=.*)</pre>", text)
    assert len(flags) == 3  # The lamp is the third.
    listed = re.findall(r"\w+\.shapes=([^']*?)'? --set", " ".join(flags))
    assert {"ball & co", "left"} <= {name for names in listed for name in names.split(", ")}
    assert "bar" not in " ".join(listed) and "walls" not in " ".join(listed)
    assert "the cluster has a piece only: bar" in text
    assert "1 shape without an id can't be listed: give it one" in text
    for pasted in (*flags, " ".join(flags)):
        options = ["--spp", "1", "--set", "patches=512", "--quiet", *shlex.split(pasted)]
        with warned() as warnings:
            assert main(["render", str(tmp_path / "room.xml"), *options]) == 0
        assert not any("there is nothing to map" in warning for warning in warnings)
    excluded = re.findall(r"<pre>--set no_cluster=(.*)</pre>", text)
    assert len(excluded) == 3 and "bar" not in " ".join(excluded)


def test_nothing_is_given_to_paste_where_nothing_can_be_listed(tmp_path):
    """Shapes that Mitsuba has merged have no ids."""
    path = tmp_path / "page.html"
    one, other = (block(x, 0.5, -1.6, 0.4) | grey(0.7) for x in (-0.5, 0.4))
    light = {"type": "point", "position": [0, 0, 1], "intensity": colour(5)}
    scene = mi.load_dict(room(block=one, ball=other, lamp=None, light=light), optimize=True)
    assert "" in [shape.id() for shape in scene.shapes()]
    write_page(path, scene, integrator("envmap_hybrid", sampler="coherent"), spp=4)
    text = html.unescape(path.read_text(encoding="utf-8"))
    assert "can't be asked for by hand" in text and "<pre>--set" not in text
    assert "without an id" in text


def test_what_a_listed_cluster_sets_is_given_back(tmp_path):
    listed = LISTED.replace(
        "</emitter>",
        """<float name="distance_ratio" value="1.75"/> <integer name="resolution" value="8"/>
        <point name="center" x="0.4" y="0.2" z="-1.5"/> </emitter>""",
    )
    text = html.unescape(inspect(tmp_path, listed))
    (flags,) = re.findall(r"<pre>(--set .*\.shapes=.*)</pre>", text)
    assert shlex.split(flags)[1::2] == [
        "desk.shapes=ball & co",
        "desk.distance_ratio=1.75",
        "desk.center=0.4,0.2,-1.5",
        "desk.resolution=8",
    ]
    (xml,) = re.findall(r"<pre>(<emitter.*?)</pre>", text, re.DOTALL)
    request, again = (
        mi.load_string(f'<scene version="3.0.0">{scene}</scene>').integrator().requests[0]
        for scene in (listed, f'<integrator type="envmap_hybrid">{xml}</integrator>')
    )
    assert again == request
    assert "--set no_cluster" not in text  # Which is refused for what is listed.


def test_json(tmp_path, capfd):
    path = tmp_path / "room.xml"
    path.write_text(SCENE.format(more=""))
    page = tmp_path / "page.html"
    options = ("--json", "--set", "patches=512", "--integrator", "one_level_path", "-o", page)
    assert main(["inspect", str(path), *map(str, options)]) == 0
    result = json.loads(capfd.readouterr().out)
    assert result["output"] == str(page) and page.exists()
    assert result["settings"]["integrator"] == "one_level_path"
    assert "There are no maps" in page.read_text(encoding="utf-8")


def test_a_scene_made_in_python(tmp_path):
    """It needs no file; the integrator may be another one than the scene's."""
    path = tmp_path / "page.html"
    ours = integrator("envmap_hybrid", sampler="coherent", desk=cluster("ball"))
    write_page(path, load(room()), ours, spp=4)
    text = path.read_text(encoding="utf-8")
    assert re.findall(r'<h2 id="(\w+)">', text) == PARTS
    assert "--set desk.shapes=ball" in text and "spp: 4" in text
    with pytest.raises(ValueError, match="has nothing to inspect"):
        write_page(path, load(room()), mi.load_dict({"type": "path"}))
    with pytest.raises(ValueError, match="the scene has no sensor; add one"):
        write_page(path, load(room(sensor=None)))
    write_page(path, load(room()), spp=4)
    assert "integrator: EnvmapHybrid[" in path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("error", "by_size", "remedy"),
    [(0.03, 0.0, "patch_samples."), (0.03, 0.025, "Raise patches."), (0.001, 0.001, "little")],
)
def test_what_lowers_the_error(error, by_size, remedy):
    scene, ours = load(room()), integrator("one_level_path", sampler="coherent")
    found = survey(scene, scene.sensors()[0], ours, 4, 0)
    state = replace(found.view.state, relative_error=error, size_error=by_size)
    found = replace(found, view=replace(found.view, state=state))
    assert remedy in in_short(found)[0]


def test_a_survey_is_of_the_render_asked_for():
    scene, ours = load(room()), integrator("envmap_hybrid", sampler="coherent", maps="auto")
    found = survey(scene, scene.sensors()[0], ours, 64, seed=0)
    tables = (s.cache.table.numpy() for s in (found.view.state, ours.prepare(scene, spp=64)))
    np.testing.assert_array_equal(*tables)
    assert (ours.maps, ours.aovs) == ("auto", "")
    assert found.spp == 16 and found.timed[0] == 8 and found.timed[1] > 0
    assert found.mapped is not None and found.mapped.state.maps
    assert found.picture.shape == (HEIGHT, WIDTH, 3) and 0 < found.noise < 1
    for view in found.mapped.clusters:
        assert 0 <= view.seen <= 1 and sum(view.served) <= 1 + 1e-5
        assert sum(view.shapes.values()) == pytest.approx(view.seen)
    seen = [view for view in found.mapped.clusters if view.seen > 0]
    assert seen and set().union(*(view.shapes for view in seen)) <= {"block", "ball", "lamp"}
    assert 0 < found.patches[0] <= 2 * ours.patches
    assert len(in_short(found)) >= 3
    assert found.rays["primary"] == pytest.approx(1, rel=0.01)
    assert found.rays["unbounded"] > 0.5 and "survey" not in found.rays


def test_clusters_that_are_not_seen_are_named(tmp_path):
    """A sensor that looks away from the ball, which another one sees."""
    away = camera(16, 12, origin=(0, 0, -1), target=(-9, 0, -1))
    scene = load(room(sensor2=away))
    ours = integrator("envmap_hybrid", sampler="coherent", desk=cluster("ball"))
    index = [sensor.film().size()[0] for sensor in scene.sensors()].index(16)
    (view,) = survey(scene, scene.sensors()[index], ours, 4, 0).view.clusters
    assert view.seen == 0 and view.shapes == {"ball": 0.0}
    # "no_cluster" is for automatic clusters: what is listed must not be named there.
    assert "Take desk out of the integrator" in " ".join(about_cluster(view, 4))
    write_page(tmp_path / "page.html", scene, ours, sensor=index, spp=4)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    folded = text[text.index("<details>") : text.index("</details>")]
    assert "Not seen by this sensor: desk" in folded and "radiance around desk" in folded


def test_warnings_are_kept():
    scene, ours = load(room()), integrator("envmap_hybrid", sampler="coherent", patch_samples=1)
    prepare = ours.prepare

    def loud(*arguments):
        mi.Log(mi.LogLevel.Warn, "too dark")
        return prepare(*arguments)

    ours.prepare = loud
    assert survey(scene, scene.sensors()[0], ours, 4, 0).warnings.count("too dark") == 1


# ---------------------- Cubes ----------------------


def cube(centre, half_width: float) -> Cluster:
    return Cluster("cluster0", np.array(centre, float), half_width / 2, half_width)


def test_wires_are_where_a_sensor_sees_them():
    """A cube ahead, of which the far face is behind a wall."""
    sensor = camera(200, 100, origin=(0, 0, 0), target=(0, 5, 0), fov=90, near_clip=0.1)
    wall = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 5.5, 0]).rotate([1, 0, 0], 90).scale(9),
    }
    scene = load(room(sensor=sensor, walls=wall, block=None, ball=None))
    drawn = wires(scene, scene.sensors()[0], cube((0, 5, 0), 1))
    near, far = 100 / 4, 100 / 6  # pixels off the middle
    solid = np.concatenate([points for points, hidden in drawn.lines if not hidden])
    pale = np.concatenate([points for points, hidden in drawn.lines if hidden])
    middle = np.array([100, 50])
    for points, largest in ((solid, near), (pale, 100 / 5.5)):
        assert np.abs(points - middle).max() == pytest.approx(largest, abs=0.3)
    assert np.abs(pale - middle).max(axis=1).min() == pytest.approx(far, abs=0.1)
    np.testing.assert_allclose(drawn.centre, middle, atol=1e-3)


def test_wires_stay_in_the_picture():
    """With the camera in the middle of the cube, and turned away from it."""
    scene = load(room())
    sensor = scene.sensors()[0]
    drawn = wires(scene, sensor, cube((0, -1.8, 0.4), 1))
    points = np.concatenate([points for points, _ in drawn.lines])
    assert (points >= 0).all() and (points <= (WIDTH, HEIGHT)).all()
    nothing = wires(scene, sensor, cube((0, -9, 0.4), 1))
    assert nothing.lines == [] and nothing.centre is None


def test_labels_are_inside_and_apart():
    width, height, size = 450, 300, 10
    corners = {f"cluster{i}": np.array([x, 300.0]) for i, x in enumerate((0, 450, 440, 445))}
    placed = labels(corners | {"far": np.array([200.0, 100]), "none": None}, width, height)
    assert placed.pop("far") == (200, 100) and set(placed) == set(corners)
    half = 0.3 * size * len("cluster0")
    for x, y in placed.values():
        assert half <= x <= width - half and size / 2 <= y <= height - size / 2
    for (x, y), (u, v) in itertools.combinations(placed.values(), 2):
        assert abs(x - u) >= 2 * half or abs(y - v) >= size
    assert len(labels(dict.fromkeys(map(str, range(99)), np.zeros(2)), 9, 9)) == 99  # No room.


@pytest.mark.parametrize("path", ["paper_room.xml", "paper_room/scene.xml"])
def test_pages_go_by_the_name_of_the_scene(path):
    assert scene_name({"scene": path}) == "paper_room"


# ---------------------- Maps ----------------------


def map_of_directions(resolution: int = 4) -> CubeMap:
    """Its radiance is 1 + the direction of each texel, its distance 2, but for what is above."""
    levels = []
    while resolution:
        face, y, x = np.indices((6, resolution, resolution), np.float32).reshape(3, -1)
        uv = mi.Point2f((x + 0.5) * 2 / resolution - 1, (y + 0.5) * 2 / resolution - 1)
        d = np.array(dr.normalize(face_to_direction(mi.UInt32(face), uv))).T
        inverse = np.where(face == 4, 0, np.where(face == 5, -0.5, 0.5))[:, None]
        level = np.concatenate([1 + d, inverse], axis=1)
        levels.append(level.reshape(6, resolution, resolution, 4).astype(np.float32))
        resolution //= 2
    return CubeMap(cube((0, 0, 0), 1), levels)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0)])
def test_crosses_are_as_the_camera_looks(up):
    """Ahead in the middle, and no seams beside it."""
    ahead = np.array([0.9, 0.1, 0.3] if up[2] else [0.1, 0.2, -0.9])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], ahead.tolist(), list(up)),
        }
    )
    faces = Faces.of(sensor)
    right = [0, -1, 0] if up[2] else [1, 0, 0]
    np.testing.assert_array_equal(faces.up, up)
    np.testing.assert_array_equal(faces.right, right)
    cross, covered = faces.cross(map_of_directions(16).levels[0])
    d = cross[..., :3] - 1
    assert covered.sum() == 6 * 16**2

    def middle(row, column):
        return d[row * 16 + 7 : row * 16 + 9, column * 16 + 7 : column * 16 + 9].mean(axis=(0, 1))

    expected = {(1, 0): -faces.right, (1, 1): faces.ahead, (1, 2): right, (1, 3): -faces.ahead}
    for (row, column), axis in (expected | {(0, 1): faces.up, (2, 1): -faces.up}).items():
        np.testing.assert_allclose(middle(row, column), axis, atol=0.02)
    assert np.abs(np.diff(d[16:32], axis=1)).max() < 0.2
    assert np.abs(np.diff(d[:, 16:32], axis=0)).max() < 0.2


def test_distances_show_what_is_known():
    sensor = mi.load_dict(camera())
    radiance, distance, near, far = unfolded(map_of_directions(), Faces.of(sensor))
    assert radiance.shape == distance.shape == (12, 16 + 8 + 4, 4)
    assert near == pytest.approx(2) and far > near
    above, below, ahead = distance[2, 6, :3], distance[10, 6, :3], distance[6, 6, :3]
    assert tuple(above) == SKY and tuple(below) == MASKED
    np.testing.assert_array_equal(ahead, RAMP[0])
    assert distance[0, 0, 3] == 0 and distance[2, 6, 3] == 255


# ---------------------- Pictures and words ----------------------


def test_pictures_survive_as_text():
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    np.testing.assert_array_equal(decoded(embedded(picture)), picture)


def test_scales():
    values = np.array([0, 0.01, 0.1, 1, 9])
    np.testing.assert_array_equal(on_ramp(values, 0.01, 1), RAMP[[0, 0, 2, 4, 4]])
    np.testing.assert_array_equal(tone_mapped(np.array([0, 0.5, 2, np.nan]), 1.0), [0, 188, 255, 0])
    large = np.ones((100, 2000, 3))
    assert shrunk(large).shape == (33, 666, 3) and (shrunk(large) == 1).all()


@pytest.mark.parametrize(
    ("served", "masked", "words"),
    [
        ((0.1, 0.2, 0.7), 0.5, "Nothing odd"),
        ((0.1, 0.7, 0.2), 0.5, "lower distance_ratio (here 2)"),
        ((0.5, 0.1, 0.4), 0.5, "Raise distance_ratio (here 2)"),
        ((0.4, 0.4, 0.2), 0.5, "no_cluster leaves its shapes out"),
        ((0.1, 0.2, 0.7), 0.95, "95\u00a0% of the map is behind walls"),
    ],
)
def test_advice(served, masked, words):
    members, shapes = Members(("ball & co",), unnamed=1, share=0.3), {"ball & co": 0.1, "": 0.2}
    pays = replace(cube((0, 0, 0), 1), benefit=0.04)
    view = ClusterView(pays, masked, members, shapes, 0.1, served)
    assert words in " ".join(about_cluster(view, 4))
    assert not {"lower", "Raise"} <= set(" ".join(about_cluster(view, 4)).split())
    # What it gives to be changed by hand loads.
    text = as_xml(view)
    loaded = mi.load_string(
        f'<scene version="3.0.0"> <integrator type="envmap_hybrid"> {text} </integrator> </scene>'
    ).integrator()
    assert loaded.requests[0].shapes == ("ball & co",)
    assert loaded.requests[0].distance_ratio == 2
    assert shlex.split(as_flags(view))[1] == "cluster0.shapes=ball & co"
    assert shlex.split(without(view))[-1] == "no_cluster=ball & co"


def test_a_map_that_is_not_worth_having_is_told_so_first():
    """Looking maps up costs 12 % of the time, a quarter of that for each of four."""
    members = Members(("ball",))
    for benefit, pays in ((0.04, True), (0.02, False)):
        its = replace(cube((0, 0, 0), 1), benefit=benefit)
        said = about_cluster(ClusterView(its, 0.0, members, {}, 0.3, (0.1, 0.7, 0.2)), 4)
        assert any("lower distance_ratio" in remark for remark in said)
        assert ("takes 2\u00a0% of the noise off at most" in said[0]) != pays
    asked = replace(members, request=ClusterRequest("cluster0", ("ball",)))
    for its, words in (
        (asked, "Take cluster0 out"),
        (members, "no_cluster"),
        (Members(()), "of the time."),
    ):
        view = ClusterView(cube((0, 0, 0), 1), 0.0, its, {}, 0.3, (0.1, 0.2, 0.7))
        assert words in about_cluster(view, 4)[0]
