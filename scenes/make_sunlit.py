"""Write a room that the sun shines into, with a table and chairs on legs of metal.

    python scenes/make_sunlit.py [--metals steel paint] [--out scenes/generated]

Brushed steel throws caustics that are found by chance only, a few samples of them very bright:
fireflies. Painted metal is diffuse and throws none. Same arguments, same bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

HERE = Path(__file__).resolve().parent

METALS = ("steel", "paint")

ROOM = """\
<!-- Made by make_sunlit.py. Units: metres, z up. Room: [-3, 3] x [-2.5, 2.5] x [0, 2.8].

     `metal` is the material of the legs: steel (caustics) or paint (none).
     Two windows without glass in the wall at x = 3; the sun shines through them onto the floor. -->
<scene version="3.0.0">
    <default name="integrator" value="path"/>
    <default name="resx"       value="640"/>
    <default name="resy"       value="480"/>
    <default name="spp"        value="64"/>
    <default name="metal"      value="{metal}"/>

    <integrator type="$integrator"/>

    <sensor type="perspective" id="camera">
        <float name="fov" value="68"/>
        <transform name="to_world">
            <lookat origin="-2.7, -2.2, 1.5" target="0.6, 0.6, 0.6" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resx"/>
            <integer name="height" value="$resy"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="box"/>
        </film>
    </sensor>

    <emitter type="sunsky" id="sky">
        <vector name="sun_direction" x="0.8" y="0.25" z="0.5"/>
    </emitter>

    <bsdf type="diffuse" id="plaster"> <rgb name="reflectance" value="0.75, 0.72, 0.68"/> </bsdf>
    <bsdf type="diffuse" id="boards"> <rgb name="reflectance" value="0.45, 0.32, 0.2"/> </bsdf>
    <bsdf type="diffuse" id="beech"> <rgb name="reflectance" value="0.6, 0.45, 0.3"/> </bsdf>
    <bsdf type="diffuse" id="paint"> <rgb name="reflectance" value="0.5, 0.5, 0.5"/> </bsdf>
    <bsdf type="roughconductor" id="steel">
        <string name="material" value="Cr"/>
        <float name="alpha" value="0.05"/>
    </bsdf>
"""

BOX = """\
    <shape type="cube" id="{name}">
        <transform name="to_world">
            <scale x="{0:.3f}" y="{1:.3f}" z="{2:.3f}"/>
            <translate x="{3:.3f}" y="{4:.3f}" z="{5:.3f}"/>
            {turned}
        </transform>
        <ref id="{material}"/>
    </shape>
"""

LEG = """\
    <shape type="cylinder" id="{name}">
        <point name="p0" x="{x:.3f}" y="{y:.3f}" z="0"/>
        <point name="p1" x="{x:.3f}" y="{y:.3f}" z="{height:.3f}"/>
        <float name="radius" value="{radius:.3f}"/>
        <transform name="to_world"> {turned} </transform>
        <ref id="$metal"/>
    </shape>
"""

#: Corners of boxes: lowest and highest x, y, z. The wall at x = 3 leaves two windows open.
WALLS = {
    "floor": (-3.1, -2.6, -0.1, 3.1, 2.6, 0),
    "ceiling": (-3.1, -2.6, 2.8, 3.1, 2.6, 2.9),
    "wall-west": (-3.1, -2.6, 0, -3, 2.6, 2.8),
    "wall-south": (-3, -2.6, 0, 3, -2.5, 2.8),
    "wall-north": (-3, 2.5, 0, 3, 2.6, 2.8),
    "wall-below": (3, -2.6, 0, 3.1, 2.6, 0.8),
    "wall-above": (3, -2.6, 2.3, 3.1, 2.6, 2.8),
    "pier-south": (3, -2.6, 0.8, 3.1, -1.8, 2.3),
    "pier-middle": (3, -0.3, 0.8, 3.1, 0.3, 2.3),
    "pier-north": (3, 1.8, 0.8, 3.1, 2.6, 2.3),
}
#: Where chairs stand, m, and how far they are turned, degrees.
CHAIRS = ((-0.7, -1.2, 15), (0.6, -1.3, -20), (-0.5, 1.1, 170), (0.8, 1.0, 200), (1.7, -0.2, 80))


def box(name, corners, material, turned="") -> str:
    """A block between two corners, as XML."""
    low, high = corners[:3], corners[3:]
    half = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
    centre = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    return BOX.format(*half, *centre, name=name, material=material, turned=turned)


def on_legs(name, half_x, half_y, height, radius, turned) -> str:
    """A board [m] on four legs at its corners."""
    corners = (-half_x, -half_y, height, half_x, half_y, height + 0.03)
    parts = [box(f"{name}-board", corners, "beech", turned)]
    inset = 2 * radius
    for i in range(4):
        x, y = (half_x - inset) * (i % 2 * 2 - 1), (half_y - inset) * (i // 2 * 2 - 1)
        parts.append(
            LEG.format(
                name=f"{name}-leg-{i + 1}", x=x, y=y, height=height, radius=radius, turned=turned
            )
        )
    return "".join(parts)


def chair(name, x, y, angle) -> str:
    """A seat on legs with a back."""
    turned = f'<rotate z="1" angle="{angle}"/> <translate x="{x}" y="{y}"/>'
    back = box(f"{name}-back", (-0.2, -0.22, 0.6, 0.2, -0.19, 0.9), "beech", turned)
    return on_legs(name, 0.21, 0.21, 0.45, 0.015, turned) + back


def scene(metal: str) -> str:
    """The scene, as Mitsuba's XML."""
    parts = [ROOM.format(metal=metal)]
    for name, corners in WALLS.items():
        parts.append(box(name, corners, "boards" if name == "floor" else "plaster"))
    parts.append(on_legs("table", 0.9, 0.5, 0.72, 0.03, ""))
    for i, place in enumerate(CHAIRS):
        parts.append(chair(f"chair-{i + 1}", *place))
    return "".join(parts) + "</scene>\n"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--metals", nargs="+", choices=METALS, default=METALS)
    parser.add_argument(
        "--out", type=Path, default=HERE / "generated", help="default: scenes/generated"
    )
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for metal in arguments.metals:
        path = arguments.out / f"sunlit-{metal}.xml"
        path.write_text(scene(metal), encoding="utf-8")
        print(path)


if __name__ == "__main__":
    main()
