"""Make the committed textures and meshes of the scenes from a fixed seed.

    python scenes/make_assets.py

needs numpy and mitsuba (only to encode the JPEG files).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from mesh_kit import grid, lathe, leaf, merge, place, smooth, tube, turn, write_ply  # noqa: E402

SEED = 1994


# ---- Textures: every picture is a function of the pixel grid -> [H, W, 3] in sRGB ----


def hex_colour(code: str) -> np.ndarray:
    """'d8a25b' -> array of three floats in [0, 1]."""
    return np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255


def pixel_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixel centres (x, y) in units of the picture's height, y down."""
    y, x = np.mgrid[0:height, 0:width]
    return (x + 0.5) / height, (y + 0.5) / height


def noise(rng, height: int, width: int, cells_y: int, cells_x: int) -> np.ndarray:
    """Smooth tileable value noise in [-1, 1] with the given number of cells."""
    lattice = rng.uniform(-1, 1, (cells_y, cells_x))
    y = np.arange(height) / height * cells_y
    x = np.arange(width) / width * cells_x
    i, j = y.astype(int), x.astype(int)
    fy, fx = (y - i)[:, None], (x - j)[None, :]
    fy, fx = fy * fy * (3 - 2 * fy), fx * fx * (3 - 2 * fx)
    i1, j1 = (i + 1) % cells_y, (j + 1) % cells_x
    top = lattice[np.ix_(i, j)] * (1 - fx) + lattice[np.ix_(i, j1)] * fx
    low = lattice[np.ix_(i1, j)] * (1 - fx) + lattice[np.ix_(i1, j1)] * fx
    return top * (1 - fy) + low * fy


def mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Blend two colours (or pictures) by ``weight [H, W]`` in [0, 1]."""
    weight = np.clip(weight, 0, 1)[..., None]
    return a * (1 - weight) + b * weight


def wood(rng) -> np.ndarray:
    """Eight floor boards with grain, butt joints and dark seams."""
    height, width, boards = 384, 384, 8
    picture = np.zeros((height, width, 3))
    board_height = height // boards
    light, dark = hex_colour("c8935a"), hex_colour("8a5a30")
    for board in range(boards):
        warp = 1.5 * noise(rng, board_height, width, 3, 6)
        row = np.arange(board_height)[:, None] / board_height
        grain = 0.5 + 0.5 * np.sin(2 * np.pi * (4 * row + warp + rng.uniform()))
        fibre = noise(rng, board_height, width, 24, 12)
        tone = 0.35 * grain + 0.22 * fibre + rng.uniform(0.1, 0.5)
        strip = mix(light, dark, tone)
        strip[:2] *= 0.45
        joint = rng.integers(20, width - 20)
        strip[:, joint : joint + 2] *= 0.5
        picture[board * board_height : (board + 1) * board_height] = strip
    return picture


def desk_wood(rng) -> np.ndarray:
    """One wide, quiet walnut board."""
    height, width = 256, 512
    warp = noise(rng, height, width, 4, 4) + 0.4 * noise(rng, height, width, 8, 8)
    y = np.arange(height)[:, None] / height
    grain = 0.5 + 0.5 * np.sin(2 * np.pi * (7 * y + 1.6 * warp))
    fibre = noise(rng, height, width, 128, 24)
    return mix(hex_colour("a9713f"), hex_colour("6d4322"), 0.55 * grain + 0.18 * fibre + 0.15)


def ceiling(_rng) -> np.ndarray:
    """A stencilled ceiling: quatrefoils and stars on a blue ground, tileable."""
    x, y = pixel_grid(256, 256)
    u, v = np.abs(x - 0.5), np.abs(y - 0.5)
    radius, angle = np.hypot(u, v), np.arctan2(y - 0.5, x - 0.5)
    lobes = np.minimum(np.hypot(u - 0.17, v), np.hypot(u, v - 0.17))
    picture = np.broadcast_to(hex_colour("e9dfc6"), (256, 256, 3)).copy()
    picture = mix(picture, hex_colour("33567f"), 80 * (0.175 - lobes))
    picture = mix(picture, hex_colour("d9a441"), 80 * (0.012 - np.abs(lobes - 0.17)))
    star = radius * (1 + 0.35 * np.cos(8 * angle))
    picture = mix(picture, hex_colour("f3d27a"), 80 * (0.10 - star))
    picture = mix(picture, hex_colour("a8432f"), 80 * (0.035 - radius))
    corner = np.hypot(0.5 - u, 0.5 - v)
    picture = mix(picture, hex_colour("a8432f"), 80 * (0.16 - corner))
    picture = mix(picture, hex_colour("e9dfc6"), 80 * (0.012 - np.abs(corner - 0.12)))
    picture = mix(picture, hex_colour("d9a441"), 80 * (0.05 - corner))
    return mix(picture, hex_colour("7d6a4c"), 120 * (np.maximum(u, v) - 0.49))


def poster(_rng) -> np.ndarray:
    """A geometric poster: discs, a quarter ring, bars."""
    height, width = 360, 256
    x, y = pixel_grid(height, width)
    picture = np.broadcast_to(hex_colour("f2e6cf"), (height, width, 3)).copy()

    def paint(code: str, distance: np.ndarray) -> None:
        nonlocal picture
        picture = mix(picture, hex_colour(code), -distance * height)

    def disc(cx, cy, r):
        return np.hypot(x - cx, y - cy) - r

    paint("e4572e", disc(0.27, 0.30, 0.19))
    paint("17324d", np.maximum(disc(0.44, 0.52, 0.22), 0.52 - y))
    paint("f3a712", np.maximum(np.abs(disc(0.18, 0.62, 0.13)) - 0.035, y - 0.62))
    paint("2a9d8f", disc(0.55, 0.20, 0.075))
    for k in range(5):
        bar = np.abs(x - 0.25) - 0.17 + 0.03 * k
        paint("17324d", np.maximum(np.abs(y - 0.80 - 0.022 * k) - 0.006, bar))
    paint("a8dadc", np.maximum(np.abs(x - y + 0.12) - 0.006, disc(0.27, 0.30, 0.30)))
    edge = np.minimum(np.minimum(x, width / height - x), np.minimum(y, 1 - y))
    paint("fffaf0", edge - 0.03)
    return picture


def picture(rng) -> np.ndarray:
    """A landscape: evening sky, sun, layered hills, a lake."""
    height, width = 256, 384
    x, y = pixel_grid(height, width)
    image = mix(hex_colour("2f4b7c"), hex_colour("f6b26b"), (y / 0.62) ** 1.3)
    image = mix(image, hex_colour("fff1c1"), 60 * (0.075 - np.hypot(x - 1.0, y - 0.42)))
    layers = ("b0677a", "7a4f74", "4b3f6b", "2b2f4f")
    for k, code in enumerate(layers):
        rough = sum(noise(rng, 1, width, 1, 4 * 2**o)[0] / 2**o for o in range(4))
        ridge = 0.46 + 0.065 * k + (0.07 - 0.008 * k) * rough
        image = mix(image, hex_colour(code), height * (y - ridge))
    ripple = np.sin(110 * y + 3 * noise(rng, height, width, 16, 6))
    lake = hex_colour("e8a06a") * (0.8 + 0.1 * ripple)[..., None]
    return mix(image, lake, 200 * (y - 0.78) * (1 - 0.5 * np.abs(x - 0.9)))


def rug(_rng) -> np.ndarray:
    """A woven rug: borders and rows of diamonds."""
    height, width = 384, 256
    x, y = pixel_grid(height, width)
    cx, cy = np.abs(x - width / height / 2), np.abs(y - 0.5)
    edge = np.minimum(width / height / 2 - cx, 0.5 - cy)
    image = np.broadcast_to(hex_colour("8c2f2b"), (height, width, 3)).copy()
    diamond = np.abs((x - 1 / 3) / 0.16 % 1 - 0.5) + np.abs((y - 0.5) / 0.16 % 1 - 0.5)
    image = mix(image, hex_colour("d9b36c"), 25 * (diamond - 0.72))
    image = mix(image, hex_colour("21405e"), 25 * (0.34 - diamond))
    image = mix(image, hex_colour("e8dcc0"), 25 * (0.13 - diamond))
    medallion = cx / 0.2 + cy / 0.3
    image = mix(image, hex_colour("21405e"), 60 * (1 - medallion))
    image = mix(image, hex_colour("d9b36c"), 60 * (0.05 - np.abs(medallion - 0.85)))
    image = mix(image, hex_colour("8c2f2b"), 60 * (0.6 - medallion))
    image = mix(image, hex_colour("e8dcc0"), 60 * (0.25 - medallion))
    zigzag = np.abs((x + y) * 18 % 2 - 1)
    border = mix(hex_colour("21405e"), hex_colour("d9b36c"), 6 * (zigzag - 0.5))
    image = mix(image, border, 300 * (0.09 - edge))
    image = mix(image, hex_colour("e8dcc0"), 300 * (0.022 - edge))
    weave = 0.93 + 0.07 * np.sin(np.pi * np.arange(height))[:, None] * np.ones(width)
    weave = weave * (0.94 + 0.06 * (np.arange(width) % 2))
    return image * weave[..., None]


def screen(rng) -> np.ndarray:
    """A monitor: an editor with coloured lines and a small rendered ball."""
    height, width = 216, 384
    x, y = pixel_grid(height, width)
    image = np.broadcast_to(hex_colour("141b2d"), (height, width, 3)).copy()
    image[y < 0.055] = hex_colour("2b3655")
    image[(x < 0.24) & (y >= 0.055)] = hex_colour("1c2540")
    palette = [hex_colour(c) for c in ("7fdbca", "c792ea", "f78c6c", "82aaff", "d6deeb", "ecc48d")]
    for line in range(20):
        top = int(height * (0.10 + 0.042 * line))
        left = int(height * (0.29 + 0.05 * rng.integers(0, 4)))
        for _ in range(rng.integers(1, 6)):
            right = left + rng.integers(6, 30)
            image[top : top + 4, left : min(right, int(1.1 * height))] = palette[rng.integers(6)]
            left = right + 4
    for line in range(12):
        top = int(height * (0.10 + 0.05 * line))
        image[top : top + 3, 10 : 10 + rng.integers(12, 36)] = hex_colour("5f6f9c")
    box = (x > 1.16) & (x < 1.70) & (y > 0.12) & (y < 0.62)
    image[box] = mix(hex_colour("f4b183"), hex_colour("5b7db1"), y)[box]
    ball = 0.16 - np.hypot(x - 1.43, y - 0.38)
    light = np.clip(0.55 - 2.2 * ((x - 1.43) + (y - 0.38)), 0.1, 1)
    image = mix(image, light[..., None] * hex_colour("ff6f59"), height * ball)
    return image


def marble(rng) -> np.ndarray:
    """Marble-like veins, used for stone plinths and the mouse pad."""
    height, width = 256, 256
    turbulence = sum(noise(rng, height, width, 4 * 2**o, 4 * 2**o) / 2**o for o in range(5))
    vein = np.abs(np.sin(2.2 * turbulence + 0.8)) ** 0.35
    return mix(hex_colour("5f6b73"), hex_colour("ece7df"), vein)


# ---- The sky: Mitsuba's sun and sky model as a small environment map ----


def sky(height: int = 128, fine: int = 12) -> np.ndarray:
    """`sunsky` averaged over the texels of a [height, 2 height, 3] map, radiance; z is up.

    Its sun is spread over a few texels (about 3 degrees): soft edges, milder caustics.
    Unlike the plugin the map also works in monochrome variants. Below the horizon: a
    dull green, mostly hidden by the ground.
    """
    import mitsuba as mi

    emitter = mi.load_dict(
        {"type": "sunsky", "sun_direction": [-0.65, -0.55, 0.55], "turbidity": 3.0, "albedo": 0.3}
    )
    radiance = np.empty((height, 2 * height, 3))
    radiance[:] = 0.030, 0.036, 0.018
    columns = (np.arange(2 * height * fine) + 0.5) / (height * fine) * np.pi
    for row in range(height // 2):
        theta = (row + (np.arange(fine) + 0.5) / fine) / height * np.pi
        t, p = (a.ravel() for a in np.meshgrid(theta, columns, indexing="ij"))
        # `envmap` maps u to the azimuth of (x, -z) and v to the angle from +y
        direction = np.stack([np.sin(t) * np.sin(p), np.sin(t) * np.cos(p), np.cos(t)])
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(*(-direction))
        value = np.array(emitter.eval(si)).reshape(3, fine, 2 * height, fine)
        radiance[row] = value.mean(axis=(1, 3)).T
    return radiance


# ---- Meshes of the desk, the two rooms and the terrace ----


def wall_of_revolution(outside: list, thickness: float, count: int, segments: int = 28):
    """A vessel turned from its outer profile, bottom to rim, with a wall and a rounded lip."""
    outer = smooth(np.array(outside), count)
    inner = outer - [thickness, 0]
    inner[:, 1] = np.maximum(inner[:, 1], outer[0, 1] + thickness)
    inner = inner[inner[:, 0] > 0.2 * thickness]
    turned = np.linspace(0, np.pi, 7)[1:-1, None]
    lip = (outer[-1] + inner[-1]) / 2 + thickness / 2 * np.hstack([-np.cos(turned), np.sin(turned)])
    floor, base = [[0, inner[0, 1]]], [[0, outer[0, 1]]]
    edge = inner[:1] * [1, 0] + [0, inner[0, 1]]
    profile = np.vstack([floor, edge, inner, lip, outer[::-1], base])
    keep = np.r_[True, np.linalg.norm(np.diff(profile, axis=0), axis=1) > 1e-6]
    return lathe(profile[keep], segments)


def mug():
    """A mug of 9 cm with a handle, standing on z = 0."""
    outer = [(0.030, 0), (0.038, 0.004), (0.040, 0.03), (0.041, 0.06), (0.042, 0.09)]
    loop = [(0.039, 0.072), (0.060, 0.073), (0.068, 0.05), (0.058, 0.025), (0.038, 0.022)]
    handle = smooth([(x, 0, z) for x, z in loop], 20)
    return merge([wall_of_revolution(outer, 0.004, 12), tube(handle, 0.005, 8)])


def tumbler():
    """A drinking glass of 11 cm: one closed dielectric boundary."""
    return wall_of_revolution([(0.028, 0), (0.031, 0.003), (0.033, 0.05), (0.037, 0.11)], 0.003, 14)


def vase():
    """A belly vase of 34 cm."""
    outer = [(0.06, 0), (0.075, 0.01), (0.12, 0.10), (0.115, 0.18), (0.055, 0.26)]
    outer += [(0.045, 0.30), (0.062, 0.34)]  # neck and lip
    return wall_of_revolution(outer, 0.006, 18)


def bowl():
    """A wide bowl, 9 cm high."""
    return wall_of_revolution(
        [(0.05, 0), (0.06, 0.006), (0.12, 0.04), (0.155, 0.09)], 0.006, 12, 32
    )


def pot():
    """A conical flower pot of 14 cm with a collar."""
    return wall_of_revolution(
        [(0.055, 0), (0.060, 0.004), (0.072, 0.10), (0.080, 0.105), (0.083, 0.14)], 0.007, 14
    )


def lamp_shade():
    """A cone shade, opening down: 16 cm wide at z = 0, 10 cm high."""
    outer = smooth(np.array([(0.082, 0.0), (0.070, 0.03), (0.040, 0.075), (0.016, 0.10)]), 14)
    inner = outer - [0.002, 0.0]
    profile = np.vstack([[[0, 0.098]], inner[::-1], outer, [[0, 0.10]]])
    profile[1, 1] = 0.098
    return lathe(profile[::-1], 28)


def house_plant(rng, leaves: int = 40):
    """Arching pointed leaves that grow from the origin (the rim of a pot)."""
    parts = []
    for k in range(leaves):
        azimuth = 2.39996 * k + rng.uniform(-0.2, 0.2)  # golden angle
        height = k / leaves
        elevation = 0.25 + 1.05 * height + rng.uniform(-0.12, 0.12)
        length = rng.uniform(0.17, 0.27)
        blade = leaf(length, 0.05 * rng.uniform(0.8, 1.2), length * rng.uniform(0.2, 0.7), 8, 5)
        root = 0.02 * np.array([np.cos(azimuth), np.sin(azimuth), 0]) + [0, 0, 0.06 * height]
        parts.append(place(blade, turn(azimuth, elevation, rng.uniform(-0.3, 0.3)), root))
    return merge(parts)


def twigs(rng):
    """Dry twigs with round leaves for the vase; the foot of the twigs is the origin."""
    parts = []
    for k in range(7):
        azimuth = 2.39996 * k
        lean = rng.uniform(0.12, 0.30)
        tip = np.array([lean * np.cos(azimuth), lean * np.sin(azimuth), rng.uniform(0.5, 0.75)])
        path = smooth([np.zeros(3), tip * [0.3, 0.3, 0.5], tip], 9)
        parts.append(tube(path, np.linspace(0.004, 0.0015, 9), 5))
        for point in path[3:]:
            for _ in range(2):
                blade = leaf(0.06, 0.036, 0.012, 5, 3)
                matrix = turn(rng.uniform(0, 2 * np.pi), rng.uniform(-0.2, 0.9))
                parts.append(place(blade, matrix, point))
    return merge(parts)


def cable():
    """The lamp's cable on the desk."""
    bends = [(0, 0), (-0.08, 0.05), (-0.10, 0.14), (-0.02, 0.22), (0.05, 0.30)]
    return tube(smooth([(x, y, 0) for x, y in bends], 32), 0.003, 8)


