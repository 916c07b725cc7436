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
#: Shapes of a cluster that are named at most, but for those to be listed.
MOST_SHAPES = 6
#: From which part of a cluster on shapes stand for all of it.
MOST = 0.95


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


def about_cluster(view: ClusterView, n_clusters: int) -> list[str]:
    """What is odd about a cluster, one of so many, and what mends it."""
    cluster, (traced, cached, mapped) = view.cluster, view.served
    ratio = f"distance_ratio (here {cluster.half_width / cluster.radius:.3g})"
    # Looking maps up costs everywhere, whatever the size of a cluster: each has to pay its part.
    cost = LOOK_UP_COST / n_clusters
    found = []
    if view.seen == 0:
        found.append(f"This sensor doesn't see it.{_leave_out(view)}")
    elif cluster.benefit < cost:
        found.append(
            f"Its map isn't worth having: it takes {percent(cluster.benefit)} of the noise off at "
            f"most, less than its part of what looking maps up costs, {percent(cost)} of the time."
            + _leave_out(view)
        )
    if cached > mapped and traced > TRACED_ON:
        found.append(
            "Few rays come to use the map, with this cube, a smaller or a larger one: many hit "
            f"something inside it, and many are traced on.{_leave_out(view)}"
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


def _leave_out(view: ClusterView) -> str:
    """How to do without a cluster, as a further sentence; nothing if there is no way."""
    if view.members.request:
        return f" Take {view.cluster.name} out of the integrator."
    return " no_cluster leaves its shapes out." if view.members.listed else ""


def about_listing(view: ClusterView) -> list[str]:
    """What of a cluster can't be asked for by hand, and why."""
    members, found = view.members, []
    if members.share < MOST:
        found.append(f"The shapes that can be listed are {percent(members.share)} of the cluster.")
    if members.pieces:
        names = ", ".join(members.pieces[:MOST_SHAPES])
        more = len(members.pieces) - MOST_SHAPES
        found.append(
            "Left out, as of these the cluster has a piece only: "
            + (f"{names}, and {more} more." if more > 0 else f"{names}.")
        )
    if members.unnamed:
        found.append(
            ("1 shape" if members.unnamed == 1 else f"{members.unnamed} shapes")
            + " without an id can't be listed: "
            + ("give it one" if members.unnamed == 1 else "give them one")
            + " (in Python, load with optimize=False: Mitsuba merges meshes that share a material)."
        )
    return found


def as_xml(view: ClusterView) -> str:
    """A ``mipmap_cube`` that asks for the same cluster, to be changed by hand.

    Nothing if none of its shapes can be listed.
    """
    if not view.members.listed:
        return ""
    lines = [
        f'<string name="shapes" value={quoteattr(", ".join(view.members.listed))}/>',
        f'<float name="distance_ratio" value="{_ratio(view)}"/>',
    ]
    if center := _center(view):
        axes = " ".join(f'{axis}="{c}"' for axis, c in zip("xyz", center, strict=True))
        lines.append(f'<point name="center" {axes}/>')
    if resolution := _resolution(view):
        lines.append(f'<integer name="resolution" value="{resolution}"/>')
    return (
        "\n    ".join([f'<emitter type="mipmap_cube" id={quoteattr(view.cluster.name)}>', *lines])
        + "\n</emitter>"
    )


def as_flags(view: ClusterView) -> str:
    """Flags of ``envmap-render`` that ask for the same; nothing likewise."""
    if not view.members.listed:
        return ""
    values = {"shapes": ", ".join(view.members.listed), "distance_ratio": _ratio(view)}
    if center := _center(view):
        values["center"] = ",".join(center)
    if resolution := _resolution(view):
        values["resolution"] = str(resolution)
    return " ".join(
        f"--set {shlex.quote(f'{view.cluster.name}.{name}={value}')}"
        for name, value in values.items()
    )


def without(view: ClusterView) -> str:
    """The flag that leaves the shapes of an automatic cluster out; nothing if there are none."""
    members = view.members
    if members.request or not members.listed:
        return ""
    return f"--set no_cluster={shlex.quote(', '.join(members.listed))}"


def _ratio(view: ClusterView) -> str:
    return f"{view.cluster.half_width / view.cluster.radius:g}"


def _center(view: ClusterView) -> list[str]:
    """That of a listed cluster that sets it."""
    request = view.members.request
    return [f"{c:.9g}" for c in (request and request.center) or ()]


def _resolution(view: ClusterView) -> int | None:
    request = view.members.request
    return request and request.resolution
