"""Resolution of the maps: the paper's Figure 6 and the left half of its Table 1.

A table top that is a perfect mirror reads the map, looked up as in the paper (plain) and by
distance (corrected). What resolution does to errors, to map generation and to rendering.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import mitsuba as mi
from matplotlib.figure import Figure

from compare.figures import panels, plot
from compare.options import option
from compare.paper_room import (
    LOOKUPS,
    Case,
    error_table,
    measure_cases,
    mirror_view,
    of_lookup,
    paper_table,
    render_time_range,
    room_note,
    slope,
    subject,
    table_top,
    table_top_figures,
    time_table,
    verdict,
)
from compare.paper_room import Options as MirrorOptions
from compare.references import Reference, reference
from compare.regions import Mask
from compare.report import Illustration, Report

PAPER = {
    "maps": {64: 16, 128: 65, 256: 262, 512: 1043},
    "render": {64: 411, 128: 414, 256: 413, 512: 415},
}
"""Seconds, Table 1."""

SAME = 1.1
"""Median rendering times count as equal if they differ by no more than this factor."""

ENOUGH = 1.25
"""A resolution is enough if its error floor exceeds that of the finest by no more than this."""


@dataclass(frozen=True)
class Options(MirrorOptions):
    """See ``--help``."""

    resolutions: tuple[int, ...] = option(
        "texels along the edge of a map's face, ascending",
        (64, 128, 256, 512, 1024),
        (64, 128, 256),
    )
    ratio: float = option("distance ratio; the paper's is 12.5", 12.5)


def run(options: Options, folder: Path) -> Iterator[Report]:
    """One report."""
    view = mirror_view(options)
    scene = view.load()
    mask = table_top(scene)
    judged_by = reference(view, options.reference_spp, folder / "references")
    make = partial(_subject, options)
    cases = measure_cases(scene, options, options.resolutions, make, judged_by, mask)
    yield _report(scene, options, cases, judged_by, mask)


def _subject(options: Options, lookup: str, resolution: int):
    return subject(lookup, resolution, options.ratio, options)


def _report(
    scene: mi.Scene, options: Options, cases: list[Case], judged_by: Reference, mask: Mask
) -> Report:
    title = f"Resolution of the map, distance ratio 1:{options.ratio:g}"
    report = Report(
        name="resolution",
        title=title,
        settings={"scene": mirror_view(options), **asdict(options)},
        numbers={
            "cases": [case.numbers() for case in cases],
            "map_time_slopes": {name: _slopes(of_lookup(cases, name)) for name in LOOKUPS},
            "render_time_range": {
                name: render_time_range(of_lookup(cases, name)) for name in LOOKUPS
            },
            "render_times_overlap": {name: _overlap(of_lookup(cases, name)) for name in LOOKUPS},
            "table_top_pixels": int(mask.sum()),
            "reference": judged_by.numbers(),
        },
        tables=[
            time_table(cases, title, "texels"),
            error_table(cases, title, "texels", judged_by),
            paper_table(cases, title, "texels", PAPER),
        ],
    )
    report.findings = [
        *(_times_found(name, report.numbers) for name in LOOKUPS),
        *(_resolution_found(of_lookup(cases, name)) for name in LOOKUPS),
        room_note(scene, options),
        "The seed of a map is the same in all runs: the noise of its texels counts as floor.",
    ]
    report.figures = _figures(cases, judged_by, mask)
    report.pictures = {"reference": judged_by.picture}
    return report


def _slopes(cases: list[Case]) -> dict[str, float | None]:
    """Exponents of the time of map generation: of all resolutions, and of the two finest."""
    x, y = [case.value for case in cases], [case.seconds("maps") for case in cases]
    if len(x) < 2:
        return {"all": None, "finest": None}
    return {"all": slope(x, y), "finest": slope(x[-2:], y[-2:])}


def _overlap(cases: list[Case]) -> bool:
    """Is there a rendering time that lies in the range of the runs of every case?"""
    spreads = [case.measured.spread("render_s") for case in cases]
    return max(low for low, _ in spreads) <= min(high for _, high in spreads)


def _times_found(lookup: str, numbers: dict) -> str:
    slopes = numbers["map_time_slopes"][lookup]
    spread = numbers["render_time_range"][lookup]
    if slopes["all"] is None:
        return f"{lookup}: one resolution, so nothing to compare."
    quadruples = verdict(abs(slopes["finest"] - 2) < 0.25)
    constant = verdict(spread <= SAME)
    if spread > SAME and numbers["render_times_overlap"][lookup]:
        constant = "open, since the ranges of the runs overlap"
    return (
        f"{lookup}: map generation takes time with the power {slopes['all']:.2f} of the "
        f"resolution, {slopes['finest']:.2f} between the two finest; the paper's 2 is "
        f"{quadruples}. Rendering times differ by a factor of up to {spread:.2f}: that they don't "
        f"depend on the resolution is {constant}."
    )


def _resolution_found(cases: list[Case]) -> str:
    """From which resolution on the table top gets no better, among those measured."""
    finest = cases[-1]
    enough = next(c for c in cases if c.region_floor <= ENOUGH * finest.region_floor or c is finest)
    floors = ", ".join(f"{case.region_floor:.1e} at {case.value:g}" for case in cases)
    known = "at least the finest" if enough is finest else f"{enough.value:g}"
    return (
        f"{finest.lookup}: the floor on the table top is {floors}. It takes {known} to come within "
        f"{100 * (ENOUGH - 1):.0f} % of the finest; the paper finds 512 to be needed."
    )


# ---------------------- Figures ----------------------


def _figures(cases: list[Case], judged_by: Reference, mask: Mask) -> list[Illustration]:
    whole = {
        f"{case.lookup}, {case.value:g}": case.measured.runs[0].picture
        for case in cases
        if case.value in (cases[0].value, cases[-1].value)
    }
    whole["reference"] = judged_by.picture
    return [
        *table_top_figures(cases, judged_by, mask),
        Illustration(
            "pictures",
            "Coarsest and finest map, and the reference.",
            panels(whole, judged_by.picture, columns=3),
        ),
        Illustration("curves", "Errors on the table top, and times.", _plot(cases)),
    ]


def _plot(cases: list[Case]) -> Figure:
    figure, (errors, times) = plot(columns=2)
    for index, lookup in enumerate(LOOKUPS):
        own = of_lookup(cases, lookup)
        x, color = [case.value for case in own], f"C{index}"
        errors.plot(x, [c.region_error.value for c in own], "o-", color=color, label=lookup)
        errors.plot(x, [c.region_floor for c in own], "o--", color=color, alpha=0.5)
        times.plot(x, [c.seconds("maps") for c in own], "o-", color=color, label=f"maps, {lookup}")
        times.plot(
            x, [c.seconds("render") for c in own], "s--", color=color, label=f"render, {lookup}"
        )
    errors.set(ylabel="relMSE, floor dashed")
    times.set(ylabel="time [s]")
    for axis in (errors, times):
        axis.set(xscale="log", yscale="log", xlabel="texels along the edge")
        axis.set_xticks(x, [f"{value:g}" for value in x], minor=False)
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend()
    return figure
