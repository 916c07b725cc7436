"""Grow the geometry of atrium.xml from a fixed seed.

    python scenes/make_atrium.py [--triangles 600000] [--out scenes/generated] [--seed 1994]

Writes binary PLY files (they are not committed). Same arguments, same bytes. All of
them but ``sculpture.ply`` lie more than 3 m away from the sculpture's axis: they load
the far field with triangles, the cluster in the middle stays small.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from mesh_kit import Mesh, lathe, leaf, merge, place, smooth, tube, turn, write_ply  # noqa: E402

SEED = 1994
MIN_TRIANGLES, MAX_TRIANGLES = 10_000, 1_000_000

# ---- The hall (metres, z up), as atrium.xml builds it ----
COLUMN_X, COLUMN_Y = 6.5, np.arange(-14.0, 14.1, 4.0)
GALLERY_Z, GALLERY_EDGE_X, GALLERY_HALF_LENGTH = 4.8, 6.0, 15.9
FLUTES, FLUTE_DEPTH = 12, 0.06  # per column; share of the radius
PALM_X, PALM_Y = 5.6, np.arange(-12.0, 12.1, 4.0)

# Share of the triangles; foliage takes what is left
SHARES = {
    "sculpture": 0.02,
    "columns": 0.15,
    "balusters": 0.20,
    "scrolls": 0.13,
    "planters": 0.02,
    "trunks": 0.03,
}
BLOSSOM_SHARE = 0.12  # of the leaves


def generate(
    out: str | Path = HERE / "generated", triangles: int = 600_000, seed: int = SEED
) -> dict[str, int]:
    """Write the PLY files to the folder ``out``; return the triangles per file."""
    if not MIN_TRIANGLES <= triangles <= MAX_TRIANGLES:
        allowed = f"[{MIN_TRIANGLES}, {MAX_TRIANGLES}]"
        raise ValueError(f"'triangles' must be in {allowed}, got {triangles}")
    rng = np.random.default_rng(seed)
    meshes = {
        "sculpture": sculpture(int(SHARES["sculpture"] * triangles)),
        "columns": columns(int(SHARES["columns"] * triangles)),
        "balusters": balusters(int(SHARES["balusters"] * triangles)),
        "scrolls": scrolls(int(SHARES["scrolls"] * triangles)),
        "planters": planters(int(SHARES["planters"] * triangles)),
    }
    fronds, meshes["trunks"] = palms(int(SHARES["trunks"] * triangles), rng)
    blade = leaf(1.0, 0.32, 0.25, 5, 3)
    rest = triangles - sum(len(mesh[3]) for mesh in meshes.values())
    count = rest // len(blade[3])
    blossoms = int(BLOSSOM_SHARE * count)
    ivy = int(0.35 * count)
    size = (30_000 / max(count, 1)) ** 0.25  # fewer leaves are larger leaves
    on_palms = palm_leaves(blade, fronds, count - blossoms - ivy, size, rng)
    meshes["foliage"] = merge([on_palms, hanging(blade, ivy, size, rng)])
    meshes["blossoms"] = hanging(blade, blossoms, 0.7 * size, rng)

    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    for name, mesh in meshes.items():
        write_ply(out / f"{name}.ply", mesh)
    return {name: len(mesh[3]) for name, mesh in meshes.items()}


# ---- Many copies of one mesh, with a budget ----


def scatter(mesh: Mesh, matrices: np.ndarray, offsets: np.ndarray) -> Mesh:
    """Copies of ``mesh`` under ``matrices [n, 3, 3]`` (uniform scale) and ``offsets [n, 3]``."""
    n, vertices = len(offsets), len(mesh[0])
    positions = np.einsum("nij,vj->nvi", matrices, mesh[0]) + offsets[:, None]
    normals = np.einsum("nij,vj->nvi", matrices, mesh[1])
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    faces = mesh[3][None] + vertices * np.arange(n)[:, None, None]
    return (
        positions.reshape(-1, 3),
        normals.reshape(-1, 3),
        np.tile(mesh[2], (n, 1)),
        faces.reshape(-1, 3),
    )


def copies(mesh: Mesh, offsets: np.ndarray) -> Mesh:
    """Unrotated copies of ``mesh``."""
    return scatter(mesh, np.broadcast_to(np.eye(3), (len(offsets), 3, 3)), offsets)


def split(budget: float, aspect: float, least: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) of a quad grid with about ``budget`` triangles, rows = aspect * columns."""
    across = max(least[1], int(np.sqrt(budget / 2 / aspect)))
    return max(least[0], int(budget / 2 / across)), across


