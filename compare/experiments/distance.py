"""Size of the cube: the paper's Figure 7 and the right half of its Table 1.

A table top that is a perfect mirror reads the map of a cube that grows. What that does to the
dislocation of the reflection, to map generation and to rendering.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from compare.figures import panels, plot
from compare.metrics import Picture
from compare.options import option
from compare.paper_room import (
    LOOKUPS,
    Case,
    error_table,
    largest_ratio,
    measure_cases,
    mirror_view,
    of_lookup,
    paper_table,
    render_time_range,
    room_note,
    subject,
    table_cube,
    table_top,
    table_top_figures,
    time_table,
    verdict,
)
from compare.paper_room import Options as MirrorOptions
from compare.references import Reference, reference
from compare.regions import Mask, pixel_centres
from compare.report import Illustration, Report
from envmap_integrator.lookup.cube import exit_distance

PAPER = {
    "maps": {1.25: 1888, 5: 1380, 10: 1079, 14: 1002},
    "render": {1.25: 575, 5: 573, 10: 584, 14: 589},
}
"""Seconds, Table 1."""

CHANGE = 0.05
"""Smaller relative changes of times are not taken for changes."""

REACH = 1 / 12
"""Largest shift that is looked for, as a fraction of the picture's width."""

WINDOW = 1 / 20
"""Edge of the windows that are registered, as a fraction of the picture's width."""


@dataclass(frozen=True)
class Options(MirrorOptions):
    """See ``--help``."""

    ratios: tuple[float, ...] = option(
        "distance ratios, ascending", (1.25, 5.0, 10.0, 14.0), (1.25, 5.0, 14.0)
    )
    resolution: int = option("texels along the edge of a map's face", 512, 128)


def run(options: Options, folder: Path) -> Iterator[Report]:
    """One report."""
    view = mirror_view(options)
    scene = view.load()
    mask = table_top(scene)
    judged_by = reference(view, options.reference_spp, folder / "references")
    make = partial(_subject, options)
    cases = measure_cases(scene, options, options.ratios, make, judged_by, mask)
    textured = with_contrast(judged_by.picture, mask)
    shifts = [median_shift(case.mean, judged_by.picture, mask, textured) for case in cases]
    expected = [expected_shifts(scene, textured, ratio) for ratio in options.ratios]
    yield _report(scene, options, cases, judged_by, mask, shifts, expected)


def _subject(options: Options, lookup: str, ratio: float):
    return subject(lookup, options.resolution, ratio, options)


# ---------------------- Dislocation ----------------------


def with_contrast(picture: Picture, mask: Mask) -> Mask:
    """The half of a region that has the most contrast: plain walls can't be registered."""
    values, window = _log_luminance(picture), _window(mask)
    contrast = _local_mean(values**2, mask, window) - _local_mean(values, mask, window) ** 2
    return mask & (contrast >= np.median(contrast[mask]))


def median_shift(picture: Picture, reference: Picture, mask: Mask, counted: Mask) -> float:
    """How far the reflection in a region is off, in pixels: the median over ``counted``.

    Every window is registered by itself, since a dislocated reflection is distorted too: the shift
    with the least mean squared difference of log luminance, among whole pixels. At least half of
    the window has to stay in the region.
    """
    ours, theirs = _log_luminance(picture), _log_luminance(reference)
    reach, window = max(round(REACH * mask.shape[1]), 2), _window(mask)
    best, found = np.full(mask.shape, np.inf), np.zeros(mask.shape)
    steps = range(-reach, reach + 1)
    for shift in sorted(product(steps, steps), key=lambda shift: np.hypot(*shift)):
        moved, valid = (np.roll(values, shift, axis=(0, 1)) for values in (ours, mask))
        cost = _local_mean((moved - theirs) ** 2, mask & valid, window)
        better = (cost < best) & (_share(mask & valid, window) > 0.5 * _share(mask, window))
        best[better], found[better] = cost[better], np.hypot(*shift)
    return float(np.median(found[counted]))


def _log_luminance(picture: Picture) -> NDArray:
    return np.log(picture.mean(axis=2) + 1e-3 * picture.mean())


def _window(mask: Mask) -> int:
    return max(round(WINDOW * mask.shape[1]), 3)


