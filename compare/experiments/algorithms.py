"""The paper's three algorithms and path in its test room: Figure 8, Tables 2 and 3.

Rays really counted, times of all passes, errors against a path traced reference, pictures with
crops, with the paper's numbers of rays and with our defaults.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from compare.figures import panels
from compare.metrics import Picture, error_floor, estimate, mean_bias, rel_mse, signed_error, tiles
from compare.options import JudgedOptions, option
from compare.references import Reference, reference
from compare.report import Illustration, Report, Slider, Table
from compare.runs import Measurements, Task, equal_time_spp, interleave, render
from compare.scenes import PAPER_CLUSTER, PAPER_ROOM, PATH, Subject, View
from envmap_integrator.system.ray_counts import count_rays

RADIOSITY = ("coarse mesh", "direct light", "irradiance cache")
MAPS = ("clusters", "maps")
"""Stages of the pre-passes that make up the passes of Table 3."""

SECONDARY = ("secondary", "unbounded")
"""Diffuse and specular rays: integrators of ours sample both from the material."""

RAYS = {
    "primary, per pixel or texel": ("primary",),
    "shadow": ("shadow",),
    "diffuse and specular": SECONDARY,
    "… as far as a cube": ("secondary",),
    "… in full": ("unbounded",),
    "traced on beyond a cube": ("retraced",),
    "does the cluster see the texel?": ("survey",),
}
"""Rows of Table 2, and the kinds of rays that each counts."""

CROP_TILES = 8
"""Width of the picture over that of the crop around the cache's largest error."""


@dataclass(frozen=True)
class Printed:
    """What the paper prints for an algorithm.

    rays          primary, shadow, diffuse and specular rays (Table 2)
    maps_s        map generation (Table 3) [s]
    rendering_s   rendering (Table 3) [s]
    """

    rays: tuple[int, int, int]
    rendering_s: int
    maps_s: int = 0

    @property
    def total_s(self) -> int:
        """Sum of all passes; the paper prints ten minutes less than that for its own method."""
        return 9 * 60 + 45 + self.maps_s + self.rendering_s


PRINTED = {
    "envmap_hybrid": Printed((1, 16, 101), 7 * 3600 + 17 * 60 + 43, 3600 + 50 * 60 + 52),
    "source_selection": Printed((1, 16, 1), 5 * 3600 + 39 * 60 + 8),
    "one_level_path": Printed((1, 16, 101), 11 * 3600 + 17 * 60 + 36),
}
PRINTED_MAP_RAYS = (1, 16, 1)


@dataclass(frozen=True)
class Options(JudgedOptions):
    """See ``--help``."""

    spp: int = option("samples per pixel with the paper's numbers of rays (paper: 1)", 4, 1)
    shadow_samples: int = option("shadow rays at a camera hit, there (paper: 16)", 16)
    secondary_samples: int = option("secondary rays at a camera hit, there (paper: 100)", 100)
    default_spp: int = option("samples per pixel with our defaults, one ray of each kind", 64, 16)
    patches: int = option("budget of patches of the coarse mesh", 16384, 2048)
    patch_samples: int = option("gather rays per patch, a power of two", 128, 32)


@dataclass(frozen=True)
class Counts:
    """Rays of one pass: of each kind, and the pixels or texels that they are for."""

    name: str
    rays: Mapping[str, int]
    n_pixels: int
    printed: tuple[int, ...]

    def number(self, kinds: tuple[str, ...]) -> float:
        """Rays of these kinds per primary ray; primary rays per pixel."""
        base = self.n_pixels if kinds == ("primary",) else self.rays["primary"]
        return sum(self.rays[kind] for kind in kinds) / max(base, 1)


@dataclass(frozen=True)
class Block:
    """One choice of numbers of rays: what was measured, our three integrators first, path last."""

    name: str
    title: str
    measured: list[Measurements]
    counts: list[Counts]
    is_paper: bool

    def of(self, integrator: str) -> Measurements:
        """What was measured of an integrator."""
        return next(one for one in self.measured if one.subject.integrator == integrator)


