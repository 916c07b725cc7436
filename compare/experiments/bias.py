"""Where the error of envmap_hybrid that is left without noise comes from.

One approximation after the other is made exact, or far finer, which gives the error that it adds:
as a signed picture, a relMSE, a share of all the error, a mean bias. Steps from the defaults to
path add up to all of it; parts split the steps into single approximations; checks must find none.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from unittest.mock import patch

import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from compare.contributions import Contribution, Ledger
from compare.figures import COLUMNS, PANEL_WIDTH, panels
from compare.metrics import Estimate, Picture, error_floor, mean_bias, signed_error, tiles
from compare.options import JudgedOptions, existing, option
from compare.references import Reference, reference
from compare.report import Illustration, Report, Table
from compare.runs import render
from compare.scenes import PAPER_ROOM, View
from compare.variants import (
    CHECKS,
    CHOICES,
    GROUPS,
    PARTS,
    SOURCES,
    STEPS,
    Source,
    Variant,
    variants,
)
from envmap_integrator.system.progress import stage
from envmap_integrator.system.ray_counts import count_rays

SCENES = (PAPER_ROOM,)

COUNTED = ("default", "masked texels trusted", "traced")
"""Variants whose rays are counted."""

PICTURE_TILES = 64
"""Width of the signed pictures in tiles: averages over them show bias where pixels show noise."""

SHOWN_PERCENTILE = 99
"""Share of tiles whose error is within the range of the colours [%]."""


@dataclass(frozen=True)
class Options(JudgedOptions):
    """See ``--help``."""

    runs: int = option("pictures of each variant, each with a seed of its own; at least 3", 16, 8)
    reference_spp: int = option("samples per pixel of each third of the reference", 4096, 1024)
    spp: int = option("samples per pixel", 64)
    patches: int = option("budget of patches of the coarse mesh", 16384)
    finer: int = option("how many times finer the finer forms are, a power of four", 16, 4)

    def __post_init__(self):
        super().__post_init__()
        if self.finer < 4 or 4 ** round(math.log(self.finer, 4)) != self.finer:
            raise ValueError(f"--finer must be a power of four from 4 on, got {self.finer}")


# ---------------------- The experiment ----------------------


@dataclass(frozen=True)
class Rendered:
    """What a variant gave.

    settings   of the integrator, as text
    pictures   one a seed
    rays       of one picture without the preparation, where they were counted
    """

    settings: str
    pictures: list[Picture] = field(repr=False)
    rays: dict[str, int] | None = None


def _render(
    scene: mi.Scene, variant: Variant, options: Options, hidden: bool, known: dict, counting: bool
) -> Rendered:
    """All seeds of a variant. The preparation has one seed; ``known`` are those made so far."""
    with ExitStack() as stack:
        for replaced in variant.replaced:
            stack.enter_context(replaced())
        integrator = variant.subject.make(hidden)
        key = integrator.settings(), variant.prepared_otherwise
        if key not in known:
            known[key] = integrator.prepare(scene, spp=options.spp)
        stack.enter_context(patch.object(integrator, "prepare", lambda *_: known[key]))
        seeds = range(options.seed, options.seed + options.runs)
        pictures = [render(scene, integrator, options.spp, seed) for seed in seeds]
        rays = None
        if counting:
            with count_rays() as rays:
                render(scene, integrator, options.spp, options.seed)
    return Rendered(str(integrator), pictures, rays)


@dataclass(frozen=True)
class Split:
    """Errors of one scene.

    whole       of the defaults, against the reference
    explained   sum of the steps
    remainder   of what the last step leads to, against the reference
    found       of each source, by its name
    missed      what the steps of a group have beyond the sum of its parts
    """

    whole: Contribution
    explained: Contribution
    remainder: Contribution
    found: dict[str, Contribution]
    missed: dict[str, Contribution]

    @property
    def is_certain(self) -> bool:
        """Without, there is nothing to have a share of."""
        return _certain(self.explained.rel_mse)

    def numbers(self) -> dict[str, object]:
        """For the JSON file."""
        return {
            "whole": self.whole.numbers(),
            "explained": self.explained.numbers(),
            "remainder": self.remainder.numbers(),
            "sources": {
                source.name: {**asdict(source), **self.found[source.name].numbers()}
                for source in SOURCES
            },
            "missed_by_parts": {group: one.numbers() for group, one in self.missed.items()},
        }


def run(options: Options, folder: Path, scenes: tuple[Path, ...] = SCENES) -> Iterator[Report]:
    """One report a scene."""
    for path in existing(scenes):
        view = View(path, options.width)
        rendered = _render_all(view, options)
        judged_by = reference(view, options.reference_spp, folder / "references")
        yield _report(view, options, rendered, judged_by)


def _render_all(view: View, options: Options) -> dict[str, Rendered]:
    scene, hidden = view.load(), view.hides_emitters()
    todo, rendered, known = variants(options.patches, options.finer), {}, {}
    with stage("variants", total=len(todo)) as advance:
        for name, variant in todo.items():
            rendered[name] = _render(scene, variant, options, hidden, known, name in COUNTED)
            advance(1)
    return rendered


def split(pictures: dict[str, list[Picture]], judged_by: Reference) -> Split:
    """Book the errors of all sources, by the pictures of each variant."""
    last = pictures[STEPS[-1].without_it[0]]
    errors = {source.name: _errors(source, pictures) for source in SOURCES}
    explained = np.subtract(pictures["default"], last, dtype=np.float64)
    ledger = Ledger(explained, judged_by)

    def total(sources: Iterable[Source], group: str) -> NDArray[np.float64]:
        return np.sum([errors[source.name] for source in sources if source.group == group], axis=0)

    return Split(
        whole=ledger.of_pictures(pictures["default"]),
        explained=ledger.of_errors(explained),
        remainder=ledger.of_pictures(last),
        found={name: ledger.of_errors(error) for name, error in errors.items()},
        missed={g: ledger.of_errors(total(STEPS, g) - total(PARTS, g)) for g in GROUPS},
    )


def _errors(source: Source, pictures: dict[str, list[Picture]]) -> NDArray[np.float64]:
    """Of each seed."""
    with_it, without_it = (
        np.sum([pictures[name] for name in names], axis=0, dtype=np.float64)
        for names in (source.with_it, source.without_it)
    )
    return with_it - without_it


def _report(
    view: View, options: Options, rendered: dict[str, Rendered], judged_by: Reference
) -> Report:
    errors = split({name: one.pictures for name, one in rendered.items()}, judged_by)
    rays = _ray_shares(rendered)
    report = Report(
        name=f"bias-{view.name}",
        title=f"{view.name}, {view.size[0]}×{view.size[1]}: where the error without noise is from",
        settings={"scene": view, **asdict(options)},
        numbers={
            **errors.numbers(),
            "shares_of_bounded_rays": rays,
            "variants": {
                name: {
                    "settings": one.settings,
                    "rays": one.rays,
                    "error_floor": error_floor(one.pictures, judged_by.thirds),
                    "bias_of_mean": mean_bias(one.pictures, judged_by.part_means),
                }
                for name, one in rendered.items()
            },
            "reference": judged_by.numbers(),
        },
    )
    report.tables = [
        _step_table(report.title, errors, judged_by),
        _part_table(errors, options),
        _other_table(errors),
    ]
    report.findings = [
        *_steps_found(errors),
        *(_parts_found(group, errors) for group in GROUPS),
        *(_check_found(source.name, errors.found[source.name]) for source in CHECKS),
        _rays_found(rays),
    ]
    _illustrate(report, errors, rendered["default"].pictures[0], judged_by.picture)
    return report


def _ray_shares(rendered: dict[str, Rendered]) -> dict[str, float]:
    """Of the rays that cubes bound, how many leave their cube, and how many are traced on."""

    def share(name: str) -> float:
        rays = rendered[name].rays
        return rays["retraced"] / max(rays["secondary"], 1)

    default, trusting, traced = (share(name) for name in COUNTED)
    return {
        "leave their cube": traced,
        "retraced": default,
        "end in masked texels": default - trusting,
    }


# ---------------------- Tables and findings ----------------------

HEADINGS = ["source", "instead", "relMSE", "share %", "left", "mean bias %"]


def _row(name: str, exact: str, one: Contribution, errors: Split) -> list[str]:
    known = one.share is not None and errors.is_certain
    return [
        name,
        exact,
        _size(one),
        _percent(one.share, 1) if known else "–",
        f"{one.left.value:.1e}" if known else "–",
        _percent(one.mean_bias, 3),
    ]


def _percent(value: Estimate, digits: int) -> str:
    return f"{100 * value.value:+.{digits}f} ± {100 * value.margin:.{digits}f}"


def _step_table(title: str, errors: Split, judged_by: Reference) -> Table:
    return Table(
        title,
        HEADINGS,
        [
            _row("all", "path", errors.whole, errors),
            *(_row(step.name, step.exact, errors.found[step.name], errors) for step in STEPS),
            _row("sum of these steps", "", errors.explained, errors),
            _row("remainder", "path", errors.remainder, errors),
        ],
        "Steps from the defaults to path; the remainder holds the cache at later hits. relMSE of "
        "each error alone and what is left of the sum without it; shares of the sum add up. Means "
        "with 95 % intervals over the seeds of rendering; noise of the preparation counts as "
        "error. Intervals leave out the noise of the reference: "
        f"3 × {judged_by.spp} spp of path, relMSE {judged_by.rel_mse:.1e}.",
    )


def _part_table(errors: Split, options: Options) -> Table:
    table = Table(
        "Parts of the steps",
        HEADINGS,
        [],
        f"More and finer: {options.finer} times. Dislocation is what is left of the maps at finer "
        "resolution and finest level. The rest is what the steps have "
        "beyond the sum of their parts.",
    )
    for group in GROUPS:
        parts = [part for part in PARTS if part.group == group]
        table.rows.extend(_row(p.name, p.exact, errors.found[p.name], errors) for p in parts)
        table.rows.append(_row(f"rest of {group}", "", errors.missed[group], errors))
    return table


def _other_table(errors: Split) -> Table:
    return Table(
        "Choices and checks",
        HEADINGS,
        [_row(one.name, one.exact, errors.found[one.name], errors) for one in (*CHOICES, *CHECKS)],
        "Of the first two neither form is exact; the third is what the defaults avoid; the last "
        "two have to be nothing but noise.",
    )


def _steps_found(errors: Split) -> Iterator[str]:
    yield (
        f"relMSE without noise {_size(errors.whole)}, mean bias "
        f"{_percent(errors.whole.mean_bias, 2)} %; of the sum of the steps "
        f"{_size(errors.explained)} and {_percent(errors.explained.mean_bias, 2)} %."
    )
    names = [one.name for one in STEPS]
    if errors.is_certain:
        largest = max(names, key=lambda name: errors.found[name].share.value)
        yield f"The largest source is {largest}: {_listed(names, errors)}."
    else:
        yield f"The sum of the steps is lost in noise. relMSE: {_listed(names, errors)}."
    unexplained = _certain(errors.remainder.rel_mse)
    yield (
        f"The remainder is {_size(errors.remainder)}, mean bias "
        f"{_percent(errors.remainder.mean_bias, 2)} %: "
        + ("the steps don't explain it." if unexplained else "nothing but noise.")
    )


def _parts_found(group: str, errors: Split) -> str:
    parts = _listed([part.name for part in PARTS if part.group == group], errors)
    if not errors.is_certain:
        return f"Parts of {group}, relMSE: {parts}."
    whole = sum(errors.found[one.name].share.value for one in STEPS if one.group == group)
    return (
        f"Parts of the {100 * whole:+.0f} % of {group}: {parts}, "
        f"rest {_percent(errors.missed[group].share, 0)} %."
    )


def _check_found(name: str, one: Contribution) -> str:
    differs = _certain(one.rel_mse) or _certain(one.mean_bias)
    return f"Check, {name}: {_size(one)}, mean bias {_percent(one.mean_bias, 3)} %, " + (
        "more than 95 % of noise would be." if differs else "nothing but noise."
    )


def _rays_found(shares: dict[str, float]) -> str:
    return (
        f"Of the rays that cubes bound, {100 * shares['leave their cube']:.1f} % leave their cube; "
        f"{100 * shares['retraced']:.1f} % are traced on since the map isn't trusted: "
        f"{100 * shares['end in masked texels']:.1f} % since they end in masked texels."
    )


def _size(one: Contribution) -> str:
    return f"{one.rel_mse.value:.1e} ± {one.rel_mse.margin:.0e}"


def _listed(names: Iterable[str], errors: Split) -> str:
    """Shares, or relMSE where there is nothing to have a share of, largest first."""
    found = {name: errors.found[name] for name in names}
    if not errors.is_certain:
        ordered = sorted(found.items(), key=lambda item: -item[1].rel_mse.value)
        return ", ".join(f"{name} {_size(one)}" for name, one in ordered)
    ordered = sorted(found.items(), key=lambda item: -item[1].share.value)
    return ", ".join(f"{name} {_percent(one.share, 0)} %" for name, one in ordered)


def _certain(value: Estimate) -> bool:
    """Does the interval leave out zero?"""
    return abs(value.value) > value.margin


# ---------------------- Figures ----------------------


def _illustrate(report: Report, errors: Split, picture: Picture, middle: Picture) -> None:
    """``picture`` is one with the defaults, ``middle`` the reference."""
    steps = {
        "all, by the steps": errors.explained,
        **{step.name: errors.found[step.name] for step in STEPS},
        "all, by path": errors.whole,
        "remainder": errors.remainder,
    }
    parts = {part.name: errors.found[part.name] for part in PARTS}
    others = {source.name: errors.found[source.name] for source in (*CHOICES, *CHECKS)}
    for name, caption, contributions in (
        ("steps", "Steps: they add up to the first picture.", steps),
        ("parts", "Parts of the steps.", parts),
        ("others", "Choices and checks.", others),
    ):
        figure = _signed_pictures(contributions, middle, errors.is_certain)
        report.figures.append(Illustration(name, caption, figure))
    both = panels({"envmap_hybrid": picture, "reference": middle}, middle)
    report.figures.append(
        Illustration("pictures", "One run with the defaults, and the reference.", both)
    )
    report.pictures = {"reference": middle} | {
        source.name.replace(" ", "-"): errors.found[source.name].picture
        for source in (*STEPS, *PARTS)
    }


def _signed_pictures(
    contributions: dict[str, Contribution], middle: Picture, with_shares: bool
) -> Figure:
    """Errors relative to the reference side by side, averages over tiles, in the same colours."""
    size = max(middle.shape[1] // PICTURE_TILES, 1)
    relative = [
        signed_error(tiles(middle + one.picture, size), tiles(middle, size))
        for one in contributions.values()
    ]
    limit = _limit(
        [e for e, one in zip(relative, contributions.values(), strict=True) if one.share]
    )
    rows = -(-len(contributions) // COLUMNS)
    height = PANEL_WIDTH * middle.shape[0] / middle.shape[1] + 0.4
    figure = Figure(figsize=(PANEL_WIDTH * COLUMNS, height * rows), layout="constrained")
    axes = np.ravel(figure.subplots(rows, COLUMNS, squeeze=False))
    for axis in axes:
        axis.set_axis_off()
    for axis, error, (name, one) in zip(axes, relative, contributions.items(), strict=False):
        image = axis.imshow(error, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
        share = f"\n{_percent(one.share, 0)} %" if with_shares and one.share else ""
        axis.set_title(name + share, fontsize="small")
    figure.colorbar(image, ax=list(axes), shrink=0.6, aspect=40, label="relative error")
    return figure


def _limit(errors: Sequence[NDArray[np.float64]]) -> float:
    """Relative error at full saturation, a round number."""
    size = max(float(np.percentile(np.abs(errors), SHOWN_PERCENTILE)), 1e-4)
    power = 10 ** math.floor(math.log10(size))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= size)