def _local_mean(values: NDArray, mask: Mask, window: int) -> NDArray:
    """Mean over those pixels of a window that belong to a mask; 0 where there are none."""
    weight = _share(mask, window)
    total = uniform_filter(np.where(mask, values, 0.0), window)
    return np.divide(total, weight, out=np.zeros(mask.shape), where=weight > 0.5 / window**2)


def _share(mask: Mask, window: int) -> NDArray:
    """Of a window around each pixel that belongs to a mask."""
    return uniform_filter(mask.astype(np.float64), window)


def expected_shifts(scene: mi.Scene, mask: Mask, ratio: float) -> dict[str, float | None]:
    """The same by geometry alone, for two ways to look up a map in the direction from its centre.

    ``direction``   the bare direction of the ray
    ``exit point``  the direction from the centre to where the ray leaves the cube

    Medians over those pixels of a mirror that show what lies beyond the cube; None if there are
    none.
    """
    si = scene.ray_intersect(pixel_centres(scene))
    d = si.to_world(mi.reflect(si.wi))
    seen = scene.ray_intersect(si.spawn_ray(d))
    centre, radius = table_cube(scene)
    centre, half_width = mi.Point3f(centre), mi.Float(ratio * radius)
    t = exit_distance(centre, half_width, si.p, d)
    beyond = mask.ravel() & (si.is_valid() & seen.is_valid() & (t > 0) & (t < seen.t)).numpy()

    # The camera behind the mirror sees along straight lines what the mirror shows.
    camera = scene.sensors()[0].world_transform() @ mi.Point3f(0)
    eye = si.p - d * dr.norm(si.p - camera)
    directions = {"direction": d, "exit point": dr.normalize(si.p + t * d - centre)}
    shifts = {}
    for name, direction in directions.items():
        start = centre + exit_distance(centre, half_width, centre, direction) * direction
        shown = scene.ray_intersect(mi.Ray3f(start, direction)).p
        cosine = dr.dot(dr.normalize(shown - eye), dr.normalize(seen.p - eye))
        shift = dr.safe_acos(cosine).numpy() / _pixel_angle(scene)
        shifts[name] = float(np.median(shift[beyond])) if beyond.any() else None
    return shifts


def _pixel_angle(scene: mi.Scene) -> float:
    """Angle of a pixel in the middle of the picture [rad]."""
    fov = np.deg2rad(float(mi.traverse(scene.sensors()[0])["x_fov"][0]))
    return 2 * np.tan(fov / 2) / scene.sensors()[0].film().size()[0]


# ---------------------- Report ----------------------


def _report(
    scene: mi.Scene,
    options: Options,
    cases: list[Case],
    judged_by: Reference,
    mask: Mask,
    shifts: list[float],
    expected: list[dict[str, float | None]],
) -> Report:
    title = f"Size of the cube, {options.resolution} texels"
    report = Report(
        name="distance",
        title=title,
        settings={"scene": mirror_view(options), **asdict(options)},
        numbers={
            "cases": [
                {**case.numbers(), "shift_pixels": shift}
                for case, shift in zip(cases, shifts, strict=True)
            ],
            "expected_shifts": dict(zip(map(str, options.ratios), expected, strict=True)),
            "render_time_range": {
                name: render_time_range(of_lookup(cases, name)) for name in LOOKUPS
            },
            "largest_ratio": largest_ratio(scene),
            "table_top_pixels": int(mask.sum()),
            "reference": judged_by.numbers(),
        },
    )
    columns = _shift_columns(shifts, expected)
    report.tables = [
        time_table(cases, title, "ratio"),
        error_table(cases, title, "ratio", judged_by, columns),
        paper_table(cases, title, "ratio", PAPER),
    ]
    report.findings = [
        *_shifts_found(cases, shifts, expected),
        *(_times_found(of_lookup(cases, name)) for name in LOOKUPS),
        room_note(scene, options),
    ]
    report.figures = _figures(cases, judged_by, mask, shifts, expected)
    report.pictures = {"reference": judged_by.picture}
    return report


def _shift_columns(shifts: list[float], expected: list[dict]) -> dict[str, list[str]]:
    """Measured shifts, and those that geometry lets expect of the plain look-up."""
    return {
        "shift px": [f"{shift:.1f}" for shift in shifts],
        "by direction": [_text(e["direction"]) for e in expected] + ["–"] * len(expected),
        "by exit point": [_text(e["exit point"]) for e in expected] + ["–"] * len(expected),
    }


