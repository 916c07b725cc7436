"""Write an open-plan office: eight workplaces in two rows, each a group of furniture by itself.

    python scenes/make_office.py [--out scenes/generated]

Writes ``office.xml`` and the meshes that it names. Same bytes each time.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from mesh_kit import lathe, leaf, merge, place, smooth, tube, turn, write_ply  # noqa: E402

SEED = 1994
#: Of the room, m, z up from the floor.
LENGTH, WIDTH, HEIGHT = 14.0, 8.0, 2.9
#: Of the workplaces' middles.
COLUMNS, ROWS = np.array([-5.1, -1.7, 1.7, 5.1]), np.array([-1.9, 2.0])

SCENE = """\
<!-- Made by make_office.py. Units: metres, z up. Room: 14 x 8 x 2.9. -->
<scene version="3.0.0">
    <default name="integrator" value="path"/>
    <default name="resx"       value="640"/>
    <default name="resy"       value="400"/>
    <default name="spp"        value="64"/>

    <integrator type="$integrator"/>

    <sensor type="perspective" id="camera">
        <float name="fov" value="72"/>
        <transform name="to_world">
            <lookat origin="-6.7, -3.6, 2.3" target="0, 0.4, 0.7" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resx"/>
            <integer name="height" value="$resy"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="box"/>
        </film>
    </sensor>

"""

DIFFUSE = {
    "plaster": (0.75, 0.74, 0.70),
    "carpet": (0.32, 0.33, 0.36),
    "tiles": (0.80, 0.80, 0.78),
    "screen-cloth": (0.25, 0.38, 0.50),
    "chair-cloth": (0.55, 0.16, 0.12),
    "case": (0.06, 0.06, 0.07),
    "paper": (0.78, 0.76, 0.70),
    "clay": (0.55, 0.27, 0.17),
    "leaf": (0.14, 0.34, 0.09),
    "lamp": (0.70, 0.70, 0.70),
}

OTHERS = """\
    <bsdf type="roughplastic" id="desk-top">
        <rgb name="diffuse_reflectance" value="0.50, 0.36, 0.22"/> <float name="alpha" value="0.2"/>
    </bsdf>
    <bsdf type="roughconductor" id="steel">
        <string name="material" value="Cr"/> <float name="alpha" value="0.15"/>
    </bsdf>
    <bsdf type="plastic" id="glaze">
        <rgb name="diffuse_reflectance" value="0.70, 0.70, 0.65"/>
    </bsdf>

