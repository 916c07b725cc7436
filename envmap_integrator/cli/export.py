"""The command ``export``: maps for other tools."""

from __future__ import annotations

import argparse

import mitsuba as mi

from envmap_integrator.cli.commands import activate_variant, check_output


def export(args: argparse.Namespace) -> int:
    """Write what ``mipmap_cube`` shows of a file as a cube map or a latitude-longitude map."""
    check_output(args.output)
    activate_variant(args.mode)
    wanted = {"type": "mipmap_cube", "filename": str(args.file), "map": args.map}
    emitter = mi.load_dict(wanted)
    if args.latlong:
        emitter.save_latlong(args.output)
    else:
        emitter.save_cube(args.output)
    if not args.quiet:
        print(f"wrote {args.output}")
    return 0