def run(options: Options, folder: Path) -> Iterator[Report]:
    """A single report."""
    view = View(PAPER_ROOM, options.width, merge_meshes=False)
    scene, hidden = view.load(), view.hides_emitters()
    paper = [Task(scene, subject, options.spp) for subject in _paper_subjects(options)]
    default = [Task(scene, subject, options.default_spp) for subject in _default_subjects(options)]
    paths = [
        Task(scene, PATH, equal_time_spp(task, options.default_spp, options.seed, hidden))
        for task in (paper[0], default[0])
    ]
    tasks = [*paper, paths[0], *default, paths[1]]
    measured = interleave(tasks, options.runs, options.seed, hidden)
    n = len(paper) + 1
    blocks = [
        Block("paper", "the paper's numbers of rays", measured[:n], _count(paper, hidden), True),
        Block("default", "our defaults", measured[n:], _count(default, hidden), False),
    ]
    judged_by = reference(view, options.reference_spp, folder / "references")
    yield _report(view, scene, options, blocks, judged_by)


def _paper_subjects(options: Options) -> list[Subject]:
    """The paper's algorithms with its numbers of rays; look-ups are ours. No pixels share light."""
    shadow = _cache(options) | {"shadow_samples": options.shadow_samples}
    both: dict[str, Any] = shadow | {
        "secondary_samples": options.secondary_samples,
        "irradiance_filter": False,
    }
    return [
        Subject("envmap_hybrid", both | {"table": PAPER_CLUSTER}),
        Subject("source_selection", shadow),
        Subject("one_level_path", both),
    ]


def _default_subjects(options: Options) -> list[Subject]:
    """The same with our defaults; clusters are found automatically."""
    return [Subject(name, _cache(options)) for name in PRINTED]


def _cache(options: Options) -> dict[str, Any]:
    """All use the same irradiance cache."""
    return {"patches": options.patches, "patch_samples": options.patch_samples}


def _count(tasks: list[Task], hidden: bool) -> list[Counts]:
    """Rays of map generation, then of the rendering of each task: the first one has maps."""
    rendering, preparing = [], []
    for task in tasks:
        integrator = task.subject.make(hidden)
        with count_rays() as rays:
            prepared = integrator.prepare(task.scene, spp=task.spp)
        preparing.append((rays, prepared))
        with count_rays() as rays:
            picture = render(task.scene, integrator, task.spp, seed=0)
        name = task.subject.integrator
        n_pixels = picture.shape[0] * picture.shape[1]
        rendering.append(Counts(name, rays, n_pixels, PRINTED[name].rays))
    (with_maps, prepared), (without, _) = preparing[:2]
    maps = {kind: number - without[kind] for kind, number in with_maps.items()}
    n_texels = sum(6 * cube_map.resolution**2 for cube_map in prepared.maps)
    return [Counts("maps", maps, n_texels, PRINTED_MAP_RAYS), *rendering]


# ---------------------- Report ----------------------


def _report(
    view: View, scene: mi.Scene, options: Options, blocks: list[Block], judged_by: Reference
) -> Report:
    report = Report(
        name="algorithms",
        title="The paper's algorithms in its test room, by rays, time and error",
        settings={"scene": view, **asdict(options)},
        numbers={"reference": judged_by.numbers()},
    )
    for block in blocks:
        report.tables += [_ray_table(block), _time_table(block)]
        results = {one.subject.name: _result(one, judged_by) for one in block.measured}
        report.tables.append(_error_table(block, results, judged_by))
        report.findings += _findings(block, results)
        report.numbers[block.name] = {
            "results": results,
            "rays": {counts.name: asdict(counts) for counts in block.counts},
        }
        _illustrate(report, block, judged_by)
    _add_crops(report, scene, blocks[-1], judged_by)  # Less noise: the errors can be seen.
    return report


def _result(one: Measurements, judged_by: Reference) -> dict[str, object]:
    errors = [rel_mse(picture, judged_by.thirds) for picture in one.pictures()]
    return {
        **one.numbers(),
        "rel_mse": estimate(errors),
        "rel_mse_of_runs": errors,
        "error_floor": error_floor(one.pictures(), judged_by.thirds),
        "bias_of_mean": mean_bias(one.pictures(), judged_by.part_means),
    }


def _ray_table(block: Block) -> Table:
    """Table 2."""
    table = Table(
        f"Rays with {block.title}" + (" (paper)" if block.is_paper else ""),
        ["per primary ray", *(counts.name for counts in block.counts)],
        [],
        "Rays really traced. Lights that a surface faces away from get no shadow ray; those that "
        "mirrors and corners ask for come on top. path is Mitsuba's own, and can't be counted.",
    )
    for index, (row, kinds) in enumerate(RAYS.items()):
        cells = [f"{counts.number(kinds):.3g}" for counts in block.counts]
        if block.is_paper and index < len(PRINTED_MAP_RAYS):
            cells = [
                f"{cell} ({counts.printed[index]})"
                for cell, counts in zip(cells, block.counts, strict=True)
            ]
        table.rows.append([row, *cells])
    return table


