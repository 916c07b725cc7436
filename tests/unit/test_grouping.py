"""Grouping and sorting of long lists."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from envmap_integrator.system.grouping import grouped, ordered

LISTS = {
    "of 64 bits": np.random.default_rng(0).choice(
        np.random.default_rng(1).integers(0, 2**64, 900, dtype=np.uint64, endpoint=False), 20000
    ),
    "of 20 bits": np.random.default_rng(2).integers(0, 1 << 20, 20000),
    "that differ in high bits": np.array([1 << 62, 1, 1 << 62, 1 << 40, 1], dtype=np.int64),
    "all zero": np.zeros(7, dtype=np.uint32),
    "none": np.zeros(0, dtype=np.int64),
}


@pytest.mark.parametrize("name", LISTS)
def test_groups_are_those_of_numpy(name):
    keys = LISTS[name]
    groups = grouped(keys)
    unique, first, index, counts = np.unique(
        keys, return_index=True, return_inverse=True, return_counts=True
    )
    assert_array_equal(groups.keys, unique)
    assert_array_equal(groups.index, index)
    assert_array_equal(groups.counts, counts)
    assert_array_equal(groups.order[groups.first[:-1]], first)
    assert_array_equal(ordered(keys), np.argsort(keys, kind="stable"))


def test_ends_of_groups():
    lowest, highest = grouped(np.array([5, 2, 5, 5])).ends(np.array([1.0, 7.0, -3.0, 2.0]))
    assert_array_equal(lowest, [7, -3])
    assert_array_equal(highest, [7, 2])
