"""``mipmap_cube``: a baked cube map as an emitter."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..lookup.cube import direction_to_face, face_to_direction, solid_angles, texel
from ..lookup.cube_map import from_stored
from ..preparation.maps.clusters import ClusterRequest
from ..system.checks import check_variant, misplaced
from ..system.jit import upload
from ..system.parameters import Parameters
from ..system.storage import StorageError, read


class MipmapCube(mi.Emitter):
    r"""
    Cube map emitter (:monosp:`mipmap_cube`)

    Two uses. With ``filename``, an environment emitter that shows a map baked by
    :monosp:`envmap_hybrid` or :monosp:`envmap_bake`, at any of its levels, in any scene. With
    ``shapes``, nested in :monosp:`envmap_hybrid`, it lists the objects of one cluster in place of
    the automatic choice.

    .. pluginparameters::

     * - filename
       - |string|
       - OpenEXR file with a map.
     * - map
       - |string|
       - Name of the map, if the file holds several. (Default: the first)
     * - level
       - |float|
       - Mip level that is shown, 0 the finest; fractions blend two levels. (Default: 0)
     * - shapes
       - |string|
       - Ids of the shapes of a cluster, separated by commas.
     * - distance_ratio
       - |float|
       - Half width of the cluster's cube over the cluster's radius, at least 1. (Default: that of
         the integrator)
    """

    def __init__(self, props: mi.Properties):
        check_variant(props.plugin_name())
        super().__init__(props)
        parameters = Parameters(props)
        if "to_world" in props:
            raise ValueError(
                f'{parameters.owner}: "to_world" isn\'t supported, maps lie in world space; '
                "remove it"
            )
        shapes = parameters.text("shapes")
        filename = parameters.text("filename")
        if bool(shapes) == bool(filename):
            raise ValueError(
                f'{parameters.owner}: give either "filename" (a baked map) or "shapes" (a '
                f"cluster), not {'both' if shapes else 'neither'}"
            )
        if shapes:
            names = tuple(name.strip() for name in shapes.split(",") if name.strip())
            if not names:
                raise ValueError(f'{parameters.owner}: "shapes" must list ids, not {shapes!r}')
            ratio = parameters.number("distance_ratio", None, 1.0)
            self.request, self.level = ClusterRequest(props.id(), names, ratio), 0.0
        else:
            self.request = None
            self.level = parameters.number("level", 0.0, 0.0)
            self.cube_map = _load(parameters.owner, filename, parameters.text("map"))
            self._prepare_evaluation()
        self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying

    # ---------------------- Evaluation ----------------------

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Spectrum:
        """Radiance [W/m²/sr] that arrives from ``-si.wi``, at the emitter's level."""
        return self.eval_level(-si.wi, self.level, active)

    def eval_level(
        self, direction: mi.Vector3f, level: float, active: mi.Bool | bool = True
    ) -> mi.Spectrum:
        """Radiance [W/m²/sr] from world space directions at any level, trilinearly filtered."""
        self._require_map()
        top = len(self.cube_map.levels) - 1
        level = min(max(level, 0.0), float(top))
        fine = int(level)
        value = self._bilinear(direction, fine, active)
        if level > fine:
            value = dr.lerp(value, self._bilinear(direction, fine + 1, active), level - fine)
        return value

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool | bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """A direction in proportion to the radiance of the emitter's level, and its weight."""
        self._require_map()
        index, remapped, _ = self._distribution.sample_reuse_pmf(sample.x, active)
        resolution = self._sampling_resolution
        pixels = resolution * resolution
        face, y, x = index // pixels, index // resolution % resolution, index % resolution
        uv = 2 * (mi.Point2f(mi.Float(x), mi.Float(y)) + mi.Point2f(remapped, sample.y))
        d = dr.normalize(face_to_direction(face, uv / resolution - 1))

        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = d
        ds.dist = self._far
        ds.p = it.p + d * self._far
        ds.n = -d
        ds.pdf = self._pdf(d, active)
        ds.delta = False
        ds.emitter = mi.EmitterPtr(self)
        ds.time = it.time
        value = self.eval_level(d, self.level, active)
        return ds, dr.select(ds.pdf > 0, value / ds.pdf, 0) & active

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool | bool = True
    ) -> mi.Float:
        """Density [1/sr] of ``sample_direction``."""
        return self._pdf(ds.d, active)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool | bool = True
    ) -> mi.Spectrum:
        """Radiance [W/m²/sr] from a direction."""
        return self.eval_level(ds.d, self.level, active)

    def to_string(self) -> str:
        """What it is, for messages."""
        return f"MipmapCube[request={self.request}]"

    # ---------------------- Internals ----------------------

    #: Distance [world units] that stands for "far away" in shadow rays: beyond all scenes, and its
    #: square is still a number of single precision.
    _far = 1e15

    def _require_map(self):
        if self.request is not None:
            raise RuntimeError(misplaced(self))

    def _prepare_evaluation(self):
        texels = self.cube_map.texels()
        n_channels = texels.shape[1] - 1
        if n_channels != len(mi.Spectrum()):
            raise ValueError(
                f"mipmap_cube: the map has {n_channels} colour channels, variant {mi.variant()} "
                f"needs {len(mi.Spectrum())}; bake it with this variant"
            )
        self._texels = upload(mi.Float, texels[:, :n_channels])
        level = int(round(self.level))
        level = min(max(level, 0), len(self.cube_map.levels) - 1)
        radiance = self.cube_map.levels[level][..., :n_channels].mean(axis=-1)
        self._sampling_resolution = radiance.shape[1]
        weight = radiance * solid_angles(radiance.shape[1])
        # Bilinear filtering spreads a texel's light over its neighbours: no texel may be missed.
        weight += 0.05 * max(weight.mean(), 1e-30)
        self._distribution = mi.DiscreteDistribution(upload(mi.Float, weight))

    def _pdf(self, d, active):
        self._require_map()
        resolution = self._sampling_resolution
        face, uv = direction_to_face(d)
        index = texel(face, uv, mi.UInt32(resolution), mi.UInt32(resolution))
        solid_angle = 4 / resolution**2 / (1 + dr.squared_norm(uv)) ** 1.5
        return self._distribution.eval_pmf_normalized(index, active) / solid_angle

    def _bilinear(self, direction, level: int, active):
        """Four texels around a direction, each found through its own direction: no seams.

        Only three texels meet at a corner of the cube; their mean stands for the fourth.
        """
        resolution = mi.UInt32(self.cube_map.resolution)
        size = self.cube_map.resolution >> level
        face, uv = direction_to_face(direction)
        grid = (uv + 1) * (0.5 * size) - 0.5
        corner = dr.floor(grid)
        w = grid - corner
        texels = []
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            centre = 2 * (corner + mi.Point2f(dx + 0.5, dy + 0.5)) / size - 1
            face_, uv_ = direction_to_face(face_to_direction(face, centre))
            index = texel(face_, uv_, resolution, mi.UInt32(size))
            weight = (w.x if dx else 1 - w.x) * (w.y if dy else 1 - w.y)
            value = dr.gather(mi.Spectrum, self._texels, index, active)
            texels.append((weight, value, dr.all(dr.abs(centre) > 1)))
        total = sum(value for _, value, _ in texels)
        return sum(
            weight * dr.select(missing, (total - value) / 3, value)
            for weight, value, missing in texels
        )


def _load(owner, filename, name):
    path = mi.file_resolver().resolve(filename)
    try:
        stored = read(path, "make it with envmap-render bake")
        maps = stored.entries("maps")
        known = [entry.text("name") for entry in maps]
        if name and name not in known:
            raise StorageError(
                f'{path}: holds no map "{name}", only {", ".join(known) or "none"}; name one of '
                "these"
            )
        if not maps:
            raise StorageError(
                f'{path}: holds no maps, its scene has no clusters; set "maps" to "always" or list '
                "a cluster, and make it again with envmap-render bake"
            )
        index = known.index(name) if name else 0
        return from_stored(maps[index], prefix=f"map{index}/")
    except StorageError as error:
        raise ValueError(f"{owner}: {error}") from None
