"""Curves of error against wall time, for path, for ours, and for both denoised.

From them: the speed-up at equal error with preparation included, the error that no number of
samples removes, and where path overtakes. Several scenes in one run give a summary with the
geometric mean.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compare.curves import Curve, overtaking_time, speed_up
from compare.figures import panels, plot
from compare.metrics import error_floor, mean_bias, rel_mse
from compare.options import JudgedOptions, existing, option
from compare.references import Reference, reference
from compare.report import Illustration, Report, Slider, Table
from compare.runs import Measurements, Task, interleave
from compare.scenes import (
    BEST_SAMPLER,
    HYBRID,
    ONE_LEVEL_PATH,
    OWN_SCENES,
    PATH,
    SOURCE_SELECTION,
    Subject,
    View,
)

SCENES = tuple(
    OWN_SCENES / f"{name}.xml" for name in ("paper_room", "desk", "door_ajar", "atrium", "open")
)
SUBJECTS = {s.integrator: s for s in (PATH, HYBRID, ONE_LEVEL_PATH, SOURCE_SELECTION)}
TARGETS = (1e-2, 1e-3)
"""relMSE at which speed-ups are read off, besides twice the floor of each subject."""

PILOT_SPP = 16
"""At most so many samples per pixel tell how long a picture will take."""

PICTURE_SPP = 16
"""Samples per pixel of the pictures that are shown, or the next fewer."""


COLUMNS = 3
"""Panels in a row of the summary's plot."""

CAPTION = (
    "relMSE against wall time: medians of the times and means of the errors of all seeds, bars "
    "from the least to the greatest; dashed: preparation not counted. Compilation is not counted."
)


@dataclass(frozen=True)
class Options(JudgedOptions):
    """See ``--help``."""

    spp: tuple[int, ...] = option(
        "samples per pixel, ascending", (1, 4, 16, 64, 256, 1024), (1, 4, 16, 64)
    )
    integrators: tuple[str, ...] = option("plugins to compare; path takes part", tuple(SUBJECTS))
    denoised: tuple[str, ...] = option("plugins to denoise too", ("path", "envmap_hybrid"))
    sampler: str = option("plugin that draws the sample points of path", BEST_SAMPLER)
    max_seconds: float = option("sample counts whose picture takes longer are left out", 60.0)


def run(options: Options, folder: Path, scenes: tuple[Path, ...] = SCENES) -> Iterator[Report]:
    """One report a scene, then, for several scenes, the summary."""
    reports = []
    for path in existing(scenes):
        view = View(path, options.width, sampler=options.sampler)
        judged_by = reference(view, options.reference_spp, folder / "references")
        reports.append(compare(view, _subjects(options), options, judged_by))
        yield reports[-1]
    if len(reports) > 1:
        yield _summary(reports, options)


def _subjects(options: Options) -> list[Subject]:
    """``path`` first; with the settings that are being compared."""
    names = dict.fromkeys(("path", *options.integrators, *options.denoised))
    return [SUBJECTS.get(name) or Subject(name) for name in names]


def compare(view: View, subjects: list[Subject], options: Options, judged_by: Reference) -> Report:
    """All curves of one scene; the first subject is what the others are measured against."""
    scene, hidden = view.load(), view.hides_emitters()
    tasks = [
        Task(scene, subject, spp, denoise=subject.integrator in options.denoised)
        for subject in subjects
        for spp in _affordable(scene, subject, options, hidden)
    ]
    measured = interleave(tasks, options.runs, options.seed, hidden)
    curves = [curve for s in subjects for curve in _curves(s, measured, judged_by)]
    return _report(view, options, measured, curves, judged_by)


def _affordable(scene: mi.Scene, subject: Subject, options: Options, hidden: bool) -> list[int]:
    """Sample counts whose pictures take no longer than allowed, judged by a pilot; at least two."""
    ladder = sorted(options.spp)
    pilot = max([spp for spp in ladder if spp <= PILOT_SPP], default=ladder[0])
    (measured,) = interleave([Task(scene, subject, pilot)], 1, options.seed, hidden)
    limit = options.max_seconds * pilot / measured.median("render_s")
    return [spp for index, spp in enumerate(ladder) if index < 2 or spp <= limit]


def _curves(
    subject: Subject, measured: list[Measurements], judged_by: Reference
) -> Iterator[Curve]:
    """The noisy curve of a subject and, if it was denoised, the denoised one."""
    own = [one for one in measured if one.subject == subject]

    def curve(name, pictures, seconds):
        return Curve(
            name=name,
            spp=[one.spp for one in own],
            errors=np.array([[rel_mse(p, judged_by.thirds) for p in pictures(one)] for one in own]),
            seconds=np.array([[seconds(run) for run in one.runs] for one in own]),
            prepare_s=np.array([[run.prepare_s for run in one.runs] for one in own]),
            floor=error_floor(pictures(own[-1]), judged_by.thirds),
            tiled_floor=error_floor(pictures(own[-1]), judged_by.thirds, tile=8),
        )

    yield curve(subject.name, Measurements.pictures, lambda run: run.total_s)
    if own[0].runs[0].denoised is not None:
        yield curve(
            f"{subject.name} + denoiser",
            lambda one: [run.denoised for run in one.runs],
            lambda run: run.total_s + run.denoise_s,
        )


