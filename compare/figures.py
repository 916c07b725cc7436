"""Pictures and plots, as matplotlib figures."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from compare.metrics import Picture, signed_error

WHITE_PERCENTILE = 97
"""Share of pixels that the common exposure keeps below white [%]."""

ERROR_LIMIT = 0.25
"""Relative error at full saturation: blue is too dark, red too bright."""

PANEL_WIDTH = 2.6
"""Inches; at 100 dots an inch, pictures of the usual width are shown about pixel by pixel."""

PLOT_WIDTH, PLOT_HEIGHT = 6.0, 4.5
"""Of the axes of a plot [inches]."""

COLUMNS = 4
"""Panels in a row."""


def exposure(reference: Picture) -> float:
    """Factor that all pictures of a scene are shown with."""
    return 1 / max(float(np.percentile(reference.max(axis=2), WHITE_PERCENTILE)), 1e-12)


def srgb(radiance: Picture) -> NDArray[np.uint8]:
    """Transfer function of IEC 61966-2-1, 8 bits a channel, clipped."""
    linear = np.clip(np.nan_to_num(radiance), 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)


def panels(
    pictures: Mapping[str, Picture],
    reference: Picture,
    errors: Mapping[str, Picture] | None = None,
    columns: int = COLUMNS,
) -> Figure:
    """Pictures in the reference's exposure, then signed errors of ``errors`` against it."""
    errors = errors or {}
    count = len(pictures) + len(errors)
    columns = min(columns, count)
    rows = -(-count // columns)
    height, width = reference.shape[:2]
    row_height = PANEL_WIDTH * height / width + 0.3
    figure = Figure(figsize=(PANEL_WIDTH * columns, row_height * rows), layout="constrained")
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
    scale = exposure(reference)
    for axis, (title, picture) in zip(axes, pictures.items(), strict=False):
        axis.imshow(srgb(picture * scale), interpolation="nearest")
        axis.set_title(title, fontsize="small")
    error_axes = axes[len(pictures) : count]
    for axis, (title, picture) in zip(error_axes, errors.items(), strict=True):
        image = axis.imshow(
            signed_error(picture, reference),
            cmap="RdBu_r",
            vmin=-ERROR_LIMIT,
            vmax=ERROR_LIMIT,
            interpolation="nearest",
        )
        axis.set_title(title, fontsize="small")
    if errors:
        figure.colorbar(image, ax=list(axes), shrink=0.6, aspect=40, label="relative error")
    for axis in axes:
        axis.set_axis_off()
    return figure


def plot(columns: int = 1, rows: int = 1) -> tuple[Figure, NDArray]:
    """A figure with empty axes, row by row."""
    figure = Figure(figsize=(PLOT_WIDTH * columns, PLOT_HEIGHT * rows), layout="constrained")
    return figure, np.ravel(figure.subplots(rows, columns, squeeze=False))


def png(image: Figure | NDArray[np.uint8]) -> bytes:
    """A figure, or 8-bit sRGB values [H, W, 3], as a PNG file."""
    buffer = io.BytesIO()
    if isinstance(image, Figure):
        image.savefig(buffer, dpi=100)
        image = np.array(Image.open(buffer).convert("RGB"))
        buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
