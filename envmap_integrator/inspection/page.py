"""The page: one HTML file that holds its pictures."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..imaging.aovs import false_colour
from ..preparation.maps.clusters import LOOK_UP_COST
from ..system.atomic import check_writable, replacing
from ..system.checks import check_size, sensor_of
from ..system.progress import stage
from ..system.scene_file import DEFAULT_INTEGRATOR
from . import advice
from .pictures import eight_bits, embedded, on_ramp, ramp_css, shrunk, tone_mapped, white_of
from .survey import ClusterView, Survey, View, survey
from .unfolded import Faces, unfolded
from .wires import LABEL, Wires, labels, wires

#: Ends of the scale of relative errors.
LEAST_ERROR, MOST_ERROR = 0.01, 1.0
#: What rays of each kind of ``system.ray_counts`` are for.
RAYS = {
    "primary": "of the camera",
    "shadow": "to sources",
    "secondary": "of surfaces, as far as a cube",
    "unbounded": "of surfaces, in full",
    "retraced": "traced on where a map wasn't trusted",
    "source": "for sources beyond a cube",
    "survey": "for where surfaces are",
}


@dataclass(frozen=True)
class Shown:
    """A cluster on the page.

    view             what is known of it
    colour           CSS colour
    wires            its cube in the picture
    radiance, distance  URIs of its unfolded map
    near, far        ends of the scale of distances
    shapes           its largest shapes, and how many there are
    remarks, unlisted  what is odd about it, and what of it can't be listed: see ``advice``
    xml, flags, without  how to ask for it, and to leave it out: see ``advice``
    """

    view: ClusterView
    colour: str
    wires: Wires
    radiance: str
    distance: str
    near: float
    far: float
    shapes: list[tuple[str, float]]
    n_shapes: int
    remarks: list[str]
    unlisted: list[str]
    xml: str
    flags: str
    without: str


def inspect(
    path: str | os.PathLike,
    scene: mi.Scene,
    integrator: mi.Integrator | None = None,
    sensor: mi.Sensor | int = 0,
    spp: int = 0,
    seed: int = 0,
    settings: dict[str, object] | None = None,
) -> None:
    """Write an HTML page that tells why pictures of a scene are as they are.

    It's about a render of ``spp`` samples per pixel (0: the sensor's) by an ``envmap_hybrid`` or
    ``one_level_path``: if none is passed the scene's own, or ``envmap_hybrid`` if that has none.
    ``settings`` are shown on it. Shapes go by their ids: where ``mi.load_file`` has merged meshes
    they have none, see ``optimize``.

    Raises ``ValueError`` for other integrators and as ``integrator.prepare`` does, ``ImportError``
    if the optional package jinja2 is missing, and ``StorageError`` if there can be no such file.
    """
    integrator = integrator or scene.integrator() or mi.load_dict({"type": DEFAULT_INTEGRATOR})
    if not hasattr(integrator, "aovs"):
        raise ValueError(
            f'integrator "{integrator.class_name()}" has nothing to inspect: pass '
            'integrator=mi.load_dict({"type": "envmap_hybrid"})'
        )
    template = _load_template()  # What may be missing is found before the work starts.
    check_writable(Path(path))
    sensor = sensor_of(scene, sensor)
    check_size(sensor, spp)
    spp = spp or sensor.sampler().sample_count()
    settings = settings or {"spp": spp, "seed": seed, "integrator": integrator}
    with stage("Inspecting"):
        found = survey(scene, sensor, integrator, spp, seed)
    title = f"{scene_name(settings)} — what {integrator.owner} does"
    with stage("Making the page"):
        text = _page(template, title, found, scene, sensor, settings)
    with replacing(path) as file:
        file.write(text.encode())


def _load_template() -> Any:
    """The page's template; raises ``ImportError`` if the optional package jinja2 is missing."""
    try:
        import jinja2
    except ImportError:
        raise ImportError("jinja2, which writes the page, is missing: pip install jinja2") from None
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["percent"] = advice.percent
    return environment.get_template("page.html.j2")


def scene_name(settings: dict[str, object]) -> str:
    """What the scene goes by; files of many are called scene.xml."""
    path = Path(str(settings.get("scene", "A scene"))).resolve()
    return path.parent.name if path.stem == "scene" else path.stem


