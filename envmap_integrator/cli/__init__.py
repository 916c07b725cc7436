"""``envmap-render``: render, bake, export maps and diagnose from the shell.

The stock ``mitsuba`` executable can't load plugins written in Python; this one echoes its flags.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import NoReturn

from envmap_integrator.cli import commands
from envmap_integrator.cli.arguments import parse_assignment, parse_setting
from envmap_integrator.cli.doctor import doctor
from envmap_integrator.cli.errors import condense
from envmap_integrator.cli.export import export
from envmap_integrator.system import progress
from envmap_integrator.system.checks import SUPPORTED_VARIANTS
from envmap_integrator.system.interrupt import interruptible

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
_INTERRUPTED = "envmap-render: interrupted"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code.

    That is 0, 1 (``doctor`` found a fault), 2 (bad input) or 130 (Ctrl-C).
    """
    parser = build_parser()
    # Only where a shell asks: else it would have to be imported each time.
    if "_ARGCOMPLETE" in os.environ and importlib.util.find_spec("argcomplete"):
        import argcomplete

        argcomplete.autocomplete(parser)
    args = parser.parse_args(arguments)
    quiet_before = progress.quiet
    progress.quiet |= getattr(args, "quiet", False) or getattr(args, "json", False)
    try:
        with interruptible(otherwise=_end):
            return args.command(args)
    except KeyboardInterrupt:
        print(_INTERRUPTED, file=sys.stderr)
        return EXIT_INTERRUPTED
    except (ValueError, TypeError, RuntimeError, ImportError, OSError, MemoryError) as error:
        if args.debug:
            raise
        print(f"envmap-render: {condense(error)}", file=sys.stderr)
        return EXIT_BAD_INPUT
    finally:
        progress.quiet = quiet_before


def _end() -> None:
    """End the process amid a kernel; files are either complete or not there."""
    os.write(sys.stderr.fileno(), f"{_INTERRUPTED}\n".encode())
    os._exit(EXIT_INTERRUPTED)


