"""Numbers as pictures, and pictures as text that pages hold."""

from __future__ import annotations

import base64

import mitsuba as mi
import numpy as np

#: Pixels along a side of a picture on a page at most.
MOST_PIXELS = 960
#: Part of the pixels that exposures keep below white.
WHITE = 0.97
#: Colours of a scale from its low to its high end, sRGB: those of matplotlib's viridis.
RAMP = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64
)


def embedded(picture: np.ndarray) -> str:
    """The URI that holds a picture [H, W, 3 or 4] of 8 bits a channel, as PNG."""
    pixel_format = {3: mi.Bitmap.PixelFormat.RGB, 4: mi.Bitmap.PixelFormat.RGBA}[picture.shape[2]]
    bitmap = mi.Bitmap(np.ascontiguousarray(picture, np.uint8), pixel_format)
    bitmap.set_srgb_gamma(True)
    stream = mi.MemoryStream()
    bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    return "data:image/png;base64," + base64.b64encode(stream.raw_buffer()).decode()


def shrunk(picture: np.ndarray) -> np.ndarray:
    """A picture [H, W, C] of ``MOST_PIXELS`` at most: means over squares of pixels."""
    height, width, channels = picture.shape
    step = -(-max(height, width) // MOST_PIXELS)
    height, width = max(height // step, 1), max(width // step, 1)
    tiles = picture[: height * step, : width * step]
    return tiles.reshape(height, step, width, step, channels).mean(axis=(1, 3))


def white_of(picture: np.ndarray) -> float:
    """What is shown as white of a picture [H, W, C], by the brightness of most of its pixels."""
    brightest = picture.max(axis=2)
    lit = brightest[brightest > 0]
    return float(np.quantile(lit, WHITE)) if len(lit) else 1.0


def tone_mapped(picture: np.ndarray, white: float) -> np.ndarray:
    """Linear values [..., C] in sRGB of 8 bits; ``white`` and all above become white."""
    linear = np.clip(np.nan_to_num(picture) / white, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return eight_bits(encoded)


def eight_bits(colours: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] that are sRGB already."""
    return np.round(255 * np.clip(np.nan_to_num(colours), 0, 1)).astype(np.uint8)


def on_ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Positive values [...] as colours of ``RAMP`` [..., 3], 8 bits, by their logarithms."""
    place = np.log(np.clip(values, low, high) / low) / np.log(high / low) * (len(RAMP) - 1)
    stops = np.arange(len(RAMP))
    colours = [np.interp(place, stops, channel) for channel in RAMP.T]
    return np.round(np.stack(colours, axis=-1)).astype(np.uint8)


def ramp_css() -> str:
    """The ramp as a CSS background."""
    stops = ", ".join(f"rgb({', '.join(f'{c:g}' for c in colour)})" for colour in RAMP)
    return f"linear-gradient(to right, {stops})"
