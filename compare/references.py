"""References by ``path``: two independent halves, rendered once for each content of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from compare.metrics import Picture, rel_mse_of_difference
from compare.runs import render
from compare.scenes import PATH, View
from envmap_integrator.progress import stage
from envmap_integrator.storage import StorageError, read, write

PART_SPP = 64
"""References are rendered in parts, so that memory is bounded and their spread is known."""

SEED = 1_000_003
"""Far from the seeds of measured runs: a shared seed would correlate their errors."""


@dataclass(frozen=True)
class Reference:
    """What pictures are judged by.

    half_a, half_b  independent pictures of ``spp`` samples per pixel each, [H, W, 3]
    part_means      mean radiance of each of their equally sampled parts
    """

    half_a: Picture = field(repr=False)
    half_b: Picture = field(repr=False)
    spp: int
    part_means: list[float] = field(repr=False)

    @property
    def picture(self) -> Picture:
        """The mean of both halves."""
        return (self.half_a + self.half_b) / 2

    @property
    def rel_mse(self) -> float:
        """Its own error, from the difference of the halves."""
        return rel_mse_of_difference(self.half_a, self.half_b) / 4

    def numbers(self) -> dict[str, object]:
        """All but the pictures."""
        return {"spp_of_each_half": self.spp, "rel_mse": self.rel_mse, "first_seed": SEED}


def reference(view: View, spp: int, folder: Path) -> Reference:
    """Take the reference from ``folder``, or render it and leave it there."""
    path = folder / f"{view.name}-{view.content_hash()}-{spp}.exr"
    try:
        stored = read(path, "render it again")
        halves = [np.stack([stored.parts[half][c] for c in "RGB"], axis=2) for half in ("a", "b")]
        return Reference(*halves, spp, stored.metadata["part_means"])
    except StorageError:
        pass
    result = _render(view, spp)
    folder.mkdir(parents=True, exist_ok=True)
    halves = {"a": result.half_a, "b": result.half_b}
    write(
        path,
        {
            name: {c: np.ascontiguousarray(half[:, :, i]) for i, c in enumerate("RGB")}
            for name, half in halves.items()
        },
        {"part_means": result.part_means},
    )
    return result


def _render(view: View, spp: int) -> Reference:
    """Parts with even indices make up one half, those with odd indices the other."""
    scene = view.load()
    integrator: mi.Integrator = PATH.make(view.hides_emitters())
    part_spp = min(PART_SPP, spp)
    n_parts = 2 * max(spp // part_spp, 1)
    sums = [np.zeros((*view.size[::-1], 3)), np.zeros((*view.size[::-1], 3))]
    means = []
    with stage(f"reference of {view.name}", total=n_parts) as advance:
        for index in range(n_parts):
            part = render(scene, integrator, part_spp, SEED + index)
            sums[index % 2] += part
            means.append(float(part.mean(dtype=np.float64)))
            advance(1)
    halves = [(total / (n_parts // 2)).astype(np.float32) for total in sums]
    return Reference(*halves, part_spp * n_parts // 2, means)