def _time_table(block: Block) -> Table:
    """Table 3."""
    table = Table(
        f"Seconds with {block.title}; × those of one_level_path"
        + (" (paper)" if block.is_paper else ""),
        ["integrator", "spp", "radiosity", "maps", "render", "from … to", "total", "render ×",
         "total ×"],
        [],
        f"Medians of {len(block.measured[0].runs)} interleaved runs; compilation is "
        "apart. The paper's total is the sum of its passes.",
    )  # fmt: skip
    for one in block.measured:
        stages = one.stage_medians()
        low, high = one.spread("render_s")
        table.rows.append(
            [
                one.subject.name, str(one.spp), _seconds(stages, RADIOSITY), _seconds(stages, MAPS),
                f"{one.median('render_s'):.2f}", f"{low:.2f} … {high:.2f}", f"{one.total_s():.2f}",
                *(_ratio(block, one, q) for q in ("render_s", "total_s")),
            ]
        )  # fmt: skip
    return table


def _seconds(stages: Mapping[str, float], names: tuple[str, ...]) -> str:
    known = [stages[name] for name in names if name in stages]
    return f"{sum(known):.2f}" if known else "–"


def _ratio(block: Block, one: Measurements, quantity: str) -> str:
    """Time relative to one_level_path; in brackets that of the paper."""
    text = f"{one.median(quantity) / block.of('one_level_path').median(quantity):.2f}"
    printed = PRINTED.get(one.subject.integrator)
    if printed is None or not block.is_paper:
        return text
    return f"{text} ({_printed_s(printed, quantity) / _printed_s(_LONGEST, quantity):.2f})"


_LONGEST = PRINTED["one_level_path"]


def _printed_s(printed: Printed, quantity: str) -> int:
    return {"render_s": printed.rendering_s, "total_s": printed.total_s}[quantity]


def _error_table(block: Block, results: Mapping[str, dict], judged_by: Reference) -> Table:
    table = Table(
        f"Errors with {block.title}",
        ["integrator", "spp", "total s", "relMSE", "floor", "bias %"],
        [],
        f"Floor: error without noise. Reference: 3 × {judged_by.spp} spp of path, "
        f"relMSE {judged_by.rel_mse:.1e}, taken out of the errors.",
    )
    for one in block.measured:
        result = results[one.subject.name]
        error, bias = result["rel_mse"], result["bias_of_mean"]
        table.rows.append(
            [
                one.subject.name, str(one.spp), f"{one.total_s():.2f}",
                f"{error.value:.2e} ± {error.margin:.1e}", f"{result['error_floor']:.1e}",
                f"{100 * bias.value:+.2f} ± {100 * bias.margin:.2f}",
            ]
        )  # fmt: skip
    return table


def _findings(block: Block, results: Mapping[str, dict]) -> list[str]:
    hybrid = next(counts for counts in block.counts if counts.name == "envmap_hybrid").rays
    bounded = hybrid["secondary"] / max(sum(hybrid[kind] for kind in SECONDARY), 1)
    retraced = hybrid["retraced"] / max(hybrid["secondary"], 1)
    floors = ", ".join(f"{name} {results[name]['error_floor']:.1e}" for name in PRINTED)
    return [
        f"With {block.title}, {_order(block, 'render_s', 'rendering')} "
        f"{_order(block, 'total_s', 'All passes')}",
        f"With {block.title}, {100 * bounded:.0f} % of the diffuse and specular rays of "
        f"envmap_hybrid end at a cube; {100 * retraced:.1f} % of those were traced on.",
        f"With {block.title}, the errors without noise are: {floors}.",
    ]


def _order(block: Block, quantity: str, what: str) -> str:
    """Which algorithm is the fastest, and whether the paper says so too."""
    ours = sorted(PRINTED, key=lambda name: block.of(name).median(quantity))
    theirs = sorted(PRINTED, key=lambda name: _printed_s(PRINTED[name], quantity))
    verdict = "as in the paper" if ours == theirs else f"in the paper {', '.join(theirs)}"
    return f"{what} from fast to slow: {', '.join(ours)} ({verdict})."


