"""The paper's section 3 on its mirror: what the experiments of Figures 6 and 7 share.

The room of ``scenes/paper_room.xml`` has space for cubes of 2.5 times the table's radius, the paper
goes to 14. So the room is enlarged around the table, and the camera is close to the table, as in
the paper.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from compare.figures import panels
from compare.metrics import Estimate, error_floor, estimate, rel_mse
from compare.options import JudgedOptions, option
from compare.references import Reference
from compare.regions import Mask, crop, first_hits, within
from compare.report import Illustration, Table
from compare.runs import Measurements, Task, interleave
from compare.scenes import PAPER_CLUSTER, PAPER_ROOM, PAPER_TABLE, Subject, View

FOOT = (0.0, 0.3, 0.0)
"""Point on the floor under the table that keeps its place when the room is enlarged [m]."""

CAMERA = {"origin": (-0.45, -1.25, 1.75), "target": (0.03, 0.25, 0.78), "up": (0, 0, 1)}
"""Close to the table, in metres of the room that isn't enlarged."""

LOOKUPS = ("plain", "corrected")


@dataclass(frozen=True)
class Options(JudgedOptions):
    """What both experiments are told."""

    spp: int = option("samples per pixel", 64, 16)
    patches: int = option("budget of patches of the coarse mesh", 16384, 2048)
    bake_samples: int = option("rays per texel, a power of two (paper: 1)", 1)
    bake_shadow_samples: int = option("shadow rays of each (paper: 16)", 16, 4)
    enlargement: float = option("of the room around the table", 6.0)


@dataclass(frozen=True)
class MirrorView(View):
    """The paper's room, its table top a perfect mirror, the room enlarged around the table.

    It is the table that shrinks towards ``FOOT``, and the camera with it, which gives the same
    picture.

    enlargement   size of the room over the size in the scene file
    """

    enlargement: float = 1.0

    def load(self) -> mi.Scene:
        scene = super().load()
        parameters = mi.traverse(scene)
        shrink = _shrink(1 / self.enlargement)
        for shape in PAPER_TABLE:
            if f"{shape}.to_world" in parameters:
                placed = mi.Transform4f(parameters[f"{shape}.to_world"].matrix)
                parameters[f"{shape}.to_world"] = shrink @ placed
            else:
                corners = dr.unravel(mi.Point3f, parameters[f"{shape}.vertex_positions"])
                parameters[f"{shape}.vertex_positions"] = dr.ravel(shrink @ corners)
        origin, target = (shrink @ mi.Point3f(CAMERA[end]) for end in ("origin", "target"))
        parameters["camera.to_world"] = mi.Transform4f().look_at(origin, target, CAMERA["up"])
        parameters.update()
        return scene

    def content_hash(self) -> str:
        changes = repr((super().content_hash(), self.enlargement, FOOT, CAMERA))
        return hashlib.blake2b(changes.encode(), digest_size=10).hexdigest()


def _shrink(factor: float) -> mi.Transform4f:
    """Scaling about ``FOOT``."""
    move = mi.Transform4f().translate(mi.Vector3f(FOOT))
    return move @ mi.Transform4f().scale(factor) @ move.inverse()


def mirror_view(options: Options) -> MirrorView:
    """Ids are needed, so meshes aren't merged."""
    return MirrorView(
        PAPER_ROOM,
        options.width,
        {"table": "table-specular"},
        merge_meshes=False,
        enlargement=options.enlargement,
    )


def subject(lookup: str, resolution: int, ratio: float, options: Options) -> Subject:
    """The paper's set-up: one cluster, whose mirror reads the map as all else does."""
    baker = {
        "type": "envmap_bake",
        "samples": options.bake_samples,
        "shadow_samples": options.bake_shadow_samples,
    }
    settings = {
        "lookup": lookup,
        "mirrors": "map",
        "irradiance_filter": False,
        "map_resolution": resolution,
        "distance_ratio": ratio,
        "patches": options.patches,
        "baker": baker,
        "table": PAPER_CLUSTER,
    }
    return Subject("envmap_hybrid", settings, f"{lookup}, {resolution}, 1:{ratio:g}")


# ---------------------- Space around the table ----------------------


