"""Indirect light for Mitsuba 3 by environment maps around clusters of objects.

Importing the package registers the integrators ``envmap_hybrid``, ``one_level_path``,
``source_selection`` and ``envmap_bake`` and the emitter ``mipmap_cube``, for the active variant
and for every variant chosen later.

After Reinhard, Tijssen and Jansen: Environment Mapping for Efficient Sampling of the Diffuse
Interreflection (1994).
"""

from .system.llvm import prefer_good_library

prefer_good_library()  # Before mitsuba is imported: Dr.Jit loads libLLVM at once.

from .registration import register  # noqa: E402

__version__ = "0.1.0"

register()
