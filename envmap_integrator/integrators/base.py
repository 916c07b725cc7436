"""What the integrators share: preparation, once, and rendering."""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi

import envmap_integrator

from ..imaging.aovs import Aov, camera_sample, parse_aovs
from ..imaging.film import (
    INDIRECT_AOVS,
    Shading,
    Sums,
    gathered_sums,
    has_bands,
    most_samples,
    n_pixels_of,
    plain_sums,
    put_gathered,
    put_plain,
)
from ..imaging.progress_file import Progress, planned_samples, progress_of, stored_progress
from ..imaging.progressive import Improving, Renderer, check_ends, improve
from ..lookup.far_field import FarField
from ..lookup.irradiance_cache import IrradianceCache
from ..lookup.lookup import Lookup
from ..preparation.baked_state import BakedState, Settings, StateKey, load
from ..preparation.pipeline import prepare
from ..preparation.scene_state import SceneState, SceneStates
from ..preparation.views import service, view_name, walks
from ..system.checks import (
    check_film,
    check_not_frozen,
    check_scene,
    check_size,
    check_variant,
    sensor_of,
)
from ..system.interrupt import interruptible
from ..system.parameters import Parameters
from ..system.printed import printed
from ..system.recording import Recorder
from ..system.spectrum import rgb, seen
from ..transport.camera import CameraSample
from ..transport.rules import PathRules, Residual

#: Our own sample points, Mitsuba's samplers, and that of the scene.
SAMPLERS = (
    "coherent",
    "multijitter",
    "independent",
    "stratified",
    "ldsampler",
    "orthogonal",
    "scene",
)
#: Prepared states that an integrator keeps: of views in different rooms, and of other sizes.
MOST_STATES = 8
#: Relative standard error of a picture's brightness, by the cache's noise, that users are told of.
DOUBTFUL = 0.01


