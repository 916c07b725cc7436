"""Tables from which kernels choose emitters (``lookup.emitter_choice``)."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...lookup.emitter_choice import EmitterChoice, Emitters
from ...system.jit import upload


def by_weight(emitters: Emitters) -> EmitterChoice:
    """A choice that knows nothing of places: one row for all cells."""
    table = upload(mi.Float, alias_tables(emitters.weights[None]))
    return EmitterChoice(emitters, table, mi.UInt32(0))


def alias_tables(probability: np.ndarray) -> np.ndarray:
    """Alias tables [R, L, 4] of discrete distributions [R, L] (``EmitterChoice``)."""
    n_rows, n = probability.shape
    rows = np.arange(n_rows)
    order = np.argsort(probability, axis=1)
    share = probability * n
    table = np.zeros((n_rows, n, 4))
    table[..., 0], table[..., 1], table[..., 2] = 1, np.arange(n), probability
    # Fill up the poorest bin with what the richest has too much of, which may make it the next
    # poor one.
    next_poor, rich = np.ones(n_rows, dtype=int), np.full(n_rows, n - 1)
    poor = order[:, 0] if n else rows
    for _ in range(n - 1):
        giver = order[rows, rich]
        table[rows, poor, 0] = np.clip(share[rows, poor], 0, 1)
        table[rows, poor, 1] = giver
        share[rows, giver] -= 1 - share[rows, poor]
        became_poor = share[rows, giver] < 1
        poor = np.where(became_poor, giver, order[rows, np.minimum(next_poor, n - 1)])
        rich -= became_poor
        next_poor += ~became_poor
    table[..., 3] = np.take_along_axis(probability, table[..., 1].astype(int), axis=1)
    return table