def subset(places: np.ndarray, budget: int, least_triangles: int) -> np.ndarray:
    """As many evenly spread places as a small budget pays for."""
    count = min(len(places), max(1, budget // least_triangles))
    return places[np.linspace(0, len(places) - 1, count).round().astype(int)]


# ---- The parts ----


def sculpture(budget: int) -> Mesh:
    """A (2, 3) torus knot that stands on the plinth; the only mesh of the near field."""
    rows, around = split(min(budget, 24_000), 8.0, (48, 6))
    t = np.linspace(0, 2 * np.pi, rows + 1)
    radius = 0.42 + 0.19 * np.cos(3 * t)
    path = np.stack([radius * np.cos(2 * t), 0.24 * np.sin(3 * t), radius * np.sin(2 * t)], -1)
    path[-1] = path[0]
    return place(
        tube(path, 0.095 + 0.03 * np.sin(3 * t) ** 2, around), np.eye(3), np.array([0, 0, 1.90])
    )


def columns(budget: int) -> Mesh:
    """Fluted columns on both floors, with base, entasis and capital."""
    spots = np.array([(sx * COLUMN_X, y, 0.0) for sx in (-1, 1) for y in COLUMN_Y])
    shafts = []
    for foot, height in ((0.0, GALLERY_Z - 0.2), (GALLERY_Z + 0.001, 5.0)):
        rows, around = split(budget / (2 * len(spots)), 0.2, (4, 6))
        if around >= FLUTES:
            around -= around % FLUTES  # the flutes' edges meet vertices
        capital = [(0.36, 1), (0.36, 0.965), (0.27, 0.93), (0.246, 0.89), (0.245, 0.80)]
        outline = smooth(capital + [(0.27, 0.4), (0.29, 0.10), (0.38, 0.05), (0.40, 0)], rows + 1)
        shaft = lathe(outline * [1, height], around)
        positions, normals, uv, faces = shaft
        angle = np.arctan2(positions[:, 1], positions[:, 0])
        inside = (positions[:, 2] > 0.10 * height) & (positions[:, 2] < 0.90 * height)
        if around >= 6 * FLUTES:  # enough triangles to show flutes: r(angle) = r0 (1 - depth)
            wave = np.sin(FLUTES / 2 * angle) * inside
            depth = FLUTE_DEPTH * np.abs(wave)
            slope = FLUTE_DEPTH * FLUTES / 2 * np.cos(FLUTES / 2 * angle) * np.sign(wave.round(6))
            tangent = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], -1)
            positions = positions * (1 - depth[:, None] * [1, 1, 0])
            normals = normals + slope[:, None] * tangent
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        shafts.append(copies((positions, normals, uv, faces), spots + [0, 0, foot]))
    return merge(shafts)


def balusters(budget: int) -> Mesh:
    """Turned balusters along both galleries, under the handrails of atrium.xml."""
    y = np.arange(-GALLERY_HALF_LENGTH + 0.2, GALLERY_HALF_LENGTH - 0.1, 0.22)
    spots = np.array(
        [(sx * (GALLERY_EDGE_X + 0.15), v, GALLERY_Z + 0.01) for sx in (-1, 1) for v in y]
    )
    spots = subset(spots, budget, 60)
    rows, around = split(budget / len(spots), 1.6, (5, 6))
    outline = [(0.05, 0.9), (0.05, 0.86), (0.03, 0.80), (0.028, 0.62), (0.06, 0.30)]
    outline += [(0.065, 0.20), (0.03, 0.09), (0.055, 0.04), (0.055, 0)]
    return copies(lathe(smooth(outline, rows + 1), around), spots)


def scrolls(budget: int) -> Mesh:
    """A frieze of spiral scrolls on the gallery's edge, each a swept, tapering tube."""
    y = np.arange(-15.3, 15.4, 0.6)
    spots = np.array(
        [(sx * (GALLERY_EDGE_X - 0.03), v, GALLERY_Z - 0.25) for sx in (-1, 1) for v in y]
    )
    spots = subset(spots, budget, 96)
    rows, around = split(budget / len(spots), 6.0, (12, 4))
    t = np.linspace(0, 1, rows + 1)
    angle, radius = 1.5 * np.pi - 5.2 * np.pi * t, 0.24 * (1 - 0.85 * t)
    path = np.stack(
        [0 * t, 0.30 * (1 - t) ** 4 + radius * np.cos(angle), radius * np.sin(angle)], -1
    )
    return copies(tube(path, 0.030 * (1 - 0.6 * t), around), spots)


def planters(budget: int) -> Mesh:
    """A big terracotta pot under every palm."""
    spots = np.array([(sx * PALM_X, y, 0.002) for sx in (-1, 1) for y in PALM_Y])
    rows, around = split(budget / len(spots), 0.7, (5, 6))
    outline = [(0.0, 0.62), (0.36, 0.62), (0.38, 0.72), (0.44, 0.72)]  # soil, rim
    outline += [(0.44, 0.62), (0.34, 0.12), (0.28, 0.0)]
    t = np.linspace(0, len(outline) - 1, rows + 1)
    table = np.array(outline)
    profile = np.stack([np.interp(t, np.arange(len(outline)), table[:, i]) for i in (0, 1)], -1)
    return copies(lathe(profile, around), spots)


