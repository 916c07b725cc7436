"""Cube maps unfolded to crosses, as the camera looks."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..lookup.cube import direction_to_face
from ..lookup.cube_map import CubeMap
from ..system.spectrum import as_rgb
from .pictures import on_ramp, tone_mapped, white_of

#: Texels along the edge of a face of the largest level that is shown.
MOST_TEXELS = 128
#: Colours of what is no distance: where nothing is met, and where no ray of the cluster arrives.
SKY, MASKED = (255, 255, 255), (150, 150, 150)


@dataclass(frozen=True)
class Faces:
    """Which way the faces of a cross look: unit vectors [3] along axes of the world.

    ahead, up   of the face in the middle, and of the one above it
    """

    ahead: np.ndarray
    up: np.ndarray

    @staticmethod
    def of(sensor: mi.Sensor) -> Faces:
        """Those nearest to where a sensor looks, upright as its pictures are."""
        to_world = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
        up = _axis(to_world[:3, 1])
        ahead = to_world[:3, 2] * (up == 0)
        return Faces(_axis(ahead if ahead.any() else 1 - np.abs(up)), up)

    @property
    def right(self) -> np.ndarray:
        """Of the face to the right of the middle one."""
        return np.cross(self.ahead, self.up)

    def names(self) -> str:
        """The axes of the middle row, from the left, and of the faces above and below."""
        row = (-self.right, self.ahead, self.right, -self.ahead)
        words = ("left", "ahead", "right", "behind")
        listed = ", ".join(f"{w} ({_name(d)})" for w, d in zip(words, row, strict=True))
        return (
            f"middle row: {listed}; above: up ({_name(self.up)}); below: down ({_name(-self.up)})"
        )

    def cross(self, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Texels [3 * R, 4 * R, C] of a level [6, R, R, C] as a cross, and where it covers [..].

        Seen from inside the cube, each texel once.
        """
        size = level.shape[1]
        cross = np.zeros((3 * size, 4 * size, level.shape[3]), level.dtype)
        covered = np.zeros(cross.shape[:2], bool)
        right, up, ahead = self.right, self.up, self.ahead
        places = {  # Row and column, and which way the face looks, to its right, and up.
            (1, 0): (-right, ahead, up),
            (1, 1): (ahead, right, up),
            (1, 2): (right, -ahead, up),
            (1, 3): (-ahead, -right, up),
            (0, 1): (up, right, -ahead),
            (2, 1): (-up, right, ahead),
        }
        step = (np.arange(size) + 0.5) * 2 / size - 1
        for (row, column), (out, along, upwards) in places.items():
            place = np.s_[row * size : (row + 1) * size, column * size : (column + 1) * size]
            d = out + step[None, :, None] * along - step[:, None, None] * upwards
            cross[place], covered[place] = _texels(level, d), True
        return cross, covered


def unfolded(cube_map: CubeMap, faces: Faces) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Radiance and distance of all levels side by side, RGBA [H, W, 4] of 8 bits a channel.

    Returns also the nearest and the farthest distance: the ends of the colour scale.
    """
    levels = [level for level in cube_map.levels if level.shape[1] <= MOST_TEXELS]
    radiance = as_rgb(cube_map.levels[0][..., :-1])
    white = white_of(radiance.reshape(-1, 1, radiance.shape[-1]))
    inverse = np.abs(levels[0][..., -1])
    known = inverse[inverse > 1e-12]
    near, far = (1 / known.max(), 1 / known.min()) if len(known) else (1.0, 2.0)
    far = max(far, 1.01 * near)
    crosses = [faces.cross(level) for level in levels]
    return (
        _side_by_side([(_coloured(as_rgb(c[..., :-1]), white), covered) for c, covered in crosses]),
        _side_by_side([(_distances(c[..., -1], near, far), covered) for c, covered in crosses]),
        float(near),
        float(far),
    )


def _coloured(radiance: np.ndarray, white: float) -> np.ndarray:
    return tone_mapped(np.broadcast_to(radiance, (*radiance.shape[:2], 3)), white)


def _distances(inverse: np.ndarray, near: float, far: float) -> np.ndarray:
    colours = on_ramp(1 / np.maximum(np.abs(inverse), 1 / far), near, far)
    colours[inverse == 0], colours[inverse < 0] = SKY, MASKED
    return colours


def _side_by_side(crosses: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Crosses [H, W, 3], with where they cover, in one picture that is clear elsewhere."""
    height = crosses[0][0].shape[0]
    picture = np.zeros((height, sum(c.shape[1] for c, _ in crosses), 4), np.uint8)
    begin = 0
    for colours, covered in crosses:
        end = begin + colours.shape[1]
        picture[: colours.shape[0], begin:end, :3] = colours
        picture[: colours.shape[0], begin:end, 3] = 255 * covered
        begin = end
    return picture


def _texels(level: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Values of a level [6, R, R, C] in directions [R, R, 3]."""
    size = level.shape[1]
    face, uv = direction_to_face(mi.Vector3f(np.ascontiguousarray(d.reshape(-1, 3).T, np.float32)))
    place = np.clip((np.array(uv) * 0.5 + 0.5) * size, 0, size - 1).astype(int)
    return level[face.numpy(), place[1], place[0]].reshape(*d.shape[:2], -1)


def _axis(d: np.ndarray) -> np.ndarray:
    """The signed axis nearest to a direction."""
    largest = int(np.argmax(np.abs(d)))
    return np.sign(d[largest]) * np.eye(3)[largest]


def _name(d: np.ndarray) -> str:
    axis = int(np.argmax(np.abs(d)))
    return ("+" if d[axis] > 0 else "−") + "xyz"[axis]
