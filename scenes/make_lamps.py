"""Write a room that many lamps light, to see what their number costs.

    python scenes/make_lamps.py [--lamps 4 200] [--scattered] [--out scenes/generated]

Each lamp is a square that faces down. However many there are, they have the same power, area and
radiance in all. They hang in a loose grid under the ceiling, or ``--scattered`` at random places
and heights, some beside walls. Same arguments, same bytes.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent

SEED = 1994
#: Of all lamps: m², W/m²/sr.
AREA, RADIANCE = 2.0, 4.0
#: Half the edge of the room, m, and the heights at which lamps hang.
HALF, LOWEST, HIGHEST = 2.0, 0.8, 1.95

ROOM = """\
<!-- Made by make_lamps.py. Units: metres, z up. Room: [-2, 2]^3. -->
<scene version="3.0.0">
    <default name="integrator" value="path"/>
    <default name="resx"       value="640"/>
    <default name="resy"       value="480"/>
    <default name="spp"        value="64"/>

    <integrator type="$integrator"/>

    <sensor type="perspective" id="camera">
        <float name="fov" value="70"/>
        <transform name="to_world">
            <lookat origin="0, -1.9, 0.2" target="0, 1, -0.3" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resx"/>
            <integer name="height" value="$resy"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="box"/>
        </film>
    </sensor>

    <bsdf type="diffuse" id="plaster"> <rgb name="reflectance" value="0.65, 0.7, 0.7"/> </bsdf>
    <bsdf type="diffuse" id="white"> <rgb name="reflectance" value="0.7, 0.7, 0.7"/> </bsdf>
    <bsdf type="diffuse" id="red"> <rgb name="reflectance" value="0.6, 0.2, 0.15"/> </bsdf>

    <shape type="cube" id="room">
        <boolean name="flip_normals" value="true"/>
        <transform name="to_world"> <scale value="2"/> </transform>
        <ref id="plaster"/>
    </shape>
"""

BOX = """\
    <shape type="cube" id="box-{i}">
        <transform name="to_world">
            <scale x="0.25" y="0.25" z="{half:.3f}"/>
            <rotate z="1" angle="{turn:.1f}"/>
            <translate x="{x:.3f}" y="{y:.3f}" z="{z:.3f}"/>
        </transform>
        <ref id="{material}"/>
    </shape>
"""

LAMP = """\
    <shape type="rectangle" id="lamp-{i}">
        <transform name="to_world">
            <scale value="{half:.4f}"/>
            <rotate x="1" angle="180"/>
            <translate x="{x:.3f}" y="{y:.3f}" z="{z:.3f}"/>
        </transform>
        <ref id="white"/>
        <emitter type="area"> <rgb name="radiance" value="{radiance}"/> </emitter>
    </shape>
"""


def scene(n_lamps: int, scattered: bool = False) -> str:
    """The scene, as Mitsuba's XML."""
    if not 1 <= n_lamps <= 10_000:
        raise ValueError(f"'lamps' must be in [1, 10000], got {n_lamps}")
    rng = np.random.default_rng(SEED)
    parts = [ROOM]
    for i in range(6):
        half, turn = rng.uniform(0.2, 0.6), rng.uniform(0, 90)
        x, y = rng.uniform((-1.4, -0.6), (1.4, 1.4))
        material = ("white", "red")[i % 2]
        parts.append(
            BOX.format(i=i, half=half, turn=turn, x=x, y=y, z=half - HALF, material=material)
        )

    half = math.sqrt(AREA / n_lamps) / 2
    reach = HALF - half - 0.01
    rows = round(math.sqrt(n_lamps))
    columns = math.ceil(n_lamps / rows)
    for i in range(n_lamps):
        if scattered:
            x, y, z = rng.uniform((-reach, -reach, LOWEST), (reach, reach, HIGHEST))
        else:
            cell = np.array([i % columns, i // columns]) + rng.uniform(0.35, 0.65, 2)
            (x, y), z = reach * (2 * cell / (columns, rows) - 1), HIGHEST
        parts.append(LAMP.format(i=i, half=half, x=x, y=y, z=z, radiance=RADIANCE))
    return "".join(parts) + "</scene>\n"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lamps", type=int, nargs="+", default=[4, 200], help="1 to 10000")
    parser.add_argument("--scattered", action="store_true", help="at random places and heights")
    parser.add_argument(
        "--out", type=Path, default=HERE / "generated", help="default: scenes/generated"
    )
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for n_lamps in arguments.lamps:
        kind = "scattered-lamps" if arguments.scattered else "lamps"
        path = arguments.out / f"{kind}-{n_lamps}.xml"
        try:
            path.write_text(scene(n_lamps, arguments.scattered), encoding="utf-8")
        except ValueError as error:
            parser.error(str(error))
        print(path)


if __name__ == "__main__":
    main()
