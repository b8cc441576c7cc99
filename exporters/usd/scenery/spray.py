"""Spray: drops that hulls throw up where they strike the water, and that the wind tears from breaking crests.

For pictures only. Each drop flies through the wind with drag in proportion to its speed, in closed form; what is thrown
up in a frame depends on that frame alone, so spray is the same whichever frames are exported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.exporters.usd.metadata import author_origin
from vehsim.exporters.usd.scenery.wake import Floating, clip_matrices
from vehsim.exporters.usd.scenery.water_grid import Grid
from vehsim.exporters.usd.scenery.waterline import aboard

if TYPE_CHECKING:
    from vehsim.world.water.water import Water
    from vehsim.world.water.whitecaps import Breaking

Array = NDArray[np.float64]

LIFE = 2.5
"""Time after which a drop is gone, s."""
MOST = 16_000
"""Largest number of drops at a time."""
SAMPLES = 4000
"""Places on a hull at which it may strike the water."""
BAND = 0.15
"""Distance from the surface within which a hull's skin throws up spray, m."""
GENTLE = 0.7
"""Speed with which a hull's skin may press on the water without spray, m/s."""
HULL_RATE = 9000.0
"""Drops per m^2 of struck water, s, and m/s above that speed."""
JET = (0.5, 2.0)
"""Speed of drops off a hull over the speed of its skin through the water, between these."""
CREST_RATE = 30.0
"""Drops per m^2 of freshly breaking crest and s, per m/s of wind above `CALM`."""
CALM = 9.0
"""Wind that tears no drops off crests, m/s (spindrift begins at 8 or 9 Beaufort, spray at 5)."""
NEAR = 2.5
"""Crests throw up drops where the water's cells are shorter than this, m: around the vehicles."""
WIDTHS = (0.005, 0.035)
"""Diameters of drops, m: evenly spread over their logarithm."""
DRAG = (0.12, 14.0)
"""Time constant of a drop's drag, s, and how it grows with its diameter, s/m."""
LOW_WIND = 0.6
"""Wind among the waves over that at 10 m."""


class Drops(NamedTuple):
    """``places`` (n, 3) m, ``velocities`` (n, 3) m/s, ``widths`` (n,) m."""

    places: Array
    velocities: Array
    widths: Array

    @classmethod
    def none(cls) -> Drops:
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


class Thrown(NamedTuple):
    """Drops as they were thrown up at ``times`` (n,) s."""

    times: Array
    drops: Drops


def flown(drops: Drops, seconds: Array, wind: Array) -> Drops:
    """The drops after ``seconds`` (n,) in ``wind`` (3,) m/s: ``v' = (wind - v) / T - g``, with `DRAG`'s T."""
    constant = (DRAG[0] + DRAG[1] * drops.widths)[:, None]
    final = wind - GRAVITY * constant * np.array([0.0, 0.0, 1.0])
    left = np.exp(-seconds[:, None] / constant)
    places = drops.places + final * seconds[:, None] + (drops.velocities - final) * constant * (1 - left)
    return Drops(places, final + (drops.velocities - final) * left, drops.widths)