def _page(
    template: Any,
    title: str,
    survey: Survey,
    scene: mi.Scene,
    sensor: mi.Sensor,
    settings: dict[str, object],
) -> str:
    """The page of a survey; ``settings`` are shown as they are."""
    view = survey.view
    aovs = {name: shrunk(picture) for name, picture in view.aovs.items()}
    picture = shrunk(survey.picture)
    irradiance = aovs["irradiance"]
    white, light = white_of(picture), white_of(irradiance)
    mean = irradiance.mean(axis=2)
    lit = mean > 0
    error = aovs["irradiance_error"][..., 0] / np.where(lit, mean, 1)
    height, width = survey.picture.shape[:2]
    with_maps = survey.mapped or view
    clusters = _clusters(with_maps, scene, sensor)
    centres = {shown.view.cluster.name: shown.wires.centre for shown in clusters}
    return template.render(
        title=title,
        survey=survey,
        in_short=advice.in_short(survey),
        state=view.state,
        picture=embedded(tone_mapped(picture, white)),
        patch=embedded(eight_bits(aovs["patch"])),
        irradiance=embedded(tone_mapped(irradiance, light)),
        indirect=embedded(tone_mapped(aovs["indirect_irradiance"], light)),
        light=light,
        error=embedded(np.where(lit[..., None], on_ramp(error, LEAST_ERROR, MOST_ERROR), 0)),
        usual_error=float(np.median(error[lit])) if lit.any() else 0.0,
        unknown=float((view.aovs["patch"].max(axis=2) == 0).mean()),
        served=embedded(_served(aovs)),
        shares=view.aovs["served"].mean(axis=(0, 1)).tolist(),
        near=float(view.aovs["near"].mean()),
        kinds=RAYS,
        ramp=ramp_css(),
        width=width,
        height=height,
        objects=embedded(_objects(picture, white, with_maps)),
        served_by_maps=embedded(_served({n: shrunk(p) for n, p in with_maps.aovs.items()})),
        clusters=clusters,
        labels=labels(centres, width, height),
        label_size=LABEL * max(width, height),
        faces=Faces.of(sensor).names(),
        look_up_cost=LOOK_UP_COST,
        settings=settings,
    )


def _served(aovs: dict[str, np.ndarray]) -> np.ndarray:
    """Where secondary rays end, in four colours: of those traced on, the near ones are yellow."""
    colours = aovs["served"].copy()
    colours[..., 1] += aovs["near"][..., 0]
    return eight_bits(colours)


def _objects(picture: np.ndarray, white: float, view: View) -> np.ndarray:
    """The picture in grey, with the clusters' colours on their objects."""
    grey = tone_mapped(picture.mean(axis=2, keepdims=True), white) / 255
    colour = shrunk(view.aovs["cluster"])
    there = colour.max(axis=2, keepdims=True) > 0
    return eight_bits(np.where(there, 0.25 * grey + 0.75 * colour, 0.5 * grey + 0.15))


def _clusters(view: View, scene: mi.Scene, sensor: mi.Sensor) -> list[Shown]:
    faces = Faces.of(sensor)
    shown = []
    for index, (cluster, cube_map) in enumerate(zip(view.clusters, view.state.maps, strict=True)):
        radiance, distance, near, far = unfolded(cube_map, faces)
        red, green, blue = (round(255 * float(c[0])) for c in false_colour(mi.UInt32(index)))
        shapes = [(name or "(no id)", share) for name, share in cluster.shapes.items()]
        shown.append(
            Shown(
                view=cluster,
                colour=f"rgb({red}, {green}, {blue})",
                wires=wires(scene, sensor, cluster.cluster),
                radiance=embedded(radiance),
                distance=embedded(distance),
                near=near,
                far=far,
                shapes=shapes[: advice.MOST_SHAPES],
                n_shapes=len(shapes),
                remarks=advice.about_cluster(cluster, len(view.clusters)),
                unlisted=advice.about_listing(cluster),
                xml=advice.as_xml(cluster),
                flags=advice.as_flags(cluster),
                without=advice.without(cluster),
            )
        )
    return shown
