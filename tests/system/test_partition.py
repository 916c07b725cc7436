"""Workers that own a cluster each: what is counted of them, and what those that are real find."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from compare.experiments import partition
from compare.experiments.partition import (
    EXACT,
    LEAKY,
    OCCLUDED,
    WHOLE,
    Options,
    Prepared,
    owned,
    prepare,
    write_jobs,
)
from compare.part_worker import do
from compare.scenes import View
from compare.walks import ENDS, Event, camera_samples
from envmap_integrator.system.ray_counts import count_rays

pytestmark = pytest.mark.usefixtures("variant")

OPTIONS = Options(width=32, spp=4, ratio=1.5, clusters="listed")
LISTED = {"hall": {"near": ("near",), "far": ("far",)}}

#: A hall with a ball at each end; a lamp that shines on both, and a screen that keeps its light
#: from the far one, though it stands beyond its cube.
HALL = """
<scene version="3.0.0">
    <sensor type="perspective">
        <float name="fov" value="100"/>
        <transform name="to_world">
            <lookat origin="0, -1.8, 0.2" target="0, 1, 0" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm"> <integer name="width" value="32"/> <integer name="height" value="24"/>
            <rfilter type="box"/> <string name="pixel_format" value="rgb"/> </film>
    </sensor>
    <bsdf type="diffuse" id="grey"> <rgb name="reflectance" value="0.5"/> </bsdf>
    <shape type="cube" id="hall">
        <boolean name="flip_normals" value="true"/>
        <transform name="to_world"> <scale x="4" y="2" z="1"/> </transform> <ref id="grey"/>
    </shape>
    <shape type="rectangle" id="lamp">
        <transform name="to_world"> <scale value="0.3"/> <rotate y="1" angle="90"/>
            <translate x="-3.9"/> </transform>
        <emitter type="area"> <rgb name="radiance" value="20"/> </emitter> <ref id="grey"/>
    </shape>
    <shape type="cube" id="screen">
        <transform name="to_world"> <scale x="0.02" y="0.8" z="0.8"/> <translate x="0.2"/>
        </transform> <ref id="grey"/>
    </shape>
    <shape type="sphere" id="near"> <point name="center" x="-1.4" y="0" z="0"/>
        <float name="radius" value="0.5"/> <ref id="grey"/> </shape>
    <shape type="sphere" id="far"> <point name="center" x="1.6" y="0" z="0"/>
        <float name="radius" value="0.5"/> <ref id="grey"/> </shape>
</scene>
"""


@pytest.fixture(scope="module")
def prepared(tmp_path_factory) -> Prepared:
    """The hall with the maps of both balls."""
    path = tmp_path_factory.mktemp("hall") / "hall.xml"
    path.write_text(HALL)
    with patch.object(partition, "LISTED", LISTED):
        found = prepare(View(path, OPTIONS.width, merge_meshes=False), OPTIONS)
    assert [cluster.name for cluster in found.clusters] == ["near", "far"]
    return found


def test_counts(prepared):
    """Every ray has one end, and all are those that the integrator sends."""
    owners = owned(prepared, OPTIONS)
    whole = owners[-1]
    for owner in owners:
        counts = owner.work.counts
        assert sum(counts[event] for event in ENDS) == counts[Event.SECONDARY] > 0
        assert 0 <= owner.work.shadow_rays_sent <= counts[Event.SHADOW]
        assert owner.sent_bytes >= 0
    for owner in owners[:-1]:
        assert 0 < owner.triangles.triangles <= owner.shapes.triangles < whole.shapes.triangles
        assert 0 < owner.triangles.bytes <= owner.shapes.bytes < whole.shapes.bytes
        assert owner.work.counts[Event.MAP] > 0
    assert whole.sent_bytes == 0

    n_samples = OPTIONS.width * 24 * OPTIONS.spp
    assert sum(owner.work.counts[Event.CAMERA] for owner in owners) == n_samples  # No way out.
    integrator = prepared.subject.make()
    integrator.prepare(prepared.scene, spp=OPTIONS.spp)
    with count_rays() as rays:
        integrator.render(prepared.scene, spp=OPTIONS.spp)
    shadow = sum(owner.work.counts[Event.SHADOW] for owner in owners)
    # Those that go on where a worker would have to send the path aren't the worker's.
    assert shadow == pytest.approx(rays["shadow"], rel=0.03)


@pytest.mark.parametrize("index", [0, 1])
def test_workers(prepared, index, tmp_path):
    """A part is as good as all where nothing outside comes between; else an occluder is."""
    n_clusters = len(prepared.clusters)
    samples = camera_samples(prepared.scene, prepared.lookup, OPTIONS.spp, 0, n_clusters)
    mask = samples.all_of(index)
    assert mask.any()
    asked = write_jobs(prepared, index, samples, mask, OPTIONS, tmp_path)
    assert asked.slot.max() + 1 == mask.sum()
    found = {}
    for worker in (WHOLE, EXACT, LEAKY, OCCLUDED):
        found[worker], measured = do(asked.jobs[worker])
        assert np.isfinite(found[worker]).all() and (found[worker] >= 0).all()
    mean = {worker: radiance.mean() for worker, radiance in found.items()}
    assert mean[EXACT] == pytest.approx(mean[WHOLE], rel=0.05)
    np.testing.assert_array_equal(found[OCCLUDED], found[EXACT])
    if prepared.clusters[index].name == "far":
        assert mean[LEAKY] > 1.5 * mean[EXACT]
    else:
        np.testing.assert_array_equal(found[LEAKY], found[EXACT])