def palms(budget: int, rng: np.random.Generator) -> tuple[np.ndarray, Mesh]:
    """Trunks, and the fronds' curves ``[fronds, 16, 3]`` that carry the leaflets."""
    spots = [(sx * PALM_X, y) for sx in (-1, 1) for y in PALM_Y]
    rows, around = split(budget / len(spots), 3.0, (4, 5))
    trunks, fronds = [], []
    for x, y in spots:
        height, lean = rng.uniform(1.5, 2.3), rng.uniform(-0.18, 0.18, 2)
        top = np.array([x + lean[0], y + lean[1], 0.62 + height])
        middle = (x + 0.2 * lean[0], y + 0.2 * lean[1], 0.6 + 0.5 * height)
        path = smooth([(x, y, 0.60), middle, top], rows + 1)
        rings = 1 + 0.12 * np.sin(np.linspace(0, 14 * np.pi, rows + 1))
        trunks.append(tube(path, np.linspace(0.11, 0.07, rows + 1) * rings, around))
        for k in range(18):
            azimuth, rise = 2.39996 * k + rng.uniform(-0.2, 0.2), rng.uniform(0.2, 1.3)
            reach, t = rng.uniform(1.2, 1.7), np.linspace(0, 1, 16)
            out = reach * t
            z = rise * t - (0.45 + 0.5 * rise) * t**2.2
            fronds.append(top + np.stack([out * np.cos(azimuth), out * np.sin(azimuth), z], -1))
    return np.array(fronds), merge(trunks)


def palm_leaves(
    blade: Mesh, fronds: np.ndarray, count: int, size: float, rng: np.random.Generator
) -> Mesh:
    """Leaflets on both sides of the fronds."""
    t = rng.uniform(0.08, 1.0, count)
    frond = rng.integers(len(fronds), size=count)
    at = t * (fronds.shape[1] - 1)
    i = np.minimum(at.astype(int), fronds.shape[1] - 2)
    start, end = fronds[frond, i], fronds[frond, i + 1]
    step = end - start
    azimuth = np.arctan2(step[:, 1], step[:, 0])
    side = rng.choice([-1.0, 1.0], count)
    azimuth += side * (0.95 - 0.45 * t)
    tilt = rng.uniform(-0.5, 0.15, count)
    length = 0.42 * size * np.sin(np.pi * (0.15 + 0.8 * t)) * rng.uniform(0.8, 1.2, count)
    matrices = turn(azimuth, tilt, 0.5 * side) * length[:, None, None]
    return scatter(blade, matrices, start + (at - i)[:, None] * step)


def hanging(blade: Mesh, count: int, size: float, rng: np.random.Generator) -> Mesh:
    """Ivy (or blossoms) that trails from the galleries in tufts of strands."""
    strands = 260
    tufts = rng.uniform(-15.0, 15.0, 40)
    strand_y = rng.choice(tufts, strands) + rng.normal(0, 0.30, strands)
    strand_y = np.clip(strand_y, -15.7, 15.7)
    strand_x = rng.choice([-1.0, 1.0], strands) * (
        GALLERY_EDGE_X - rng.uniform(0.06, 0.16, strands)
    )
    drop = rng.uniform(0.3, 1.9, strands)
    k = rng.choice(strands, count, p=drop / drop.sum())
    depth = drop[k] * rng.uniform(0, 1, count) ** 1.2
    sway = 0.05 * np.sin(5 * depth + k)
    points = np.stack([strand_x[k] + sway, strand_y[k] + 0.7 * sway, GALLERY_Z + 0.12 - depth], -1)
    azimuth, tilt = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1.2, 0.1, count)
    length = 0.11 * size * rng.uniform(0.7, 1.3, count)
    return scatter(blade, turn(azimuth, tilt, 0 * tilt) * length[:, None, None], points)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--triangles", type=int, default=600_000, help="10000 to 1000000 (default 600000)"
    )
    parser.add_argument(
        "--out", type=Path, default=HERE / "generated", help="default: scenes/generated"
    )
    parser.add_argument("--seed", type=int, default=SEED)
    arguments = parser.parse_args()
    try:
        counts = generate(arguments.out, arguments.triangles, arguments.seed)
    except ValueError as error:
        parser.error(str(error))
    for name, count in counts.items():
        print(f"{name + '.ply':16s} {count:9,d} triangles")
    print(f"{'total':16s} {sum(counts.values()):9,d} triangles in {arguments.out}")


if __name__ == "__main__":
    main()