# ---------------------- Report ----------------------


def _report(
    view: View,
    options: Options,
    measured: list[Measurements],
    curves: list[Curve],
    judged_by: Reference,
) -> Report:
    first = curves[0]
    speed_ups = {
        curve.name: {f"{target:.0e}": speed_up(first, curve, target) for target in TARGETS}
        | {
            "twice its floor": speed_up(first, curve, 2 * max(curve.floor, 0)),
            "its last error": speed_up(first, curve, curve.errors[-1].max()),
        }
        for curve in curves
        if curve is not first
    }
    report = Report(
        name=f"error-vs-time-{view.name}",
        title=f"{view.name}, {view.size[0]}×{view.size[1]}: error against time",
        settings={"scene": view, **asdict(options)},
        numbers={
            "measurements": [one.numbers() for one in measured],
            "curves": [curve.numbers() for curve in curves],
            "speed_ups": speed_ups,
            "overtaking": {c.name: overtaking_time(first, c) for c in curves[1:]},
            "bias_of_mean": {
                one.subject.name: mean_bias(one.pictures(), judged_by.part_means)
                for one in _finest(measured)
            },
            "reference": judged_by.numbers(),
        },
    )
    report.tables = [_speed_up_table(report, curves), _time_table(measured)]
    report.findings = _findings(report, curves)
    report.figures = [
        Illustration("curves", CAPTION, _plot({view.name: curves})),
        Illustration(
            "pictures", "One run of each, and mean errors.", _pictures(measured, judged_by)
        ),
    ]
    _add_slider(report, measured, judged_by)
    return report


def _speed_up_table(report: Report, curves: list[Curve]) -> Table:
    first, *others = curves
    rows = []
    for curve in others:
        ups = report.numbers["speed_ups"][curve.name]
        rows.append(
            [
                curve.name,
                f"{np.median(curve.prepare_s):.2f}",
                f"{curve.floor:.1e}",
                f"{curve.tiled_floor:.1e}",
            ]
            + [_text(up) for up in ups.values()]
            + [report.numbers["overtaking"][curve.name].text]
        )
    reference = report.numbers["reference"]
    return Table(
        f"{report.title}: speed-up over {first.name} at equal error, preparation included",
        ["integrator", "prepare s", "floor", "tiled floor"]
        + [f"at {target:.0e}" for target in TARGETS]
        + ["at twice its floor", "at its last", f"{first.name} overtakes"],
        rows,
        "Means over the seeds with 95 % intervals. Floor: relMSE without noise, of pixels and of "
        f"averages over 8×8. ≈: {first.name} needs more samples than were rendered, its error is "
        "extrapolated as 1/spp. –: not reached. Reference: "
        f"3 × {reference['spp_of_each_third']} spp, its own relMSE {reference['rel_mse']:.1e}, "
        "taken out of all errors.",
    )


def _text(estimate) -> str:
    if estimate is None:
        return "–"
    sign = "≈ " if estimate.extrapolated else ""
    return f"{sign}{estimate.value:.2f} ± {estimate.margin:.2f}"


def _time_table(measured: list[Measurements]) -> Table:
    rows = []
    for one in measured:
        low, high = one.spread("render_s")
        rows.append(
            [one.subject.name, str(one.spp), f"{one.median('prepare_s'):.2f}",
             f"{one.median('render_s'):.3f}", f"{low:.3f} … {high:.3f}",
             f"{one.median('denoise_s'):.2f}", f"{one.compile_s():.1f}"]
        )  # fmt: skip
    return Table(
        "Times",
        ["integrator", "spp", "prepare s", "render s", "from … to", "denoise s", "compile s"],
        rows,
        f"Medians of {len(measured[0].runs)} interleaved runs.",
    )


def _findings(report: Report, curves: list[Curve]) -> list[str]:
    first = curves[0].name
    findings = []
    for curve in curves[1:]:
        ups = report.numbers["speed_ups"][curve.name]
        reached = [f"{_text(up)} times as fast at {at}" for at, up in ups.items() if up is not None]
        speed = f"{curve.name} is {', '.join(reached)}." if reached else f"{curve.name}: no target."
        findings.append(
            f"{speed} {first} overtakes: {report.numbers['overtaking'][curve.name].text}."
        )
    return findings


