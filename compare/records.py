"""What a comparison is told, what it measures, and what it concludes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from compare.metrics import Estimate, Picture


@dataclass(frozen=True)
class Experiment:
    """What is compared; everything needed to repeat it."""

    scene: Path
    integrators: tuple[str, ...]
    spp: int
    reference_spp: int
    size: tuple[int, int]
    runs: int
    seed: int
    variant: str


@dataclass
class Measurements:
    """All runs of one integrator; lists have one entry a run, ``_s`` are seconds.

    ``late_compile_s`` is compilation that the warm-up missed and that a timed run includes.
    """

    integrator: str
    settings: str = ""
    compile_s: float = 0.0
    late_compile_s: list[float] = field(default_factory=list)
    prepare_s: list[float] = field(default_factory=list)
    stages_s: list[dict[str, float]] = field(default_factory=list)
    render_s: list[float] = field(default_factory=list)
    seeds: list[int] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list, repr=False)

    def numbers(self) -> dict[str, object]:
        """All but the pictures."""
        return {key: value for key, value in vars(self).items() if key != "pictures"}


@dataclass(frozen=True)
class Result:
    """What the table shows of one integrator: medians over its runs."""

    integrator: str
    spp: int
    prepare_s: float
    render_s: float
    total_s: float
    compile_s: float
    rel_mse: float
    rel_mse_runs: list[float]
    bias: Estimate
