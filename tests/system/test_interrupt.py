"""Ctrl-C ends whatever is going on within two seconds, and leaves everything usable."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time

import pytest

from tests.helpers import ROOT

#: Seconds that a process may take to end, and more for a machine that is busy.
LIMIT, TOLERANCE = 2.0, 1.0
#: Of pre-passes and renders that last for minutes.
PATCHES, SPP = 1 << 18, 1 << 12

# ---------------------- From Python ----------------------

#: Presses Ctrl-C a second into a stage, then does it all again, small, and compares.
PYTHON = f"""
import json, os, signal, sys, threading, time
import envmap_integrator
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import numpy as np
from tests.helpers import camera, cluster, integrator, load, room

scene = load(room(sensor=camera(256, 192)))
renderer = integrator("envmap_hybrid", desk=cluster())
expected = renderer.render(scene, spp=1).numpy()
big = integrator("envmap_hybrid", desk=cluster(), patches={PATCHES})
stages = {{
    "prepare": lambda: big.prepare(scene),
    "render": lambda: renderer.render(scene, spp={16 * SPP}).numpy(),
}}

def press():
    pressed.append(time.perf_counter())
    os.kill(os.getpid(), signal.SIGINT)

pressed = []
threading.Timer(1.0, press).start()
try:
    stages[sys.argv[1]]()
    ended = "finished"
except KeyboardInterrupt:
    ended = "KeyboardInterrupt"
seconds = time.perf_counter() - pressed[0]
same = np.array_equal(renderer.render(scene, spp=1).numpy(), expected)
fresh = integrator("envmap_hybrid", desk=cluster())
same &= np.array_equal(fresh.render(scene, spp=1).numpy(), expected)
renderer.prepare(scene).save(sys.argv[2])
stored = integrator("envmap_hybrid", desk=cluster(), cache_file=sys.argv[2])
same &= np.array_equal(stored.render(scene, spp=1).numpy(), expected)
print(json.dumps([ended, seconds, bool(same)]))
"""


@pytest.mark.parametrize("stage", ["prepare", "render"])
def test_in_python(stage, tmp_path):
    command = [sys.executable, "-c", PYTHON, stage, str(tmp_path / "state.exr")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    ended, seconds, same = json.loads(result.stdout.splitlines()[-1])
    assert ended == "KeyboardInterrupt"
    assert seconds < LIMIT + TOLERANCE
    assert same


# ---------------------- From the shell ----------------------

SHELL = "import sys; from envmap_integrator.cli import main; sys.exit(main())"
SCENE = ROOT / "scenes" / "paper_room.xml"
HYBRID = ("--integrator", "envmap_hybrid")


@pytest.mark.parametrize("delay", [2.5, 4.0])
@pytest.mark.parametrize(
    "arguments",
    [
        ("bake", *HYBRID, "--set", f"patches={PATCHES}"),
        ("render", *HYBRID, "--spp", SPP),
        ("render", "--integrator", "path", "--spp", SPP),
    ],
    ids=["bake", "render", "path"],
)
def test_in_the_shell(arguments, delay, tmp_path):
    output = tmp_path / "output.exr"
    output.write_text("old")
    command, *options = map(str, arguments)
    process = subprocess.Popen(
        [sys.executable, "-c", SHELL, command, str(SCENE), "-o", str(output), *options],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        time.sleep(delay)
        assert process.poll() is None
        begin = time.perf_counter()
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert time.perf_counter() - begin < LIMIT + TOLERANCE
    assert process.returncode == 130
    assert error == "envmap-render: interrupted\n"
    assert output.read_text() == "old"
    assert list(tmp_path.iterdir()) == [output]
