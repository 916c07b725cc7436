"""What the integrators share: preparation and the sampling kernel."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..imaging.film import INDIRECT_AOVS, expose, expose_gathered, most_samples, n_pixels_of, rgb
from ..lookup.emitter_choice import Emitters, SourceChoice
from ..lookup.ids import ObjectIds
from ..preparation.baked_state import BakedState, Settings, StateKey, load
from ..preparation.coarse_mesh.views import service, view_name
from ..preparation.pipeline import prepare
from ..system.checks import check_not_frozen, check_scene, check_variant
from ..system.fingerprint import SceneContent, SceneFingerprint
from ..system.interrupt import interruptible
from ..system.parameters import Parameters
from ..transport.camera import CameraSample, camera_radiance
from ..transport.path import Residual, Transport

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


@dataclass(frozen=True)
class SceneObjects:
    """How kernels tell the objects of a scene apart, and the content for which that holds.

    Other scenes of the same content have other objects, and shapes that move change places. Holding
    on to the scene, which holds its integrator, would keep both alive for ever.
    """

    content: SceneContent
    ids: ObjectIds
    emitters: Emitters


class CachedIntegrator(mi.SamplingIntegrator):
    """Base of all integrators that end their paths in the irradiance cache.

    Subclasses say what the pre-passes depend on (``settings``) and how paths are followed
    (``transport``).
    """

    LEAST_PATCH_SAMPLES = 32
    """If few camera samples share the cache; the noise of many patches averages out where secondary
    rays end in them."""

    SHADOW_SAMPLES = 2
    """By default: shared irradiance has little noise, so direct light is worth a ray more."""

    def __init__(self, props: mi.Properties):
        check_variant(props.plugin_name())
        super().__init__(props)
        parameters = Parameters(props)
        self.owner = parameters.owner
        self.patches = parameters.integer("patches", None, 16, 1 << 22)
        self.patch_samples = parameters.power_of_two("patch_samples", None, 1, 1 << 16)
        self.shadow_samples = parameters.integer("shadow_samples", self.SHADOW_SAMPLES, 1, 1 << 16)
        self.secondary_samples = 1
        self.residual_probability = 0.0
        self.irradiance_filter = False
        self.indirect_aovs = False
        self.clamp_indirect = 0.0
        self.sampler = parameters.choice("sampler", "coherent", SAMPLERS)
        self.cache_file = parameters.text("cache_file")
        self._fingerprint = SceneFingerprint()
        self._made_for: tuple[StateKey, str] | None = None
        self._prepared: dict[tuple[Settings, str], BakedState] = {}
        self._objects: SceneObjects | None = None
        self._seed = 0

    # ---------------------- To be overridden ----------------------

    def settings(self, **more) -> Settings:
        """What the pre-passes depend on besides the scene."""
        return Settings(self.patches, self.patch_samples, self.LEAST_PATCH_SAMPLES, **more)

    def transport(self, scene: mi.Scene, prepared: BakedState, spp: int) -> Transport:
        """How paths are followed; ``spp`` samples share a pixel."""
        raise NotImplementedError

    def to_string(self):
        parameters = {
            name: value
            for name, value in vars(self).items()
            if not name.startswith("_") and name != "owner"
        }
        listed = ",\n".join(f"  {name} = {value}" for name, value in parameters.items())
        return f"{type(self).__name__}[\n{listed}\n]"

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
        check_not_frozen(self.owner)
        settings = self.settings()
        key = StateKey(self._fingerprint(scene), settings)
        if (key, self.cache_file) != self._made_for:
            check_scene(scene, self.owner)
            self._made_for, self._prepared = (key, self.cache_file), {}
        sensors = list(scene.sensors())
        if isinstance(sensor, mi.Sensor):
            view = sensor
        else:
            view = sensors[sensor or 0] if sensors else None
        name = view_name(view) if view else ""
        if view and name not in map(view_name, sensors):
            sensors.append(view)
        if not self.cache_file:
            settings = settings.for_render(_camera_samples(view, spp))
        if (settings, name) not in self._prepared:
            state = self._that_serves(scene, settings, view)
            if state is None:
                state = self._make(scene, key, settings, sensors)
                for served in state.views:
                    self._keep(settings, served, state)
            if self.cache_file and not self._serves(state, scene, view):
                raise ValueError(
                    f'{self.owner}: "cache_file" {self.cache_file} was made for other views than '
                    "this sensor's; make it again with envmap-render bake, with this sensor in the "
                    "scene"
                )
            self._keep(settings, name, state)
        return self._prepared[settings, name]

    def _keep(self, settings: Settings, view: str, state: BakedState) -> None:
        """Remember which state serves a view, and forget the oldest of many states."""
        self._prepared[settings, view] = state
        states = list({id(state): state for state in self._prepared.values()}.values())
        for old in states[:-MOST_STATES]:
            self._prepared = {k: s for k, s in self._prepared.items() if s is not old}

    def _that_serves(self, scene, settings: Settings, view: mi.Sensor | None) -> BakedState | None:
        """What has been prepared for other views, if it serves this one too."""
        states = {id(s): s for (its, _), s in self._prepared.items() if its == settings}
        return next((s for s in states.values() if self._serves(s, scene, view)), None)

    def _serves(self, state: BakedState, scene: mi.Scene, view: mi.Sensor | None) -> bool:
        if view is None or view_name(view) in state.views:
            return True
        with dr.suspend_grad():
            found = service(scene, self.objects_of(scene).ids, state.cache.patches, view)
        return found.suffices(state.service)

    def _make(
        self, scene, key: StateKey, settings: Settings, sensors: list[mi.Sensor]
    ) -> BakedState:
        if self.cache_file:
            state = load(self.cache_file, key, self.owner, len(scene.emitters()))
        else:
            with interruptible(), dr.suspend_grad():
                state = prepare(scene, key, settings, sensors, self.owner)
        if state.relative_error > DOUBTFUL:
            mi.Log(
                mi.LogLevel.Warn,
                f"{self.owner}: little light finds its way to what is seen; the picture may be too "
                f"bright or too dark by {2 * state.relative_error:.1%} (two standard errors); take "
                'more samples per pixel, or raise "patch_samples"',
            )
        return state

    def objects_of(self, scene: mi.Scene) -> SceneObjects:
        """The same record as long as nothing in the scene changes."""
        content = SceneContent(scene)
        if self._objects is None or self._objects.content != content:
            self._objects = SceneObjects(content, ObjectIds(scene), Emitters(scene))
        return self._objects

    def transport_from(self, scene: mi.Scene, prepared: BakedState, **more) -> Transport:
        """A ``Transport`` with all that is the same for all integrators."""
        objects = self.objects_of(scene)
        return Transport(
            prepared.cache.patches,
            objects.ids,
            SourceChoice(objects.emitters, prepared.sources, prepared.source_rows),
            cache=prepared.cache,
            shadow_samples=self.shadow_samples,
            clamp=dr.opaque(mi.Float, self.clamp_indirect) if self.clamp_indirect else None,
            **more,
        )

    # ---------------------- Rendering ----------------------

    def residual(self) -> Residual | None:
        """How the errors of cache and maps are corrected, if they are."""
        if self.residual_probability == 0:
            return None
        self._seed = mi.UInt32(self._seed) + 1  # Every pass of a render decides anew.
        dr.make_opaque(self._seed)
        probability = dr.opaque(mi.Float, self.residual_probability)
        return Residual(probability, self._seed)

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        prepared = self.prepare(scene, sensor, spp)
        self._seed = seed
        film = sensor.film()
        with interruptible(), dr.suspend_grad():
            sampler, spp = self._pixel_sampler(sensor, spp)
            transport = self.transport(scene, prepared, spp)

            def shade(sampler, ray, index):
                return self.radiance(scene, transport.of_sample(index), sampler, ray, True)

            shared = self.irradiance_filter and self.residual_probability == 0
            if shared or self.indirect_aovs:
                n_shared = spp * self.secondary_samples if shared else 0
                expose_gathered(sensor, sampler, spp, seed, shade, n_shared, self.indirect_aovs)
            else:
                expose(sensor, sampler, spp, seed, shade, self.aov_names(), self.aovs)
            picture = film.develop() if develop else mi.TensorXf()
            if evaluate:
                film.schedule_storage()
                dr.eval(picture)
        return picture

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        self._refuse_gradients()

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
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

    def sample(self, scene, sampler, ray, medium=None, active=True):
        if not scene.sensors():
            raise ValueError(
                f"{self.owner}: within another integrator only sensors of the scene are known, and "
                "there are none; add the sensor to the scene"
            )
        transport = self.transport(scene, self.prepare(scene), sampler.sample_count())
        found = self.radiance(scene, transport, sampler, ray, active)
        if dr.grad_enabled(found.radiance):
            self._refuse_gradients()
        return found.radiance, found.valid, self.aovs(found)

    def aov_names(self) -> list[str]:
        return list(INDIRECT_AOVS) if self.indirect_aovs else []

    def aovs(self, found: CameraSample) -> list[mi.Float]:
        """Values of ``aov_names``."""
        if not self.indirect_aovs:
            return []
        gathered = found.gathered
        return [c for x in (gathered.radiance, gathered.radiance, gathered.albedo) for c in rgb(x)]

    def radiance(self, scene, transport, sampler, ray, active) -> CameraSample:
        """As ``camera_radiance``, with the integrator's own number of secondary rays."""
        ray, active = mi.Ray3f(ray), mi.Bool(active)
        return camera_radiance(scene, transport, sampler, ray, active, self.secondary_samples)


class GatheringIntegrator(CachedIntegrator):
    """Base of those that send secondary rays before paths end."""

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        parameters = Parameters(props)
        self.secondary_samples = parameters.integer("secondary_samples", 1, 1, 1 << 16)
        self.residual_probability = parameters.number("residual_probability", 0.0, 0.0, 1.0)
        self.irradiance_filter = parameters.flag("irradiance_filter", True)
        self.indirect_aovs = parameters.flag("indirect_aovs", False)
        self.clamp_indirect = parameters.number("clamp_indirect", 0.0, 0.0)


def _camera_samples(sensor: mi.Sensor | None, spp: int) -> int:
    """Number of samples of a render of a sensor, if there is one."""
    if sensor is None:
        return 0
    return n_pixels_of(sensor.film()) * (spp or sensor.sampler().sample_count())