# ---------------------- Pictures ----------------------


def _illustrate(report: Report, block: Block, judged_by: Reference) -> None:
    single = {one.subject.name: one.runs[0].picture for one in block.measured}
    pictures = {**single, "reference": judged_by.picture}
    errors = {f"{name} − reference": mean for name, mean in _means(block).items()}
    caption = f"One run of each with {block.title}, and the mean error of all runs."
    figure = panels(pictures, judged_by.picture, errors, columns=len(pictures))
    report.figures.append(Illustration(block.name, caption, figure))
    names = [("envmap_hybrid", other) for other in single if other != "envmap_hybrid"]
    report.sliders += [
        Slider(f"{left} and {right}, with {block.title}", (left, single[left]),
               (right, single[right]), judged_by.picture)
        for left, right in names
    ]  # fmt: skip
    report.pictures |= {f"{block.name}-{name}": picture for name, picture in single.items()}
    report.pictures["reference"] = judged_by.picture


def _means(block: Block) -> dict[str, Picture]:
    """Means of all runs."""
    return {one.subject.name: np.mean(one.pictures(), axis=0) for one in block.measured}


def _add_crops(report: Report, scene: mi.Scene, block: Block, judged_by: Reference) -> None:
    means = _means(block)
    whole = {**means, "reference": judged_by.picture}
    crops = _crops_of_paper(scene) | {
        "cache": (
            "Where source_selection, which reads the cache at camera hits, is off most.",
            _largest_error(means["source_selection"], judged_by.picture),
        )
    }
    for name, (caption, window) in crops.items():
        cut = {key: picture[window] for key, picture in whole.items()}
        errors = {f"{key} − reference": cut[key] for key in means}
        figure = panels(cut, cut["reference"], errors, columns=len(cut))
        caption = f"{caption} Means of all runs with {block.title}."
        report.figures.append(Illustration(f"crop-{name}", caption, figure))


Window = tuple[slice, slice]


def _crops_of_paper(scene: mi.Scene) -> dict[str, tuple[str, Window]]:
    """The places that the paper writes about: caption and window."""
    boxes = {shape.id(): shape.bbox() for shape in scene.shapes()}
    ball, table = (
        np.array([boxes[name].min, boxes[name].max]).reshape(2, 3) for name in ("ball", "table-top")
    )
    centre, radius = ball.mean(axis=0), (ball[1] - ball[0])[0] / 2
    contact = np.array([centre - [1.2 * radius, 1.2 * radius, 0], centre + 1.2 * radius])
    contact[:, 2] = ball[0, 2], centre[2]
    shadow = np.array([centre - 2.5 * radius, centre + 2.5 * radius])
    shadow[:, 1] = table[0, 1], centre[1]
    shadow[:, 2] = table[1, 2]
    return {
        "bleeding": ("Colour bleeding between ball and table.", _window(scene, contact)),
        "shadow": ("The ball's shadow on the table.", _window(scene, shadow)),
    }


def _window(scene: mi.Scene, box: np.ndarray) -> Window:
    """The pixels that a box [lowest and highest corner, 3], in world space, is seen in."""
    sensor = scene.sensors()[0]
    size = np.array(sensor.film().size())
    params = mi.traverse(sensor)
    to_film = mi.perspective_projection(
        size.tolist(), size.tolist(), [0, 0], params["x_fov"], params["near_clip"],
        params["far_clip"],
    )  # fmt: skip
    corners = mi.Point3f(*np.stack(np.meshgrid(*box.T)).reshape(3, -1))
    seen = np.array(to_film @ (sensor.world_transform().inverse() @ corners))[:2].T * size
    low = np.clip(np.floor(seen.min(axis=0)).astype(int), 0, size - 1)
    high = np.clip(np.ceil(seen.max(axis=0)).astype(int), low + 1, size)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _largest_error(picture: Picture, reference: Picture) -> Window:
    """The tile whose mean is off most."""
    edge = max(picture.shape[1] // CROP_TILES, 1)
    errors = signed_error(tiles(picture, edge), tiles(reference, edge))
    row, column = np.unravel_index(np.abs(errors).argmax(), errors.shape)
    return tuple(slice(i * edge, (i + 1) * edge) for i in (int(row), int(column)))
