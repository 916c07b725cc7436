"""Which source a shadow ray goes to."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from envmap_integrator.lookup.emitter_choice import EmitterChoice, Emitters
from envmap_integrator.preparation.radiosity.alias_tables import alias_tables, by_weight
from envmap_integrator.preparation.radiosity.direct_light import (
    RAYS_PER_EMITTER,
    SAMPLES,
    choose_emitters,
    survey_direct_light,
)
from envmap_integrator.system.jit import upload
from tests.helpers import grey, lamp
from tests.unit.kit import CoarseMesh, coarse_mesh, scene_of

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("n", [1, 2, 3, 13, 200])
def test_alias_tables_hold_the_distribution(n):
    random = np.random.default_rng(n)
    probability = random.random((50, n)) ** 4 * (random.random((50, n)) < 0.7) + 1e-6
    probability /= probability.sum(axis=1, keepdims=True)
    share, second, own, others = np.moveaxis(alias_tables(probability), -1, 0)
    assert share.min() >= 0 and share.max() <= 1
    found = share / n
    rows = np.arange(50)[:, None]
    np.add.at(found, (np.broadcast_to(rows, (50, n)), second.astype(int)), (1 - share) / n)
    assert_allclose(found, probability, atol=1e-12)
    assert_allclose(own, probability)
    assert_allclose(others, probability[rows, second.astype(int)])


def lamp_at(x: float, power: float = 1.0, **more) -> dict:
    """A small lamp over the floor."""
    shape = lamp(x, 0, 1, 0.2, power)
    shape["emitter"] |= more
    return shape


@pytest.fixture(scope="module")
def hall(variant) -> CoarseMesh:
    """A long floor with a lamp over each end, one in the middle and one that is off."""
    return hall_with(lamp_at(-7), lamp_at(0, 4.0), lamp_at(7), lamp_at(3, 0.0), budget=1024)


def hall_with(*lamps: dict, budget: int) -> CoarseMesh:
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([8, 1, 1])} | grey(0.5)
    return coarse_mesh(scene_of(floor, *lamps), budget, points_per_patch=64)


@pytest.fixture(scope="module")
def choice(hall) -> EmitterChoice:
    return choice_in(hall)


def choice_in(hall) -> EmitterChoice:
    emitters = Emitters.of(hall.scene)
    return choose_emitters(emitters, survey_direct_light(hall.scene, emitters, hall), hall)


def on_the_floor(hall, x: float | mi.Float, n: int = 1):
    """An interaction at (x, 0, 0) and the cell it lies in."""
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.p, si.n = mi.Point3f(x, 0.1, 0), mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    cell = hall.patches.locate(si.p, si.n, _floor_id(hall))
    return si, cell.index, cell.found


def _floor_id(hall):
    low = np.abs(hall.points.position[:, 2]) < 1e-3
    return mi.UInt32(int(hall.points.object_id[low][0]))


@pytest.mark.parametrize("x", [-7.0, 0.0, 7.0])
def test_shadow_rays_go_to_the_lamp_above(hall, choice, x):
    si, cell, found = on_the_floor(hall, x)
    assert dr.all(found)
    si, n = on_the_floor(hall, x, 4096)[0], 4096
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, n)
    ds, _ = choice.sample_direction(si, choice.row(cell, found), sampler.next_2d(), True)
    near = np.abs(ds.p.x.numpy() - x) < 0.5
    assert near.mean() > 0.8
    # The others keep a small probability.
    assert near.mean() < 1


@pytest.mark.parametrize("x", [-7.0, 3.0])
def test_densities_are_those_of_the_samples(hall, choice, x):
    """Chi² over the emitters, the density of each sample, and an unbiased mean."""
    n = 1 << 18
    si, cell, found = on_the_floor(hall, x, n)
    row = choice.row(cell, found)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(2, n)
    ds, weight = choice.sample_direction(si, row, sampler.next_2d(), True)
    assert_allclose(choice.pdf_direction(si, row, ds, True).numpy(), ds.pdf.numpy(), rtol=1e-4)

    count = choice.emitters.count
    first = choice.row(cell, found).numpy()[0] * count
    probability = choice.table.numpy().reshape(-1, 4)[first : first + count, 2]
    assert probability.sum() == pytest.approx(1, abs=1e-5)
    index = choice.emitters.index(ds.emitter).numpy()
    counts = np.bincount(index, minlength=count)
    expected = probability.astype(np.float64)
    assert stats.chisquare(counts, expected / expected.sum() * n).pvalue > 0.001

    plain = by_weight(choice.emitters)
    sampler.seed(3, n)
    other, other_weight = plain.sample_direction(
        si, plain.row(cell, found), sampler.next_2d(), True
    )
    ours, theirs = (
        (w.x * dr.maximum(d.d.z, 0)).numpy() for w, d in ((weight, ds), (other_weight, other))
    )
    error = np.hypot(ours.std(), theirs.std()) / np.sqrt(n)
    assert abs(ours.mean() - theirs.mean()) < 4 * error
    assert ours.std() < 0.7 * theirs.std()


def test_places_in_no_cell_use_the_last_row(hall, choice):
    last = len(choice.table.numpy()) // (4 * choice.emitters.count) - 1
    assert choice.row(mi.UInt32(3), mi.Bool(False)).numpy() == last
    assert by_weight(choice.emitters).row(mi.UInt32(3), mi.Bool(True)).numpy() == 0


def test_rows_are_for_cells_that_are_lit(choice):
    """Not for every slot of the cells' hash table: those would be gigabytes for many emitters."""
    rows = choice.row_of_cell.numpy()
    n_rows = len(choice.table.numpy()) // (4 * choice.emitters.count)
    used = rows[rows < n_rows - 1]
    assert len(np.unique(used)) == len(used) == n_rows - 1 < len(rows) / 2


