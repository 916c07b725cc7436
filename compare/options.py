"""Command line arguments made from the fields of a dataclass."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any


def option(help: str, full: Any, quick: Any = None) -> Any:
    """A field with its value in a full run and, where it differs, in a quick one."""
    return field(default=full, metadata={"help": help, "quick": full if quick is None else quick})


@dataclass(frozen=True)
class Options:
    """What every experiment is told."""

    width: int = option("of the film, in pixels; its shape is the scene's own", 320, 96)
    runs: int = option("interleaved runs, each with a seed of its own; at least 3", 5, 3)
    seed: int = option("seed of the first run", 0)

    def __post_init__(self):
        if self.runs < 3:
            raise ValueError(f"--runs must be at least 3 for a median, got {self.runs}")


@dataclass(frozen=True)
class JudgedOptions(Options):
    """What experiments are told that compare pictures with a reference."""

    reference_spp: int = option("samples per pixel of each third of the reference", 1024, 256)


def add_options(parser: argparse.ArgumentParser, kind: type[Options]) -> None:
    """Add one argument a field: ``reference_spp`` becomes ``--reference-spp``."""
    for item in fields(kind):
        several = isinstance(item.default, tuple)
        example = item.default[0] if several else item.default
        parser.add_argument(
            "--" + item.name.replace("_", "-"),
            type=type(example),
            nargs="+" if several else None,
            metavar=item.name.upper(),
            help=f"{item.metadata['help']} (default: {_text(item.default)})",
        )


def read_options(args: argparse.Namespace, kind: type[Options]) -> Options:
    """What the user has given; the rest from the defaults, those of ``--quick`` if it is set."""
    values = {}
    for item in fields(kind):
        given = getattr(args, item.name)
        default = item.metadata["quick"] if args.quick else item.default
        value = default if given is None else given
        values[item.name] = tuple(value) if isinstance(item.default, tuple) else value
    return kind(**values)


def _text(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def existing(paths: tuple[Path, ...]) -> tuple[Path, ...]:
    """The paths, or ``FileNotFoundError`` for the first that isn't there."""
    for path in paths:
        if not path.is_file():
            raise FileNotFoundError(f'scene "{path}" does not exist')
    return paths
