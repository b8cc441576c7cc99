"""Contact: where a vehicle's convex hulls touch something, and the resulting wrench, a function of states and of the
grip of each touching pair.

MuJoCo finds where hulls meet obstacles and each other (`mj_collision`), `grounding.py` where they meet terrain, and
`rock.py` where they meet one with overhangs. Each touching pair acts as one spring and damper, as stiff as its approach
requires to keep the depth below `DEPTH`; what rests or slides is softer, and takes longer steps. Its force is
distributed over the contact points by their depth; a `Grip` acts along the surface, up to Coulomb's friction. Spring
and damper follow from the effective mass of the contact, so restitution does not depend on the bodies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.integrators.carried import carried, carry_on
from vehsim.integrators.environment import Environment
from vehsim.vehicles.definition.base import State
from vehsim.world.contact.bodies import Body, Led, MovingBody, MovingObstacle, damping_rate, effective
from vehsim.world.contact.grip import Grip
from vehsim.world.contact.grounding import TOUCH, Points, Underside
from vehsim.world.contact.rock import Rock
from vehsim.world.contact.statics import balanced

Array = NDArray[np.float64]
Pair = tuple[int, int | None, str]
"""A vehicle and another body, None: what stands still, with its name."""
Forces = dict[tuple[int, str], tuple[Array, Array, Array]]
"""Index of a vehicle and name of what it touches -> places (n, 3), forces (n, 3) N and closing speeds (n,) m/s."""

DEPTH = 0.012
"""Largest depth of hulls that meet at `Contact.speed`, m."""
FIRM = 4.0
"""Speed for which a pair is stiff, over that at which it closes: impacts stay this much below `DEPTH`, except the
fastest."""
GENTLEST, GENTLEST_LEANING = 1.4, 2.8
"""The lowest such speed, m/s: the weight of what rests presses it in by 0.7 mm; and where both bodies move, which add
up in a stack, by half of that where each carries a body like itself."""
SOFTENING = 0.25
"""Time in which a pair that stays in touch becomes as soft as its motion permits, by a factor of e, s: far longer than
any impact."""
BURIED = 0.02
"""A start deeper than this is refused, m: contact would shoot the vehicle out."""
RESOLVED = 0.06
"""Phase of the contact's spring covered by one step in an impact, rad: 50 steps from touch to parting, and more where
the damper, which starts suddenly, dominates."""
RESTING = 0.5
"""The same if nothing closes or rebounds faster than `GENTLE`."""
DAMPED = 0.8
"""Decay by dampers in a step: the wrench at its end follows from a velocity that is predicted with the wrench at its
start, so that above 1 a damper alternates instead of coming to rest. All dampers on a body count."""
GENTLE = 0.3
"""m/s"""
SIDEWAYS, SIDEWAYS_DAMPING = 0.7, 0.7
"""Angular frequency of the spring along the surface, which holds what does not slide, over that of the contact's
spring; and its damping ratio: motion decays as fast as can be, and steps are longer than with a critical damper."""
ROOM = 1.0
"""Assumed increase of speeds until then, m/s."""
STILL = 2e-3
"""Speed below which bodies that do not slide are at rest, m/s."""
PARKED = 1e-5
"""Speed below which an obstacle stands still, m/s: what stands on a slower one would rest, in jerks."""
COMING = 0.25
"""A moving obstacle that can touch a body within this time keeps it awake, s; longer than any step of a simulation."""
AHEAD = 0.5
"""Largest step, as a share of the time to the next contact."""
MONITORED = 1.0
"""Pairs closer than this are monitored, m."""
PAUSE = 0.1
"""Contacts with the same object within this time are one event, s."""
TERRAIN = "terrain"


@dataclass(frozen=True)
class Contact:
    """How hulls touch: ``friction`` (Coulomb's coefficient), ``restitution`` (speed after over before, 0.02 to 1).

    ``speed`` m/s: the fastest approach at which hulls sink in by less than `DEPTH`; a lower value computes faster.
    """

    friction: float = 0.4
    restitution: float = 0.3
    speed: float = 20.0

    def __post_init__(self) -> None:
        for name, low, high in (("friction", 0.0, 10.0), ("restitution", 0.02, 1.0), ("speed", 0.1, 200.0)):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and low <= value <= high):
                remedy = f"give a number from {low:g} to {high:g}"
                raise InputError("out of range", remedy, key=f"world.contact.{name}", value=value)

    @property
    def frequency(self) -> float:
        """Angular frequency of the contact's spring, rad/s."""
        return self.speed / DEPTH

    @property
    def step(self) -> float:
        """The longest step during contact, s."""
        return self.step_of(self.stiff_for(0.0), False)

    def stiff_for(self, closing: float, leaning: bool = False) -> float:
        """The speed for which a pair is stiff that closes at ``closing`` m/s; ``leaning``: both bodies move."""
        return min(max(FIRM * closing, GENTLEST_LEANING if leaning else GENTLEST), float(self.speed))

    def step_of(self, speed: float, impact: bool) -> float:
        """The longest step of a pair that is stiff for ``speed`` m/s, s."""
        phase = RESOLVED / (1 + self.damping) if impact else min(RESTING, DAMPED / max(2 * self.damping, 1e-9))
        return phase * DEPTH / speed

    @property
    def damping(self) -> float:
        """The damping ratio that gives the restitution."""
        return damping_ratio(float(self.restitution))


@lru_cache(maxsize=64)
def damping_ratio(restitution: float) -> float:
    """Damping ratio of a spring and damper that cannot pull, whose bounce keeps ``restitution`` of the speed.

    They separate when the force is zero, before the spring is relaxed (Schwager and Poeschel 2007, eq. 23-24).
    """
    from scipy.optimize import brentq

    def bounce(zeta: float) -> float:
        if zeta < 1:
            omega = math.sqrt(1 - zeta**2)
            return math.exp(-zeta / omega * math.atan2(2 * zeta * omega, 2 * zeta**2 - 1))
        if zeta == 1:
            return math.exp(-2.0)
        root = math.sqrt(zeta**2 - 1)
        return math.exp(-zeta / root * math.log((zeta + root) / (zeta - root)))

    if restitution >= 1.0:
        return 0.0
    return float(brentq(lambda zeta: bounce(zeta) - restitution, 0.0, 50.0))


@dataclass
class Event:
    """A contact, from the first touch until `PAUSE` after the last."""

    vehicle: str
    other: str
    time: float
    place: Array
    speed: float
    last: float
    impulse: Array = field(default_factory=lambda: np.zeros(3))
    force: Array = field(default_factory=lambda: np.zeros(3))

    def report(self) -> dict[str, Any]:
        """The event for clips and reports: place of the first touch (m, world), its closing speed (m/s), impulse
        (N s)."""
        return {
            "kind": "contact",
            "with": self.other,
            "time": round(self.time, 9),
            "duration": round(self.last - self.time, 9),
            "place": [round(float(x), 6) for x in self.place],
            "speed": round(self.speed, 6),
            "impulse": round(float(np.linalg.norm(self.impulse)), 6),
        }


class ContactScene:
    """Several vehicles' hulls, a world's obstacles and its terrain in one MuJoCo model.

    ``start_time``: the time at which ``t`` is 0, in s since frame 0, for moving obstacles.
    """

    CARRIED = (
        *("_events", "_grips", "_time", "_begun", "_soon", "_nearing", "_last", "_pushes"),
        *("next_step", "settled", "free", "islands", "asleep"),
    )

    def __init__(self, vehicles: dict[str, Any], world: Any, contact: Contact, start_time: float = 0.0) -> None:
        import mujoco

        from vehsim.rig.parts import add_to_spec

        self.contact, self.terrain, self._start_time = contact, world.terrain, start_time
        spec = mujoco.MjSpec()
        bodies = {name: self._add_vehicle(spec, name, vehicle, add_to_spec) for name, vehicle in vehicles.items()}
        moving = [obstacle for obstacle in world.obstacles if hasattr(obstacle, "motion_at")]
        for obstacle in world.obstacles:
            body = spec.worldbody.add_body(name=f"obstacle/{obstacle.name}")
            if obstacle in moving:
                body.mass, body.inertia, body.explicitinertial = 1.0, [1.0, 1.0, 1.0], True
                body.add_freejoint()
            self._add_hulls(spec, body, obstacle)
        for geom in spec.geoms:  # before compiling: bodies of several geoms are sorted by a box that contains them
            geom.margin = MONITORED
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._undersides: list[Underside | Rock] = []
        self.bodies = [self._body(vehicles[name], body) for name, body in bodies.items()]
        self._moving_obstacles = [self._moving_obstacle(obstacle) for obstacle in moving]
        names = [body.name for body in self.bodies] + [f"obstacle/{obstacle.name}" for obstacle in moving]
        self._owner = {self.model.body(name).id: k for k, name in enumerate(names)}
        self._events: list[list[Event]] = [[] for _ in self.bodies]
        self._grips: dict[Pair, Grip] = {}
        self._time = 0.0
        self._begun = False
        self.next_step = self._soon = math.inf
        count = len(self.bodies)
        self.settled: Sequence[bool] = [False] * count
        self.free: Sequence[bool] = [False] * count
        self.islands: Sequence[int] = list(range(count))
        self.asleep: Sequence[bool] = [False] * count
        self._nearing = 0.0
        self._last: tuple[list[State], list[Array], Forces] | None = None
        """The states, wrenches and forces of the last evaluation."""
        self._pushes: dict[Pair, tuple[Points, Array, Array]] = {}
        """Its touching pairs: their points, forces (n, 3) N on the first and closing speeds (n,) m/s."""

    def _add_vehicle(self, spec: Any, name: str, vehicle: Any, add: Any) -> str:
        if vehicle.rig is None or vehicle.group.dim != 6 or not hasattr(vehicle, "inertia"):
            remedy = "contact needs vehicles that move in space and have an asset with hulls; remove world.contact"
            raise InputError("nothing to touch with", remedy, key="contact", subject=name)
        body = add(spec, vehicle.rig, f"vehicle/{name}")
        for geom in body.geoms:
            geom.contype, geom.conaffinity = 1, 3
        return str(body.name)

    def _add_hulls(self, spec: Any, body: Any, obstacle: Any) -> None:
        import mujoco

        for k, hull in enumerate(obstacle.hulls):
            mesh = f"obstacle/{obstacle.name}/{k}"
            spec.add_mesh(name=mesh, uservert=np.ravel(hull), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
            kind = mujoco.mjtGeom.mjGEOM_MESH
            body.add_geom(name=mesh, type=kind, meshname=mesh, contype=2, conaffinity=1)

    def _body(self, vehicle: Any, body: str) -> Body:
        from vehsim.rig.parts import collision_hulls

        hulls = collision_hulls(vehicle.rig.asset, vehicle.rig.root or None)
        reach = float(max(np.linalg.norm(hull - vehicle.origin, axis=1).max() for hull in hulls))
        everything = np.concatenate(hulls)
        box = np.array(list(product(*zip(everything.min(axis=0), everything.max(axis=0), strict=True))))
        inverse = np.linalg.inv(np.asarray(vehicle.inertia, float))
        if self.terrain is not None:
            plain = self.terrain.surface is None
            self._undersides.append(Underside(hulls, self.terrain) if plain else Rock(hulls, self.terrain, vehicle.rig))
        return Body(body, vehicle, self._joint(body), reach, box, inverse)

    def _moving_obstacle(self, obstacle: Any) -> MovingObstacle:
        reach = float(max(np.linalg.norm(hull, axis=1).max() for hull in obstacle.hulls))
        return MovingObstacle(self._joint(f"obstacle/{obstacle.name}"), reach, obstacle)

    def _joint(self, body: str) -> int:
        """Index of the first position of a body's free joint in the model."""
        return int(self.model.jnt_qposadr[self.model.body_jntadr[self.model.body(body).id]])

    def wrenches(self, t: float, states: Sequence[State]) -> list[Array]:
        """Wrench (6,) on each vehicle, in body axes about its body frame's origin, at public ``states`` at ``t`` s.

        Raises ``InputError`` if a vehicle starts inside something.
        """
        if self._last is not None and not self._moving_obstacles and all(map(State.same, states, self._last[0])):
            self._note(t, self._last[2])
            return self._last[1]
        vehicles = [MovingBody(body, state) for body, state in zip(self.bodies, states, strict=True)]
        moving: list[MovingBody | Led] = [*vehicles]
        moving += [Led(obstacle, self._start_time + t) for obstacle in self._moving_obstacles]
        pairs = self._touching(moving)
        if not self._begun:
            self._begun = True
            self._refuse_buried(pairs)
        total = [np.zeros(6) for _ in moving]
        forces: Forces = {}
        grips, before, longest = self._grips, self._pushes, self.contact.step
        damping: dict[int, Array] = {}
        if self._nearing:
            longest = self.contact.step_of(self.contact.stiff_for(self._nearing), self._nearing > GENTLE)
        softer = math.exp(-min(max(t - self._time, 0.0), self.next_step) / SOFTENING)
        self._grips = {pair: grip for pair, grip in grips.items() if self._rests(pair)}
        self._pushes = {pair: push for pair, push in before.items() if self._rests(pair)}
        for (a, b, name), points in pairs.items():
            one, other = moving[a], None if b is None else moving[b]
            grip = self._grips[a, b, name] = grips.get((a, b, name)) or Grip(one, other)
            leaning = self._yielding(b) is not None
            push, closing, kick, dampers = self._push(one, other, points, grip, softer, leaning)
            impact = max(kick, float(closing.max())) > GENTLE
            longest = min(longest, self.contact.step_of(grip.speed, impact))
            both = (a,) if (yields := self._yielding(b)) is None else (a, yields)
            for k in both:  # two may move against each other
                more = len(both) * vehicles[k].damping(points.places, points.normals, *dampers)
                damping[k] = damping[k] + more if k in damping else more
            self._pushes[a, b, name] = points, push, closing
        for (a, b, name), (points, push, closing) in self._pushes.items():
            total[a] += moving[a].wrench(points.places, push)
            forces[(a, name)] = points.places, push, closing
            if self._yielding(b) is not None:
                assert b is not None
                total[b] += moving[b].wrench(points.places, -push)
                forces[(b, _plain(self.bodies[a].name))] = points.places, -push, closing
        rates = [damping_rate(vehicles[k], total) for k, total in damping.items()]
        longest = min([longest, *(DAMPED / max(rate, 1e-9) for rate in rates)])
        self.next_step = max(longest, AHEAD * self._soon)
        self._see_rest(moving)
        self._note(t, forces)
        self._last = list(states), total[: len(self.bodies)], forces
        return self._last[1]

    def holds(self, changes: Sequence[Array]) -> Sequence[bool]:
        """Whether further wrenches (6,) on the vehicles leave each at rest, if it was settled."""
        assert self._last is not None
        bodies = [MovingBody(body, state) for body, state in zip(self.bodies, self._last[0], strict=True)]
        pairs = [
            (a, self._yielding(b), at.places, at.normals, push) for (a, b, _), (at, push, _) in self._pushes.items()
        ]
        return balanced(bodies, self.islands, pairs, changes, self.contact.friction)

    def _yielding(self, b: int | None) -> int | None:
        """The vehicle ``b``, None if it is a moving obstacle or what stands still."""
        return b if b is not None and b < len(self.bodies) else None

    def _rests(self, pair: Pair) -> bool:
        """Whether both of a pair are as they were, so that their forces are, too."""
        a, b, _ = pair
        return bool(self.asleep[a]) and (b is None or (b < len(self.bodies) and bool(self.asleep[b])))

    def _see_rest(self, moving: Sequence[MovingBody | Led]) -> None:
        """Which vehicles are free, which lean on each other, and which of these groups contact holds still."""
        count = len(self.bodies)
        vehicles, obstacles = moving[:count], [led for led in moving[count:] if led.speed >= PARKED]
        islands, still = list(range(count)), [m.speed < STILL for m in vehicles]
        touching = [False] * count
        for pair in self._pushes:
            a, b = pair[0], self._yielding(pair[1])
            both = (a,) if b is None else (a, b)
            for k in both:
                touching[k] = True
                still[k] &= not self._grips[pair].slides
            if b is not None and islands[a] != islands[b]:
                low, high = sorted((islands[a], islands[b]))
                islands = [low if island == high else island for island in islands]
        near = [any(_can_reach(led, vehicle) for led in obstacles) for vehicle in vehicles]
        for k in range(count):
            still[k] &= touching[k] and not near[k]
        self.free = [not (touched or close) for touched, close in zip(touching, near, strict=True)]
        moved = {island for island, calm in zip(islands, still, strict=True) if not calm}
        self.islands, self.settled = islands, [island not in moved for island in islands]

    def _refuse_buried(self, pairs: dict[Pair, Points]) -> None:
        for (a, _, name), points in pairs.items():
            depth = float(points.depths.max())
            if depth > BURIED:
                place = tuple(points.places[points.depths.argmax()].round(2).tolist())
                message = f"{depth:.2f} m deep in {name} at {place} m"
                remedy = "start elsewhere, or remove world.contact"
                raise InputError(message, remedy, key="start", subject=_plain(self.bodies[a].name))

    def _touching(self, moving: list[MovingBody | Led]) -> dict[Pair, Points]:
        """(vehicle, other vehicle or None, its name) -> the overlaps.

        Records the earliest time of the next touch, and the closing speed (m/s) of pairs, and of further corners above
        the ground, that are one resting step apart.
        """
        import mujoco

        for m in moving:
            self.data.qpos[m.body.joint : m.body.joint + 3] = m.position
            self.data.qpos[m.body.joint + 3 : m.body.joint + 7] = m.orientation
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        found: dict[Pair, list[tuple[float, Array, Array]]] = {}
        # pairs that are not reported are farther apart than the margin, and both may move
        soon = MONITORED / max(2 * max(m.fastest for m in moving), 1e-6)
        nearing = 0.0
        contacts = self.data.contact
        for k in range(self.data.ncon):
            first, second = (int(g) for g in contacts.geom[k])
            a, b = (self._owner.get(int(self.model.geom_bodyid[g])) for g in (first, second))
            normal, distance = contacts.frame[k][:3], float(contacts.dist[k])
            if a is None or (b is not None and b < a):
                (a, b), first, second = (b, a), second, first
            else:
                normal = -normal  # MuJoCo's normals point from the first to the second
            assert a is not None
            if self._rests((a, b, "")):
                continue
            fast = 2 * (moving[a].fastest + (0.0 if b is None else moving[b].fastest)) + ROOM
            if distance > fast * max(soon, self.contact.step):  # the other bodies come first
                continue
            closing, most = _toward(moving[a], None if b is None else moving[b], contacts.pos[k], normal)
            soon = min(soon, max(distance, 0.0) / most)
            if -TOUCH <= distance < closing * self.contact.step:
                nearing = max(nearing, closing)
            if distance < -TOUCH:
                name = _plain(self.model.geom(second).name)
                found.setdefault((a, b, name), []).append((-distance, contacts.pos[k].copy(), normal.copy()))
        pairs = {
            pair: Points(*(np.array(column) for column in zip(*points, strict=True))) for pair, points in found.items()
        }
        if self.terrain is not None:
            for a, (side, m) in enumerate(zip(self._undersides, moving, strict=False)):
                if self.asleep[a]:
                    continue
                gap, points = side.on(m.R_wr, m.position)
                soon = min(soon, gap / max(m.fastest, 1e-6))
                if points is not None:
                    pairs[(a, None, TERRAIN)] = points
                    if FIRM * m.speed > GENTLEST:
                        nearing = max(nearing, side.nearing(m.R_wr, m.position, m.velocity, self.contact.step))
                elif gap < m.fastest * self.contact.step:
                    nearing = max(nearing, m.speed)
        self._soon, self._nearing = soon, nearing
        return pairs

    def _push(
        self,
        a: MovingBody | Led,
        b: MovingBody | Led | None,
        points: Points,
        grip: Grip,
        softer: float,
        leaning: bool,
    ) -> tuple[Array, Array, float, tuple[Array, Array]]:
        """Forces (n, 3) N on ``a`` and closing speeds (n,) m/s of a pair's points; the rebound speed of a spring with
        their combined push, m/s; and their dampers along the normals and across them, (n,) N s/m each."""
        c, normals = self.contact, points.normals
        share = points.depths / points.depths.sum()
        middle, mean = share @ points.places, share @ normals
        length = float(np.linalg.norm(mean))
        mean = mean / length if length > 1e-6 else normals[0]
        yielding = a.yielding(middle) + (0.0 if b is None else b.yielding(middle))
        mass, sideways = effective(yielding, mean)
        velocity = a.velocity(points.places) - (0.0 if b is None else b.velocity(points.places))
        closing = -(velocity * normals).sum(axis=1)
        grip.speed = max(c.stiff_for(float(closing.max()), leaning), softer * grip.speed)
        frequency = grip.speed / DEPTH
        stiff = frequency * points.depths + 2 * c.damping * closing
        pressure = np.maximum(0.0, share * mass * frequency * stiff)
        slide = velocity + closing[:, None] * normals
        load = float(pressure.sum())  # where there is more of it, friction holds more: all points slide at once
        masses = mass * (pressure / load if load > 0 else share)
        across = 2 * SIDEWAYS_DAMPING * SIDEWAYS * frequency * math.sqrt(sideways / mass) * masses
        hold = grip.hold(
            a, b, middle, mean, points, slide, (SIDEWAYS * frequency) ** 2 * masses, across, c.friction * pressure
        )
        force = pressure[:, None] * normals + hold
        along = np.where(pressure > 0, 2 * c.damping * frequency * mass * share, 0.0)
        across = np.minimum(across, c.friction * pressure / np.maximum(np.linalg.norm(slide, axis=1), 1e-300))
        return force, closing, load / (mass * frequency), (along, across)

    def _note(self, t: float, forces: Forces) -> None:
        """Open events, and add the impulse since the last time."""
        elapsed, self._time = max(t - self._time, 0.0), t
        for k, events in enumerate(self._events):
            live = {event.other: event for event in events if t - event.last < PAUSE}
            names = {name for owner, name in forces if owner == k}
            for name in names - set(live):
                places, push, closing = forces[(k, name)]
                hardest = int(np.linalg.norm(push, axis=1).argmax())
                live[name] = Event(self.bodies[k].name, name, t, places[hardest], float(closing[hardest]), t)
                events.append(live[name])
            for name, event in live.items():
                now = forces[(k, name)][1].sum(axis=0) if name in names else np.zeros(3)
                event.impulse += elapsed / 2 * (event.force + now)
                event.force = now
                if name in names:
                    event.last = t

    def events(self, k: int = 0) -> list[dict[str, Any]]:
        """The contacts of the ``k``-th vehicle, in order of time."""
        return [event.report() for event in self._events[k]]


class Touching(Environment):
    """One vehicle among a world's obstacles and on its terrain."""

    def __init__(self, vehicle: Any, world: Any, contact: Contact, start_time: float = 0.0) -> None:
        self._scene = ContactScene({vehicle.name: vehicle}, world, contact, start_time)

    @property
    def next_step(self) -> float:  # type: ignore[override]  # an attribute of `Environment`
        return self._scene.next_step

    @property
    def settled(self) -> bool:  # type: ignore[override]  # the same
        return bool(self._scene.settled[0])

    @property
    def free(self) -> bool:  # type: ignore[override]  # the same
        return bool(self._scene.free[0])

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        return self._scene.wrenches(t, [state])[0]

    def holds(self, change: Array) -> bool:
        return bool(self._scene.holds([change])[0])

    def events(self) -> list[dict[str, Any]]:
        return self._scene.events()

    def memory(self) -> Any:
        return carried(self._scene)

    def recall(self, memory: Any) -> None:
        carry_on(self._scene, memory)


def _toward(a: MovingBody | Led, b: MovingBody | Led | None, place: Array, normal: Array) -> tuple[float, float]:
    """The speed at which two convex hulls close along the ``normal`` between them at a ``place``, m/s, and the greatest
    closing speed of any of their points, with an allowance for pushes."""
    velocity, turning, reach = a.velocity(place), a.omega, a.body.reach
    if b is not None:
        velocity, turning, reach = velocity - b.velocity(place), turning - b.omega, min(reach, b.body.reach)
    closing = max(-float(velocity @ normal), 0.0)
    return closing, closing + 2 * reach * float(np.linalg.norm(turning)) + ROOM


def _can_reach(obstacle: MovingBody | Led, vehicle: MovingBody | Led) -> bool:
    """Whether a moving obstacle can touch a vehicle that stands still within `COMING`, by spheres that contain them."""
    gap = float(np.linalg.norm(obstacle.centre - vehicle.centre)) - obstacle.body.reach - vehicle.body.reach
    return gap < COMING * obstacle.fastest


def _plain(name: str) -> str:
    """The name in "vehicle/<name>/..." or "obstacle/<name>/..."."""
    return name.split("/")[1] if "/" in name else name
