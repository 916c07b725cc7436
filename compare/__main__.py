"""``python -m compare render SCENE.xml``: pictures, errors and times of several integrators."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from compare import render
from envmap_integrator.cli.errors import condense


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m compare", description=__doc__)
    subparsers = parser.add_subparsers(required=True, metavar="EXPERIMENT")
    _add_render(subparsers)
    args = parser.parse_args()
    try:
        args.experiment(args)
    except (ValueError, TypeError, RuntimeError, ImportError, OSError) as error:
        if args.debug:
            raise
        print(f"compare: {condense(error)}", file=sys.stderr)
        return 2
    return 0


def _add_render(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser("render", help="equal samples, against a path traced reference")
    parser.add_argument("scene", type=Path, metavar="SCENE.xml")
    parser.add_argument(
        "--integrators", nargs="+", default=["envmap_hybrid", "path"], metavar="NAME",
        help="the first is the one whose error the picture shows",
    )  # fmt: skip
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--reference-spp", type=int, default=512, help="of each of its two halves")
    parser.add_argument("--size", type=_size, default=(320, 240), metavar="WxH")
    parser.add_argument("--runs", type=int, default=3, help="timed runs of each integrator")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("renders"))
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", metavar="VARIANT")
    parser.add_argument("--quick", action="store_true", help="a look in seconds: few samples")
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    parser.set_defaults(experiment=_render)


def _render(args: argparse.Namespace) -> None:
    render.compare(
        render.Experiment(
            scene=args.scene,
            integrators=tuple(dict.fromkeys(args.integrators)),
            spp=16 if args.quick else args.spp,
            reference_spp=64 if args.quick else args.reference_spp,
            size=args.size,
            runs=args.runs,
            seed=args.seed,
            variant=args.mode,
        ),
        args.out,
    )


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = map(int, text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f'expected WxH, such as 320x240, got "{text}"') from None
    return width, height


if __name__ == "__main__":
    sys.exit(main())
