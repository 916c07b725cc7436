"""Kills processes at random moments while they save: ``python -m tests.fuzz.kills --count 1000``.

After each kill the file has to be one of the versions that were written, whole.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from envmap_integrator.system.atomic import PREFIX
from envmap_integrator.system.storage import read, write

#: Versions that a writer leaves in turn, of different sizes.
VERSIONS = 4
#: A kill comes at most so long [s] after the writer's start; a write takes some milliseconds.
LATEST = 0.05


def parts_of(version: int) -> dict[str, dict[str, np.ndarray]]:
    values = np.random.default_rng(version).integers(0, 1000, (40 << version, 256))
    return {"words": {"id": values.astype(np.uint32)}}


def keep_writing(path: Path) -> None:
    """Save one version after the other until we're killed."""
    written = [parts_of(version) for version in range(VERSIONS)]
    while True:
        for version, parts in enumerate(written):
            write(path, parts, {"version": version})


def assert_whole(path: Path) -> None:
    stored = read(path, "")
    version = stored.integer("version", 0, VERSIONS - 1)
    words = stored.array("words", "id", np.uint32)
    assert np.array_equal(words, parts_of(version)["words"]["id"])


def run(count: int, folder: Path, seed: int = 0, writers: int = 2) -> Counter:
    """Kill ``count`` groups of ``writers`` processes that write the same file.

    Returns how often a kill came within a write, which leaves a temporary file.
    """
    random_ = random.Random(seed)
    path = folder / "state.exr"
    write(path, parts_of(0), {"version": 0})
    tally: Counter = Counter()
    for _ in range(count):
        children = []
        for _ in range(writers):
            child = os.fork()
            if child == 0:
                try:
                    keep_writing(path)
                finally:
                    os._exit(1)
            children.append(child)
        time.sleep(random_.uniform(0, LATEST))
        for child in children:
            os.kill(child, signal.SIGKILL)
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        tally["kills"] += 1
        tally["within a write"] += any(folder.glob(f"{PREFIX}*"))
        assert_whole(path)
    write(path, parts_of(0), {"version": 0})
    assert [file.name for file in folder.iterdir()] == [path.name]
    return tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        tally = run(args.count, Path(folder), args.seed)
    print(f"{dict(tally)} in {time.perf_counter() - begin:.0f} s: every file was whole")


if __name__ == "__main__":
    main()