def table_top(scene: mi.Scene) -> Mask:
    """The region of interest: pixels that show the upper face of the table."""
    return first_hits(scene, ("table-top",), facing=(0, 0, 1))


def table_cube(scene: mi.Scene) -> tuple[np.ndarray, float]:
    """Centre of the box around the table and ball, and its radius: half the longest edge."""
    boxes = [shape.bbox() for shape in scene.shapes() if shape.id() in PAPER_TABLE]
    low = np.min([np.ravel(box.min) for box in boxes], axis=0)
    high = np.max([np.ravel(box.max) for box in boxes], axis=0)
    return (low + high) / 2, float((high - low).max()) / 2


def largest_ratio(scene: mi.Scene) -> float:
    """Distance ratio of the largest cube that leaves all walls and the ceiling outside."""
    centre, radius = table_cube(scene)
    room = scene.bbox()
    high = np.ravel(room.max) - centre
    low = centre - np.ravel(room.min)
    return float(min(*high, *low[:2]) / radius)


# ---------------------- Measuring ----------------------


@dataclass(frozen=True)
class Case:
    """All runs with one look-up at one value of what is varied.

    value           resolution of the map, or distance ratio
    error           relMSE of the whole picture
    region_error    relMSE in the pixels of the table's upper face
    floor           relMSE that is left of the whole picture without noise
    region_floor    the same in the pixels of the table's upper face
    """

    lookup: str
    value: float
    measured: Measurements = field(repr=False)
    error: Estimate
    region_error: Estimate
    floor: float
    region_floor: float

    @property
    def mean(self) -> np.ndarray:
        """Mean picture of all runs, [H, W, 3]."""
        return np.mean(self.measured.pictures(), axis=0, dtype=np.float64)

    def seconds(self, stage: str) -> float:
        """Median time of a stage, or of ``render``."""
        if stage == "render":
            return self.measured.median("render_s")
        return self.measured.stage_medians()[stage]

    def numbers(self) -> dict[str, object]:
        """For the JSON file."""
        own = {k: v for k, v in vars(self).items() if k != "measured"}
        return {
            **own,
            "stages_s": self.measured.stage_medians(),
            "render_s": self.measured.median("render_s"),
            "measurements": self.measured.numbers(),
        }


def measure_cases(
    scene: mi.Scene,
    options: Options,
    values: Sequence[float],
    make: Callable[[str, float], Subject],
    judged_by: Reference,
    mask: Mask,
) -> list[Case]:
    """Both look-ups at all values; ``make`` gives the subject of a look-up and a value."""
    kinds = [(lookup, value) for lookup in LOOKUPS for value in values]
    tasks = [Task(scene, make(*kind), options.spp) for kind in kinds]
    measured = interleave(tasks, options.runs, options.seed)
    return [_judge(*kind, one, judged_by, mask) for kind, one in zip(kinds, measured, strict=True)]


def _judge(
    lookup: str, value: float, measured: Measurements, judged_by: Reference, mask: Mask
) -> Case:
    pictures = measured.pictures()
    region = [within(picture, mask) for picture in pictures]
    region_thirds = tuple(within(third, mask) for third in judged_by.thirds)
    return Case(
        lookup=lookup,
        value=value,
        measured=measured,
        error=estimate([rel_mse(picture, judged_by.thirds) for picture in pictures]),
        region_error=estimate([rel_mse(picture, region_thirds) for picture in region]),
        floor=error_floor(pictures, judged_by.thirds),
        region_floor=error_floor(region, region_thirds),
    )


def of_lookup(cases: list[Case], lookup: str) -> list[Case]:
    """The cases of one look-up, in the order of their values."""
    return [case for case in cases if case.lookup == lookup]


# ---------------------- Tables and findings ----------------------


def time_table(cases: list[Case], title: str, heading: str) -> Table:
    """Times of all stages."""
    stages = list(cases[0].measured.stage_medians())
    rows = []
    for case in cases:
        low, high = case.measured.spread("render_s")
        rows.append(
            [f"{case.lookup}, {case.value:g}"]
            + [f"{case.seconds(stage):.2f}" for stage in stages]
            + [f"{case.seconds('render'):.2f}", f"{low:.2f} … {high:.2f}"]
            + [f"{case.measured.compile_s():.1f}"]
        )
    return Table(
        f"{title}: seconds",
        [f"look-up, {heading}", *stages, "render", "from … to", "compile"],
        rows,
        f"Medians of {len(cases[0].measured.runs)} interleaved runs.",
    )


