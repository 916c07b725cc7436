"""Experiments: what our integrators cost and how far they are off, beside ``path``."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from types import ModuleType

from compare import report
from compare.experiments import (
    algorithms,
    bias,
    complexity,
    distance,
    error_vs_time,
    flicker,
    gallery,
    partition,
    render,
    resolution,
    workers,
)
from compare.options import add_options, read_options
from envmap_integrator.cli.commands import activate_variant
from envmap_integrator.cli.errors import condense

EXPERIMENTS: dict[str, ModuleType] = {
    "resolution": resolution,
    "distance": distance,
    "algorithms": algorithms,
    "error-vs-time": error_vs_time,
    "complexity": complexity,
    "bias": bias,
    "flicker": flicker,
    "gallery": gallery,
    "render": render,
    "workers": workers,
    "partition": partition,
}
"""Each module has ``Options`` and ``run(options, folder)``; its docstring is the help."""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m compare", description=__doc__)
    subparsers = parser.add_subparsers(required=True, metavar="EXPERIMENT", dest="experiment")
    for name, module in EXPERIMENTS.items():
        _add_experiment(subparsers, name, module)
    args = parser.parse_args(arguments)
    try:
        _run(EXPERIMENTS[args.experiment], args)
    except (ValueError, TypeError, RuntimeError, ImportError, OSError) as error:
        if args.debug:
            raise
        print(f"compare: {condense(error)}", file=sys.stderr)
        return 2
    return 0


def _add_experiment(subparsers: argparse._SubParsersAction, name: str, module: ModuleType) -> None:
    summary = module.__doc__.splitlines()[0]
    parser = subparsers.add_parser(name, help=summary, description=module.__doc__)
    if hasattr(module, "SCENES"):
        parser.add_argument(
            "scenes", nargs="*", type=Path, metavar="SCENE.xml",
            help="default: " + ", ".join(path.name for path in module.SCENES),
        )  # fmt: skip
    add_options(parser, module.Options)
    parser.add_argument("--quick", action="store_true", help="a look in minutes: less of it all")
    parser.add_argument("--out", type=Path, default=Path("renders"), help="folder of the results")
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", metavar="VARIANT")
    parser.add_argument("--debug", action="store_true", help="show tracebacks")


def _run(module: ModuleType, args: argparse.Namespace) -> None:
    options = read_options(args, module.Options)
    activate_variant(args.mode)
    start = time.perf_counter()
    for outcome in module.run(options, args.out, **_scenes(module, args)):
        report.show(outcome)
        report.write(outcome, args.out)
        print(f"wrote {args.out / outcome.name}.html, .json, *.png, *.exr")
    print(f"{args.experiment} took {time.perf_counter() - start:.0f} s")


def _scenes(module: ModuleType, args: argparse.Namespace) -> dict[str, tuple[Path, ...]]:
    """The scenes that were named, else the experiment's own, or two of them for a quick look."""
    if not hasattr(module, "SCENES"):
        return {}
    own = module.SCENES[:2] if args.quick else module.SCENES
    return {"scenes": tuple(args.scenes) or own}


if __name__ == "__main__":
    sys.exit(main())
