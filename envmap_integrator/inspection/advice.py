"""Why a picture is as it is, and what to do about it, in words."""

from __future__ import annotations

import shlex
from xml.sax.saxutils import quoteattr

import numpy as np

from ..preparation.maps.clusters import LOOK_UP_COST
from .survey import ClusterView, Survey

#: From which on it is worth a word: the error of the brightness by the cache, the part of the
#: secondary rays that are traced on, and of the picture without patches.
ERROR, TRACED_ON, UNKNOWN = 0.01, 0.25, 0.15
#: The same of the texels of a map that nothing reaches.
MASKED = 0.9
#: Shapes of a cluster that are named at most.
MOST_SHAPES = 6


def percent(share: float) -> str:
    """A share as people read it, on one line."""
    return f"{100 * share:.2g}\u00a0%" if share < 0.1 else f"{100 * share:.0f}\u00a0%"


def in_short(survey: Survey) -> list[str]:
    """Why the picture is as it is, in a few sentences."""
    state, aovs = survey.view.state, survey.view.aovs
    error, by_size = state.relative_error, state.size_error
    remedy = "Raise patches." if 2 * by_size**2 > error**2 else "Raise patch_samples."
    found = [
        f"The cache may make the picture too bright or too dark by {percent(error)} (one standard "
        "error), which more samples don't change. "
        + (remedy if error > ERROR else "That is little."),
    ]
    if np.isfinite(survey.noise):
        found.append(
            f"Noise at {survey.spp} samples per pixel is about {percent(survey.noise**0.5)} of the "
            "brightness of a pixel; four times as many samples halve it."
        )
    traced_on = aovs["served"][..., 0].mean()
    if traced_on > TRACED_ON:
        found.append(
            f"{percent(traced_on)} of the secondary rays are traced on, which takes time and makes "
            "noise: see below where, and why."
        )
    unknown = (aovs["patch"].max(axis=2) == 0).mean()
    if unknown > UNKNOWN:
        found.append(
            f"{percent(unknown)} of the picture has no patches: there are mirrors and glass, "
            "lamps, the sky, or what is finer than a patch. For the latter, raise patches."
        )
    return [*found, _about_maps(survey)]


def _about_maps(survey: Survey) -> str:
    clusters = (survey.mapped or survey.view).clusters
    if not clusters:
        return "There are no maps: secondary rays are traced in full."
    benefit = sum(cluster.cluster.benefit for cluster in clusters)
    pays = "more" if benefit > LOOK_UP_COST else "less"
    made = "They weren't made." if survey.mapped else "They were made."
    return (
        f"Maps are predicted to take {percent(benefit)} of the noise off at most, {pays} than the "
        f"{percent(LOOK_UP_COST)} of the time that looking them up costs. {made}"
    )


def about_cluster(view: ClusterView) -> list[str]:
    """What is odd about a cluster, and what mends it."""
    cluster, (traced, cached, mapped) = view.cluster, view.served
    ratio = f"distance_ratio (here {cluster.half_width / cluster.radius:.3g})"
    found = []
    if view.seen == 0:
        found.append("This sensor doesn't see it: no_cluster leaves its shapes out.")
    if cached > mapped and traced > TRACED_ON:
        found.append(
            "Few rays come to use the map, with this cube, a smaller or a larger one: many hit "
            "something inside it, and many are traced on. no_cluster leaves its shapes out."
        )
    elif cached > mapped:
        found.append(
            "More rays hit something inside the cube than come to use the map: lower "
            f"{ratio}, or list fewer shapes that lie closer together."
        )
    elif traced > TRACED_ON:
        found.append(
            "Many rays are traced on: what lies beyond the cube looks different from different "
            f"places of the cluster, or its surfaces nearly touch. Raise {ratio}, or list fewer "
            "shapes that lie closer together."
        )
    if view.masked > MASKED:
        found.append(
            f"{percent(view.masked)} of the map is behind walls or inside of objects: lower "
            f"{ratio}, move its center, or list other shapes."
        )
    return found or ["Nothing odd."]


def as_xml(view: ClusterView) -> str:
    """A ``mipmap_cube`` that asks for the same cluster, to be changed by hand.

    Nothing if its shapes have no ids.
    """
    cluster = view.cluster
    ids = _ids(view)
    if not ids:
        return ""
    return (
        f'<emitter type="mipmap_cube" id={quoteattr(cluster.name)}>\n'
        f'    <string name="shapes" value={quoteattr(ids)}/>\n'
        f'    <float name="distance_ratio" value="{cluster.half_width / cluster.radius:.3g}"/>\n'
        "</emitter>"
    )


def as_flags(view: ClusterView) -> str:
    """Flags of ``envmap-render`` that ask for the same, and that leave its shapes out."""
    cluster, ids = view.cluster, _ids(view)
    if not ids:
        return ""
    name, ratio = shlex.quote(cluster.name), cluster.half_width / cluster.radius
    return (
        f"--set {name}.shapes={shlex.quote(ids)} --set {name}.distance_ratio={ratio:.3g}\n"
        f"--set no_cluster={shlex.quote(ids)}"
    )


def _ids(view: ClusterView) -> str:
    return ", ".join(list(filter(None, view.shapes))[:MOST_SHAPES])
