"""Cubes drawn over what a sensor sees."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lookup.cube_map import Cluster

#: Height of a label, as a part of the picture's longer side, and width of its letters, of that.
LABEL, LETTER = 1 / 45, 0.6
#: Points along an edge: what lies outside of the picture is left out point by point.
POINTS = 96


@dataclass(frozen=True)
class Wires:
    """A cube as lines in the picture.

    lines   [K, 2] points of each, pixels from the upper left corner, and whether it's hidden behind
            surfaces
    centre  [2] where its centre is, None if that isn't in the picture
    """

    lines: list[tuple[np.ndarray, bool]]
    centre: np.ndarray | None


def wires(scene: mi.Scene, sensor: mi.Sensor, cluster: Cluster) -> Wires:
    """The twelve edges of a cluster's cube, as far as they are in the picture.

    Nothing if the sensor can't tell where a point is in its picture: only perspective ones can.
    """
    centre, half_width = cluster.centre, cluster.half_width
    corners = np.array(list(itertools.product((-1, 1), repeat=3)))
    edges = [(a, b) for a, b in itertools.combinations(corners, 2) if np.abs(a - b).sum() == 2]
    t = np.linspace(0, 1, POINTS)[None, :, None]
    begin, end = (np.array(ends)[:, None, :] for ends in zip(*edges, strict=True))
    points = np.concatenate([((1 - t) * begin + t * end).reshape(-1, 3), np.zeros((1, 3))])
    place, inside, visible = _projected(scene, sensor, centre + half_width * points)

    lines = []
    for first in range(0, len(points) - 1, POINTS):
        state = np.where(inside, 1 + visible, 0)[first : first + POINTS]
        for value, run in itertools.groupby(range(POINTS), lambda i, state=state: state[i]):
            run = list(run)
            # As far as the first point of the next run, so that there are no gaps.
            last = run[-1] + 1
            if last < POINTS and state[last]:
                run.append(last)
            if value and len(run) > 1:
                lines.append((place[first + np.array(run)], value == 1))
    return Wires(lines, place[-1] if inside[-1] else None)


def labels(
    places: dict[str, np.ndarray | None], width: int, height: int
) -> dict[str, tuple[float, float]]:
    """Middles of labels near their places: inside the picture, and apart as far as there's room.

    Those without a place have none.
    """
    size, placed = LABEL * max(width, height), {}
    for name, place in places.items():
        if place is None:
            continue
        half = np.array([LETTER * size * len(name), 1.2 * size]) / 2
        # Up and down, the nearest first.
        steps = sorted(range(-len(places), len(places) + 1), key=abs)
        tried = [place + (0, 2 * step * half[1]) for step in steps]
        tried = np.clip(tried, half, np.maximum((width, height) - half, half))
        apart = [
            all((np.abs(middle - other) >= half + its).any() for other, its in placed.values())
            for middle in tried
        ]
        placed[name] = tried[int(np.argmax(apart))], half  # The first, if there's no room.
    return {name: tuple(middle.tolist()) for name, (middle, _) in placed.items()}


def _projected(
    scene: mi.Scene, sensor: mi.Sensor, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels [N, 2] of points [N, 3], whether they are in the picture, and not behind a surface."""
    it = dr.zeros(mi.Interaction3f, len(points))
    it.p = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    try:
        ds, _ = sensor.sample_direction(it, mi.Point2f(0.5))
        seen = scene.ray_test(it.spawn_ray_to(it.p + ds.dist * ds.d))
        inside = (ds.pdf > 0) & mi.Bool(True)
        dr.eval(ds, seen, inside)
    except RuntimeError:  # Other sensors haven't got it.
        none = np.zeros(len(points), bool)
        return np.zeros((len(points), 2)), none, none
    inside = np.broadcast_to(inside.numpy(), len(points))
    return np.array(ds.uv).T.astype(np.float64), inside, ~seen.numpy()
