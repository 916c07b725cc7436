"""How times grow with triangles, clusters, resolution of the maps and threads.

Preparation, its stages and rendering are timed in four sweeps. The paper expects (section 3) that
far triangles cost path tracing much, and environment mapping and source selection little.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from compare.figures import plot
from compare.options import Options as CommonOptions
from compare.options import option
from compare.report import Illustration, Report, Table
from compare.runs import Measurements, Task, interleave
from compare.scenes import HYBRID, ONE_LEVEL_PATH, OWN_SCENES, PATH, SOURCE_SELECTION, Subject, View

ATRIUM_GROUP = ("plinth*", "sculpture", "bench-*", "ball-*")
"""Ids of the one cluster of atrium.xml: nearly all triangles lie outside its cube."""

CLOSE_UP_ORIGIN, CLOSE_UP_TARGET, CLOSE_UP_FOV = (-1.5, -6.6, 2.1), (0.0, 0.0, 1.3), 14.0
"""Camera of the atrium [metres, degrees across]: the group is half of this view, and a
fourteenth of the scene's own; what lies outside a cluster is rendered as by ``one_level_path``."""

DESK_GROUPS = (
    ("plant-*",),
    ("monitor-*",),
    ("mug-*", "glass", "fruit-*"),
    ("shelf-*",),
    ("book-*", "pencil-*"),
    ("mouse", "keyboard-case", "key-*"),
    ("lamp-*", "light-bulb"),
    ("notebook-*", "pen"),
)
"""Ids of clusters of desk.xml, in the order in which they are added."""

NO_CLUSTER = 1e9
"""Distance ratio whose cubes hold any scene: ``envmap_hybrid`` drops such clusters."""

SMALL = 0.1
"""Exponent up to which growth counts as small: a quarter more time for ten times as much."""

SLOW = 0.3
"""Exponent up to which growth counts as slow: twice the time for ten times as much."""


@dataclass(frozen=True)
class Options(CommonOptions):
    """See ``--help``."""

    spp: int = option("samples per pixel", 36, 8)
    patches: int = option("budget of patches of the coarse mesh", 16384, 512)
    triangles: tuple[int, ...] = option(
        "generated for atrium.xml, two numbers or more from 10000 to 1000000",
        (10_000, 30_000, 100_000, 300_000, 1_000_000),
        (10_000, 100_000),
    )
    clusters: tuple[int, ...] = option(
        f"listed for desk.xml, two numbers or more up to {len(DESK_GROUPS)}",
        (0, 1, 2, 4, 8),
        (0, 1),
    )
    resolutions: tuple[int, ...] = option(
        "of the maps of desk.xml, two powers of two or more", (32, 64, 128, 256, 512), (16, 32)
    )
    threads: tuple[int, ...] = option(
        "two numbers of threads or more, for desk.xml", (1, max(os.cpu_count() or 1, 2))
    )

    def __post_init__(self):
        super().__post_init__()
        for name in ("triangles", "clusters", "resolutions", "threads"):
            if len(set(getattr(self, name))) < 2:
                raise ValueError(f"--{name} must be two different numbers or more")
        if not 0 <= min(self.clusters) <= max(self.clusters) <= len(DESK_GROUPS):
            raise ValueError(f"--clusters must be in [0, {len(DESK_GROUPS)}]")
        if min(self.threads) < 1:
            raise ValueError(f"--threads must be at least 1, got {min(self.threads)}")


def run(options: Options, folder: Path) -> Iterator[Report]:
    """One report with all four sweeps."""
    by_triangles = _sweep_triangles(options, folder)
    view = View(OWN_SCENES / "desk.xml", options.width, merge_meshes=False)
    scene = view.load()
    by_clusters = _sweep_clusters(view, scene, options)
    by_resolution = _sweep_resolutions(view, scene, options)
    by_threads = _sweep_threads(view, scene, options)
    sweeps = [by_triangles, by_clusters, by_resolution, by_threads]
    yield Report(
        name="complexity",
        title="How times grow",
        settings=asdict(options),
        findings=[
            *_triangle_findings(by_triangles),
            _cluster_finding(by_clusters),
            *_resolution_findings(by_resolution),
            *_thread_findings(by_threads),
        ],
        tables=[_table(sweep) for sweep in sweeps],
        figures=[
            Illustration(
                "times",
                "Medians, bars from the least to the greatest. Compilation is not counted.",
                _plot(sweeps),
            )
        ],
        numbers={sweep.quantity: sweep.numbers() for sweep in sweeps},
    )


# ---------------------- Growth ----------------------


@dataclass(frozen=True)
class Spread:
    """Median, least and greatest of interleaved runs."""

    median: float
    low: float
    high: float

    @property
    def text(self) -> str:
        """With all three."""
        return f"{self.median:.2f} ({self.low:.2f} … {self.high:.2f})"


