"""What a hard case is, and how an integrator is judged by it.

A case passes if every pixel is finite, not negative and no brighter than the case's scene allows,
if the mean of the picture is that of ``path``, and if no warning is given that isn't expected; or,
for input that can't be rendered, if the error is the one that is documented.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import mitsuba as mi
import numpy as np
from scipy import stats

from compare.metrics import Picture
from compare.scene_kit import Description
from envmap_integrator.cli.errors import condense
from envmap_integrator.registration import PLUGINS
from envmap_integrator.system.warned import warned

INTEGRATORS = tuple(
    name
    for name, (module, _) in PLUGINS.items()
    if module.startswith("integrators.") and name != "envmap_bake"  # shows maps, not pictures
)
"""Those that are judged: all that the package has."""

BIAS = {"source_selection": 0.04}
"""Relative error of the mean that the method may leave by default: ``source_selection`` looks at
the cache directly, at the camera's hit."""

DEFAULT_BIAS = 0.01
"""... for the others, whose light has gone at least one bounce before it comes from the cache."""

SEEDS = 12
"""Independent pictures of each mean."""

PATH_FACTOR = 4
"""Samples of ``path`` for each of ours."""

CONFIDENCE = 0.9999
"""Of the interval of the mean's error: in 300 comparisons, 3 % of correct ones would have one that
fails."""

MAPPING = "envmap_hybrid"
"""The integrator that makes maps."""


@dataclass(frozen=True, eq=False)
class Case:
    """A scene that is hard, and what must hold for its picture.

    scene        makes its description
    brightest    radiance [W/m²/sr] that no pixel may exceed
    bias         integrator → relative error of the mean that its method may leave
    precision    the widest half interval of that error with which a comparison means anything
    maps         clusters and other settings of the integrator that makes maps
    settings     of every integrator, ``path`` too
    own          of our integrators only
    spp          samples per pixel
    sensor       index
    warnings     that preparing and rendering once may give
    error        part of the message of the error that rendering ends in
    merged       let Mitsuba merge meshes
    """

    scene: Callable[[], Description]
    brightest: float = math.inf
    bias: Mapping[str, float] = field(default_factory=dict)
    precision: float = 0.02
    maps: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    own: Mapping[str, Any] = field(default_factory=dict)
    spp: int = 16
    sensor: int = 0
    warnings: int = 0
    error: str = ""
    merged: bool = False

    def allowed(self, integrator: str) -> float:
        """Relative error of the mean that the integrator's method may leave."""
        return self.bias.get(integrator, BIAS.get(integrator, DEFAULT_BIAS))

    def load(self) -> mi.Scene:
        return mi.load_dict(self.scene(), optimize=self.merged)

    def integrator(self, name: str) -> mi.Integrator:
        """``path`` or one of ours, with its defaults but for what the case is about."""
        if name == "path":
            return mi.load_dict({"type": name, **self.settings})
        maps = self.maps if name == MAPPING else {}
        return mi.load_dict({"type": name, **self.settings, **self.own, **maps})


@dataclass(frozen=True)
class Verdict:
    """What an integrator made of a case.

    bias, margin   relative error of the mean, and half its confidence interval
    lowest, highest, brightest   [W/m²/sr] of the pixels, and what they may be at most
    problems       what is wrong, in words; none if the case is passed
    """

    integrator: str
    allowed: float = math.nan
    bias: float = math.nan
    margin: float = math.nan
    lowest: float = math.nan
    highest: float = math.nan
    brightest: float = math.inf
    error: str = ""
    problems: tuple[str, ...] = ()
    picture: Picture | None = field(default=None, repr=False)

    def numbers(self) -> dict[str, object]:
        """All but the picture, without what wasn't measured."""
        return {
            name: value
            for name, value in vars(self).items()
            if name != "picture" and not (isinstance(value, float) and not math.isfinite(value))
        }


# ---------------------- Judging ----------------------


