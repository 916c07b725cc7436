"""Integrators beside path on any scene, at equal samples or at equal time.

Pictures side by side with a slider, signed errors against a path traced reference, times.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from compare.figures import panels
from compare.metrics import error_floor, estimate, mean_bias, rel_mse
from compare.options import JudgedOptions, existing, option
from compare.references import Reference, reference
from compare.report import Illustration, Report, Slider, Table
from compare.runs import Measurements, Task, equal_time_spp, interleave
from compare.scenes import PAPER_ROOM, PATH, Subject, View
from envmap_integrator.cli.output import write_png

SCENES = (PAPER_ROOM,)


@dataclass(frozen=True)
class Options(JudgedOptions):
    """See ``--help``."""

    spp: int = option("samples per pixel", 64, 16)
    integrators: tuple[str, ...] = option(
        "plugins to compare with path, with settings perhaps: NAME:parameter=value,…",
        ("envmap_hybrid",),
    )
    equal: str = option("what path is given as much of as the first integrator: spp or time", "spp")

    def __post_init__(self):
        super().__post_init__()
        if self.equal not in ("spp", "time"):
            raise ValueError(f'--equal must be "spp" or "time", got "{self.equal}"')
        for integrator in self.integrators:
            Subject.parse(integrator)


def run(options: Options, folder: Path, scenes: tuple[Path, ...] = SCENES) -> Iterator[Report]:
    """One report a scene."""
    for path in existing(scenes):
        yield _compare(View(path, options.width), options, folder)


def _compare(view: View, options: Options, folder: Path) -> Report:
    scene, hidden = view.load(), view.hides_emitters()
    named = dict.fromkeys(options.integrators)
    subjects = [Subject.parse(name) for name in named if name != "path"]
    tasks = [Task(scene, subject, options.spp) for subject in subjects]
    spp = options.spp
    first_look = _FirstLook(view, folder)
    if options.equal == "time" and tasks:
        spp = equal_time_spp(tasks[0], spp, options.seed, hidden, first_look)
    tasks.append(Task(scene, PATH, spp))
    measured = interleave(tasks, options.runs, options.seed, hidden, first_look)
    judged_by = reference(view, options.reference_spp, folder / "references")
    return _report(view, options, measured, judged_by)


class _FirstLook:
    """Writes each integrator's first picture and tells where it is: a reference takes a while."""

    def __init__(self, view: View, folder: Path):
        self._view, self._folder = view, folder
        self._written: set[tuple[str, int]] = set()

    def __call__(self, measurements: Measurements) -> None:
        name, spp, run = measurements.subject.name, measurements.spp, measurements.runs[-1]
        if (name, spp) in self._written:
            return
        self._written.add((name, spp))
        self._folder.mkdir(parents=True, exist_ok=True)
        plain = re.sub(r"[^\w.-]+", "-", name)
        path = self._folder / f"{self._view.name}-{plain}.png"
        write_png(path, mi.Bitmap(run.picture))
        took = f"in {run.total_s:.1f} s, after {run.compile_s:.1f} s of compilation"
        print(f"wrote {path}: {spp} samples per pixel {took}", flush=True)


def _report(
    view: View, options: Options, measured: list[Measurements], judged_by: Reference
) -> Report:
    *ours, path = measured
    table = Table(
        f"{view.name}, {view.size[0]}×{view.size[1]}",
        ["integrator", "spp", "prepare s", "render s", "total s", "compile s",
         "relMSE", "floor", "bias %"],
        [],
        f"Medians of {options.runs} interleaved runs; compilation is apart and not in the total. "
        f"Floor: error without noise. Reference: 3 × {judged_by.spp} spp of path, "
        f"relMSE {judged_by.rel_mse:.1e}, taken out of the errors.",
    )  # fmt: skip
    report = Report(
        name=f"render-{view.name}",
        title=f"{view.name} at equal {options.equal}: "
        + ", ".join(one.subject.name for one in measured),
        settings={"scene": view, **asdict(options)},
        tables=[table],
    )
    results = {}
    for one in measured:
        errors = [rel_mse(picture, judged_by.thirds) for picture in one.pictures()]
        floor = error_floor(one.pictures(), judged_by.thirds)
        bias = mean_bias(one.pictures(), judged_by.part_means)
        results[one.subject.name] = {
            **one.numbers(),
            "rel_mse": estimate(errors),
            "rel_mse_of_runs": errors,
            "error_floor": floor,
            "bias_of_mean": bias,
        }
        table.rows.append(
            [one.subject.name, str(one.spp)]
            + [f"{one.median(q):.2f}" for q in ("prepare_s", "render_s", "total_s")]
            + [
                f"{one.compile_s():.1f}", f"{np.mean(errors):.2e}", f"{floor:.1e}",
                f"{100 * bias.value:+.2f} ± {100 * bias.margin:.2f}",
            ]
        )  # fmt: skip
    report.numbers = {"results": results, "reference": judged_by.numbers()}
    path_error = results["path"]["rel_mse"].value
    for one in ours:
        error = results[one.subject.name]["rel_mse"].value
        equal_error = path.total_s() * path_error / error
        report.findings.append(
            f"{one.subject.name}: {path.total_s() / one.total_s():.2f}× as fast as path with "
            f"{path.spp} spp, preparation included, and its error is {path_error / error:.2f}× "
            f"smaller; about {equal_error / one.total_s():.1f}× as fast at equal error, if the "
            "error of path falls as 1/spp."
        )
    _illustrate(report, measured, judged_by)
    return report


def _illustrate(report: Report, measured: list[Measurements], judged_by: Reference) -> None:
    single = {one.subject.name: one.runs[0].picture for one in measured}
    means = {f"{one.subject.name} − reference": np.mean(one.pictures(), axis=0) for one in measured}
    figure = panels({**single, "reference": judged_by.picture}, judged_by.picture, means, columns=3)
    report.figures.append(
        Illustration("pictures", "One run of each, and the mean error of all runs.", figure)
    )
    for one in measured[:-1]:
        left = (one.subject.name, one.runs[0].picture)
        report.sliders.append(
            Slider(f"{one.subject.name} and path", left, ("path", single["path"]),
                   judged_by.picture)
        )  # fmt: skip
    report.pictures = {**single, "reference": judged_by.picture}
