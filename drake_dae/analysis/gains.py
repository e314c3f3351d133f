"""Gains of a law and its estimator for a contact that gives way, from the loop's own block."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.analysis.sampled_loop import LinearLoop, SampledLoop
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.blocks.compose import compose
from drake_dae.dae import (
    FeedbackGains,
    GainDesign,
    SensedContact,
    SensorNoise,
    Structure,
    TrackingLaw,
    ZeroDynamics,
    direction_gains,
    find_structure,
    gain_coefficients,
    poles,
    with_disturbance,
)
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.settings import LoopSettings
from drake_dae.diagrams.wiring import make_closed_loop
from drake_dae.errors import GainError, ModelError
from drake_dae.references import Reference, references_by_name
from drake_dae.references.reference import stack_references
from drake_dae.robots import RobotModel, velocities_are_rates
from drake_dae.systems.observing.observing import Observing
from drake_dae.systems.plants.contact.compliant_plant import CompliantPlant
from drake_dae.systems.plants.contact.contact_material import PointMaterial
from drake_dae.systems.sensing.force_sensor import ForceSensor

DAMPING = 0.1
"""The least damping ratio below half the Nyquist rate."""

DECAY = 1.0
"""The least decay of the slowest mode in 1/s."""

SHARE = 0.003
"""The default of the largest roughness, as a fraction of the largest effort limit."""

LOST = -3.0
"""The margin below which no gains are given."""

RESTING = 0.5
"""The factor of gains for references that rest: a contact sticks, and estimates are held, so that
no linear model tells a margin."""

FINER, TRIES = 0.5, 4
"""What a factor that is too large is multiplied by, and how many pairs are tried."""

SLIDING = ((1.0, 0.8, 0.5), (0.5, 0.8, 2.0), (2.0, 0.8, 1.0))
STIFF = ((1.0, 0.0, 1.0), (2.0, 0.0, 0.5), (0.5, 0.0, 2.0))
"""Stiffness relative to the stated one, friction, and the tool's mass relative to the model's:
where friction damps most, and where the contact is fastest. Of the corners of 1/2 to 2, 0 to 0.8
and 1/2 to 2 loops were slowest, or swung most, in these."""

SETTLE, BEGIN = 40, 0.5
"""The samples from a point of the path to the motion that is linearized, and the time in s for
which the start is run."""

FORCE, GRAVITY = 1.0, 9.81
"""The unknown force in N, along gravity and along friction, that appears or turns every 2 s."""


@dataclass(frozen=True)
class ContactGains:
    """The gains of a law for motion and force on a compliant contact, in 1/s, and their margins.

    Attributes:
        position_rate: p, the distance of the poles of position outputs from 0.
        force_gain: The gain of the integral of the force's error.
        constraint_damping: The poles of the constraint's rate.
        observing: The rates of the estimator.
        decay: The decay of the slowest mode in 1/s, the least of all variations.
        damping: The least damping ratio below half the Nyquist rate, likewise.
        roughness: The rms change of the controls from sample to sample by noise, in N m.
        position_error, force_error: The rms errors to expect in m and N: by noise, and by an
            unknown force of 1 N that appears or turns every 2 s.
        binds: Why the gains are no faster: "roughness", "damping", "decay", "start"; "rest" where
            the references rest, so that no loop was examined; "" where the first were taken.
    """

    position_rate: float
    force_gain: float
    constraint_damping: float
    observing: Observing
    decay: float = -inf
    damping: float = 0.0
    roughness: float = inf
    position_error: float = inf
    force_error: float = inf
    binds: str = ""

    def position_gains(self, poles: int) -> list[float]:
        """Returns the gains of a position output with 2 poles, or with 3 and an integral.

        As `gain_coefficients` takes them, lowest derivative first: Butterworth's polynomials,
        s^2 + sqrt(2) p s + p^2 and s^3 + 2 p s^2 + 2 p^2 s + p^3.
        """
        p = self.position_rate
        return [p**2, 2.0**0.5 * p] if poles == 2 else [p**3, 2.0 * p**2, 2.0 * p]

    @property
    def margin(self) -> float:
        """The lesser of decay and damping, relative to what is recommended."""
        return min(self.decay / DECAY, self.damping / DAMPING)


@checked(ModelError)
def contact_gains(
    model: RobotModel,
    material: PointMaterial,
    references: Sequence[Reference] | Mapping[str, Reference | float],
    settings: LoopSettings,
    *,
    times: tuple[float, float] = (0.0, 10.0),
    guess: ArrayLike | None = None,
    structure: Structure | None = None,
    identify: Sequence[str] = (),
    integral: Sequence[str] = (),
    constraint_damping: GainDesign | FeedbackGains | None = None,
    contact_stiffness: float | None = None,
    latency: float = 0.0,
    roughness: float | None = None,
) -> ContactGains:
    """Returns the fastest gains with a margin on the loop of plant, sensors, estimator and law.

    First each direction has the gains with the least error, by noise and by an unknown force,
    within the roughness, from a linear model of its own (`direction_gains`). Then the loop decides.
    It is one `Block`, whose map over a sample has a Jacobian with all couplings in it: of friction,
    tilt, the tool's inertia, curvature, delay, sensors and estimator. That is taken where on the
    path friction damps most, d = mu lambda A_t / |v|, and where the contact is fastest, with
    stiffness and tool's mass from 1/2 to 2 times the model's and friction from 0 to 0.8. The gains
    of free directions, or of the contact, are reduced until

    - the slowest mode decays at 1/s or faster (poles at 0 left out: counters, held estimates),
    - modes below half the Nyquist rate have a damping ratio of 0.1 or more,
    - noise changes the controls by at most `roughness` from sample to sample, in rms,
    - half a second from a start at rest, with friction of 0.8 unknown, keeps the control limits and
      ends in contact.

    Where references rest, friction holds the contact, no linear model tells a margin, and half of
    the rates of the directions are returned.

    Those are reduced whose integrals take part in the worst mode. Where slower gains do not help,
    the best ones within the roughness are returned, with their margins.

    Args:
        model: The robot with rigid joints; each constraint a `PointOnSurface`.
        material: Its contact, with the stated stiffness.
        references: As for `make_closed_loop`.
        settings: Sensors and sampling; the rates of an `observer` are kept.
        times: Begin and end of the motion, in s.
        guess: A state near its begin, shape (n,).
        structure: That of the model's system.
        identify: Parameters that the estimator identifies, as for `with_disturbance`.
        integral, constraint_damping, contact_stiffness, latency: As for `TrackingLaw`; a given
            damping is kept.
        roughness: In N m; 0.3 % of the largest effort limit if None, 1 N m without limits.

    Raises:
        GainError: All tried gains are unstable or too rough; the message says what would help.
        ModelError: An argument is not valid, or the motion has no begin.
    """
    if roughness is None:
        efforts = model.control_limits[np.isfinite(model.control_limits)]
        roughness = SHARE * float(np.max(efforts)) if efforts.size else 1.0
    positive("roughness", roughness)
    law = {
        "integral": list(integral),
        "constraint_damping": constraint_damping,
        "contact_stiffness": contact_stiffness,
        "latency": latency,
    }
    trials = _Trials(model, replace(material, friction=0.0), references, settings, identify, law)
    trials.structure = structure or find_structure(model.dae)
    begin, end = times
    trials.go_along(np.linspace(begin, end, 25), guess, roughness)
    parts = trials.start
    rough = float(np.hypot(parts[0].roughness, parts[1].roughness))
    if rough > 1.5 * roughness:
        raise GainError(
            f"the noise of encoders and of the force changes the controls by {rough:.3g} N m from "
            f"sample to sample with the smoothest gains, and {roughness:.3g} N m are allowed: "
            "allow more roughness, or use better sensors"
        )
    if not trials.slides:
        return replace(
            trials.gains(RESTING, RESTING),
            decay=inf,
            damping=1.0,
            roughness=rough,
            position_error=2.0 * parts[0].error,
            force_error=2.0 * parts[1].error,
            binds="rest",
        )
    free, contact, binds, found = 1.0, 1.0, "", list[ContactGains]()
    for _ in range(TRIES):
        gains, is_of_contact = trials.examined(trials.gains(free, contact), roughness)
        found.append(replace(gains, binds=binds))
        before = found[-2].margin if binds in ("damping", "decay") else -inf
        if roughness < gains.roughness < inf:
            binds, less = "roughness", _smoother(found, roughness)
            free, contact = less * free, less * contact
        elif gains.margin < 1.0:
            if gains.margin < before + 0.01:
                break  # Slower gains do not help against friction, and a contact swings with them.
            binds = "damping" if gains.damping / DAMPING < gains.decay / DECAY else "decay"
            free, contact = (free, FINER * contact) if is_of_contact else (FINER * free, contact)
        elif not trials.starts():
            binds, free, contact = "start", FINER * free, FINER * contact
        else:
            return found[-1]
    smooth = [g for g in found if g.roughness <= roughness or g.decay <= 0.0]
    best = max(smooth, key=lambda g: g.margin, default=None)
    if best is None:
        raise GainError(
            f"noise changes the controls by {found[-1].roughness:.3g} N m from sample to sample "
            f"with the slowest gains that were tried, and {roughness:.3g} N m are allowed: allow "
            "more roughness, or use better sensors"
        )
    if best.margin < LOST:
        raise GainError(
            f"with the best gains that were tried a contact of {material.stiffness:.3g} N/m, half "
            f"or twice as stiff, grows at {-best.decay:.3g} 1/s, with samples of "
            f"{trials.period:g} s and this delay: sample more often, or make it softer"
        )
    return best


def _smoother(found: Sequence[ContactGains], roughness: float) -> float:
    """By which factor gains must be slower, by a power of the rate through the last two."""
    last, power = found[-1], 2.0
    if len(found) > 1 and np.isfinite(found[-2].roughness) and np.isfinite(last.roughness):
        rates = found[-2].position_rate / last.position_rate
        if rates > 1.01 and found[-2].roughness > last.roughness:
            power = float(np.log(found[-2].roughness / last.roughness) / np.log(rates))
    return float(np.clip(0.95 * (roughness / last.roughness) ** (1.0 / power), 0.3, 0.9))


@dataclass(eq=False)
class _Trials:
    """Loops with given factors, and what their linear models say along a motion."""

    model: RobotModel
    material: PointMaterial
    references: Any
    settings: LoopSettings
    identify: Sequence[str]
    law: dict[str, Any]
    structure: Structure = field(init=False)

    def __post_init__(self) -> None:
        model, settings, material = self.model, self.settings, self.material
        self.period = settings.period(material.time_step)
        if not self.period:
            raise ModelError("gains for a contact are for sampled laws: give a sampling")
        velocities = [signal.name for signal in model.links.velocity_signals]
        self.observed = find_structure(with_disturbance(model.dae, velocities, self.identify))
        if (encoders := settings.encoders) is not None:  # A resolution has no slope: it is noise.
            noise = encoders.position_deviation
            encoders = replace(encoders, resolution=0.0, position_noise=noise)
            self.settings = replace(settings, encoders=encoders)
        names = [signal.name for signal in model.dae.output_signals]
        count = len(model.position_signals)
        self.positions, self.forces = names[:count], names[count:]
        self.points = [i for i, s in enumerate(model.position_signals) if s.unit == "m"]
        if isinstance(self.references, Mapping):
            degrees = self.observed.output_degrees
            self.references = references_by_name(self.references, names, degrees)

    def go_along(self, times: FloatArray, guess: ArrayLike | None, roughness: float) -> None:
        """Finds the begin, the two points that are examined, and the gains with factors of 1."""
        model, system = self.model, self.model.dae
        reference = stack_references(self.references, self.structure.layout.reference_degrees)
        dynamics = ZeroDynamics(system, structure=self.structure)
        motion = dynamics.motion(lambda time: reference(time).copy(), times, guess)
        if not len(motion.states):
            raise ModelError(f"{system.name}: {motion.ending}")
        q = slice(0, model.links.q.numel())
        v = slice(q.stop, q.stop + model.links.v.numel())
        N = model.links.velocity_map
        slides = [c.sliding for c in system.contacts if c.sliding is not None]
        slip = ca.vertcat(ca.SX(0, 1), *slides)
        rows = [
            ca.mtimes(ca.jacobian(each, system.state[q]), N)
            for each in (system.k, system.l[self.points])
        ]
        values = [system.mass_matrix[v, v], *rows, ca.jacobian(slip, system.state[v]), slip, N]
        function = ca.Function("f", [system.state, system.parameter_symbol], values)
        along, across, ways = list[float](), list[float](), list[FloatArray]()
        sizes = list[dict[str, float]]()
        for state, force in zip(motion.states, motion.constraint_inputs, strict=True):
            M, J, J_p, J_t, speed, to_q = (
                value.full() for value in function(state, system.parameter_values)
            )
            moved = np.linalg.solve(M, J.T)
            A, slow = J @ moved, float(np.linalg.norm(speed))
            along.append(float(np.max(np.diag(A))))
            most = np.linalg.norm(J_t @ np.linalg.solve(M, J_t.T), 2) if J_t.size else 0.0
            across.append(float(most) / slow if slow > 1e-3 else 0.0)
            way = np.zeros(state.size)  # With 1 N/m a contact gives way so far, in the metric of M.
            way[q] = -to_q @ moved @ np.linalg.solve(A, force)
            ways.append(way)
            J_p = J_p if J_p.size else J
            free = float(np.max(np.einsum("ij,ji->i", J_p, np.linalg.solve(M, J_p.T))))
            levers = (float(np.max(np.linalg.norm(each, axis=1))) for each in (J_p, J))
            lever, contact_lever = levers
            sizes.append(
                {
                    "mobility": along[-1],
                    "free_mobility": free,
                    "lever": lever,
                    "contact_lever": contact_lever,
                    "inertia": float(np.linalg.norm(M)),
                }
            )
        chosen = int(np.argmax(across)), int(np.argmax(along))
        self.slides = not slides or max(across) > 0.0  # Without friction nothing sticks.
        self.path = [
            (
                round(times[i] / self.period) * self.period,
                motion.states[i],
                motion.constraint_inputs[i],
                ways[i],
                cases,
            )
            for i, cases in zip(chosen, (SLIDING, STIFF), strict=True)
        ]
        rest = motion.states[0].copy()
        rest[v] = 0.0
        begin = round(times[0] / self.period) * self.period
        self.begin = begin, rest, motion.constraint_inputs[0]
        self.start = direction_gains(self._situation(sizes[chosen[1]]), 0.8 * roughness)

    def _situation(self, sizes: dict[str, float]) -> SensedContact:
        settings, k = self.settings, self.material.stiffness
        delay = 0.0 if settings.sampling is None else settings.sampling.delay
        encoders, noise, estimates = settings.encoders, SensorNoise(), False
        if encoders is not None:
            noise = SensorNoise(
                float(np.max(encoders.position_deviation)),
                float(np.max(np.asarray(encoders.velocity_noise, dtype=float))),
                velocity_bandwidth=encoders.velocity_bandwidth or 0.0,
            )
            is_plain = encoders.velocity_bandwidth is None and noise.position > 0.0
            estimates = is_plain and velocities_are_rates(self.model.links)
        if settings.sensor is not None:
            noise = replace(noise, force=float(np.max(settings.sensor.noise_deviation)))
        samples = int(np.ceil(delay / self.period - 1e-9))
        leads = self.law["contact_stiffness"] is not None
        return SensedContact(
            self.period, samples, k, noise=noise, estimates=estimates, leads=leads, **sizes
        )

    def gains(self, free: float, contact: float) -> ContactGains:
        """The gains with factors for free directions and for the contact."""
        (of_free, of_contact), most = self.start, 0.5 / self.period
        w, k_n = free * of_free.rate, contact * of_contact.rate
        c, fast = contact * of_contact.gains.gains[2], of_free.gains.state_rate
        own = Observing(
            rate=2.0 * w,
            force_rate=k_n,
            friction_rate=w / 2.0,
            state_rate=None if fast is None else min(max(free, contact) * fast, most),
        )
        return ContactGains(1.5 * w, 0.4 * c, c, self.settings.observer or own)

    def loop(self, gains: ContactGains) -> ClosedLoop:
        """The loop with some gains."""
        more, integral = dict(self.law), self.law["integral"]
        if more["constraint_damping"] is None:
            more["constraint_damping"] = poles(-gains.constraint_damping)
        of = {name: gains.position_gains(3 if name in integral else 2) for name in self.positions}
        of |= {name: [gains.force_gain] for name in self.forces if name in integral}
        law = TrackingLaw(
            self.observed.system,
            gain_coefficients(of),
            structure=self.observed,
            measured_force=True,
            **more,
        )
        plant = CompliantPlant(self.model, self.material, structure=self.structure)
        settings = replace(self.settings, observer=gains.observing)
        if (sensor := settings.sensor) is not None:  # A system belongs to one diagram.
            lags, errors = (sensor.time_constant, sensor.sample_period), sensor.noise_deviation
            settings = replace(settings, sensor=ForceSensor(errors.size, *lags, 0.0, errors))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return make_closed_loop(plant, law, self.references, settings)

    def examined(self, gains: ContactGains, roughness: float) -> tuple[ContactGains, bool]:
        """Gains with their margins, and whether the worst mode is one of the contact.

        Gains that are too rough, or unstable, are not examined further.
        """
        self.run = run = _Run(self.loop(gains), self.model, self.material)
        found = list[LinearLoop]()
        errors: tuple[float, ...] = (inf, inf, inf)
        for moment, state, force, way, cases in self.path:
            for k, mu, mass in cases:
                x = state + way / (k * self.material.stiffness)
                linear, at = run.linear(moment, x, force, (k, mu), mass)
                found.append(linear)
                if len(found) == 1 and linear.decay > 0.0:
                    errors = self._errors(run, linear, *at)
                is_done = not linear.decay > 0.0 or not errors[0] <= roughness
                if is_done:
                    break
            if is_done:
                break
        margins = [min(linear.decay / DECAY, linear.damping / DAMPING) for linear in found]
        worst = int(np.argmin(margins))
        shares = found[worst].participation(DAMPING / DECAY)
        is_of_contact = run.is_of_contact(shares, len(self.positions))
        least = min(each.decay for each in found), min(each.damping for each in found)
        return replace(
            gains,
            decay=least[0],
            damping=least[1],
            roughness=errors[0],
            position_error=errors[1],
            force_error=errors[2],
        ), is_of_contact

    def _errors(
        self, run: "_Run", linear: LinearLoop, time: float, x: FloatArray, p: FloatArray
    ) -> tuple[float, float, float]:
        """Roughness, and the rms errors by noise and by `FORCE` of weight and of friction."""
        squares = linear.by_noise("controlled_output") ** 2
        for push in run.pushes(time, x, p):
            squares += linear.after_push("controlled_output", push) ** 2
        rough = float(np.linalg.norm(linear.change_by_noise("control")))
        forces = squares[len(self.positions) :]
        return rough, float(squares[self.points].sum() ** 0.5), float(np.max(forces) ** 0.5)

    def starts(self) -> bool:
        """Whether the last loop keeps its control limits from rest on, and ends in contact."""
        moment, state, force = self.begin
        run, limits = self.run, self.model.control_limits[:, None]
        x, p = run.begun(state, force, 0.0)[:, None], run.parameters(1.0, 0.8)[:, None]
        x = run.sampled.begun(moment, x, p)
        for i in range(round(BEGIN / self.period)):
            x = run.sampled.after(moment + i * self.period, x, p)
            shown = run.sampled.shown(moment + i * self.period, x, p)
            if not np.all(np.abs(shown["control"]) <= limits):  # Also where it is not finite.
                return False
        return bool(np.all(shown["controlled_output"][len(self.positions) :] > 0.0))


class _Run:
    """One loop as a map over its samples, with other numbers of its plant."""

    def __init__(self, loop: ClosedLoop, model: RobotModel, material: PointMaterial) -> None:
        self.loop, self.composed, self.material = loop, compose(loop.diagram), material
        self.sampled = SampledLoop(self.composed.block, ["controlled_output", "control"])
        self.context = loop.diagram.CreateDefaultContext()
        self.at_plant = loop.plant.GetMyMutableContextFromRoot(self.context)
        first = self.composed.parameters[loop.plant].start
        self.tool = [first + place for place in _tool_masses(model)]
        self.friction = first + model.dae.parameter_symbol.numel() + 2

    def parameters(self, stiffness: float, friction: float, mass: float = 1.0) -> FloatArray:
        """All parameters, with the plant's relative stiffness, friction and mass of the tool."""
        stiffness *= self.material.stiffness
        changed = replace(self.material, stiffness=stiffness, friction=friction)
        self.loop.plant.set_contact(self.at_plant, changed)
        values = self.sampled.block.default("parameters")
        own = self.at_plant.get_numeric_parameter(0).CopyToVector()
        values[self.composed.parameters[self.loop.plant]] = own
        values[self.tool] *= mass
        return values

    def begun(self, state: FloatArray, force: FloatArray, friction: float) -> FloatArray:
        """x at the start from a state and a measured force, with friction that is known."""
        loop, x = self.loop, self.sampled.start.copy()
        loop.plant.set_state(self.at_plant, state)
        assert loop.observer is not None
        at_observer = loop.observer.GetMyMutableContextFromRoot(self.context)
        loop.observer.set_friction(at_observer, friction)
        systems = {loop.plant: self.at_plant, loop.observer: at_observer}
        if loop.sensor is not None:
            at_sensor = loop.sensor.GetMyMutableContextFromRoot(self.context)
            loop.sensor.set_force(at_sensor, force)
            systems[loop.sensor] = at_sensor
        for system, at in systems.items():
            if system in self.composed.states:
                x[self.composed.states[system]] = at.get_continuous_state_vector().CopyToVector()
            for i in range(at.num_discrete_state_groups()):
                name, part = self.composed.held[system, i]
                first = self.sampled.places[name]
                own = at.get_discrete_state(i).CopyToVector()
                if system is loop.observer and loop.observer.observing.state_rate is not None:
                    # Behind the number of the sample; at zeros an arm may be singular.
                    own[1 : 1 + state.size] = state
                x[first + part.start : first + part.stop] = own
        return x

    def advanced(self, time: float, x: FloatArray, p: FloatArray, samples: int) -> FloatArray:
        """Columns of x after some samples without noise."""
        x = self.sampled.begun(time, x, p)
        for i in range(samples):
            x = self.sampled.after(time + i * self.sampled.period, x, p)
        return x

    def linear(
        self,
        moment: float,
        state: FloatArray,
        force: FloatArray,
        contact: tuple[float, float],
        mass: float,
    ) -> tuple[LinearLoop, tuple[float, FloatArray, FloatArray]]:
        """The linear model some samples after a state, with the tool's mass wrong; and where."""
        x, p = self.begun(state, force, contact[1]), self.parameters(*contact)
        x = self.advanced(moment, x[:, None], p[:, None], SETTLE)[:, 0]
        at = moment + SETTLE * self.sampled.period, x, self.parameters(*contact, mass)
        return self.sampled.linear(*at), at

    def is_of_contact(self, shares: FloatArray, positions: int) -> bool:
        """Whether integrals of forces take part in a mode more than those of positions."""
        controller = self.loop.controller
        outputs = np.array(controller.law.integral.outputs)
        name, part = self.composed.held[controller, 0]
        own = shares[self.sampled.places[name] + part.start :][: outputs.size]
        return bool(own[outputs >= positions].sum() > own[outputs < positions].sum())

    def pushes(self, time: float, x: FloatArray, p: FloatArray) -> list[FloatArray]:
        """The changes of x in a sample by `FORCE` more of weight of the tool, and of friction."""
        shown = self.sampled.shown(time, x[:, None], p[:, None])["controlled_output"]
        steps = dict.fromkeys(self.tool[:1], FORCE / GRAVITY)
        steps[self.friction] = FORCE / max(float(np.abs(shown[-1, 0])), FORCE)
        columns = np.repeat(p[:, None], 1 + len(steps), axis=1)
        for i, (place, step) in enumerate(steps.items(), 1):
            columns[place, i] += 1e-4 * step
        after = self.sampled.after(time, np.repeat(x[:, None], columns.shape[1], axis=1), columns)
        return [(after[:, i] - after[:, 0]) / 1e-4 for i in range(1, columns.shape[1])]


def _tool_masses(model: RobotModel) -> list[int]:
    """The places of the masses that are welded to a point in contact."""
    plant, dae = model.links.plant, model.dae
    if plant is None:
        return []
    names = set[str]()
    for constraint in model.constraints:
        body = plant.GetFrameByName(constraint.frame).body()  # type: ignore[attr-defined]
        names |= {f"{one.name()}.mass" for one in plant.GetBodiesWeldedTo(body)}
    return [dae.parameter_slice(p.name).start for p in dae.parameters if p.name in names]
