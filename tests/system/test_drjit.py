"""What Dr.Jit offers and the integrators can't do ends in one line, not in a crash or in zeros."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from tests.helpers import integrator, load, picture, room

pytestmark = pytest.mark.usefixtures("variant")

OURS = ("envmap_hybrid", "one_level_path", "source_selection", "envmap_bake")
REFLECTANCE = "ball.bsdf.reflectance.value"


def messages(error: BaseException | None) -> str:
    """Of an error and all that caused it."""
    return f"{error}\n{messages(error.__cause__)}" if error else ""


# ---------------------- dr.freeze ----------------------


@pytest.mark.parametrize("kind", OURS)
def test_a_frozen_render_is_refused(kind):
    """It used to abort the process."""
    scene, renderer = load(room()), integrator(kind, patches=64)
    frozen = dr.freeze(lambda seed: mi.render(scene, integrator=renderer, seed=seed, spp=1))
    with pytest.raises(RuntimeError) as raised:
        frozen(mi.UInt32(0))
    assert "can't be recorded by dr.freeze" in messages(raised.value)
    assert picture(scene, renderer, spp=1).mean() > 0


def test_a_frozen_sample_is_refused():
    scene, renderer = load(room()), integrator("one_level_path", patches=64)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 8)

    @dr.freeze
    def frozen(origin):
        return renderer.sample(scene, sampler, mi.Ray3f(origin, mi.Vector3f(0, 0, 1)))[0]

    with pytest.raises(RuntimeError) as raised:
        frozen(dr.zeros(mi.Point3f, 8))
    assert "can't be recorded by dr.freeze" in messages(raised.value)


# ---------------------- Gradients ----------------------


def differentiable() -> tuple[mi.Scene, mi.SceneParameters]:
    scene = load(room())
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters[REFLECTANCE])
    parameters.update()
    return scene, parameters


@pytest.mark.parametrize("kind", OURS)
@pytest.mark.parametrize("backward", [True, False], ids=["backward", "forward"])
def test_gradients_are_refused(kind, backward):
    scene, parameters = differentiable()
    image = mi.render(scene, parameters, integrator=integrator(kind, patches=64), spp=1)
    assert dr.all(dr.isfinite(image), axis=None)
    with pytest.raises(NotImplementedError, match="can't be differentiated; use prb"):
        if backward:
            dr.backward(dr.sum(image, axis=None))
        else:
            dr.forward(parameters[REFLECTANCE])


def test_samples_with_gradients_are_refused():
    """They would lack what the cache brings."""
    scene, _ = differentiable()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 8)
    ray = mi.Ray3f(mi.Point3f(0), dr.normalize(mi.Vector3f(0.4, 0.2, -1.6)))
    renderer = integrator("one_level_path", patches=64)
    with pytest.raises(NotImplementedError, match="can't be differentiated; use prb"):
        renderer.sample(scene, sampler, ray)
    with dr.suspend_grad():
        assert dr.all(renderer.sample(scene, sampler, ray)[1])