def _plot(scenes: dict[str, list[Curve]]) -> Figure:
    """One panel a scene."""
    columns = min(len(scenes), COLUMNS)
    figure, axes = plot(columns=columns, rows=-(-len(scenes) // columns))
    for axis in axes[len(scenes) :]:
        axis.set_axis_off()
    for axis, (name, curves) in zip(axes, scenes.items(), strict=False):
        for index, curve in enumerate(curves):
            _draw(axis, curve, f"C{index}", "ox^sDv*P"[index % 8])
        axis.set(title=name, xscale="log", yscale="log", xlabel="wall time [s]", ylabel="relMSE")
        axis.grid(alpha=0.3, which="both")
    axes[0].legend(fontsize="small")
    return figure


def _draw(axis: Axes, curve: Curve, color: str, marker: str) -> None:
    time, error = np.median(curve.seconds, axis=1), curve.errors.mean(axis=1)
    spreads = [
        np.abs(np.stack([values.min(axis=1), values.max(axis=1)]) - middle)
        for values, middle in ((curve.errors, error), (curve.seconds, time))
    ]
    axis.errorbar(time, error, *spreads, color=color, marker=marker, ms=4, label=curve.name)
    if curve.prepare_s.any():
        apart = np.median(curve.seconds - curve.prepare_s, axis=1)
        axis.plot(apart, error, "--", color=color, alpha=0.5)


def _pictures(measured: list[Measurements], judged_by: Reference):
    shown = _shown(measured)
    errors = {
        f"{one.subject.name}, mean error": np.mean(one.pictures(), axis=0, dtype=np.float64)
        for one in _finest(measured)
    }
    pictures = {f"{one.subject.name}, {one.spp} spp": one.runs[0].picture for one in shown}
    return panels(pictures, judged_by.picture, errors, columns=max(len(shown), 2))


def _finest(measured: list[Measurements]) -> list[Measurements]:
    """Of each subject, what has the most samples: they are in ascending order."""
    return list({one.subject.name: one for one in measured}.values())


def _shown(measured: list[Measurements]) -> list[Measurements]:
    spp = max([one.spp for one in measured if one.spp <= PICTURE_SPP], default=measured[0].spp)
    return [one for one in measured if one.spp == spp]


def _add_slider(report: Report, measured: list[Measurements], judged_by: Reference) -> None:
    path, *others = _shown(measured)
    for one in others[:1]:
        report.sliders.append(
            Slider(
                f"{one.subject.name} and {path.subject.name}, {one.spp} samples per pixel",
                (one.subject.name, one.runs[0].picture),
                (path.subject.name, path.runs[0].picture),
                judged_by.picture,
            )
        )
    report.pictures = {"reference": judged_by.picture}


# ---------------------- Summary ----------------------


def _summary(reports: list[Report], options: Options) -> Report:
    """Speed-ups of all scenes; geometric means over those that reach the error."""
    names = list(reports[0].numbers["speed_ups"])
    curves = {
        report.name.removeprefix("error-vs-time-"): [
            Curve(**numbers) for numbers in report.numbers["curves"]
        ]
        for report in reports
    }
    tables, means = [], {}
    for target in (f"{target:.0e}" for target in TARGETS):
        means[target] = {name: _geometric_mean(reports, name, target) for name in names}
        tables.append(_summary_table(reports, names, target, means[target], options))
    return Report(
        name="error-vs-time",
        title=f"Speed-up over path at equal error, {len(reports)} scenes",
        settings={**asdict(options), "variant": mi.variant()},
        tables=tables,
        figures=[Illustration("curves", CAPTION, _plot(curves))],
        numbers={
            "speed_ups": {r.name: r.numbers["speed_ups"] for r in reports},
            "geometric_means": means,
        },
    )


def _geometric_mean(reports: list[Report], name: str, target: str) -> dict[str, object]:
    ups = [report.numbers["speed_ups"][name][target] for report in reports]
    reached = [up.value for up in ups if up is not None]
    mean = float(np.exp(np.mean(np.log(reached)))) if reached else None
    return {"mean": mean, "scenes": len(reached)}


def _summary_table(
    reports: list[Report], names: list[str], target: str, means: dict, options: Options
) -> Table:
    rows = [
        [report.name.removeprefix("error-vs-time-")]
        + [_text(report.numbers["speed_ups"][name][target]) for name in names]
        for report in reports
    ]
    mean_row = [
        "–"
        if means[name]["mean"] is None
        else f"{means[name]['mean']:.2f} of {means[name]['scenes']}"
        for name in names
    ]
    return Table(
        f"Speed-up over path at relMSE {target}, preparation included; {options.width} wide",
        ["scene", *names],
        [*rows, ["geometric mean", *mean_row]],
        "The mean is of those scenes that reach the error.",
    )