def _spread(values: NDArray[np.float64]) -> Spread:
    return Spread(float(np.median(values)), float(values.min()), float(values.max()))


@dataclass(frozen=True)
class Sweep:
    """Measurements of several subjects at ascending values of one quantity, taken in turns.

    quantity  what is varied
    values    of the quantity [V]
    measured  [V][subjects]
    powers    is time a power of the quantity, or else a constant and so much for each?
    """

    title: str
    quantity: str
    values: list[int]
    measured: list[list[Measurements]]
    powers: bool = True

    @property
    def subjects(self) -> list[str]:
        """Their names."""
        return [one.subject.name for one in self.measured[0]]

    def parts(self, subject: str) -> list[str]:
        """What is timed: preparation, its stages and rendering."""
        stages = self.measured[0][self.subjects.index(subject)].runs[0].stages_s
        return ["prepare", *stages, "render"] if stages else ["render"]

    def seconds(self, subject: str, part: str) -> NDArray[np.float64]:
        """Times [V, runs]."""
        index = self.subjects.index(subject)
        return np.array([_seconds(row[index], part) for row in self.measured])

    def slope(self, subject: str, part: str, start: int = 0) -> Spread:
        """From value number ``start`` on: exponent of the power, or seconds for one more."""
        values, seconds = np.array(self.values[start:], float), self.seconds(subject, part)[start:]
        if self.powers:
            values, seconds = np.log(values), np.log(seconds)
        return _spread(np.array([stats.linregress(values, run).slope for run in seconds.T]))

    def factor(self, subject: str, part: str) -> Spread:
        """Time at the greatest value over that at the least."""
        seconds = self.seconds(subject, part)
        return _spread(seconds[-1] / seconds[0])

    def speed_up(self, subject: str, part: str) -> Spread:
        """Its inverse."""
        seconds = self.seconds(subject, part)
        return _spread(seconds[0] / seconds[-1])

    def numbers(self) -> dict[str, object]:
        """For the JSON file."""
        lines = [(subject, part) for subject in self.subjects for part in self.parts(subject)]
        return {
            "values": self.values,
            "measurements": [[one.numbers() for one in row] for row in self.measured],
            "exponents" if self.powers else "seconds_for_one_more": _nested(self.slope, lines),
            "factors": _nested(self.factor, lines),
        }


def _seconds(one: Measurements, part: str) -> list[float]:
    """Of each run. The clocks of stages include compilation: the first run is left out there."""
    if part in ("prepare", "render"):
        return [getattr(run, f"{part}_s") for run in one.runs]
    return [run.stages_s[part] for run in one.runs[1:]]


def _nested(function, lines: list[tuple[str, str]]) -> dict[str, dict[str, Spread]]:
    nested: dict[str, dict[str, Spread]] = {}
    for subject, part in lines:
        nested.setdefault(subject, {})[part] = function(subject, part)
    return nested


# ---------------------- Sweeps ----------------------


def _sweep_triangles(options: Options, folder: Path) -> Sweep:
    views = [
        View(OWN_SCENES / "atrium.xml", options.width, {"data": str(data)}, merge_meshes=False)
        for data in (_generate(triangles, folder) for triangles in _ascending(options.triangles))
    ]
    scenes = [view.load() for view in views]
    for scene in scenes:
        _close_up(scene)
    group = {"group": _listed(scenes[0], ATRIUM_GROUP)}
    subjects = _all_subjects(options, group)
    tasks = [[Task(scene, subject, options.spp) for subject in subjects] for scene in scenes]
    return Sweep(
        f"atrium, close-up of the one cluster, {_size(views[0])}: triangles",
        "triangles",
        [_count_triangles(scene) for scene in scenes],
        _measure(tasks, options, views[0]),
    )


def _generate(triangles: int, folder: Path) -> Path:
    """Folder with the meshes of atrium.xml; they are made once."""
    target = folder.resolve() / f"atrium-{triangles}"
    if not target.is_dir():
        path = OWN_SCENES / "make_atrium.py"
        spec = importlib.util.spec_from_file_location(path.stem, path)
        script = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(script)
        unfinished = target.with_suffix(".part")
        script.generate(unfinished, triangles)
        unfinished.rename(target)
    return target


def _close_up(scene: mi.Scene) -> None:
    """Turn the camera to the group in the middle."""
    parameters = mi.traverse(scene.sensors()[0])
    parameters["x_fov"] = CLOSE_UP_FOV
    parameters["to_world"] = mi.ScalarTransform4f().look_at(
        CLOSE_UP_ORIGIN, CLOSE_UP_TARGET, (0, 0, 1)
    )
    parameters.update()


def _count_triangles(scene: mi.Scene) -> int:
    return sum(shape.face_count() for shape in scene.shapes() if isinstance(shape, mi.Mesh))


