"""The side-by-side picture: each integrator, the reference, the signed error of the first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from compare.metrics import Picture, signed_error
from compare.records import Measurements
from envmap_integrator.cli.output import replacing

WHITE_PERCENTILE = 97
"""Share of pixels that the common exposure keeps below white [%]."""

ERROR_LIMIT = 0.25
"""Relative error at full saturation: blue is too dark, red too bright."""

PANEL_WIDTH = 4.0
"""Inches."""


def write_comparison(path: Path, measured: list[Measurements], reference: Picture) -> None:
    """Draw one picture of each integrator; the error panel averages all runs, to show bias."""
    exposure = 1 / max(float(np.percentile(reference.max(axis=2), WHITE_PERCENTILE)), 1e-12)
    panels = [(m.integrator, m.pictures[0]) for m in measured] + [("reference", reference)]

    height, width = reference.shape[:2]
    size = (PANEL_WIDTH * (len(panels) + 1), PANEL_WIDTH * height / width + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, len(panels) + 1)
    for axis, (title, picture) in zip(axes, panels, strict=False):
        axis.imshow(_srgb(picture * exposure))
        axis.set_title(title)
    subject = measured[0]
    error = signed_error(np.mean(subject.pictures, axis=0), reference)
    image = axes[-1].imshow(error, cmap="RdBu_r", vmin=-ERROR_LIMIT, vmax=ERROR_LIMIT)
    axes[-1].set_title(f"{subject.integrator} − reference, relative")
    figure.colorbar(image, ax=axes[-1], shrink=0.8)
    for axis in axes:
        axis.set_axis_off()
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=max(100, width / PANEL_WIDTH))


def _srgb(radiance: Picture) -> NDArray[np.float32]:
    """Transfer function of IEC 61966-2-1, clipped to [0, 1]."""
    linear = np.clip(radiance, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