def judge(case: Case, integrator: str) -> Verdict:
    """Render the case and see whether all holds that must."""
    if case.error:
        return _judge_error(case, integrator)
    scene, path = reference(case)
    with listening() as heard:
        ours = case.integrator(integrator)
        first = _render(scene, ours, case, 0)
    problems = []
    if len(heard) > case.warnings:
        problems.append(f"{len(heard)} warnings, {case.warnings} expected: {heard[0]}")
    with listening() as heard:
        pictures = [first] + [_render(scene, ours, case, seed) for seed in range(1, SEEDS)]
    if len(heard) > case.warnings * (SEEDS - 1):
        problems.append(f"{len(heard)} warnings in later renders: {heard[0]}")
    return _verdict(case, integrator, np.stack(pictures), path, problems)


def _verdict(case: Case, integrator: str, ours: Picture, path: Picture, problems) -> Verdict:
    allowed = case.allowed(integrator)
    n_wrong = int((~np.isfinite(ours)).sum())
    lowest, highest = float(np.nanmin(ours)), float(np.nanmax(ours))
    bias, margin = relative_difference(ours, path)
    if n_wrong:
        problems.append(f"{n_wrong} values aren't finite")
    if lowest < 0:
        problems.append(f"pixels down to {lowest:g}")
    if highest > case.brightest:
        problems.append(f"pixels up to {highest:g}, {case.brightest:g} is possible")
    if margin > case.precision:
        problems.append(f"too noisy to tell: ± {margin:.2%}, {case.precision:.2%} needed")
    if not abs(bias) <= allowed + margin:
        problems.append(f"mean off by {bias:+.2%} ± {margin:.2%}, {allowed:.2%} allowed")
    return Verdict(
        integrator, allowed, bias, margin, lowest, highest, case.brightest,
        problems=tuple(problems), picture=ours.mean(axis=0),
    )  # fmt: skip


def relative_difference(ours: Picture, path: Picture) -> tuple[float, float]:
    """Of the means of two stacks of pictures, and half its confidence interval (Welch)."""
    ours, path = (stack.mean(axis=(1, 2, 3), dtype=np.float64) for stack in (ours, path))
    scale = path.mean()
    if scale == 0:
        return (0.0, 0.0) if not ours.any() else (math.inf, 0.0)
    difference = float(ours.mean() / scale - 1)
    if np.ptp(ours) == np.ptp(path) == 0:
        return difference, 0.0
    test = stats.ttest_ind(ours / scale, path / scale, equal_var=False)
    interval = test.confidence_interval(CONFIDENCE)
    return difference, float(interval.high - interval.low) / 2


@lru_cache(maxsize=1)
def reference(case: Case) -> tuple[mi.Scene, Picture]:
    """The scene, and pictures [seed, H, W, C] of ``path``."""
    scene, path = case.load(), case.integrator("path")
    spp = PATH_FACTOR * case.spp
    return scene, np.stack([_render(scene, path, case, seed, spp) for seed in range(SEEDS)])


def _render(scene, integrator, case: Case, seed: int, spp: int = 0) -> Picture:
    image = mi.render(
        scene, integrator=integrator, spp=spp or case.spp, seed=seed, sensor=case.sensor
    )
    return np.array(image)


def _judge_error(case: Case, integrator: str) -> Verdict:
    """Is there an error, and does it name whose it is and what is wrong?"""
    try:
        scene = case.load()
        _render(scene, case.integrator(integrator), case, 0)
    except (ValueError, TypeError, RuntimeError) as error:
        text = condense(error.__cause__ or error)  # ``mi.render`` wraps what integrators raise.
    else:
        return Verdict(integrator, problems=(f'no error, expected "{case.error}"',))
    problems = []
    if case.error not in text:
        problems.append(f'the error is "{text}", expected "{case.error}"')
    if integrator not in text:
        problems.append(f'the error "{text}" doesn\'t say whose it is')
    return Verdict(integrator, error=text, problems=tuple(problems))


# ---------------------- Warnings ----------------------


@contextmanager
def listening() -> Iterator[list[str]]:
    """Collect the warnings that Mitsuba and Python give meanwhile, repeated ones too."""
    with warned() as heard:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield heard
        heard += [str(warning.message) for warning in caught]