"""


def block(name: str, low, high, material: str) -> str:
    """A block between two corners."""
    middle, half = (np.add(low, high) / 2, np.subtract(high, low) / 2)
    return (
        f'    <shape type="cube" id="{name}">\n        <transform name="to_world"> '
        '<scale x="{:.4f}" y="{:.4f}" z="{:.4f}"/> '.format(*half)
        + '<translate x="{:.4f}" y="{:.4f}" z="{:.4f}"/> </transform>\n'.format(*middle)
        + f'        <ref id="{material}"/>\n    </shape>\n'
    )


def mesh(name: str, file: str, at, angle: float, material: str) -> str:
    """A mesh of a file, turned about z and moved."""
    return (
        f'    <shape type="ply" id="{name}">\n'
        f'        <string name="filename" value="{file}"/>\n        <transform name="to_world"> '
        f'<rotate z="1" angle="{angle:.1f}"/> '
        + '<translate x="{:.4f}" y="{:.4f}" z="{:.4f}"/> </transform>\n'.format(*at)
        + f'        <ref id="{material}"/>\n    </shape>\n'
    )


def lamp(name: str, x: float, y: float, half_x: float, half_y: float) -> str:
    """A panel under the ceiling that faces down."""
    return (
        f'    <shape type="rectangle" id="{name}">\n        <transform name="to_world"> '
        f'<scale x="{half_x}" y="{half_y}"/> <rotate x="1" angle="180"/> '
        f'<translate x="{x}" y="{y}" z="{HEIGHT - 0.02}"/> </transform>\n'
        '        <ref id="lamp"/>\n        <emitter type="area"> '
        '<rgb name="radiance" value="7, 6.8, 6.3"/> </emitter>\n    </shape>\n'
    )


def room() -> list[str]:
    """Walls, floor, ceiling, six panels of light, and a cupboard along one wall."""
    x, y, thick = LENGTH / 2, WIDTH / 2, 0.2
    parts = [
        block("floor", (-x, -y, -thick), (x, y, 0), "carpet"),
        block("ceiling", (-x, -y, HEIGHT), (x, y, HEIGHT + thick), "tiles"),
        block("wall-left", (-x - thick, -y, 0), (-x, y, HEIGHT), "plaster"),
        block("wall-right", (x, -y, 0), (x + thick, y, HEIGHT), "plaster"),
        block("wall-front", (-x, -y - thick, 0), (x, -y, HEIGHT), "plaster"),
        block("wall-back", (-x, y, 0), (x, y + thick, HEIGHT), "plaster"),
        block("cupboard", (-6.2, 3.55, 0), (6.2, 3.98, 0.85), "paper"),
    ]
    for i, lamp_x in enumerate((-4.6, 0.0, 4.6)):
        for j, lamp_y in enumerate((-1.9, 2.0)):
            parts.append(lamp(f"panel-{2 * i + j}", lamp_x, lamp_y, 0.9, 0.15))
    return parts


def workplace(n: int, x: float, y: float, rng: np.random.Generator) -> list[str]:
    """A desk with what stands on it, a chair, a screen behind it and a plant or a bin."""
    low = np.array([x, y, 0.0])

    def at(*p):
        return low + p

    def box(name, a, b, material):
        return block(f"{name}-{n}", at(*a), at(*b), material)

    parts = [
        box("top", (-0.8, -0.4, 0.70), (0.8, 0.4, 0.74), "desk-top"),
        box("side-a", (-0.78, -0.38, 0), (-0.74, 0.38, 0.70), "paper"),
        box("side-b", (0.74, -0.38, 0), (0.78, 0.38, 0.70), "paper"),
        box("screen", (-0.95, 0.46, 0), (0.95, 0.50, 1.35), "screen-cloth"),
        box("monitor", (-0.30, 0.16, 0.86), (0.30, 0.20, 1.22), "case"),
        box("stand", (-0.03, 0.18, 0.74), (0.03, 0.22, 0.90), "steel"),
        box("keyboard", (-0.22, -0.22, 0.74), (0.22, -0.08, 0.765), "case"),
    ]
    height = 0.74
    for i in range(rng.integers(2, 6)):
        thick = rng.uniform(0.01, 0.04)
        corner = rng.uniform((0.42, -0.28), (0.50, -0.20))
        a, b = (*corner, height), (*corner + (0.21, 0.30), height + thick)
        parts.append(box(f"paper{i}", a, b, "paper"))
        height += thick
    seat = rng.uniform((-0.25, -1.0), (0.25, -0.75))
    angle = rng.uniform(-40, 40)
    parts.append(mesh(f"chair-{n}", "office-chair.ply", at(*seat, 0), angle, "chair-cloth"))
    parts.append(mesh(f"foot-{n}", "office-foot.ply", at(*seat, 0), rng.uniform(0, 72), "steel"))
    mug = rng.uniform((-0.6, -0.3), (-0.4, -0.1))
    parts.append(mesh(f"mug-{n}", "office-mug.ply", at(*mug, 0.74), rng.uniform(0, 360), "glaze"))
    spot = (-0.6, 0.2, 0.74) if n % 2 else (1.05, -0.2, 0.0)
    parts.append(mesh(f"pot-{n}", "office-pot.ply", at(*spot), 0, "clay"))
    parts.append(mesh(f"plant-{n}", "office-plant.ply", at(*spot), rng.uniform(0, 360), "leaves"))
    return parts


def meshes(rng: np.random.Generator) -> dict:
    """What the workplaces share."""
    blade = leaf(0.30, 0.05, 0.12, 9, 5)
    up = np.array([0, 0, 0.16])
    fronds = [
        place(blade, turn(a, e), up + rng.uniform(-0.02, 0.02, 3))
        for a, e in zip(rng.uniform(0, 6.28, 60), rng.uniform(0.1, 1.4, 60), strict=True)
    ]
    pad = smooth(
        np.array([[0.001, 0.52], [0.18, 0.52], [0.23, 0.49], [0.20, 0.45], [0.001, 0.45]]), 24
    )
    back = lathe(pad, 48)
    upright = place(back, np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([0, 0.30, 0.78]))
    legs = [
        tube(np.array([[0, 0, 0.10], [0.28 * np.cos(a), 0.28 * np.sin(a), 0.04]]), 0.018, 16)
        for a in 2 * np.pi * np.arange(5) / 5
    ]
    post = tube(np.array([[0, 0, 0.06], [0, 0, 0.46]]), 0.025, 24)
    arm = tube(
        smooth(np.array([[0, -0.05, 0.47], [0, -0.24, 0.52], [0, -0.27, 0.78]]), 16), 0.015, 16
    )
    cup = np.array(
        [[0.001, 0.008], [0.034, 0.01], [0.036, 0.09], [0.041, 0.09], [0.04, 0.0], [0.001, 0.0]]
    )
    handle = tube(
        smooth(np.array([[0.038, 0, 0.08], [0.07, 0, 0.06], [0.038, 0, 0.02]]), 16), 0.006, 12
    )
    pot = np.array(
        [[0.001, 0.13], [0.07, 0.13], [0.075, 0.15], [0.085, 0.15], [0.06, 0.0], [0.001, 0.0]]
    )
    return {
        "office-plant.ply": merge(fronds),
        "office-chair.ply": merge([back, upright]),
        "office-foot.ply": merge([*legs, post, arm]),
        "office-mug.ply": merge([lathe(cup, 48), handle]),
        "office-pot.ply": lathe(pot, 48),
    }


def scene() -> str:
    """The scene, as Mitsuba's XML."""
    rng = np.random.default_rng(SEED)
    parts = [SCENE]
    for name, colour in DIFFUSE.items():
        value = ", ".join(map(str, colour))
        parts.append(
            f'    <bsdf type="diffuse" id="{name}"> '
            f'<rgb name="reflectance" value="{value}"/> </bsdf>\n'
        )
    parts.append('    <bsdf type="twosided" id="leaves"> <ref id="leaf"/> </bsdf>\n')
    parts += [OTHERS, *room()]
    for n, (x, y) in enumerate((x, y) for y in ROWS for x in COLUMNS):
        parts += workplace(n, x, y, rng)
    return "".join(parts) + "</scene>\n"


def generate(out: Path = HERE / "generated") -> Path:
    """Write the scene and its meshes to a folder; returns the scene's path."""
    out.mkdir(parents=True, exist_ok=True)
    for name, one in meshes(np.random.default_rng(SEED)).items():
        write_ply(out / name, one)
    path = out / "office.xml"
    path.write_text(scene(), encoding="utf-8")
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out", type=Path, default=HERE / "generated", help="default: scenes/generated"
    )
    print(generate(parser.parse_args().out))