def _text(shift: float | None) -> str:
    return "–" if shift is None else f"{shift:.1f}"


def _shifts_found(cases: list[Case], shifts: list[float], expected: list[dict]) -> Iterator[str]:
    for lookup in LOOKUPS:
        own = [(c, s) for c, s in zip(cases, shifts, strict=True) if c.lookup == lookup]
        (first, at_first), (last, at_last) = own[0], own[-1]
        found = verdict(at_last < 0.5 * at_first)
        claim = f": that larger cubes dislocate it less is {found}" if lookup == "plain" else ""
        listed = ", ".join(f"{shift:.1f} at 1:{case.value:g}" for case, shift in own)
        yield (
            f"{lookup}: the reflection is off by {listed} pixels; the floor on the table top goes "
            f"from {first.region_floor:.1e} to {last.region_floor:.1e}{claim}."
        )
    by_exit = ", ".join(_text(e["exit point"]) for e in expected)
    by_direction = ", ".join(_text(e["direction"]) for e in expected)
    yield (
        f"By geometry, a look-up of the bare direction is off by {by_direction} pixels, one "
        f"through the point where the ray leaves the cube by {by_exit}. The paper reports that "
        "dislocation falls as the cube grows."
    )


def _times_found(cases: list[Case]) -> str:
    first, last = cases[0], cases[-1]
    maps, render = (last.seconds(stage) / first.seconds(stage) for stage in ("maps", "render"))
    cheaper = verdict(maps < 1 - CHANGE)
    # Rendering times differ so little that only runs whose ranges don't overlap tell.
    dearer = verdict(last.measured.spread("render_s")[0] > first.measured.spread("render_s")[1])
    return (
        f"{first.lookup}: from 1:{first.value:g} to 1:{last.value:g}, map generation takes "
        f"{maps:.2f} of the time (paper: 0.53 from 1:1.25 to 1:14; that it falls is {cheaper}), "
        f"rendering {render:.2f} (paper: 1.02; that it rises is {dearer}); rendering times differ "
        f"by a factor of up to {render_time_range(cases):.2f}."
    )


# ---------------------- Figures ----------------------


def _figures(
    cases: list[Case], judged_by: Reference, mask: Mask, shifts: list[float], expected: list[dict]
) -> list[Illustration]:
    whole = {f"{c.lookup}, 1:{c.value:g}": c.measured.runs[0].picture for c in cases}
    columns = len(of_lookup(cases, LOOKUPS[0]))
    return [
        *table_top_figures(cases, judged_by, mask),
        Illustration(
            "pictures",
            "One run of each, and the reference.",
            panels({**whole, "reference": judged_by.picture}, judged_by.picture, columns=columns),
        ),
        Illustration(
            "curves",
            "Dislocation of the reflection, and times. Dotted: by geometry.",
            _plot(cases, shifts, expected),
        ),
    ]


def _plot(cases: list[Case], shifts: list[float], expected: list[dict]) -> Figure:
    figure, (dislocation, times) = plot(columns=2)
    for index, lookup in enumerate(LOOKUPS):
        own = [(c, s) for c, s in zip(cases, shifts, strict=True) if c.lookup == lookup]
        x, color = [case.value for case, _ in own], f"C{index}"
        dislocation.plot(x, [shift for _, shift in own], "o-", color=color, label=lookup)
        for stage, style in (("maps", "o-"), ("render", "s--")):
            y = [case.seconds(stage) for case, _ in own]
            times.plot(x, y, style, color=color, label=f"{stage}, {lookup}")
    for index, name in enumerate(expected[0]):
        y = [np.nan if e[name] is None else e[name] for e in expected]
        dislocation.plot(x, y, "x:", color=f"C{index + 2}", label=f"by {name}")
    dislocation.set(ylabel="median shift [pixels]")
    dislocation.set_yscale("symlog", linthresh=0.5)
    times.set(ylabel="time [s]", yscale="log")
    for axis in (dislocation, times):
        axis.set(xlabel="distance ratio")
        axis.grid(alpha=0.3)
        axis.legend()
    return figure
