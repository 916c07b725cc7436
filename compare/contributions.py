"""What each source contributes to an error, free of noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from compare.metrics import Estimate, Picture, error_floor, estimate, mean_bias
from compare.references import Reference


@dataclass(frozen=True)
class Contribution:
    """The error that an approximation adds.

    rel_mse     of this error alone, without noise
    mean_bias   its mean over that of the reference
    picture     its mean over the seeds, [H, W, 3]
    share       of the sum of all steps: the product of the two, averaged over the picture, over
                the square of the sum; shares of what adds up add up
    left        relMSE of the sum of all steps without this error
    """

    rel_mse: Estimate
    mean_bias: Estimate
    picture: NDArray[np.float64] = field(repr=False)
    share: Estimate | None = None
    left: Estimate | None = None

    def numbers(self) -> dict[str, object]:
        """All but the picture."""
        return {name: value for name, value in vars(self).items() if name != "picture"}


@dataclass(frozen=True)
class Ledger:
    """What errors are booked against.

    explained   sum of the steps, one picture a seed: noise that variants share isn't in it
    judged_by   the reference
    """

    explained: Sequence[Picture]
    judged_by: Reference

    def of_pictures(self, pictures: Sequence[Picture]) -> Contribution:
        """The whole error of a variant, against the reference."""
        return Contribution(
            jackknife([error_floor(some, self.judged_by.thirds) for some in leaving_out(pictures)]),
            mean_bias(pictures, self.judged_by.part_means),
            np.mean(pictures, axis=0, dtype=np.float64) - self.judged_by.picture,
        )

    def of_errors(self, errors: Sequence[Picture]) -> Contribution:
        """An error that is known from each seed, as the difference of two variants."""
        whole, size = self._rel_mses(self.explained), self._rel_mses(errors)
        left = self._rel_mses(np.subtract(self.explained, errors))
        scale = self.judged_by.picture.mean(dtype=np.float64)
        return Contribution(
            rel_mse=jackknife(size),
            mean_bias=estimate([error.mean() / scale for error in errors]),
            picture=np.mean(errors, axis=0),
            share=jackknife((whole + size - left) / (2 * whole)),  # 2ab = a² + b² - (a - b)²
            left=jackknife(left),
        )

    def _rel_mses(self, errors: Sequence[Picture]) -> NDArray[np.float64]:
        # Differences know nothing of the reference but the scale.
        middle = self.judged_by.picture.astype(np.float64)
        pictures = [middle + error for error in errors]
        return np.array([error_floor(some, (middle,) * 3) for some in leaving_out(pictures)])


def leaving_out(pictures: Sequence[Picture]) -> Iterator[list[Picture]]:
    """All of them, then all but each one."""
    yield list(pictures)
    for index in range(len(pictures)):
        yield [*pictures[:index], *pictures[index + 1 :]]


def jackknife(values: Sequence[float]) -> Estimate:
    """A statistic of all runs, by its values as ``leaving_out`` orders them."""
    whole, *without = values
    n = len(without)
    return estimate(n * whole - (n - 1) * np.array(without))