class CachedIntegrator(mi.SamplingIntegrator):
    """Base of all integrators that end their paths in the irradiance cache.

    Subclasses say what the pre-passes depend on (``settings``) and how paths go (``rules``).
    """

    LEAST_PATCH_SAMPLES = 32
    """If few camera samples share the cache; the noise of many patches averages out where secondary
    rays end in them."""

    SHADOW_SAMPLES = 2
    """By default: shared irradiance has little noise, so direct light is worth a ray more."""

    HAS_MAPS = False
    """Only maps are asked for and baked by nested plugins."""

    def __init__(self, props: mi.Properties):
        check_variant(props.plugin_name())
        super().__init__(props)
        parameters = Parameters(props)
        self.owner = parameters.owner
        if not self.HAS_MAPS:
            for _, child in props.objects():
                raise TypeError(
                    f'{self.owner}: has no maps, so the nested {child.class_name()} "{child.id()}" '
                    "is for nothing; use envmap_hybrid, or remove it"
                )
        self.patches = parameters.integer("patches", None, 16, 1 << 22)
        self.patch_samples = parameters.power_of_two("patch_samples", None, 1, 1 << 16)
        self.shadow_samples = parameters.integer("shadow_samples", self.SHADOW_SAMPLES, 1, 1 << 16)
        self.sampler = parameters.choice("sampler", "coherent", SAMPLERS)
        self.cache_file = parameters.text("cache_file")
        self._scenes = SceneStates()
        self._made_for: tuple[StateKey, str] | None = None
        self._prepared: dict[tuple[Settings, str], BakedState] = {}
        self._recorders: list[Recorder] = []
        self._passes = 0

    # ---------------------- To be overridden ----------------------

    def settings(self, **more) -> Settings:
        """What the pre-passes depend on besides the scene."""
        return Settings(self.patches, self.patch_samples, self.LEAST_PATCH_SAMPLES, **more)

    def rules(self, seed: int) -> PathRules:
        """How paths go; ``seed`` is that of a pass over the picture."""
        raise NotImplementedError

    def maps_for(
        self, scene: mi.Scene, now: SceneState, baked: BakedState, spp: int
    ) -> FarField | None:
        """The maps, if there are any; ``spp`` samples share a pixel."""
        return None

    def aov_names(self) -> list[str]:
        """Names of the channels that the film holds besides those of every film."""
        return []

    def aov_values(self, found: CameraSample) -> list[mi.Float]:
        """Values of ``aov_names``."""
        return []

    def sample_aovs(self) -> tuple[Aov, ...]:
        """What there is to be in ``CameraSample.aovs``."""
        return ()

    def check_sensor(self, sensor: mi.Sensor) -> None:
        """Raise ``ValueError`` for a sensor that can't be rendered."""
        check_film(sensor, self.owner)

    def sums(
        self,
        sensor: mi.Sensor,
        sampler: mi.Sampler | None,
        spp: int,
        seed: int,
        shading: Shading,
        recorder: Recorder,
        first: int = 0,
        pixels: range | None = None,
    ) -> Sums:
        """Sums over samples of each pixel, or of some, as ``imaging.film`` has them."""
        n_aovs, values = len(self.aov_names()), self.aov_values
        return plain_sums(
            sensor, sampler, spp, seed, shading, recorder, n_aovs, values, first, pixels
        )

    def put(self, sensor: mi.Sensor, sums: Sums, spp: int) -> None:
        """Put sums over ``spp`` samples to the film of a sensor; the list is used up."""
        put_plain(sensor, sums, self.aov_names())

    def to_string(self) -> str:
        """Its parameters, for messages and the metadata of pictures."""
        listed = ",\n".join(f"  {name} = {value}" for name, value in self._parameters().items())
        return f"{type(self).__name__}[\n{listed}\n]"

    def _parameters(self) -> dict[str, object]:
        return {
            name: value
            for name, value in vars(self).items()
            if not name.startswith("_") and name != "owner"
        }

    # ---------------------- Preparation ----------------------

    def prepare(
        self, scene: mi.Scene, sensor: mi.Sensor | int | None = None, spp: int = 0
    ) -> BakedState:
        """Run the pre-passes for a render of a sensor, unless they have been run.

        They are made for all sensors of the scene, and for the given one if it isn't the scene's;
        None stands for the first. Other views share the result if it serves them as well. Larger
        renders get a finer irradiance cache, unless ``patches`` and ``patch_samples`` are set. It's
        rebuilt when a parameter of a shape, material or emitter of the scene changes, and for
        sensors that see what none has seen before.

        Raises ``ValueError`` for scenes that can't be rendered and for a ``cache_file`` that is
        missing, damaged, or of another scene, other settings or other views.
        """
        return self._ready(scene, sensor, spp)[1]

    def _ready(self, scene, sensor, spp) -> tuple[SceneState, BakedState]:
        """The scene as it is now, and what has been prepared for a render of a sensor."""
        check_not_frozen(self.owner)
        settings = self.settings()
        now = self._scenes(scene)
        key = StateKey(now.fingerprint, settings)
        if (key, self.cache_file) != self._made_for:
            check_scene(scene, self.owner)
            self._made_for, self._prepared = (key, self.cache_file), {}
        sensors = list(scene.sensors())
        if sensor is None:
            view = sensors[0] if sensors else None
        else:
            view = sensor_of(scene, sensor)
        if view:
            check_size(view, spp)
            self.check_sensor(view)
        name = view_name(view) if view else ""
        if view and name not in map(view_name, sensors):
            sensors.append(view)
        if not self.cache_file:
            settings = settings.for_render(camera_samples(view, spp))
        if (settings, name) not in self._prepared:
            kept = {id(s.cache): s for (its, _), s in self._prepared.items() if its == settings}
            state = _that_serves(kept.values(), scene, now, view)
            if state is None:
                made = self._make(scene, now, key, settings, sensors)
                for served in made.views:
                    self._keep(settings, served, made)
                state = _that_serves([made], scene, now, view)
            if state is None:
                raise ValueError(
                    f'{self.owner}: "cache_file" {self.cache_file} was made for other views than '
                    "this sensor's; make it again with envmap-render bake, with this sensor in the "
                    "scene"
                )
            self._warn_of_error(state)
            self._keep(settings, name, state)
        return now, self._prepared[settings, name]

    def _keep(self, settings: Settings, view: str, state: BakedState) -> None:
        """Remember which state serves a view, and forget the oldest of many caches."""
        self._prepared[settings, view] = state
        caches = list({id(s.cache): s.cache for s in self._prepared.values()}.values())
        for old in caches[:-MOST_STATES]:
            self._prepared = {k: s for k, s in self._prepared.items() if s.cache is not old}

    def _make(self, scene, now, key, settings, sensors) -> BakedState:
        if self.cache_file:
            owner = f'{self.owner}: "cache_file"'
            return load(self.cache_file, key, owner, len(scene.emitters()))
        with interruptible(), dr.suspend_grad():
            return prepare(scene, now, key.settings, settings, sensors, self.owner)

    def _warn_of_error(self, state: BakedState) -> None:
        if state.relative_error > DOUBTFUL:
            mi.Log(
                mi.LogLevel.Warn,
                f"{self.owner}: little light finds its way to what is seen; the picture may be too "
                f"bright or too dark by {2 * state.relative_error:.1%} (two standard errors); take "
                'more samples per pixel, or raise "patch_samples"',
            )

    # ---------------------- Rendering ----------------------

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render a sensor of the scene, or another one, to its film, as Mitsuba's integrators do.

        Raises ``ValueError`` as ``prepare`` does, and for more samples than ``sampler`` takes.
        """
        sensor = sensor_of(scene, sensor)
        now, baked = self._ready(scene, sensor, spp)
        film = sensor.film()
        with interruptible(), dr.suspend_grad():
            sampler, spp = self._pixel_sampler(sensor, spp)
            lookup, recorder = self._lookup(scene, now, baked, spp)
            shading = Shading(scene, lookup, self.rules(seed), self.sample_aovs())
            self.put(sensor, self.sums(sensor, sampler, spp, seed, shading, recorder), spp)
            picture = film.develop() if develop else mi.TensorXf()
            if evaluate:
                film.schedule_storage()
                dr.eval(picture)
        return picture

    def pixel_sums(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seed: int,
        spp: int,
        pixels: range,
        first: int = 0,
        planned: int = 0,
    ) -> Sums:
        """What ``render`` puts to the film for some pixels, of ``imaging.film.pixel_ranges``.

        ``put`` makes the picture of all of them, the same to the bit. Of a picture that is to have
        more samples than these ``spp``, ``planned`` is their number, and ``first`` the index of the
        first of these. Raises ``ValueError`` as ``prepare`` does, and if ``sampler`` isn't
        ``coherent``.
        """
        self.require_coherent("renders all pixels at once")
        now, baked = self._ready(scene, sensor, planned or spp)
        with dr.suspend_grad():
            lookup, recorder = self._lookup(scene, now, baked, planned or spp)
            shading = Shading(scene, lookup, self.rules(seed), self.sample_aovs())
            return self.sums(sensor, None, spp, seed, shading, recorder, first, pixels)

    def require_coherent(self, otherwise: str) -> None:
        """Raise ``ValueError`` unless sample points are our own: others do ``otherwise``."""
        if self.sampler != "coherent":
            raise ValueError(f'{self.owner}: "sampler" {self.sampler} {otherwise}; leave it out')

    def progressive(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 16,
        total: int = 256,
        seconds: float = math.inf,
        target_error: float = 0.0,
        progress_file: str | os.PathLike | None = None,
        resume: bool = False,
        elsewhere: Callable[[BakedState, int], Renderer] | None = None,
        planned: int = 0,
    ) -> Iterator[Improving]:
        """Render a sensor in passes of ``spp`` samples per pixel.

        It ends after ``total`` samples, after so many ``seconds``, pre-passes included, or when the
        noise that is left has a relMSE of ``target_error``. After 1, 2, 3, 4, 6, 8, 12 … passes,
        and the last, comes a picture of all so far; the film has it too. The pre-passes are those
        for ``planned`` samples per pixel, or for ``total`` if that is 0.

        ``progress_file`` keeps what has been rendered, from every picture and from Ctrl-C on. With
        ``resume`` it goes on from there, to the same bits as if it hadn't ended. If ``total`` is
        another one then, the pre-passes remain those for the first.

        ``elsewhere(state, planned)`` gives what renders passes in place of this process, from a
        baked state, of a picture that is to have so many samples: see ``distributed``.

        Raises ``ValueError`` as ``prepare`` does, for numbers that ask for no picture, if
        ``sampler`` isn't ``coherent``, and for a ``progress_file`` that is missing, damaged, or of
        another scene, sensor or setting.
        """
        deadline = time.perf_counter() + seconds
        self.require_coherent("has no end of samples")
        check_ends(self.owner, spp, total, seconds, target_error)
        sensor = sensor_of(scene, sensor)
        size = sensor.film().crop_size()
        stored = stored_progress(progress_file) if resume else None
        planned = planned_samples(stored) if stored else planned or total
        now, baked = self._ready(scene, sensor, planned)
        lookup, recorder = self._lookup(scene, now, baked, planned)
        made_for = self._made_with(sensor, baked, seed, spp)
        progress = progress_of(stored, made_for, size) if stored else Progress.none(planned)

        def here(passes):
            for _, its, first, n in passes:
                shading = Shading(scene, lookup, self.rules(its), self.sample_aovs())
                yield self.sums(sensor, None, n, its, shading, recorder, first)

        def develop(sums, n_samples):
            self.put(sensor, sums, n_samples)
            picture = sensor.film().develop()
            dr.eval(picture)
            return picture

        def keep():
            if progress_file is not None:
                progress.save(progress_file, made_for, size)

        render = elsewhere(baked, planned) if elsewhere else here
        return improve(
            render, develop, keep, progress, seed, spp, total, deadline, target_error, state=baked
        )

    def _made_with(self, sensor, baked: BakedState, seed: int, spp: int) -> dict[str, object]:
        """All that the passes of a picture depend on."""
        return {
            "version": envmap_integrator.__version__,
            "variant": mi.variant(),
            "scene": baked.key.scene,
            "film": sensor.film().class_name(),
            **{f"film.{name}": text for name, text in printed(sensor.film()).items()},
            "sensor": view_name(sensor),
            "integrator": type(self).__name__,
            **printed(self),
            "seed": seed,
            "spp": spp,
            "cache": hashlib.blake2b(baked.cache.table.numpy(), digest_size=16).hexdigest(),
        }

    def _lookup(
        self, scene, now: SceneState, baked: BakedState, spp: int
    ) -> tuple[Lookup, Recorder]:
        """What paths look up, and what is recorded of renders that do."""
        maps = self.maps_for(scene, now, baked, spp)
        return now.lookup(baked, maps), self._recorder_of(now, baked.cache, maps)

    def _recorder_of(
        self, now: SceneState, cache: IrradianceCache, maps: FarField | None
    ) -> Recorder:
        """The same one as long as nothing in the scene has been replaced."""
        self._recorders = [r for r in self._recorders if r.about[0] is now][-MOST_STATES:]
        for recorder in self._recorders:
            if recorder.is_about(now, cache, maps):
                return recorder
        possible = not now.content.in_python
        self._recorders.append(Recorder(now, cache, maps, possible=possible))
        return self._recorders[-1]

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0) -> None:
        """Raises ``NotImplementedError``."""
        self._refuse_gradients()

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0) -> None:
        """Raises ``NotImplementedError``."""
        self._refuse_gradients()

    def _refuse_gradients(self):
        """The cache is made without gradients: they would lack most of the light."""
        raise NotImplementedError(
            f"{self.owner}: can't be differentiated; use prb for gradients, or render without them"
        )

    def _pixel_sampler(self, sensor: mi.Sensor, spp: int) -> tuple[mi.Sampler | None, int]:
        """A sampler of Mitsuba's, None for our own points, and its samples per pixel.

        The scene says how many if ``spp`` is 0. Samplers that stratify may round up to a full grid.
        """
        spp = spp or sensor.sampler().sample_count()
        if self.sampler == "coherent":
            return None, spp
        own = self.sampler == "scene"
        sampler = sensor.sampler().clone() if own else mi.load_dict({"type": self.sampler})
        sampler.set_sample_count(spp)
        spp = sampler.sample_count()
        most = most_samples(sensor)
        if spp > most:
            raise ValueError(
                f'{self.owner}: "sampler" {self.sampler} takes at most {most} samples per pixel of '
                f"such a film, not {spp}; leave it out to take any number"
            )
        return sampler, spp

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Bool | bool = True,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
        """Radiance [W/m²/sr], validity and AOVs of rays, within another integrator."""
        if not scene.sensors():
            raise ValueError(
                f"{self.owner}: within another integrator only sensors of the scene are known, and "
                "there are none; add the sensor to the scene"
            )
        lookup, _ = self._lookup(scene, *self._ready(scene, None, 0), sampler.sample_count())
        self._passes += 1
        ray, active = mi.Ray3f(ray), mi.Bool(active)
        rules = self.rules(self._passes).of_sample(0, dr.arange(mi.UInt32, dr.width(ray)))
        found = camera_sample(scene, lookup, rules, self.sample_aovs(), sampler, ray, active)
        if dr.grad_enabled(found.radiance):
            self._refuse_gradients()
        return found.radiance, found.valid, self.aov_values(found)


class GatheringIntegrator(CachedIntegrator):
    """Base of those that send secondary rays before paths end."""

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        parameters = Parameters(props)
        self.secondary_samples = parameters.integer("secondary_samples", 1, 1, 1 << 16)
        self.residual_probability = parameters.number("residual_probability", 0.0, 0.0, 1.0)
        self.irradiance_filter = parameters.flag("irradiance_filter", True)
        self.indirect_aovs = parameters.flag("indirect_aovs", False)
        self.aovs = parameters.text("aovs")
        parse_aovs(self.aovs, self.owner)  # Complains at once.
        self.clamp_indirect = parameters.number("clamp_indirect", 0.0, 0.0)

    def rules(self, seed: int) -> PathRules:
        residual = None
        if self.residual_probability > 0:
            residual = Residual(
                dr.opaque(mi.Float, self.residual_probability),
                dr.opaque(mi.UInt32, (seed + 1) & 0xFFFFFFFF),
            )
        return PathRules(
            gather_depth=1,
            secondary_samples=self.secondary_samples,
            shadow_samples=self.shadow_samples,
            hide_emitters=self.hide_emitters,
            residual=residual,
            clamp=dr.opaque(mi.Float, self.clamp_indirect) if self.clamp_indirect else None,
        )

    def sums(self, sensor, sampler, spp, seed, shading, recorder, first=0, pixels=None) -> Sums:
        if not self._takes_apart(sensor):
            return super().sums(sensor, sampler, spp, seed, shading, recorder, first, pixels)
        return gathered_sums(sensor, sampler, spp, seed, shading, recorder, first, pixels)

    def put(self, sensor, sums, spp) -> None:
        if not self._takes_apart(sensor):
            return super().put(sensor, sums, spp)
        n_shared = spp * self.secondary_samples if self._shares() else 0
        put_gathered(sensor, sums, n_shared, self._own_names(), self.indirect_aovs)

    def check_sensor(self, sensor: mi.Sensor) -> None:
        super().check_sensor(sensor)
        if self.indirect_aovs and has_bands(sensor.film()):
            raise ValueError(
                f'{self.owner}: "indirect_aovs" are colours, and the film of sensor '
                f'"{sensor.id()}" holds bands; leave them out, or take a hdrfilm'
            )

    def _takes_apart(self, sensor: mi.Sensor) -> bool:
        """Is what surfaces gather wanted by itself, as a colour?"""
        if has_bands(sensor.film()):
            return False  # What pixels share is a colour.
        return self._shares() or self.indirect_aovs

    def _shares(self) -> bool:
        """Do pixels share what they gather?"""
        return self.irradiance_filter and self.residual_probability == 0

    def sample_aovs(self) -> tuple[Aov, ...]:
        return parse_aovs(self.aovs, self.owner)

    def aov_names(self) -> list[str]:
        return [*self._own_names(), *(INDIRECT_AOVS if self.indirect_aovs else [])]

    def _own_names(self) -> list[str]:
        return [channel for aov in self.sample_aovs() for channel in aov.channels()]

    def aov_values(self, found: CameraSample) -> list[mi.Float]:
        if not self.indirect_aovs:
            return found.aovs
        gathered, wavelengths = found.gathered, found.vertex.si.wavelengths
        indirect = (gathered.radiance, gathered.radiance, gathered.albedo)
        return [*found.aovs, *(c for x in indirect for c in rgb(seen(x, wavelengths)))]


def _that_serves(
    states: Collection[BakedState], scene: mi.Scene, now: SceneState, view: mi.Sensor | None
) -> BakedState | None:
    """The first of some states that serves a view, with the error of its picture."""
    for state in states:
        if view is None or view_name(view) in state.views:
            return state
    if not states:
        return None
    with dr.suspend_grad():
        points = walks(scene, now.ids, view)
        for state in states:
            found = service(points, state.cache, state.size_error)
            if found.suffices(state.service):
                return replace(state, relative_error=found.error)
    return None


def camera_samples(sensor: mi.Sensor | None, spp: int) -> int:
    """Number of samples of a render of a sensor, if there is one."""
    if sensor is None:
        return 0
    return n_pixels_of(sensor.film()) * (spp or sensor.sampler().sample_count())