@dataclass(eq=False)
class Spray:
    """The spray of a shot: of ``vehicles``, and of ``breaking`` waves on a ``grid``; ``wind`` (3,) m/s.

    Time is 0 on the frame ``start``.
    """

    vehicles: Mapping[str, Floating]
    water: Water
    breaking: Breaking | None
    grid: Grid
    wind: Array
    start: float
    fps: float

    def __post_init__(self) -> None:
        from vehsim.world.water.whitecaps import Folding

        self._skins = [_skin(vehicle, k) for k, vehicle in enumerate(self.vehicles.values())]
        self._near = np.flatnonzero(self.grid.cells < NEAR)
        self._surface = self._near if len(self._near) else np.arange(len(self.grid.cells))
        self._crests = self.breaking is not None and self.breaking.speed > CALM
        if self._crests:
            assert self.breaking is not None
            rest = self.grid.xy[self._near]
            self._folding = Folding(self.breaking.waves, rest)
            self._uneven = self.breaking.unevenness(rest)
            along, across = (np.linalg.norm(step[self._near], axis=1) for step in self.grid.steps)
            self._areas = along * across
        self._thrown: dict[int, Thrown] = {}

    def at(self, frame: float, surface: Array) -> Drops:
        """The drops in the air on a whole frame, above the sea's own ``surface``: the grid's points (n, 3) m."""
        from scipy.spatial import cKDTree

        last, count = round(frame), int(np.ceil(LIFE * self.fps))
        recent = range(last - count, last + 1)
        self._thrown = {k: self._thrown.get(k) or self._throw(k) for k in recent}
        times = np.concatenate([self._thrown[k].times for k in recent])
        thrown = Drops(*(np.concatenate(parts) for parts in zip(*(self._thrown[k].drops for k in recent), strict=True)))
        age = (frame - self.start) / self.fps - times
        drops = flown(thrown, age, LOW_WIND * self.wind)
        if not len(age):
            return drops
        near = surface[self._surface]
        _, below = cKDTree(near[:, :2]).query(drops.places[:, :2])
        there = (age < LIFE) & (drops.places[:, 2] > near[below, 2] - 0.02)
        drops = Drops(*(part[there] for part in drops))
        for vehicle in self.vehicles.values():
            hidden = aboard(vehicle, drops.places, frame)
            drops = Drops(*(np.delete(part, hidden, axis=0) for part in drops))
        return drops

    def _throw(self, frame: int) -> Thrown:
        """The drops thrown up in the frame before and up to a whole one."""
        random = np.random.default_rng([29, frame + 2**31])
        t = (frame - self.start) / self.fps
        sources = [
            self._off_hull(*one, frame, t, random) for one in zip(self.vehicles.values(), self._skins, strict=True)
        ]
        if self._crests:
            sources.append(self._off_crests(t, random))
        places, velocities = (np.concatenate([source[k] for source in sources] or [np.zeros((0, 3))]) for k in (0, 1))
        most = int(MOST / (LIFE * self.fps + 1))
        if len(places) > most:
            kept = random.permutation(len(places))[:most]
            places, velocities = places[kept], velocities[kept]
        widths = WIDTHS[0] * (WIDTHS[1] / WIDTHS[0]) ** random.uniform(size=len(places))
        return Thrown(t - random.uniform(0, 1 / self.fps, len(places)), Drops(places, velocities, widths))

    def _off_hull(
        self, vehicle: Floating, skin: Skin, frame: int, t: float, random: np.random.Generator
    ) -> tuple[Array, Array]:
        """Places and velocities (n, 3) of drops off a hull: it throws them outwards where its skin strikes water."""
        before, now = clip_matrices(vehicle.clip, np.array([frame - 1.0, frame]))
        place = skin.places @ now[:3, :3].T + now[:3, 3]
        velocity = (place - skin.places @ before[:3, :3].T - before[:3, 3]) * self.fps
        moving = np.flatnonzero(np.linalg.norm(velocity, axis=1) > GENTLE)
        if not len(moving):
            return np.zeros((0, 3)), np.zeros((0, 3))
        place, velocity, normal = place[moving], velocity[moving], skin.normals[moving] @ now[:3, :3].T
        found = self.water.at(place, t)
        pressing = ((velocity - found.velocity) * normal).sum(axis=1)
        struck = np.abs(found.height - place[:, 2]) < BAND
        rate = HULL_RATE * skin.area * np.where(struck, np.maximum(pressing - GENTLE, 0.0), 0.0) ** 1.5
        chosen = np.repeat(np.arange(len(place)), random.poisson(rate / self.fps))
        outwards = normal[chosen] * (1.0, 1.0, 0.0)
        outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-9)
        rise = random.uniform(0.25, 1.1, (len(chosen), 1))
        way = outwards + rise * (0.0, 0.0, 1.0)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        speed = pressing[chosen, None] * random.uniform(*JET, (len(chosen), 1))
        thrown = found.velocity[chosen] + 0.35 * (velocity[chosen] - found.velocity[chosen]) + speed * way
        thrown += random.normal(scale=0.12, size=thrown.shape) * speed
        scatter = random.normal(scale=0.05, size=thrown.shape)
        return place[chosen] + scatter + outwards * 0.05, thrown

    def _off_crests(self, t: float, random: np.random.Generator) -> tuple[Array, Array]:
        """Places and velocities (n, 3) of drops that the wind tears off crests as they break."""
        assert self.breaking is not None
        waves = self.breaking.waves
        born = self.breaking.born(self._folding.at(t) + self._uneven)
        rate = CREST_RATE * (self.breaking.speed - CALM) * born * self._areas / self.fps
        chosen = np.repeat(np.arange(len(born)), random.poisson(rate))
        if not len(chosen):
            return np.zeros((0, 3)), np.zeros((0, 3))
        rest = self.grid.xy[self._near[chosen]] + random.normal(size=(len(chosen), 2)) * (
            0.4 * np.sqrt(self._areas[chosen])[:, None]
        )
        theta = rest @ waves.number.T + waves.phase - waves.omega * t
        drift = waves.choppiness * np.sin(theta) @ (waves.amplitude[:, None] * waves.along)
        left = waves.share(rest - waves.share(rest) * drift)
        swing = waves.amplitude * waves.omega
        along, up = left * (np.cos(theta) @ (swing[:, None] * waves.along)), left[:, 0] * (np.sin(theta) @ swing)
        torn = self.breaking.speed * random.uniform(0.15, 0.5, (len(chosen), 1)) * self.breaking.downwind
        velocity = np.column_stack([along + torn, up + random.gamma(2.0, 0.8, len(chosen))])
        velocity += random.normal(scale=0.5, size=velocity.shape)
        height = left[:, 0] * (np.cos(theta) @ waves.amplitude)
        return np.column_stack([rest - left * drift, self.water.level + height]), velocity


