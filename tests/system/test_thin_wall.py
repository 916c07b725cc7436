"""No light passes a wall without thickness between a lit room and a dark one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import pytest

from tests.helpers import Description, at, block, camera, grey, integrator, lamp, picture

pytestmark = pytest.mark.usefixtures("variant")

ALGORITHMS = ("envmap_hybrid", "source_selection", "one_level_path")
#: The dark room's pixels may be this bright, compared to the mean of the lit room's.
DARK = 1e-4
PAINT = {"type": "twosided"} | grey(0.6)


@dataclass(frozen=True)
class Rooms:
    """Two rooms in a box of 4 x 2 x 2, the lit one at positive x.

    place, turn   of the wall between them: its x, and degrees about the axes y and z
    building      degrees about the axes y and z that all is turned by
    floor         "box" for that of the box; "rectangle" or "mesh" for one under both rooms
    contents      makes the shapes in them
    scale         of all lengths
    merged        whether all shapes but the lamp are one mesh
    sensors       rooms that the scene has sensors in
    """

    place: float = 0.0
    turn: tuple[float, float] = (0.0, 0.0)
    building: tuple[float, float] = (0.0, 0.0)
    floor: str = "box"
    contents: Callable[[], list[Description]] = list
    scale: float = 1.0
    merged: bool = False
    sensors: tuple[str, ...] = ("dark", "lit")

    def load(self) -> mi.Scene:
        shapes = [{"type": "cube", "to_world": stretched(2, 1, 1)}, *self.wall(), *self.contents()]
        if self.floor != "box":
            floor = {"type": "rectangle", "to_world": at(0, 0, -0.9) @ stretched(2.1, 1.1, 1)}
            shapes.append(floor)
        paint = mi.load_dict(PAINT)
        painted = [shape | {"bsdf": paint} for shape in map(self.placed, shapes)]
        if self.floor == "mesh":
            painted[-1] = mesh_of(painted[-1], divisions=20)
        if self.merged:
            meshes = {f"shape{i}": mesh_of(shape) for i, shape in enumerate(painted)}
            painted = [{"type": "merge"} | meshes]
        parts = {f"shape{i}": shape for i, shape in enumerate(painted)}
        parts["lamp"] = self.placed(lamp(1.1, 0, 0.95, half_width=0.3))
        sensors = {f"{room} sensor": self.sensor_in(room) for room in self.sensors}
        return mi.load_dict({"type": "scene"} | parts | sensors, optimize=False)

    def wall(self) -> list[Description]:
        """A rectangle that pierces the box, so that nothing passes its rim, in a frame.

        Where it doesn't meet the box at right angles, rays start from points so near the acute
        corner, lifted off the box, that they start beyond the wall: the frame covers these.
        """
        pose = at(self.place, 0, 0) @ turned(self.turn)
        upright = mi.ScalarTransform4f().rotate([0, 1, 0], 90) @ stretched(1.4, 1.4, 1)
        parts = [{"type": "rectangle", "to_world": pose @ upright}]
        rims = ([0, 0, 1], (0.06, 1.4, 0.06)), ([0, 1, 0], (0.06, 0.06, 1.4))
        for angle, (axis, size) in zip(self.turn, rims, strict=True):
            for side in (1, -1) if angle else ():
                rim = side / np.cos(np.radians(angle)) * np.array(axis)
                parts.append({"type": "cube", "to_world": pose @ at(*rim) @ stretched(*size)})
        return parts

    def placed(self, shape: Description) -> Description:
        return shape | {"to_world": self.pose() @ shape["to_world"]}

    def pose(self) -> mi.ScalarTransform4f:
        return turned(self.building) @ stretched(*[self.scale] * 3)

    def sensor_in(self, room: str) -> Description:
        """It sees the wall, and the floor before it."""
        side = {"lit": 1, "dark": -1}[room]
        points = (1.85 * side, 0.2, 0.4), (0.2 * side, 0, -0.4)
        origin, target = (np.ravel(self.pose() @ mi.ScalarPoint3f(*p)).tolist() for p in points)
        return camera(origin=origin, target=target)


def stretched(x: float, y: float, z: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().scale([x, y, z])


def turned(angles: tuple[float, float]) -> mi.ScalarTransform4f:
    about_y, about_z = angles
    tilt = mi.ScalarTransform4f().rotate([0, 1, 0], about_y)
    return mi.ScalarTransform4f().rotate([0, 0, 1], about_z) @ tilt


def mesh_of(shape: Description, divisions: int = 1) -> mi.Mesh:
    """The triangles of a cube or a rectangle, without anything else."""
    n = divisions
    y, x = np.mgrid[-1 : 1 : (n + 1) * 1j, -1 : 1 : (n + 1) * 1j]
    sheet = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    a, b, c, d = corner, corner + 1, corner + n + 2, corner + n + 1
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    sheets = [sheet]
    if shape["type"] == "cube":
        sheets = [np.roll(sheet + [0, 0, s], axis, axis=1) for axis in range(3) for s in (1, -1)]
    faces = np.concatenate([faces + i * len(sheet) for i in range(len(sheets))])
    vertices = np.concatenate(sheets) @ np.array(shape["to_world"].matrix)[:3, :3].T
    vertices += np.array(shape["to_world"].matrix)[:3, 3]

    properties = mi.Properties()
    properties["bsdf"] = shape["bsdf"]
    mesh = mi.Mesh("mesh", len(vertices), len(faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def near() -> list[Description]:
    """Blocks on the floor close to the wall, on both sides."""
    return [block(-0.5, 0.3, -0.7, 0.2), block(0.5, 0.1, -0.7, 0.2)]


def furniture() -> list[Description]:
    """These blocks, and a beam and a block that the wall cuts."""
    beam = {"type": "cube", "to_world": at(0.05, -0.3, -0.4) @ stretched(0.5, 0.15, 0.1)}
    return [*near(), beam, block(0.02, 0.7, -0.8, 0.25)]


#: A place on no round coordinate, and turns by no right angle.
ODD, LEANING, ASKEW, BOTH = 0.137, (20, 0), (0, 20), (15, 20)

# Scenes of equally many shapes of each kind share their kernels.
CASES = {
    "empty": Rooms(ODD),
    "empty-turned-building": Rooms(building=BOTH),
    "upright": Rooms(ODD, contents=furniture),
    "upright-at-the-origin": Rooms(contents=furniture),
    "leaning": Rooms(turn=LEANING, contents=near),
    "askew": Rooms(turn=ASKEW, contents=near),
    "turned-building": Rooms(contents=furniture, building=BOTH),
    "tiny": Rooms(ODD, contents=furniture, scale=1e-2),
    "huge": Rooms(contents=furniture, building=ASKEW, scale=1e3),
    "sensor-in-the-dark-room-alone": Rooms(ODD, contents=furniture, sensors=("dark",)),
    "sensor-in-the-dark-room-of-the-turned-building-alone": Rooms(
        contents=furniture, building=BOTH, sensors=("dark",)
    ),
    "floor-of-one-rectangle": Rooms(ODD, floor="rectangle", contents=furniture),
    "floor-of-a-mesh": Rooms(floor="mesh", contents=furniture, building=ASKEW),
    "merged": Rooms(ODD, floor="rectangle", contents=furniture, merged=True),
    "merged-turned-building": Rooms(contents=furniture, building=BOTH, merged=True),
}


@pytest.fixture(scope="module", params=CASES)
def rooms(request, variant) -> tuple[mi.Scene, float]:
    """A scene, and the mean radiance that a sensor in its lit room sees."""
    case = CASES[request.param]
    scene = case.load()
    assert len(scene.shapes()) == 2 or not case.merged
    lit = mi.load_dict(case.sensor_in("lit"))
    return scene, float(picture(scene, integrator("path"), sensor=lit).mean())


def test_the_rooms_are_tight(rooms):
    """Else the other tests would mean nothing: ``path`` finds no light in the dark room."""
    scene, lit = rooms
    assert lit > 0.1
    assert not picture(scene, integrator("path"), spp=128).any()


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_dark_room_is_dark(rooms, name, artefacts):
    """Of 10⁷ rays one slips past a rim, also with ``path``, but not twice in the same pixel."""
    scene, lit = rooms
    pictures = [picture(scene, integrator(name), spp=64, seed=seed) / lit for seed in (1, 2)]
    dark = np.minimum(*pictures)
    artefacts["dark"] = dark
    assert dark.max() < DARK
    assert np.mean(pictures) < 0.1 * DARK


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("rooms", ["upright"], indirect=True)
def test_the_lit_room_is_lit(rooms, name):
    """What keeps the dark room dark takes no light from the lit one."""
    scene, lit = rooms
    assert picture(scene, integrator(name), sensor=1).mean() == pytest.approx(lit, rel=0.05)