def error_table(
    cases: list[Case],
    title: str,
    heading: str,
    judged_by: Reference,
    more: dict[str, list[str]] | None = None,
) -> Table:
    """Errors in the whole picture and on the table top; ``more`` are further columns."""
    more = more or {}
    rows = [
        [f"{case.lookup}, {case.value:g}"]
        + [f"{e.value:.2e} ± {e.margin:.0e}" for e in (case.error, case.region_error)]
        + [f"{case.floor:.1e}", f"{case.region_floor:.1e}"]
        + [column[index] for column in more.values()]
        for index, case in enumerate(cases)
    ]
    return Table(
        f"{title}: relMSE",
        [f"look-up, {heading}", "picture", "table top", "floor", "floor, table top", *more],
        rows,
        "Means over the runs with 95 % intervals. Floor: error without noise. Reference: "
        f"3 × {judged_by.spp} spp of path, relMSE {judged_by.rel_mse:.1e}, taken out of the "
        "errors.",
    )


def paper_table(
    cases: list[Case], title: str, heading: str, paper: dict[str, dict[float, int]]
) -> Table:
    """Times relative to those of the first value, beside those of the paper's Table 1.

    ``paper`` has the seconds of each value under ``maps`` and ``render``.
    """
    first = cases[0].value
    rows = []
    for value in dict.fromkeys(case.value for case in cases):
        row = [f"{value:g}"]
        for stage, theirs in paper.items():
            row.append(
                f"{theirs[value] / theirs[first]:.2f}" if {first, value} <= set(theirs) else "–"
            )
            row += [f"{ratio:.2f}" for ratio in _relative(cases, stage, value)]
        rows.append(row)
    columns = [f"{stage}, {who}" for stage in paper for who in ("paper", *LOOKUPS)]
    return Table(
        f"{title}: times over those at {first:g}, beside the paper's Table 1",
        [heading, *columns],
        rows,
        "Ratios, since machines differ: the paper's was a Silicon Graphics Indigo.",
    )


def _relative(cases: list[Case], stage: str, value: float) -> Iterator[float]:
    """Time of a stage at a value over that at the first value, for each look-up."""
    for lookup in LOOKUPS:
        first, *_ = own = of_lookup(cases, lookup)
        case = next(one for one in own if one.value == value)
        yield case.seconds(stage) / first.seconds(stage)


def render_time_range(cases: list[Case]) -> float:
    """Longest over shortest median time of rendering."""
    times = [case.seconds("render") for case in cases]
    return max(times) / min(times)


def verdict(confirmed: bool) -> str:
    """How findings put it."""
    return "confirmed" if confirmed else "not confirmed"


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Exponent of the power law that fits best."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def room_note(scene: mi.Scene, options: Options) -> str:
    """What had to be changed to have the paper's distance ratios."""
    return (
        f"The room is enlarged {options.enlargement:g} times around the table, which leaves walls "
        f"and ceiling outside cubes of up to 1:{largest_ratio(scene):.1f}; the map of a cube that "
        "holds the room would be empty. The ratio is half the edge of the table to the distance "
        "from the centre to the faces of the cube."
    )


# ---------------------- Figures ----------------------


def table_top_figures(cases: list[Case], judged_by: Reference, mask: Mask) -> list[Illustration]:
    """The table top enlarged, as in the paper's figures, and its errors; a row a look-up."""
    close = crop(judged_by.picture, mask)
    zoomed = {f"{case.lookup}, {case.value:g}": crop(case.mean, mask) for case in cases}
    columns = len(of_lookup(cases, LOOKUPS[0]))
    return [
        Illustration(
            "table-top",
            "The table top: means of all runs, and the reference.",
            panels({**zoomed, "reference": close}, close, columns=columns),
        ),
        Illustration(
            "errors",
            "Mean errors on the table top.",
            panels({}, close, zoomed, columns=columns),
        ),
    ]
