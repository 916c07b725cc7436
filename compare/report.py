"""A comparison's numbers, for people and for programs."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict
from pathlib import Path

import drjit as dr
import mitsuba as mi
from rich.console import Console
from rich.table import Table

import envmap_integrator
from compare.records import Experiment, Measurements, Result
from envmap_integrator.cli.output import replacing

WIDTH = 100
"""Of the table where no terminal sets it [characters]."""


def print_table(experiment: Experiment, results: list[Result]) -> None:
    """Print one row an integrator and, where ``path`` takes part, the speed-ups against it."""
    table = Table(
        title=f"{experiment.scene.name}, {'×'.join(map(str, experiment.size))}; times in s"
    )
    table.add_column("integrator", no_wrap=True)
    for heading in ("spp", "prepare", "render", "total", "compile", "relMSE", "bias %"):
        table.add_column(heading, justify="right", no_wrap=True)
    for result in results:
        table.add_row(
            result.integrator,
            str(result.spp),
            f"{result.prepare_s:.2f}",
            f"{result.render_s:.2f}",
            f"{result.total_s:.2f}",
            f"{result.compile_s:.1f}" if result.compile_s > 0 else "cached",
            f"{result.rel_mse:.2e}",
            f"{100 * result.bias.value:+.2f} ± {100 * result.bias.margin:.2f}",
        )
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    console.print(table)
    path = next((result for result in results if result.integrator == "path"), None)
    for result in results:
        if path and result is not path:
            console.print(_speed_up(result, path), highlight=False)


def _speed_up(result: Result, path: Result) -> str:
    """Equal samples, and an estimate at equal error: that of ``path`` falls as 1/spp."""
    faster = path.total_s / result.total_s
    text = f"{result.integrator} against path: {faster:.2f}× as fast at equal samples"
    if result.rel_mse > 0:
        equal_error = path.prepare_s + path.render_s * path.rel_mse / result.rel_mse
        text += f", about {equal_error / result.total_s:.1f}× at equal error"
    return text


def write_json(
    path: Path, experiment: Experiment, measured: list[Measurements], results: list[Result]
) -> None:
    """Write every number, seed, setting and version."""
    document = {
        "experiment": asdict(experiment),
        "results": [asdict(result) for result in results],
        "runs": [measurements.numbers() for measurements in measured],
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
        },
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(document, indent=2, default=str) + "\n")
