"""References by ``path``: three independent thirds, rendered once for each content of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import mitsuba as mi
import numpy as np

from compare.metrics import Picture, Thirds, rel_mse_of_difference
from compare.runs import render
from compare.scenes import PATH, View
from envmap_integrator.system.progress import stage
from envmap_integrator.system.storage import StorageError, read, write

PART_SPP = 64
"""References are rendered in parts, so that memory is bounded and their spread is known."""

THIRDS = ("a", "b", "c")
"""Their names in files."""

SEED = 1_000_003
"""Far from the seeds of measured runs: a shared seed would correlate their errors."""


@dataclass(frozen=True)
class Reference:
    """What pictures are judged by.

    thirds      independent pictures of ``spp`` samples per pixel each, [H, W, 3]
    part_means  mean radiance of each of their equally sampled parts
    """

    thirds: Thirds = field(repr=False)
    spp: int
    part_means: list[float] = field(repr=False)

    @property
    def picture(self) -> Picture:
        """The mean of the thirds."""
        return np.mean(self.thirds, axis=0)

    @property
    def rel_mse(self) -> float:
        """Its own error, from the differences of the thirds."""
        pairs = combinations(self.thirds, 2)
        return float(np.mean([rel_mse_of_difference(*pair) for pair in pairs])) / 6

    def numbers(self) -> dict[str, object]:
        """All but the pictures."""
        return {"spp_of_each_third": self.spp, "rel_mse": self.rel_mse, "first_seed": SEED}


def reference(view: View, spp: int, folder: Path) -> Reference:
    """Take the reference from ``folder``, or render it and leave it there."""
    path = folder / f"{view.name}-{view.content_hash()}-{spp}.exr"
    try:
        stored = read(path, "render it again")
        thirds = [np.stack([stored.parts[third][c] for c in "RGB"], axis=2) for third in THIRDS]
        return Reference(tuple(thirds), spp, stored.metadata["part_means"])
    except StorageError:
        pass
    result = _render(view, spp)
    folder.mkdir(parents=True, exist_ok=True)
    write(
        path,
        {
            name: {c: np.ascontiguousarray(third[:, :, i]) for i, c in enumerate("RGB")}
            for name, third in zip(THIRDS, result.thirds, strict=True)
        },
        {"part_means": result.part_means},
    )
    return result


def _render(view: View, spp: int) -> Reference:
    """Parts go to the thirds in turn."""
    scene = view.load()
    integrator: mi.Integrator = PATH.make(view.hides_emitters())
    part_spp = min(PART_SPP, spp)
    n_parts = 3 * max(spp // part_spp, 1)
    sums = np.zeros((3, *view.size[::-1], 3))
    means = []
    with stage(f"reference of {view.name}", total=n_parts) as advance:
        for index in range(n_parts):
            part = render(scene, integrator, part_spp, SEED + index)
            sums[index % 3] += part
            means.append(float(part.mean(dtype=np.float64)))
            advance(1)
    thirds = tuple((sums / (n_parts // 3)).astype(np.float32))
    return Reference(thirds, part_spp * n_parts // 3, means)
