"""``envmap_hybrid`` with one of its approximations made exact, or far finer."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from unittest.mock import patch

import drjit as dr
import mitsuba as mi

from compare.scenes import HYBRID, Subject
from envmap_integrator.lookup.far_field import FarField
from envmap_integrator.lookup.patches import Patches
from envmap_integrator.transport.lobes import Lobes

FINEST = -32.0
"""``mip_bias`` with which every look-up reads the finest level."""

SMALLER_RATIO = 1.25
"""``distance_ratio`` of cubes that leave more sources outside."""

# ---------------------- Approximations without a parameter ----------------------


def escaped_rays_traced() -> AbstractContextManager:
    """No map is trusted: rays that leave their cube are traced on from there."""

    def eval_none(self, *_):
        return mi.Spectrum(0), mi.Bool(False)

    return patch.object(FarField, "eval", eval_none)


def masked_texels_trusted() -> AbstractContextManager:
    """Texels that no bake ray has filled are read as they were filled from their neighbours.

    The sign of the inverse distance, which tells them apart, is dropped.
    """
    inverse_distance = FarField._inverse_distance

    def read_unsigned(self, layout, d, active):
        return dr.abs(inverse_distance(self, layout, d, active))

    return patch.object(FarField, "_inverse_distance", read_unsigned)


def patches_unblended() -> AbstractContextManager:
    """The cache is read at the place itself, not at random up to half a patch beside it."""
    find = Patches.find

    def find_own(self, p, normal, object_id, cell, active=True, u=None):
        return find(self, p, normal, object_id, cell, active)

    return patch.object(Patches, "find", find_own)


def only_diffuse_is_wide() -> AbstractContextManager:
    """Irradiance stands for no material with gloss; of those, all is traced on."""
    wide_share = Lobes.wide_share

    def of_diffuse(self, wo, value, active=True):
        return dr.select(self.every, wide_share(self, wo, value, active), 0)

    return patch.object(Lobes, "wide_share", of_diffuse)


# ---------------------- Variants ----------------------


@dataclass(frozen=True)
class Variant:
    """An integrator of which some approximations are replaced.

    subject    with the parameters that do so
    replaced   makes contexts that do what no parameter does, to prepare and to render in
    """

    subject: Subject
    replaced: tuple[Callable[[], AbstractContextManager], ...] = ()

    @property
    def prepared_otherwise(self) -> tuple[Callable[[], AbstractContextManager], ...]:
        """Those that matter to the preparation, in which no map is read."""
        return tuple(replaced for replaced in self.replaced if replaced is not escaped_rays_traced)


@dataclass(frozen=True)
class Source:
    """An approximation, as the difference of variants.

    group         what it belongs to
    with_it       variants that have it, added
    without_it    variants that don't, subtracted
    exact         what stands in its place
    """

    name: str
    group: str
    with_it: tuple[str, ...]
    without_it: tuple[str, ...]
    exact: str


def switch(name: str, group: str, before: str, after: str, exact: str) -> Source:
    """The difference of two variants that differ in nothing else."""
    return Source(name, group, (before,), (after,), exact)


STEPS = (
    switch("direct light at second hits", "direct light", "default", "shadow rays", "shadow rays"),
    switch("maps", "maps", "shadow rays", "traced", "rays traced in full"),
    switch(
        "indirect light at second hits", "indirect light", "traced", "2 bounces", "a bounce more"
    ),
    switch(
        "indirect light at third hits", "indirect light", "2 bounces", "3 bounces", "a bounce more"
    ),
)
"""From the defaults to something that ``path`` differs little from; each starts where the last has
ended. Maps hold direct light by shadow rays, so what they are compared with has it too."""

PARTS = (
    # With shadow rays the cache's direct light plays no part, but all else does.
    Source(
        "noise of direct light",
        "direct light",
        ("default", "shadow rays, gathered finely"),
        ("shadow rays", "gathered finely"),
        "more gather rays",
    ),
    Source(
        "resolution of direct light",
        "direct light",
        ("gathered finely", "shadow rays, small patches"),
        ("shadow rays, gathered finely", "small patches"),
        "smaller patches",
    ),
    Source(
        "wide lobes of direct light",
        "direct light",
        ("gathered finely", "shadow rays, wide lobes traced"),
        ("shadow rays, gathered finely", "wide lobes traced"),
        "lobes traced",
    ),
    switch("mip filtering", "maps", "default", "finest level", "finest level"),
    switch("bake noise", "maps", "default", "baked finely", "more rays per texel"),
    switch("map resolution", "maps", "baked finely", "small texels", "smaller texels"),
    switch("dislocation", "maps", "best maps", "traced", "rays traced in full"),
    switch(
        "noise of indirect light",
        "indirect light",
        "traced",
        "traced, gathered finely",
        "more gather rays",
    ),
    switch(
        "resolution of indirect light",
        "indirect light",
        "traced, gathered finely",
        "traced, small patches",
        "smaller patches",
    ),
    switch(
        "wide lobes of indirect light",
        "indirect light",
        "traced, gathered finely",
        "traced, wide lobes traced",
        "lobes traced",
    ),
)
"""Of the steps of their group, whose sum they may miss: what is finer isn't exact.