def mouse():
    """A computer mouse: a flattened ellipsoid, 11 cm long, standing on z = 0."""
    v = np.linspace(-np.pi / 2, np.pi / 2, 17)[:, None]
    u = np.linspace(0, 2 * np.pi, 33)[None, :]
    x, y = 0.032 * np.cos(v) * np.cos(u), 0.054 * np.cos(v) * np.sin(u)
    z = np.where(np.sin(v) < 0, 0.006, 0.028) * np.sin(v) + 0.006 + 0 * u
    return grid(np.stack([x, y, z], -1), flip=True)


def cushion():
    """A square cushion, 44 cm wide: a super-ellipsoid."""
    v = np.linspace(-np.pi / 2, np.pi / 2, 17)[:, None]
    u = np.linspace(0, 2 * np.pi, 41)[None, :]

    def power(value, exponent):
        return np.sign(value) * np.abs(value) ** exponent

    x = 0.22 * power(np.cos(v), 0.6) * power(np.cos(u), 0.55)
    y = 0.22 * power(np.cos(v), 0.6) * power(np.sin(u), 0.55)
    return grid(np.stack([x, y, 0.075 * np.sin(v) + 0 * u], -1), flip=True)


TEXTURES = (wood, desk_wood, ceiling, poster, picture, rug, screen, marble)
SEEDED_MESHES = (house_plant, twigs)
MESHES = (mug, tumbler, vase, bowl, pot, lamp_shade, cable, mouse, cushion)


def main() -> None:
    """Write textures/*.jpg and meshes/*.ply."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    for make in TEXTURES:
        image = np.clip(make(np.random.default_rng(SEED)), 0, 1)
        bitmap = mi.Bitmap((255 * image + 0.5).astype(np.uint8))
        bitmap.write(str(HERE / "textures" / f"{make.__name__}.jpg"), quality=85)
    mi.Bitmap(sky().astype(np.float16)).write(str(HERE / "textures" / "sky.exr"))
    for make in SEEDED_MESHES:
        write_ply(HERE / "meshes" / f"{make.__name__}.ply", make(np.random.default_rng(SEED)))
    for make in MESHES:
        write_ply(HERE / "meshes" / f"{make.__name__}.ply", make())


if __name__ == "__main__":
    main()
