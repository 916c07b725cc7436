"""What an experiment hands over, and the files made of it."""

from __future__ import annotations

import base64
import json
import os
import platform
from dataclasses import dataclass, field
from pathlib import Path

import drjit as dr
import jinja2
import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table as RichTable

import envmap_integrator
from compare.figures import exposure, png, srgb
from compare.metrics import Picture
from envmap_integrator.cli.output import write_bitmap
from envmap_integrator.system.atomic import replacing

SCHEMA = 1
"""Version of the JSON files' layout."""

WIDTH = 110
"""Of tables where no terminal sets it [characters]."""


@dataclass(frozen=True)
class Table:
    """Text under headings; ``note`` says what the reader has to know."""

    title: str
    columns: list[str]
    rows: list[list[str]]
    note: str = ""


@dataclass(frozen=True)
class Illustration:
    """A figure, and what it shows; ``name`` ends the name of its PNG file."""

    name: str
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Slider:
    """Two pictures to be wiped over each other, in the exposure of ``reference``."""

    title: str
    left: tuple[str, Picture]
    right: tuple[str, Picture]
    reference: Picture


@dataclass
class Report:
    """The outcome of one experiment.

    name      of its files
    title     what was asked
    findings  what was found, one paragraph each
    settings  everything needed to repeat it
    numbers   everything measured, as JSON takes it
    figures   plots and rows of pictures
    pictures  name → radiance, for OpenEXR files
    """

    name: str
    title: str
    settings: dict[str, object]
    findings: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: list[Illustration] = field(default_factory=list)
    sliders: list[Slider] = field(default_factory=list)
    pictures: dict[str, Picture] = field(default_factory=dict)
    numbers: dict[str, object] = field(default_factory=dict)


def write(report: Report, folder: Path) -> None:
    """Write JSON, PNG, EXR and one self-contained HTML file."""
    folder.mkdir(parents=True, exist_ok=True)
    _write_text(folder / f"{report.name}.json", json.dumps(_document(report), indent=1) + "\n")
    images = [(illustration, png(illustration.figure)) for illustration in report.figures]
    for illustration, data in images:
        with replacing(folder / f"{report.name}-{illustration.name}.png") as file:
            file.write(data)
    for name, picture in report.pictures.items():
        bitmap = mi.Bitmap(np.ascontiguousarray(picture, np.float32))
        write_bitmap(folder / f"{report.name}-{name}.exr", bitmap)
    _write_text(folder / f"{report.name}.html", _html(report, images))


def show(report: Report) -> None:
    """Print tables and findings."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    for table in report.tables:
        grid = RichTable(title=table.title, caption=table.note or None)
        for index, column in enumerate(table.columns):
            grid.add_column(column, justify="right" if index else "left")
        for row in table.rows:
            grid.add_row(*row)
        console.print(grid)
    for paragraph in report.findings:
        console.print(paragraph, highlight=False, markup=False)


def environment() -> dict[str, object]:
    """Versions and machine."""
    return {
        "versions": {
            "envmap_integrator": envmap_integrator.__version__,
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
            "llvm": ".".join(map(str, dr.detail.llvm_version())),
            "python": platform.python_version(),
        },
        "machine": {
            "platform": platform.platform(),
            "cores": os.cpu_count(),
            "threads": dr.thread_count(),
            "variant": mi.variant(),
        },
    }


def _document(report: Report) -> dict[str, object]:
    document = {
        "schema": SCHEMA,
        "experiment": report.name,
        "title": report.title,
        "settings": report.settings,
        "numbers": report.numbers,
        "findings": report.findings,
        **environment(),
    }
    return json.loads(json.dumps(document, default=_plain))


def _plain(value: object) -> object:
    """NumPy's numbers and dataclasses as JSON has them, anything else as text."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    return vars(value) if hasattr(value, "__dataclass_fields__") else str(value)


def _html(report: Report, images: list[tuple[Illustration, bytes]]) -> str:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    template = jinja2.Environment(loader=loader, autoescape=True).get_template("report.html.j2")
    sliders = []
    for slider in report.sliders:
        scale = exposure(slider.reference)
        left, right = (_embed(png(srgb(p * scale))) for _, p in (slider.left, slider.right))
        sliders.append((slider, left, right))
    return template.render(
        report=report,
        images=[(illustration.caption, _embed(data)) for illustration, data in images],
        sliders=sliders,
        settings=json.dumps(report.settings, indent=1, default=_plain),
        environment=json.dumps(environment(), indent=1),
    )


def _embed(data: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(data).decode()


def _write_text(path: Path, text: str) -> None:
    with replacing(path) as file:
        file.write(text.encode())
