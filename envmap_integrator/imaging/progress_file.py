"""Files that keep what has been rendered, so that a picture can go on to improve later."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..system.fingerprint import difference
from ..system.jit import upload
from ..system.storage import Stored, read, write
from .film import Sums

#: What is told by a hash, which says nothing to people.
_HASHES = ("sensor", "cache")


@dataclass
class Stream:
    """What the passes of a stream have found so far.

    sums      over its samples, ``imaging.film.Sums``; none before the first pass
    samples   per pixel
    """

    sums: Sums
    samples: int = 0


@dataclass
class Progress:
    """What has been rendered of a picture.

    streams   two, with seeds of their own
    planned   samples per pixel that were asked for at first: the cache is as fine as they are worth
    """

    streams: list[Stream]
    planned: int

    @classmethod
    def none(cls, planned: int) -> Progress:
        """Before the first pass."""
        return cls([Stream([]), Stream([])], planned)

    @property
    def samples(self) -> int:
        """Samples per pixel of both streams."""
        return sum(stream.samples for stream in self.streams)

    def save(self, path: str | os.PathLike, made_for: Mapping[str, object], size) -> None:
        """Write it to an OpenEXR file: ``made_for`` is what it depends on, as plain values by name,
        and ``size`` the width and height of the film.
        """
        width, height = (int(n) for n in size)
        parts = {
            f"stream{index}": {
                f"sum{n:02}": values.numpy().reshape(height, width)
                for n, values in enumerate(stream.sums)
            }
            for index, stream in enumerate(self.streams)
            if stream.samples
        }
        streams = [{"samples": s.samples, "sums": len(s.sums)} for s in self.streams]
        metadata = {"made_for": [dict(made_for)], "planned": self.planned, "streams": streams}
        # Sums hardly get smaller, and it's done between passes.
        write(path, parts, metadata, compress=False)


def stored_progress(path: str | os.PathLike) -> Stored:
    """The file; ``StorageError`` if it's missing, damaged, or of another format."""
    return read(path, "begin anew, without resume or --resume")


def planned_samples(stored: Stored) -> int:
    """Samples per pixel that were asked for at first."""
    return stored.integer("planned", 1)


def progress_of(stored: Stored, made_for: Mapping[str, object], size) -> Progress:
    """What a file holds; ``StorageError`` if that was ``made_for`` something else."""
    (theirs,) = stored.entries("made_for")
    for name, ours in made_for.items():
        reason = _refusal(name, theirs.metadata.get(name), ours)
        if reason:
            raise stored.refusal(reason)
    width, height = (int(n) for n in size)
    streams = []
    for index, entry in enumerate(stored.entries("streams")):
        samples, n_sums = entry.integer("samples", 0), entry.integer("sums", 0, 1 << 16)
        images = [entry.array(f"stream{index}", f"sum{n:02}", np.float32) for n in range(n_sums)]
        if any(image.shape != (height, width) for image in images):
            raise stored.refusal(f"its pictures aren't {width} x {height}")
        streams.append(Stream([upload(mi.Float, image) for image in images], samples))
    return Progress(streams, planned_samples(stored))


def _refusal(name: str, theirs: object, ours: object) -> str:
    """What keeps something made with one value from going on with another; nothing if nothing."""
    if theirs == ours:
        return ""
    if name == "scene":
        differing = difference(str(theirs), str(ours))
        return "made for another scene" + (f": it has other {differing}" if differing else "")
    if name in _HASHES:
        return f"made for another {name}"
    return f"made with {name}={theirs}, not {name}={ours}"