class Skin(NamedTuple):
    """Places (n, 3) m on a hull, evenly spread, their outward normals (n, 3), in the root's frame, and the ``area`` m^2
    of each."""

    places: Array
    normals: Array
    area: float


def _skin(vehicle: Floating, seed: int) -> Skin:
    assert vehicle.hull is not None
    points, faces = vehicle.hull
    a, b, c = np.moveaxis(points[faces], 1, 0)
    cross = np.cross(b - a, c - a)
    size = np.linalg.norm(cross, axis=1)
    random = np.random.default_rng(seed)
    face = random.choice(len(faces), SAMPLES, p=size / size.sum())
    u, v = random.uniform(size=(2, SAMPLES, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    places = a[face] + u * (b - a)[face] + v * (c - a)[face]
    return Skin(places, cross[face] / size[face, None], float(size.sum()) / 2 / SAMPLES)


def author_spray(stage: object, frames: Array, drops: list[Drops], near: Array) -> None:
    """Write ``/water/spray``: drops with velocities and widths, for every frame, on water around ``near`` (3,) m;
    nothing if there is none at all."""
    from pxr import Gf, UsdGeom, Vt

    if not any(len(each.widths) for each in drops):
        return
    points = UsdGeom.Points.Define(stage, "/water/spray")
    points.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(0.85, 0.87, 0.88)]))
    UsdGeom.PrimvarsAPI(points).CreatePrimvar("displayOpacity", _float_array(), UsdGeom.Tokens.constant).Set([0.6])
    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    place, velocity, extent = points.CreatePointsAttr(), points.CreateVelocitiesAttr(), points.CreateExtentAttr()
    width = points.CreateWidthsAttr()
    empty, origin = Drops.none(), author_origin(points, near)
    for when, each in [(None, empty), *zip(frames.tolist(), drops, strict=True)]:
        at = () if when is None else (when,)
        single = (each.places - origin).astype(np.float32)
        place.Set(Vt.Vec3fArray.FromNumpy(single), *at)
        velocity.Set(Vt.Vec3fArray.FromNumpy(each.velocities.astype(np.float32)), *at)
        width.Set(Vt.FloatArray.FromNumpy(each.widths.astype(np.float32)), *at)
        reach = np.float32(0.5 * WIDTHS[1])
        box = np.stack([single.min(axis=0) - reach, single.max(axis=0) + reach]) if len(single) else np.zeros((2, 3))
        extent.Set(Vt.Vec3fArray.FromNumpy(box.astype(np.float32)), *at)


def _float_array() -> object:
    from pxr import Sdf

    return Sdf.ValueTypeNames.FloatArray
