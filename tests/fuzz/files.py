"""Mutation fuzzing of saved files: ``python -m tests.fuzz.files --count 100000``.

Three kinds of mutations of a baked state and of a file with maps alone:

bytes      of the file, in any place. It must be refused, or be what was saved.
sealed     the same with the digest mended, as a forger would: OpenEXR parses what has been altered.
values     metadata and arrays are altered, and written by our own writer.

The last two may also pass for a good file, which must then be safe to render with. Whatever comes,
a refusal is one line that names the file, and nothing crashes, takes more than :data:`MAX_SECONDS`
or more memory than :data:`MAX_MEMORY`. Mutations are made and read in processes of their own, so
that a crash is known by its seed: ``--begin SEED --count 1`` repeats it.
"""

from __future__ import annotations

import argparse
import copy
import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from envmap_integrator.system import storage
from tests.helpers import ROOT, cluster, integrator, load, room

#: Limits of the time [s] to read one file, and to render with it.
MAX_SECONDS, MAX_RENDER_SECONDS = 2, 30
#: Address space [bytes] that reading may take beyond what the process has at first.
MAX_MEMORY = 1 << 30
#: Share of each kind.
KINDS = {"bytes": 0.8, "sealed": 0.1, "values": 0.1}
#: Numbers that sizes and offsets are replaced by.
EXTREME = (0, 1, 2, 255, 2**16 - 1, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
VALUES = (
    None, True, -1, 0, 1, 3, 2**15, 2**31 - 1, 2**31, 2**63, 10**400, -0.0, 0.5, 1e-38, 1e300,
    float("nan"), float("inf"), "", "desk", "\n" * 3, "x" * 10_000,
    [], [1], [1, 2, 3], {}, {"a": 1},
)  # fmt: skip
MADE_BY = "make it again"
#: So many failures are enough.
MAX_FAILURES = 20


class Failure(AssertionError):
    """A file was neither refused as it should be nor what was saved."""


# ---------------------- Mutations ----------------------


def mutate_bytes(content: bytes, others: list[bytes], rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        content = rng.choice(_BYTE_MUTATIONS)(bytearray(content), others, rng)
    return content


def _place(content: bytes, rng: random.Random) -> int:
    """Headers decide more than pixels do: half of the places lie there."""
    end = min(len(content), rng.choice((2048, len(content))))
    return rng.randrange(end) if end else 0


def _range(content: bytes, rng: random.Random) -> tuple[int, int]:
    begin = _place(content, rng)
    return begin, min(begin + rng.choice((1, 4, 16, 256, 4096)), len(content))


def _flip_bit(content, others, rng):
    if content:
        content[_place(content, rng)] ^= 1 << rng.randrange(8)
    return bytes(content)


def _set_byte(content, others, rng):
    if content:
        content[_place(content, rng)] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
    return bytes(content)


def _set_number(content, others, rng):
    begin, size = _place(content, rng), rng.choice((2, 4, 8))
    content[begin : begin + size] = (rng.choice(EXTREME) % 256**size).to_bytes(size, "little")
    return bytes(content)


def _truncate(content, others, rng):
    return bytes(content[: _place(content, rng)])


def _insert(content, others, rng):
    begin = _place(content, rng)
    content[begin:begin] = rng.randbytes(rng.choice((1, 4, 100)))
    return bytes(content)


def _delete(content, others, rng):
    begin, end = _range(content, rng)
    del content[begin:end]
    return bytes(content)


def _swap(content, others, rng):
    (a, b), (c, d) = sorted((_range(content, rng), _range(content, rng)))
    if b <= c:
        return bytes(content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:])
    return bytes(content)


def _repeat(content, others, rng):
    begin, end = _range(content, rng)
    return bytes(content[:end] + content[begin:])


def _splice(content, others, rng):
    other = rng.choice(others)
    return bytes(content[: _place(content, rng)] + other[_place(other, rng) :])


_BYTE_MUTATIONS = (
    _flip_bit, _set_byte, _set_number, _truncate, _insert, _delete, _swap, _repeat, _splice,
)  # fmt: skip


def seal(content: bytes) -> bytes:
    """Replace the digest at the end by that of the content."""
    kept = content[: -storage._DIGEST_SIZE]
    return kept + storage._digest(kept)


def mutate_values(stored: storage.Stored, rng: random.Random) -> tuple[storage.Parts, dict]:
    """Parts and metadata with one value or several altered."""
    parts = {name: dict(channels) for name, channels in stored.parts.items()}
    metadata = copy.deepcopy(stored.metadata)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if rng.random() < 0.6:
            _alter_metadata(metadata, rng)
        elif parts:
            _alter_parts(parts, rng)
    return parts or {"none": {"Y": np.zeros((1, 1), np.float32)}}, metadata


def _alter_metadata(container: Any, rng: random.Random) -> None:
    keys = list(container if isinstance(container, dict) else range(len(container)))
    if not keys:
        return
    key = rng.choice(keys)
    if isinstance(container[key], dict | list) and container[key] and rng.random() < 0.8:
        _alter_metadata(container[key], rng)
    elif rng.random() < 0.2:
        del container[key]
    else:
        container[key] = copy.deepcopy(rng.choice(VALUES))


def _alter_parts(parts: storage.Parts, rng: random.Random) -> None:
    part = rng.choice(list(parts))
    channel = rng.choice(list(parts[part]))
    image = parts[part][channel]
    numbers = (np.nan, np.inf, -1, 1e30, 1e-40) if image.dtype == np.float32 else EXTREME[:-2]
    number = np.array(rng.choice(numbers)).astype(image.dtype)
    match rng.randrange(5):
        case 0:
            del parts[part]
        case 1:
            rows = rng.choice((image[:1], image[: len(image) // 2 + 1], np.repeat(image, 2, 0)))
            parts[part] = dict.fromkeys(parts[part], np.ascontiguousarray(rows))
        case 2:
            other = np.uint32 if image.dtype == np.float32 else np.float32
            parts[part][channel] = image.view(other)
        case 3:
            parts[part][channel] = np.full_like(image, number)
        case 4:
            parts[part][channel] = image.copy()
            parts[part][channel].flat[rng.randrange(image.size)] = number


# ---------------------- What is to hold ----------------------


class Reader:
    """Reads mutated files, in one process."""

    def __init__(self, folder: Path):
        mi.set_variant("llvm_ad_rgb")
        self.paths = [folder / name for name in ("state.exr", "maps.exr")]
        self.contents = [path.read_bytes() for path in self.paths]
        self.saved = [storage.read(path, MADE_BY) for path in self.paths]
        self.path = folder / f"mutated-{time.time_ns()}.exr"
        self.scene = load(room())
        self.it = mi.SurfaceInteraction3f()
        self.it.wi = mi.Vector3f(0.3, 0.4, [0.5, -0.5])
        for path in self.paths:  # Kernels are compiled before anything is limited.
            self._use(path)

    def try_seed(self, seed: int) -> str:
        """Make and read one mutation; return what came of it."""
        rng = random.Random(seed)
        kind = rng.choices(list(KINDS), KINDS.values())[0]
        which = rng.randrange(len(self.paths))
        signal.setitimer(signal.ITIMER_REAL, MAX_SECONDS)
        if kind == "values":
            storage.write(self.path, *mutate_values(self.saved[which], rng))
        else:
            content = mutate_bytes(self.contents[which], self.contents, rng)
            self.path.write_bytes(seal(content) if kind == "sealed" else content)
        outcome = self._outcome(kind == "bytes", self.saved[which])
        signal.setitimer(signal.ITIMER_REAL, 0)
        return f"{kind}: {outcome}"

    def _outcome(self, must_be_same: bool, saved: storage.Stored) -> str:
        try:
            found = storage.read(self.path, MADE_BY)
        except storage.StorageError as error:
            self._check(str(error))
            return "refused"
        same = _same(found, saved)
        if must_be_same and not same:
            raise Failure("other content was taken for what was saved")
        if same:
            return "the same"
        signal.setitimer(signal.ITIMER_REAL, MAX_RENDER_SECONDS)
        return "used" if self._use(self.path) else "refused when used"

    def _use(self, path: Path) -> bool:
        """Render with a file, and show its map; return whether either was possible."""
        filename = {"filename": str(path)}
        uses: tuple[Callable[[], Any], ...] = (
            lambda: mi.load_dict({"type": "mipmap_cube"} | filename).eval(self.it, True).numpy(),
            lambda: _hybrid(cache_file=str(path)).render(self.scene, spp=1).numpy(),
        )
        used = False
        for use in uses:
            try:
                use()
                used = True
            except (ValueError, RuntimeError) as error:  # Mitsuba adds where it loaded a plugin.
                self._check(str(error).rpartition("Error: ")[2] or str(error), path)
        return used

    def _check(self, message: str, path: Path | None = None) -> None:
        path = path or self.path
        if str(path) not in message or "\n" in message.strip() or "make it" not in message:
            raise Failure(f"a bad message: {message!r}")


def _same(a: storage.Stored, b: storage.Stored) -> bool:
    def arrays(stored):
        return {
            (part, channel): (image.dtype, image.shape, image.tobytes())
            for part, channels in stored.parts.items()
            for channel, image in channels.items()
        }

    return a.metadata == b.metadata and arrays(a) == arrays(b)


def _hybrid(**settings: Any) -> mi.Integrator:
    return integrator("envmap_hybrid", desk=cluster(), patches=256, map_resolution=4, **settings)


# ---------------------- Processes ----------------------

_RESULT = "result: "


def make_corpus(folder: Path) -> None:
    """Save what is to be mutated."""
    mi.set_variant("llvm_ad_rgb")
    _hybrid().prepare(load(room())).save(folder / "state.exr")
    stored = storage.read(folder / "state.exr", MADE_BY)
    maps = {name: parts for name, parts in stored.parts.items() if name.startswith("map")}
    storage.write(folder / "maps.exr", maps, {"maps": stored.metadata["maps"]})


def work(folder: Path, begin: int, end: int) -> None:
    """Try the seeds of a range. What has come of each is printed at once, before the next."""
    reader = Reader(folder)
    used = next(line for line in open("/proc/self/status") if line.startswith("VmSize"))
    limit = int(used.split()[1]) * 1024 + MAX_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    for seed in range(begin, end):
        print(_RESULT + reader.try_seed(seed), flush=True)


def run(begin: int, count: int) -> tuple[Counter, list[str]]:
    """Try ``count`` seeds; return how often each outcome came, and what failed."""
    tally: Counter = Counter()
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        make_corpus(Path(folder))
        seed, end = begin, begin + count
        while seed < end and len(failures) < MAX_FAILURES:
            command = [sys.executable, "-m", "tests.fuzz.files", "--work", folder]
            result = subprocess.run(
                [*command, f"--begin={seed}", f"--count={end - seed}"],
                cwd=ROOT, capture_output=True, text=True,
            )  # fmt: skip
            # OpenEXR prints there too.
            lines = [line for line in result.stdout.splitlines() if line.startswith(_RESULT)]
            tally.update(line.removeprefix(_RESULT) for line in lines)
            seed += len(lines)
            if result.returncode:
                last = (result.stderr.strip().splitlines() or ["no message"])[-1]
                failures.append(f"seed {seed}: exit code {result.returncode}, {last}")
                seed += 1
    return tally, failures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--begin", type=int, default=0, help="first seed")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        work(args.work, args.begin, args.begin + args.count)
        return 0
    start = time.perf_counter()
    tally, failures = run(args.begin, args.count)
    print(json.dumps(dict(sorted(tally.items())), indent=1))
    print(*failures, sep="\n")
    seconds = time.perf_counter() - start
    print(f"{args.count} mutations in {seconds:.0f} s, {len(failures)} failures")
    return bool(failures)


if __name__ == "__main__":
    sys.exit(main())
