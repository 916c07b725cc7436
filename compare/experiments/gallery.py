"""All hard cases: what each integrator makes of them, against stated bounds and path.

The tests judge the same cases, so a run that finds a problem is a test that fails.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from compare import gallery
from compare.figures import exposure, srgb
from compare.gallery import INTEGRATORS, Case, Verdict, judge, reference
from compare.hard_cases import CASES
from compare.metrics import Picture
from compare.options import option
from compare.report import Illustration, Report, Table
from envmap_integrator.system.progress import stage

TILE = 72, 54
"""Width and height of a picture on the sheet [dots]."""

LABEL, GAP = 16, 12
"""Height of a case's name, and space beside it [dots]."""

COLUMNS = 3
"""Cases in a row of the sheet."""


@dataclass(frozen=True)
class Options:
    match: str = option("regular expression; only cases with such names are judged", "")


def run(options: Options, folder: Path) -> Iterator[Report]:
    """Judge the cases; nothing else is written to the folder."""
    cases = {name: case for name, case in CASES.items() if re.search(options.match, name)}
    if not cases:
        raise ValueError(f'--match: no case is called "{options.match}"')
    verdicts: dict[str, dict[str, Verdict]] = {}
    pictures: dict[str, list[Picture]] = {}
    with stage("hard cases", total=len(cases)) as advance:
        for name, case in cases.items():
            verdicts[name] = {integrator: judge(case, integrator) for integrator in INTEGRATORS}
            shown = [verdict.picture for verdict in verdicts[name].values()]
            if all(picture is not None for picture in shown):
                pictures[name] = [reference(case)[1].mean(axis=0), *shown]
            advance(1)
    yield _report(options, cases, verdicts, pictures)


def _report(options, cases, verdicts, pictures) -> Report:
    rendered = [name for name, case in cases.items() if not case.error]
    report = Report(
        name="gallery",
        title="Hard cases against bounds and path",
        settings={
            "seeds": gallery.SEEDS,
            "confidence": gallery.CONFIDENCE,
            "path_factor": gallery.PATH_FACTOR,
            **asdict(options),
        },
        numbers={
            name: {one: verdict.numbers() for one, verdict in of.items()}
            for name, of in verdicts.items()
        },
    )
    report.tables.append(
        Table(
            "Pictures",
            ["case", "bound", *INTEGRATORS],
            [_row(name, cases[name], verdicts[name]) for name in rendered],
            "Bound: radiance that no pixel may exceed. Then the brightest pixel, and how far the "
            "mean is off that of path [%], with half its interval; in brackets, the bias that the "
            f"method may leave. {gallery.SEEDS} seeds, {gallery.CONFIDENCE:.2%} intervals.",
        )
    )
    refused = [[name, verdicts[name][INTEGRATORS[0]].error] for name in cases if cases[name].error]
    report.tables.append(Table("Errors", ["case", "message"], refused))
    problems = [
        f"{name}, {one}: {problem}"
        for name, of in verdicts.items()
        for one, verdict in of.items()
        for problem in verdict.problems
    ]
    report.findings = [
        f"{len(cases)} cases for {len(INTEGRATORS)} integrators, {len(problems)} problems.",
        *problems,
    ]
    if pictures:
        caption = "Each case by path, " + ", ".join(INTEGRATORS) + "."
        report.figures.append(Illustration("sheet", caption, _sheet(pictures)))
    return report


def _row(name: str, case: Case, verdicts: dict[str, Verdict]) -> list[str]:
    return [name, f"{case.brightest:.3g}", *(_measured(v) for v in verdicts.values())]


def _measured(verdict: Verdict) -> str:
    mark = " !" if verdict.problems else ""
    bias, margin, allowed = (
        100 * value for value in (verdict.bias, verdict.margin, verdict.allowed)
    )
    return f"{verdict.highest:.3g}; {bias:+.2f} ± {margin:.2f} ({allowed:g}){mark}"


# ---------------------- The sheet ----------------------


def _sheet(pictures: dict[str, list[Picture]]) -> Figure:
    """All pictures in rows, each case in the exposure of its ``path``."""
    count = len(next(iter(pictures.values())))
    width, height = count * TILE[0] + GAP, TILE[1] + LABEL
    columns = min(COLUMNS, len(pictures))
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * height, columns * width, 3), 255, np.uint8)
    figure = Figure(figsize=(columns * width / 100, rows * height / 100))
    axis = figure.add_axes((0, 0, 1, 1))
    for index, (name, shown) in enumerate(pictures.items()):
        top, left = index // columns * height, index % columns * width
        axis.text(left, top + LABEL - 4, name, fontsize=7)
        scale = exposure(shown[0][..., :3])
        for position, picture in enumerate(shown):
            x = left + position * TILE[0]
            tile = _fitted(srgb(picture[..., :3] * scale))
            sheet[top + LABEL : top + height, x : x + TILE[0]] = tile
    axis.imshow(sheet, interpolation="nearest")
    axis.set_axis_off()
    return figure


def _fitted(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image as large as a tile takes it, on grey."""
    height, width = image.shape[:2]
    scale = min(TILE[0] / width, TILE[1] / height)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    tile = Image.new("RGB", TILE, (128, 128, 128))
    picture = Image.fromarray(image).resize(size, Image.Resampling.NEAREST)
    tile.paste(picture, tuple((t - s) // 2 for t, s in zip(TILE, size, strict=True)))
    return np.array(tile)