def test_many_lamps_are_told_apart():
    """Where the shadow rays of a cell are too few for that, those of its surroundings help."""
    random = np.random.default_rng(5)
    hall = hall_with(*map(lamp_at, random.uniform(-7.5, 7.5, 150)), budget=512)
    choice = choice_in(hall)
    n_emitters = choice.emitters.count
    n_rows = len(choice.table.numpy()) // (4 * n_emitters)
    assert 4 < n_rows < hall.patches.count * SAMPLES / (RAYS_PER_EMITTER * n_emitters)

    n = 1 << 16
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(6, n)
    si, cell, found = on_the_floor(hall, 16 * sampler.next_1d() - 8, n)

    def error(choice):
        row = choice.row(cell, found)
        ds, weight = choice.sample_direction(si, row, sampler.next_2d(), True)
        return np.std((weight.x * dr.maximum(ds.d.z, 0)).numpy())

    assert error(choice) < 0.5 * error(by_weight(choice.emitters))


def test_sampling_weights_count():
    """Those of weight 0 are never chosen; the others in proportion where nothing is known."""
    scene = scene_of(lamp_at(-1, sampling_weight=0.0), lamp_at(0, sampling_weight=3.0), lamp_at(1))
    emitters = Emitters.of(scene)
    assert sorted(emitters.weights) == pytest.approx([0, 0.25, 0.75])
    n = 4096
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(4, n)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    ds, weight = by_weight(emitters).sample_direction(si, mi.UInt32(0), sampler.next_2d(), True)
    x = np.round(ds.p.x.numpy())
    assert (x == 0).mean() == pytest.approx(0.75, abs=0.03)
    assert not (x == -1).any()
    assert np.isfinite(weight.numpy()).all()


def test_a_scene_without_emitters_has_nothing_to_choose():
    scene = scene_of({"type": "sphere"})
    si = dr.zeros(mi.SurfaceInteraction3f, 4)
    ds, weight = by_weight(Emitters.of(scene)).sample_direction(
        si, mi.UInt32(0), mi.Point2f(0.5), True
    )
    assert np.all(ds.pdf.numpy() == 0) and np.all(weight.numpy() == 0)


def test_the_largest_random_number_is_in_the_last_bin():
    table = upload(mi.Float, alias_tables(np.array([[0.5, 0.5]])))
    scene = scene_of(lamp_at(-1), lamp_at(1))
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    u = mi.Point2f(1 - 2**-24, 0.5)
    choice = EmitterChoice(Emitters.of(scene), table, mi.UInt32(0))
    ds, _ = choice.sample_direction(si, mi.UInt32(0), u, True)
    assert np.isfinite(ds.p.numpy()).all()