def _sweep_clusters(view: View, scene: mi.Scene, options: Options) -> Sweep:
    groups = [_listed(scene, patterns) for patterns in DESK_GROUPS]
    tasks, counts = [], _ascending(options.clusters)
    for count in counts:
        listed = {f"group-{index}": group for index, group in enumerate(groups[:count])}
        settings = listed or {"distance_ratio": NO_CLUSTER}
        tasks.append([Task(scene, _cached(HYBRID, options, settings), options.spp)])
    title = f"desk, {_size(view)}: clusters"
    return Sweep(title, "clusters", counts, _measure(tasks, options, view), powers=False)


def _sweep_resolutions(view: View, scene: mi.Scene, options: Options) -> Sweep:
    resolutions = _ascending(options.resolutions)
    tasks = [
        [Task(scene, _cached(HYBRID, options, {"map_resolution": resolution}), options.spp)]
        for resolution in resolutions
    ]
    title = f"desk, {_size(view)}: texels along the edge of a map's face"
    return Sweep(title, "resolution", resolutions, _measure(tasks, options, view))


def _sweep_threads(view: View, scene: mi.Scene, options: Options) -> Sweep:
    counts = _ascending(options.threads)
    tasks = [Task(scene, subject, options.spp) for subject in _all_subjects(options, {})]
    measured = [[Measurements(task.subject, task.spp) for task in tasks] for _ in counts]
    for index in range(options.runs):
        for count, row in zip(counts, measured, strict=True):
            with _threads(count):
                new = interleave(tasks, 1, options.seed + index, view.hides_emitters())
            for one, other in zip(row, new, strict=True):
                one.settings = other.settings
                one.runs += other.runs
    return Sweep(f"desk, {_size(view)}: threads", "threads", counts, measured)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Have Dr.Jit use this many threads."""
    before = dr.thread_count()
    dr.set_thread_count(count)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def _measure(tasks: list[list[Task]], options: Options, view: View) -> list[list[Measurements]]:
    """Let all tasks of a sweep take turns; the rows stay as they are."""
    flat = [task for row in tasks for task in row]
    measured = iter(interleave(flat, options.runs, options.seed, view.hides_emitters()))
    return [[next(measured) for _ in row] for row in tasks]


def _all_subjects(options: Options, hybrid_settings: dict[str, object]) -> list[Subject]:
    return [
        PATH,
        _cached(HYBRID, options, hybrid_settings),
        _cached(ONE_LEVEL_PATH, options),
        _cached(SOURCE_SELECTION, options),
    ]


def _cached(
    subject: Subject, options: Options, settings: dict[str, object] | None = None
) -> Subject:
    """The subject with the patches of the options and further settings."""
    return Subject(subject.integrator, {"patches": options.patches, **(settings or {})})


def _listed(scene: mi.Scene, patterns: Sequence[str]) -> dict[str, str]:
    """A cluster of all shapes whose ids match one of the patterns."""
    ids = [shape.id() for shape in scene.shapes()]
    chosen = [i for i in ids if any(fnmatch(i, pattern) for pattern in patterns)]
    return {"type": "mipmap_cube", "shapes": ", ".join(chosen)}


def _ascending(values: Sequence[int]) -> list[int]:
    return sorted(set(values))


def _size(view: View) -> str:
    return "×".join(map(str, view.size))


# ---------------------- Findings ----------------------


@dataclass(frozen=True)
class Claim:
    """What the paper says of a time, as bounds of its exponent."""

    text: str
    subject: str
    part: str
    at_least: float = -np.inf
    at_most: float = np.inf

    def verdict(self, exponent: Spread) -> str:
        """Is it so in every run, in none, or in some?"""
        if self.at_least <= exponent.low and exponent.high <= self.at_most:
            return "confirmed"
        if exponent.high < self.at_least or exponent.low > self.at_most:
            return "not confirmed"
        return "undecided, runs disagree"

    def finding(self, sweep: Sweep, start: int = 0) -> str:
        """The verdict, with the measured exponent from value number ``start`` on."""
        exponent = sweep.slope(self.subject, self.part, start)
        return (
            f"Paper: {self.text}. {self.verdict(exponent).capitalize()}: the time of "
            f"{self.subject} ({self.part}) grows as {sweep.quantity}^{exponent.text}, from "
            f"{sweep.values[start]:,} to {sweep.values[-1]:,}."
        )


def _triangle_findings(sweep: Sweep) -> list[str]:
    hybrid, path_tracing = HYBRID.name, ONE_LEVEL_PATH.name
    claims = [
        Claim("rendering by environment mapping will not increase much", hybrid, "render",
              at_most=SMALL),
        Claim("rendering by path tracing (one-level) will grow significantly", path_tracing,
              "render", at_least=SMALL),
        Claim("map generation will grow slowly", hybrid, "maps", at_most=SLOW),
        Claim("source selection is relatively independent of the scene", SOURCE_SELECTION.name,
              "render", -SMALL, SMALL),
    ]  # fmt: skip
    factors = ", ".join(
        f"{subject} {sweep.factor(subject, 'render').text}" for subject in sweep.subjects
    )
    count = f"{sweep.values[-1] / sweep.values[0]:.0f}"
    return [
        *(claim.finding(sweep) for claim in claims),
        f"With {count} times the triangles, rendering takes so many times as long: {factors}.",
    ]


def _cluster_finding(sweep: Sweep) -> str:
    maps, factor = sweep.slope(HYBRID.name, "maps"), sweep.factor(HYBRID.name, "render")
    return (
        f"One more cluster adds {maps.text} s to the maps. From {sweep.values[0]} to "
        f"{sweep.values[-1]} listed, the time of rendering changes by a factor of {factor.text}."
    )


def _resolution_findings(sweep: Sweep) -> list[str]:
    claims = [
        Claim("twice the resolution takes four times as long to generate", HYBRID.name, "maps",
              1.8, 2.2),
        Claim("rendering doesn't depend on the resolution", HYBRID.name, "render", -SMALL, SMALL),
    ]  # fmt: skip
    last_step = len(sweep.values) - 2  # below, what each map costs at any resolution counts more
    return [claims[0].finding(sweep, last_step), claims[1].finding(sweep)]


def _thread_findings(sweep: Sweep) -> list[str]:
    return [
        f"{sweep.values[-1]} threads in place of {sweep.values[0]}, {subject}: "
        + ", ".join(
            f"{part} {sweep.speed_up(subject, part).text} times as fast"
            for part in sweep.parts(subject)
            if part in ("prepare", "render")
        )
        + "."
        for subject in sweep.subjects
    ]


# ---------------------- Table and plot ----------------------


def _table(sweep: Sweep) -> Table:
    slope = "exponent" if sweep.powers else "s for one more"
    n_runs = len(sweep.measured[0][0].runs)
    return Table(
        f"Seconds, by {sweep.title}",
        ["integrator", "part", *(f"{value:,}" for value in sweep.values), "spread %", slope,
         "from … to", "last ÷ first"],
        [_row(sweep, subject, part) for subject in sweep.subjects for part in sweep.parts(subject)],
        f"Medians of {n_runs} interleaved runs, of stages without the first run, which compiles. "
        f"Spread: the greatest of greatest − least over median. From … to: {slope} of single runs. "
        "Neither compilation nor building the scene is counted.",
    )  # fmt: skip


def _row(sweep: Sweep, subject: str, part: str) -> list[str]:
    seconds = sweep.seconds(subject, part)
    medians = np.median(seconds, axis=1)
    spread = 100 * (np.ptp(seconds, axis=1) / medians).max()
    slope = sweep.slope(subject, part)
    return [
        subject,
        part,
        *(f"{median:.3f}" for median in medians),
        f"{spread:.0f}",
        f"{slope.median:.2f}",
        f"{slope.low:.2f} … {slope.high:.2f}",
        f"{sweep.factor(subject, part).median:.2f}" if medians[0] > 1e-4 else "–",
    ]


def _plot(sweeps: list[Sweep]):
    figure, axes = plot(columns=2, rows=2)
    figure.suptitle("solid: rendering, dashed: preparation, dotted: of that the maps")
    for axis, sweep in zip(axes, sweeps, strict=True):
        for index, subject in enumerate(sweep.subjects):
            _draw(axis, sweep, subject, f"C{index}")
        if sweep.powers:
            axis.set(xscale="log", yscale="log")
        else:
            axis.set_ylim(bottom=0)
        axis.set_xticks(sweep.values, [f"{value:,}" for value in sweep.values], rotation=30)
        axis.set_xticks([], minor=True)
        axis.set(xlabel=sweep.quantity, ylabel="wall time [s]")
        axis.grid(alpha=0.3, which="both")
        axis.legend(fontsize="small")
    return figure


def _draw(axis, sweep: Sweep, subject: str, color: str) -> None:
    """Rendering, preparation and maps of one subject."""
    styles = {"render": "-", "prepare": "--", "maps": ":"}
    for part in sweep.parts(subject):
        if part in styles:
            seconds = sweep.seconds(subject, part)
            median = np.median(seconds, axis=1)
            bars = np.abs(np.stack([seconds.min(axis=1), seconds.max(axis=1)]) - median)
            label = subject if part == "render" else None
            axis.errorbar(
                sweep.values, median, bars, ls=styles[part], color=color, marker="o", ms=3,
                label=label,
            )  # fmt: skip