EXIT_CODES = """exit codes:
  0    done
  2    bad input, or a file that can't be read or written: one line on stderr says what to do
  130  Ctrl-C
"""
EXIT_CODES_OF_DOCTOR = """exit codes:
  0    something can be rendered with here
  1    nothing can
"""
RENDER_EXAMPLES = """examples:
  envmap-render render room.xml --spp 16 --denoise --png       # a look
  envmap-render render room.xml -D resx=320 -s 1               # smaller, second sensor
  envmap-render render room.xml --json | jq .seconds.total

  # --integrator can be left out where the scene names one of ours, or none.
  envmap-render render room.xml --integrator envmap_hybrid --spp 256 -o room.exr
  envmap-render render room.xml --integrator envmap_hybrid --progressive --time 30 --png
  envmap-render render room.xml --integrator envmap_hybrid --resume --time 30 --png
  envmap-render render room.xml --integrator envmap_hybrid --target-error 1e-3
  envmap-render render room.xml --integrator envmap_hybrid --cluster tcp://render-1:8786

  # Without bias, but with more noise:
  envmap-render render room.xml --integrator envmap_hybrid --set residual_probability=0.5

"""
BAKE_EXAMPLES = """examples:
  envmap-render bake room.xml --integrator envmap_hybrid -o state.exr
  envmap-render render room.xml --integrator envmap_hybrid --set cache_file=state.exr

  # Clusters of your choice, each with a map: the same settings with the cache_file.
  envmap-render bake room.xml --integrator envmap_hybrid -o state.exr \\
      --set desk.shapes="table, ball" --set desk.resolution=128 --set desk.center="0, 1, 0.5"
  envmap-render bake room.xml --integrator envmap_hybrid -o state.exr \\
      --set maps=always --set no_cluster="lamp, curtain"

  # One of them finer, in the file that there is: all other settings as before.
  envmap-render bake room.xml --integrator envmap_hybrid -o state.exr \\
      --set desk.shapes="table, ball" --set desk.resolution=256 --clusters desk

"""
EXPORT_EXAMPLES = """examples:
  envmap-render export state.exr --map desk -o desk.exr        # for mipmap_cube and other tools
  envmap-render export desk.exr --latlong -o sky.exr           # for Mitsuba's envmap

"""
INSPECT_EXAMPLES = """examples:
  envmap-render inspect room.xml                       # room.html, to be opened in a browser
  envmap-render inspect room.xml --spp 256 -s 1        # as a render of 256 samples, second sensor
  envmap-render inspect room.xml --set distance_ratio=3.0 --set maps=always

"""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage text, and shows examples as they are."""

    def __init__(self, **settings):
        if "description" in settings:
            settings["description"] = fill(" ".join(settings["description"].split()), 88)
        shown = argparse.RawDescriptionHelpFormatter
        super().__init__(formatter_class=shown, allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: {message} (see --help)\n")


def build_parser() -> argparse.ArgumentParser:
    """The command line, one sub-command a function of :mod:`envmap_integrator.cli.commands`."""
    parser = _Parser(prog="envmap-render", description=__doc__, epilog=EXIT_CODES)
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")

    render = subparsers.add_parser(
        "render",
        help="render a scene to an OpenEXR file",
        description="Render a scene to an OpenEXR file, by its own integrator or by envmap_hybrid.",
        epilog=RENDER_EXAMPLES + EXIT_CODES,
    )
    _add_scene_options(render)
    _add_sensor(render)
    render.add_argument("-o", "--output", type=Path, help="default: beside the scene, .exr")
    render.add_argument(
        "--spp", type=int, default=0, help="samples per pixel; 0, the default: the scene's"
    )
    render.add_argument("--seed", type=int, default=0, help="of the sampler")
    render.add_argument("--png", action="store_true", help="also write an sRGB PNG beside the EXR")
    render.add_argument(
        "--denoise", action="store_true", help="by Open Image Denoise; films get a box filter"
    )
    render.add_argument(
        "--progressive", action="store_true", help="write better pictures while it goes on"
    )
    render.add_argument("--time", type=float, metavar="SECONDS", help="end after so long")
    render.add_argument(
        "--target-error", type=float, metavar="RELMSE", help="end when so little noise is left"
    )
    render.add_argument(
        "--resume", action="store_true", help="go on from what --progressive has kept beside OUTPUT"
    )
    by_workers = render.add_mutually_exclusive_group()
    by_workers.add_argument(
        "--workers", type=int, metavar="N", help="render by N processes of this machine"
    )
    by_workers.add_argument(
        "--cluster", metavar="ADDRESS", help="render by the workers of a Dask scheduler, tcp://…"
    )
    render.add_argument(
        "--tls", nargs=3, metavar=("CA", "CERT", "KEY"), help="files (PEM) for a tls:// scheduler"
    )
    render.set_defaults(command=commands.render)

    bake = subparsers.add_parser(
        "bake",
        help="compute what rendering reuses, and save it",
        description="Compute what renders of all sensors of a scene reuse, and save it.",
        epilog=BAKE_EXAMPLES + EXIT_CODES,
    )
    _add_scene_options(bake)
    bake.add_argument("-o", "--output", type=Path, required=True)
    bake.add_argument(
        "--clusters",
        metavar="NAME,…",
        help="bake the maps of these clusters in OUTPUT anew, by their settings now, and leave all "
        "else in it as it is",
    )
    bake.set_defaults(command=commands.bake)

    inspect = subparsers.add_parser(
        "inspect",
        help="show why a picture is as it is, as an HTML page",
        description="Show why a picture is as it is: patches and irradiance of the cache and its "
        "error, clusters, cubes and maps, and where rays end, as one HTML file that needs no "
        "network. By envmap_hybrid, unless the scene or --integrator names one_level_path. Takes "
        "pip install '.[inspect]'.",
        epilog=INSPECT_EXAMPLES + EXIT_CODES,
    )
    _add_scene_options(inspect)
    _add_sensor(inspect)
    inspect.add_argument("-o", "--output", type=Path, help="default: beside the scene, .html")
    inspect.add_argument(
        "--spp", type=int, default=0,
        help="samples per pixel of the render that it is about; 0, the default: the scene's",
    )  # fmt: skip
    inspect.add_argument("--seed", type=int, default=0, help="of the sampler")
    inspect.set_defaults(command=commands.inspect, denoise=False)

    convert = subparsers.add_parser(
        "export",
        help="write a map for other tools",
        description="Write a map of a baked state, or a cube map of another tool, as an OpenEXR "
        "cube map, its levels as parts. Emitters that shadow rays sample aren't in baked maps.",
        epilog=EXPORT_EXAMPLES + EXIT_CODES,
    )
    convert.add_argument("file", type=Path, metavar="FILE.exr", help="baked state or cube map")
    convert.add_argument("-o", "--output", type=Path, required=True)
    convert.add_argument("--map", default="", metavar="NAME", help="default: the first of a state")
    convert.add_argument(
        "--latlong", action="store_true", help="for Mitsuba's envmap, y upwards, instead of a cube"
    )
    _add_mode(convert)
    convert.add_argument("--quiet", action="store_true", help="errors alone")
    convert.add_argument("--debug", action="store_true", help="show tracebacks")
    convert.set_defaults(command=export)

    check = subparsers.add_parser(
        "doctor", help="say what this machine can render with", epilog=EXIT_CODES_OF_DOCTOR
    )
    check.add_argument("--debug", action="store_true", help=argparse.SUPPRESS)
    check.set_defaults(command=doctor)
    return parser


def _add_sensor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-s", "--sensor", type=int, default=0, metavar="INDEX", help="in the scene's order, from 0"
    )


def _add_scene_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", type=Path, metavar="SCENE.xml")
    _add_mode(parser)
    parser.add_argument("-t", "--threads", type=int, help="default: one per core")
    parser.add_argument(
        "-D", "--define", type=parse_assignment, action="append", default=[], metavar="KEY=VALUE",
        help="define $KEY of the scene description",
    )  # fmt: skip
    integrator = parser.add_argument(
        "--integrator", metavar="NAME", help="replaces the scene's; default: the scene's own"
    )
    _offer(integrator, ("envmap_hybrid", "one_level_path", "source_selection", "path"))
    parser.add_argument(
        "--set", type=parse_setting, action="append", default=[], metavar="KEY=VALUE",
        help="integrator parameter: true, false, an integer, a float (1.0) or a string; "
        "CHILD.KEY: of what is nested in it, shapes make a cluster",
    )  # fmt: skip
    output = parser.add_mutually_exclusive_group()
    output.add_argument(
        "--quiet", action="store_true", help="no table, no progress; warnings and errors remain"
    )
    output.add_argument(
        "--json", action="store_true", help="what there is to know of the result as JSON instead"
    )
    parser.add_argument("--debug", action="store_true", help="show tracebacks")


def _add_mode(parser: argparse.ArgumentParser) -> None:
    mode = parser.add_argument(
        "-m", "--mode", default="llvm_ad_rgb", metavar="VARIANT", help="default: %(default)s"
    )
    _offer(mode, SUPPORTED_VARIANTS)


def _offer(option: argparse.Action, values: Sequence[str]) -> None:
    """Have shells complete the values of an option; others can be given all the same."""
    option.completer = lambda **_: values
