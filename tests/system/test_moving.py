"""What stands still keeps its patches and their random numbers while something else moves."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.lookup.patches import MARK_BITS
from envmap_integrator.system.scene_order import lasting_ids, ordered_shapes
from tests.helpers import ball, load, room

pytestmark = pytest.mark.usefixtures("variant")


def test_the_cache_keeps_its_noise_where_nothing_moves():
    scene = load(room() | {"moved": ball(-0.5, -0.4, -0.5, 0.2)})
    integrator = mi.load_dict({"type": "one_level_path", "patches": 2048, "patch_samples": 64})
    before = patches(integrator.prepare(scene))
    params = mi.traverse(scene)
    params["moved.to_world"] = mi.Transform4f().translate([0.02, 0, 0]) @ params["moved.to_world"]
    params.update()
    after = patches(integrator.prepare(scene))
    both = before.keys() & after.keys()
    assert len(both) > 0.9 * len(before)
    change = [abs(after[its] / before[its] - 1) for its in both if before[its] > 0]
    # Rays of its own leave 3 % of noise in each.
    assert np.median(change) < 0.005


def patches(state) -> dict[int, float]:
    """Indirect irradiance of each patch, by the hash of its place."""
    cells = state.cache.patches.cells.numpy()
    irradiance = state.cache.mean_channel()[1::2]
    return {int(cells[i] >> MARK_BITS): float(irradiance[i]) for i in np.flatnonzero(cells)}


def test_shapes_keep_their_ids_while_others_move():
    def ids(x):
        places = {"first": 0.0, "moved": x, "last": 2.0, "twin": 2.0}
        scene = load({"type": "scene"} | {name: ball(at, 0, 0, 0.3) for name, at in places.items()})
        shapes = ordered_shapes(scene)
        return dict(zip([shape.id() for shape in shapes], lasting_ids(shapes), strict=True))

    here, there = ids(1.0), ids(3.0)
    assert len(set(here.values())) == len(here)
    assert here["first"] == there["first"]
    assert {here["last"], here["twin"]} == {there["last"], there["twin"]}
    assert here["moved"] != there["moved"]
