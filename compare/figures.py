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

PANEL_WIDTH = 4.0
"""Inches."""

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
    row_height = PANEL_WIDTH * height / width + 0.35
    figure = Figure(figsize=(PANEL_WIDTH * columns, row_height * rows), layout="constrained")
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
    scale = exposure(reference)
    for axis, (title, picture) in zip(axes, pictures.items(), strict=False):
        axis.imshow(srgb(picture * scale))
        axis.set_title(title)
    error_axes = axes[len(pictures) : count]
    for axis, (title, picture) in zip(error_axes, errors.items(), strict=True):
        image = axis.imshow(
            signed_error(picture, reference), cmap="RdBu_r", vmin=-ERROR_LIMIT, vmax=ERROR_LIMIT
        )
        axis.set_title(title)
    if errors:
        figure.colorbar(image, ax=list(error_axes), shrink=0.8, label="relative error")
    for axis in axes:
        axis.set_axis_off()
    return figure


def plot(width: float = 6.0, height: float = 4.5, columns: int = 1) -> tuple[Figure, NDArray]:
    """A figure with a row of empty axes."""
    figure = Figure(figsize=(width * columns, height), layout="constrained")
    return figure, np.ravel(figure.subplots(1, columns, squeeze=False))


def png(image: Figure | NDArray[np.uint8], dpi: float = 100) -> bytes:
    """A figure, or 8-bit sRGB values [H, W, 3], as a PNG file."""
    buffer = io.BytesIO()
    if isinstance(image, Figure):
        image.savefig(buffer, dpi=dpi)
        buffer.seek(0)
        image, buffer = np.array(Image.open(buffer).convert("RGB")), io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
