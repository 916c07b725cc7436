"""No file is lost or taken for another, whatever happens to it: short runs of ``tests.fuzz``."""

from __future__ import annotations

import re
import subprocess
import sys

from tests.helpers import ROOT

KILLS, MUTATIONS = 200, 1000


def run(module: str, count: int) -> str:
    command = [sys.executable, "-m", f"tests.fuzz.{module}", f"--count={count}"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_killed_while_saving():
    """Two processes at a time, by kill -9. Most kills have to come within a write."""
    output = run("kills", KILLS)
    tally = dict(re.findall(r"'([\w ]+)': (\d+)", output))
    assert int(tally["kills"]) == KILLS
    assert int(tally["within a write"]) > KILLS // 2, output


def test_damaged_in_any_way():
    output = run("files", MUTATIONS)
    tally = {what: int(count) for what, count in re.findall(r'"(.+)": (\d+)', output)}
    assert sum(tally.values()) == MUTATIONS
    assert {"bytes: refused", "sealed: refused", "values: refused", "values: used"} <= tally.keys()
