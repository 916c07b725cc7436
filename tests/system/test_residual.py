"""With ``residual_probability``, the mean is that of ``path``: Welch's t-test, pixel by pixel."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

pytestmark = pytest.mark.usefixtures("variant")

SCENES = Path(__file__).parents[2] / "scenes"

SEEDS, SPP = 8, 128
WIDTH, HEIGHT = 48, 36
#: Probability that any pixel at all of an unbiased picture fails.
FAMILY_ERROR = 0.01
#: Pixels that must pass: the t distribution fits few samples of skewed noise only roughly.
PASSING = 0.9975


def pictures(scene, integrator: dict, spp: int, first_seed: int) -> np.ndarray:
    """Mean of the colour channels [seeds, H, W]."""
    plugin = mi.load_dict(integrator)
    seeds = range(first_seed, first_seed + SEEDS)
    rendered = [mi.render(scene, integrator=plugin, spp=spp, seed=seed) for seed in seeds]
    return np.stack([np.array(picture)[..., :3].mean(axis=-1) for picture in rendered])


def passing(ours: np.ndarray, reference: np.ndarray) -> float:
    """Share of pixels whose means don't differ (Welch's t-test with Šidák's correction)."""
    p = stats.ttest_ind(ours, reference, axis=0, equal_var=False).pvalue
    p = np.where(np.isnan(p), 1.0, p)  # Both constant: sources seen directly.
    return float((p > 1 - (1 - FAMILY_ERROR) ** (1 / p.size)).mean())


def load(path: Path, **settings) -> mi.Scene:
    scene = mi.load_file(str(path), **settings)
    parameters = mi.traverse(scene.sensors()[0])
    parameters["film.size"] = [WIDTH, HEIGHT]
    parameters.update()
    return scene


@pytest.mark.parametrize("integrator", ["envmap_hybrid", "one_level_path"])
@pytest.mark.parametrize("name", ["paper_room", "desk", "door_ajar"])
def test_the_mean_is_that_of_path(name, integrator):
    check_mean(load(SCENES / f"{name}.xml"), {"type": integrator})


def test_the_mean_with_shadow_rays_at_second_hits_is_that_of_path():
    check_mean(load(SCENES / "desk.xml"), {"type": "envmap_hybrid", "second_hit": "shadow_rays"})


@pytest.mark.parametrize("name", ["cornell-box", "staircase2"])
def test_the_mean_is_that_of_path_in_third_party_scenes(third_party_scene, name):
    check_mean(load(third_party_scene(name)), {"type": "envmap_hybrid"})


def check_mean(scene, integrator: dict):
    reference = pictures(scene, {"type": "path"}, SPP, first_seed=100)
    ours = pictures(scene, integrator | {"residual_probability": 0.5}, SPP, first_seed=0)
    assert passing(ours, reference) >= PASSING
    # The mean of the picture is far more precise than any pixel.
    means = ours.mean(axis=(1, 2)), reference.mean(axis=(1, 2))
    assert stats.ttest_ind(*means, equal_var=False).pvalue > 0.001


def test_bias_is_found():
    """The same test fails for what the method does with a small cube and the plain look-up."""
    scene = load(SCENES / "paper_room.xml", optimize=False)
    parameters = mi.traverse(scene.sensors()[0])
    parameters["film.size"] = [96, 72]
    parameters["film.crop_offset"] = [32, 48]  # The table alone.
    parameters["film.crop_size"] = [32, 12]
    parameters.update()
    shapes = ", ".join(["table-top", "ball", *(f"table-leg-{k}" for k in range(1, 5))])
    biased = {
        "type": "envmap_hybrid",
        "table": {"type": "mipmap_cube", "shapes": shapes},
        "distance_ratio": 1.25,
        "lookup": "plain",
        "mirrors": "map",
    }
    reference = pictures(scene, {"type": "path"}, 4 * SPP, first_seed=100)
    assert passing(pictures(scene, biased, 4 * SPP, first_seed=0), reference) < PASSING
    corrected = pictures(scene, biased | {"residual_probability": 0.5}, 4 * SPP, first_seed=0)
    assert passing(corrected, reference) >= PASSING