Smaller patches and texels take as many rays in all as more rays do, so noise isn't in their
difference. Wide lobes are those that irradiance stands for as if they were diffuse. Dislocation is
what the best maps have left: all that depends on the place from which one looks. Clusters depend on
the patches' surface points, which makes no difference where all rays are traced."""

CHOICES = (
    switch("blending of patches", "", "default", "unblended patches", "each place its patch"),
    switch("maps, not cache, beyond cubes", "", "default", "traced to cache", "cache in full"),
    switch("masked texels, if trusted", "", "masked texels trusted", "shadow rays", "rays traced"),
)
"""What the defaults choose, of two that are not exact, and what they avoid."""

CHECKS = (
    switch("sources in smaller cubes", "", "traced", "traced, smaller cubes", "more beyond cubes"),
    switch("same as one_level_path", "", "traced to cache", "one_level_path", "no cubes"),
)
"""Where every source is counted once, these make no difference but noise."""

SOURCES = (*STEPS, *PARTS, *CHOICES, *CHECKS)
GROUPS = ("direct light", "maps", "indirect light")


def variants(patches: int, finer: int) -> dict[str, Variant]:
    """All of them by the names that sources have for them.

    ``patches`` is the budget of the coarse mesh. Finer forms have ``finer``, a square, times as
    many patches, texels or rays.
    """
    own = HYBRID.make()
    # The filter's error isn't that of the method, and hides its noise.
    samples = own.LEAST_PATCH_SAMPLES
    shared = {"patches": patches, "patch_samples": samples, "irradiance_filter": False}
    gathered = {"patch_samples": samples * finer}
    small_patches = {"patches": patches * finer}
    baked = {"baker": {"type": "envmap_bake", "samples": own.baker.samples * finer}}
    small_texels = {"map_resolution": own.map_resolution * math.isqrt(finer)}

    def hybrid(*replaced, **settings) -> Variant:
        return Variant(Subject("envmap_hybrid", shared | {"maps": "always"} | settings), replaced)

    def lit(*replaced, **settings) -> Variant:
        return hybrid(*replaced, second_hit="shadow_rays", **settings)

    def traced(*replaced, **settings) -> Variant:
        return lit(escaped_rays_traced, *replaced, **settings)

    return {
        "default": hybrid(),
        "shadow rays": lit(),
        "traced": traced(),
        "2 bounces": traced(gather_depth=2),
        "3 bounces": traced(gather_depth=3),
        "gathered finely": hybrid(**gathered),
        "shadow rays, gathered finely": lit(**gathered),
        "traced, gathered finely": traced(**gathered),
        "small patches": hybrid(**small_patches),
        "shadow rays, small patches": lit(**small_patches),
        "traced, small patches": traced(**small_patches),
        "wide lobes traced": hybrid(only_diffuse_is_wide, **gathered),
        "shadow rays, wide lobes traced": lit(only_diffuse_is_wide, **gathered),
        "traced, wide lobes traced": traced(only_diffuse_is_wide, **gathered),
        "unblended patches": hybrid(patches_unblended),
        "finest level": hybrid(mip_bias=FINEST),
        "baked finely": hybrid(**baked),
        "small texels": hybrid(**small_texels),
        "best maps": lit(mip_bias=FINEST, **small_texels),
        "masked texels trusted": lit(masked_texels_trusted),
        "traced to cache": hybrid(escaped_rays_traced),
        "traced, smaller cubes": traced(distance_ratio=SMALLER_RATIO),
        "one_level_path": Variant(Subject("one_level_path", shared)),
    }
