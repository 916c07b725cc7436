"""Pictures by several processes: the same to the bit, whatever happens to these."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import psutil
import pytest
from distributed import Client, LocalCluster, Status

from envmap_integrator.cli import main
from envmap_integrator.distributed import cluster, progressive, render, tasks
from envmap_integrator.distributed.job import Job, View
from envmap_integrator.distributed.progressive import progressive_distributed
from envmap_integrator.distributed.render import check_workers, render_distributed, render_views
from envmap_integrator.imaging.film import pixel_ranges
from envmap_integrator.system.scene_file import SceneFile
from tests import sleepers
from tests.helpers import ROOT, SCENES, ball, camera, film, load, room
from tests.helpers import cluster as desk

pytestmark = pytest.mark.usefixtures("variant")

SCENE = SCENES / "paper_room.xml"
SHELL = "import sys; from envmap_integrator.cli import main; sys.exit(main())"
SPP = 20
#: Of renders by workers here: small, and in many parts.
PARAMETERS = {"resx": "80", "resy": "60"}
SETTINGS = {"patches": 1024}
MANY_PARTS = 80 * 60 * SPP // 25
#: Workers that are killed, for a longer run.
KILLS = int(os.environ.get("ENVMAP_KILLS", 3))


@pytest.fixture(scope="module")
def client():
    """Two workers, which share the two threads of one."""
    with cluster.local(2, 2) as client:
        yield client


@pytest.fixture(scope="module")
def in_one_process(variant):
    """The picture of one process, and as files have it."""
    scene_file = SceneFile(SCENE, PARAMETERS)
    scene_file.configure_integrator("envmap_hybrid", SETTINGS)
    scene = scene_file.load(merge_meshes=False)
    picture = scene.integrator().render(scene, seed=3, spp=SPP).numpy()
    return picture, np.array(scene.sensors()[0].film().bitmap())


@pytest.fixture
def at_once(in_one_process):
    return in_one_process[0]


def by_workers(client, **more) -> np.ndarray:
    return render_distributed(
        SCENE, client, integrator="envmap_hybrid", settings=SETTINGS, parameters=PARAMETERS,
        spp=SPP, seed=3, **more,
    ).numpy()  # fmt: skip


@contextmanager
def many_parts(monkeypatch):
    """Renders are cut into about 25 parts."""
    with monkeypatch.context() as patch:
        for module in (render, progressive):
            patch.setattr(module, "LEAST_SAMPLES", MANY_PARTS)
            patch.setattr(module, "MOST_SAMPLES", MANY_PARTS)
        yield


def processes(parent: int | None = None) -> list[psutil.Process]:
    """Those of the workers that are there, of all clusters of this process or another one."""
    children = psutil.Process(parent).children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def at_work(client) -> list[psutil.Process]:
    """Those that have started: Dask gives up one that dies before."""
    workers = [nanny.process for nanny in client.cluster.workers.values()]
    pids = [worker.pid for worker in workers if worker and worker.status is Status.running]
    return [psutil.Process(pid) for pid in pids if pid is not None and psutil.pid_exists(pid)]


# ---------------------- Parts of a picture ----------------------


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("envmap_hybrid", {"desk": desk(), "indirect_aovs": True}),
        ("one_level_path", {"residual_probability": 0.5}),
    ],
)
@pytest.mark.parametrize("lanes", [1, 1 << 20])
def test_pixels_of_ranges_are_those_of_the_whole(kind, settings, lanes, tmp_path, monkeypatch):
    """From a saved state, in any order; with one lane a pixel and with several; of a part of a film
    with a wide filter.
    """
    monkeypatch.setattr("envmap_integrator.imaging.film.MIN_LANES", lanes)
    spp = 17
    crop = {"crop_offset_x": 3, "crop_width": 54, "crop_height": 45}
    sensor = camera() | {"film": film(61, 47) | crop | {"rfilter": {"type": "gaussian"}}}
    glass = ball(0.4, 0.2, -1.6, 0.4) | {"bsdf": {"type": "dielectric"}}
    scene = load(room(glass=glass, sensor=sensor))
    (sensor,) = scene.sensors()

    def ours(**more):
        return mi.load_dict({"type": kind, "patches": 1024, **settings, **more})

    whole = ours()
    expected = whole.render(scene, sensor, seed=3, spp=spp).numpy()
    whole.prepare(scene, sensor, spp).save(tmp_path / "state.exr")
    other = ours(cache_file=str(tmp_path / "state.exr"))
    n_pixels = int(np.prod(sensor.film().crop_size()))
    ranges = pixel_ranges(n_pixels, [n_pixels // 3, 50, n_pixels // 5, n_pixels])
    assert len(ranges) == 4
    assert [*itertools.chain(*ranges)] == [*range(n_pixels)]
    sums = {
        pixels.start: np.array(other.pixel_sums(scene, sensor, 3, spp, pixels))
        for pixels in reversed(ranges)
    }
    joined = np.concatenate([sums[pixels.start] for pixels in ranges], axis=1)
    with dr.suspend_grad():
        other.put(sensor, [mi.Float(channel) for channel in joined], spp)
    assert np.array_equal(sensor.film().develop().numpy(), expected)


@pytest.mark.parametrize("n_workers", [1, 2, 64])
@pytest.mark.parametrize("n_pixels", [1, 100, 640 * 480])
def test_parts_cover_a_picture_and_shrink(n_pixels, n_workers):
    sizes = [*render.part_sizes(n_pixels, n_pixels, 64, n_workers)]
    assert sum(sizes) == n_pixels
    assert sizes == sorted(sizes, reverse=True)
    assert len(sizes) == 1 or max(sizes) * 64 <= render.MOST_SAMPLES


# ---------------------- Pictures ----------------------


def test_workers_give_the_same_picture(client, at_once, monkeypatch):
    with many_parts(monkeypatch):
        assert np.array_equal(by_workers(client), at_once)


def test_several_views(client, at_once):
    """Of one scene, moved sensors among them; all from one state."""
    home = mi.traverse(mi.load_file(str(SCENE)).sensors()[0])["to_world"].matrix
    nearer = np.array(home).reshape(4, 4) @ np.array(
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    )
    places = [None, tuple(map(float, nearer.ravel())), None]
    found = render_views(
        SCENE, client, [View(0, place) for place in places], integrator="envmap_hybrid",
        settings=SETTINGS, parameters=PARAMETERS, spp=SPP, seed=3,
    )  # fmt: skip
    pictures = {index: picture.numpy() for index, picture in found}
    assert sorted(pictures) == [0, 1, 2]
    assert np.array_equal(pictures[0], at_once)
    assert np.array_equal(pictures[2], pictures[0])
    assert not np.array_equal(pictures[1], pictures[0])


def test_better_and_better_pictures(client, tmp_path, monkeypatch):
    """All of them, and what is kept to go on from, whoever has begun with it."""
    scene_file = SceneFile(SCENE, PARAMETERS)
    scene_file.configure_integrator("envmap_hybrid", SETTINGS)
    scene = scene_file.load(merge_meshes=False)
    here, there = tmp_path / "here.exr", tmp_path / "there.exr"
    passes = {"seed": 3, "spp": 4, "total": SPP}
    expected = scene.integrator().progressive(scene, progress_file=here, **passes)
    expected = [(better.spp, better.error, better.picture.numpy()) for better in expected]
    halfway = scene.integrator().progressive(scene, progress_file=there, **passes)
    found = [next(halfway), next(halfway)]
    halfway.close()
    with many_parts(monkeypatch):
        rest = progressive_distributed(
            SCENE, client, integrator="envmap_hybrid", settings=SETTINGS, parameters=PARAMETERS,
            progress_file=there, resume=True, **passes,
        )  # fmt: skip
        assert next(rest).spp == found[1].spp  # What there is already.
        found += rest
    assert [(better.spp, better.error) for better in found] == [(n, e) for n, e, _ in expected]
    for better, (_, _, picture) in zip(found, expected, strict=True):
        assert np.array_equal(better.picture.numpy(), picture)
    assert here.read_bytes() == there.read_bytes()


@pytest.mark.parametrize("progressive", [False, True])
def test_in_the_shell(in_one_process, tmp_path, capsys, progressive):
    options = [arg for key, value in PARAMETERS.items() for arg in ("-D", f"{key}={value}")]
    options += ["--integrator", "envmap_hybrid", "--set", "patches=1024"]
    options += ["--spp", str(SPP), "--seed", "3", "--workers", "1"]
    options += ["--progressive"] if progressive else []
    output = tmp_path / "room.exr"
    assert main(["render", str(SCENE), *options, "-o", str(output)]) == 0
    told = capsys.readouterr().out
    assert "find workers" in told
    if progressive:  # Another sequence of samples.
        assert told.startswith("16 samples per pixel, ") and f"{SPP} samples per pixel, " in told
        assert list(mi.Bitmap(str(output)).size()) == [80, 60]
    else:
        assert np.array_equal(np.array(mi.Bitmap(str(output))), in_one_process[1])


def test_ctrl_c(tmp_path):
    """It ends at once, and no worker stays."""
    command = [sys.executable, "-c", SHELL, "render", str(SCENE), "--workers", "2"]
    command += ["--integrator", "envmap_hybrid", "--spp", "4096", "-o", str(tmp_path / "room.exr")]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        while len(workers := processes(process.pid)) < 2:
            time.sleep(0.1)
        time.sleep(6)
        assert process.poll() is None
        pressed = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
        assert time.monotonic() - pressed < 5
    finally:
        process.kill()
    assert process.returncode == 130
    assert error == "envmap-render: interrupted\n"
    _, left = psutil.wait_procs(workers, timeout=5)
    assert not left
    assert list(tmp_path.iterdir()) == []


# ---------------------- Workers that fail ----------------------


@pytest.fixture
def when_a_part_comes(monkeypatch):
    """``when_a_part_comes(do)``: ``do(number)`` is called for each part of a picture in turn."""

    def install(do):
        def watched(*arguments):
            for number, found in enumerate(results(*arguments)):
                do(number)
                yield found

        results = tasks.results
        monkeypatch.setattr(render, "results", watched)

    return install


def test_killed_workers(client, at_once, when_a_part_comes, monkeypatch):
    """Each time that a few parts have come, one worker is killed, or both are."""
    rng = np.random.default_rng(0)
    killed = []

    def kill(number):
        if number % 2 == 0 and len(killed) < KILLS:
            for process in rng.permutation(at_work(client))[: rng.integers(1, 3)]:
                process.kill()
                killed.append(process)

    when_a_part_comes(kill)
    pictures = []
    with many_parts(monkeypatch):
        while len(killed) < KILLS:
            pictures.append(by_workers(client))
    assert all(np.array_equal(picture, at_once) for picture in pictures)


def test_a_hung_worker(client, at_once, when_a_part_comes, monkeypatch):
    """Stopped amid its work, it never answers."""
    client.wait_for_workers(2)
    victim, _ = processes()
    when_a_part_comes(lambda number: victim.suspend() if number == 0 else None)
    try:
        with many_parts(monkeypatch):
            picture = by_workers(client, time_limit=5.0)
        assert victim.status() == psutil.STATUS_STOPPED
    finally:
        victim.kill()
    assert np.array_equal(picture, at_once)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scene": "/none/room.xml"}, 'no scene file "/none/room.xml"; put it there'),
        ({"content": "other"}, "has other content than where the picture is asked for; copy"),
        ({"environment": {"mitsuba": "3.8.0"}}, "instead of 3.8.0; install that version there"),
        ({"environment": {"CPU": "arm64"}}, "another kind of CPU"),
    ],
)
def test_workers_that_differ(client, change, message):
    job = Job.of(SCENE, parameters=PARAMETERS)
    if "environment" in change:
        change = {"environment": job.environment | change["environment"]}
    with pytest.raises(ValueError, match=r"^worker tcp://127\.0\.0\.1:\d+: ") as caught:
        check_workers(client, replace(job, **change))
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"env": {"DRJIT_LIBLLVM_PATH": "/none/libLLVM.so"}}, "need LLVM 17 or newer"),
        (
            {"preload": ["import sys; sys.modules['envmap_integrator'] = None"]},
            "no package envmap_integrator; install it there",
        ),
    ],
)
def test_workers_that_lack_something(options, message):
    settings = {"n_workers": 1, "threads_per_worker": 1, "host": "127.0.0.1"}
    with LocalCluster(dashboard_address=":0", **settings, **options) as there, Client(there) as one:
        with pytest.raises(ValueError, match="^worker tcp://") as caught:
            check_workers(one, Job.of(SCENE))
    assert message in str(caught.value) and "\n" not in str(caught.value)


# ---------------------- Another program's cluster ----------------------


@pytest.fixture(scope="module")
def certificates(tmp_path_factory) -> dict[str, str]:
    """Files by their names: an authority's certificate, one that it has signed, and a key for it;
    the same of another authority.
    """
    if not shutil.which("openssl"):
        pytest.skip("makes certificates with openssl")
    folder = tmp_path_factory.mktemp("certificates")

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    for authority in ("ca", "other"):
        openssl(
            "req", "-x509", *curve, "-subj", f"/CN={authority}", "-keyout", "x", "-out", authority
        )
        openssl("req", *curve, "-subj", "/CN=us", "-keyout", f"{authority}-key", "-out", "request")
        openssl(
            *("x509", "-req", "-in", "request", "-CA", authority, "-CAkey", "x"),
            *("-CAcreateserial", "-out", f"{authority}-signed"),
        )
    return {file.name: str(file) for file in folder.iterdir()}


@pytest.fixture(scope="module")
def farm(certificates, tmp_path_factory) -> Iterator[str]:
    """Address of a scheduler with TLS, which was started in a shell, with a worker."""
    folder = tmp_path_factory.mktemp("farm")
    ca, certificate, key = (certificates[name] for name in ("ca", "ca-signed", "ca-key"))
    tls = ["--tls-ca-file", ca, "--tls-cert", certificate, "--tls-key", key, "--no-dashboard"]
    dask = [sys.executable, "-m", "dask"]
    local = ["--protocol", "tls", "--host", "127.0.0.1", "--port", "0"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    file = folder / "scheduler.json"
    started = []

    def start(*arguments: str) -> None:
        started.append(
            subprocess.Popen(
                [*dask, *arguments, *tls], cwd=folder, env=environment,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )
        )  # fmt: skip

    try:
        start("scheduler", *local, "--scheduler-file", str(file))
        start("worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny")
        while not file.exists():
            assert started[0].poll() is None
            time.sleep(0.1)
        time.sleep(0.1)
        yield json.loads(file.read_text())["address"]
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_certificates(farm, certificates, at_once):
    """A worker of a scheduler that knows us by our certificate; both are elsewhere."""
    ours = [certificates[name] for name in ("ca", "ca-signed", "ca-key")]
    with cluster.connected(farm, ours) as client:
        assert farm.startswith("tls://")
        assert np.array_equal(by_workers(client), at_once)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("ca", "other-signed", "other-key"), "must be signed by the authority that both name"),
        (("other", "ca-signed", "ca-key"), "must be signed by the authority that both name"),
        (("ca", "ca-signed", "other-key"), "give the authority's certificate, yours, and your key"),
    ],
)
def test_wrong_certificates(farm, certificates, names, message):
    with pytest.raises(ValueError, match=message) as caught:
        cluster.connected(farm, [certificates[name] for name in names]).__enter__()
    assert "\n" not in str(caught.value)


# ---------------------- Calls ----------------------


def test_faults_end_it(client):
    with pytest.raises(RuntimeError, match=r"^worker tcp://127.0.0.1:\d+: has no paper; buy some$"):
        list(tasks.results(client, sleepers.fail, [("has no paper; buy some",)] * 3))


def test_memory_that_no_worker_has(client):
    with pytest.raises(RuntimeError, match="^a worker failed: no memory for so many pixels; see"):
        list(tasks.results(client, sleepers.starve, [()]))


@pytest.mark.parametrize("seconds", [[0.01] * 100, [0.3] * 4])
def test_each_call_once(client, seconds):
    calls = [(i, s) for i, s in enumerate(seconds)]
    found = list(tasks.results(client, sleepers.sleep, calls))
    assert sorted(found) == [(i, i) for i in range(len(calls))]
