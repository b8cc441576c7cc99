"""The snakeboard and its rider: `python -m vehsim.assets.generate snakeboard` writes its `snakeboard.usdc`.

A board of 0.54 m between its trucks and a figure of 1.75 m on it. X forward, Y left, Z up; the root is on the ground
below the middle of the board. The trucks turn about Z with the feet strapped to them, wheels about Y; the legs connect
trucks and pelvis; torso and pelvis turn about Z. At rest every driven angle is zero.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from vehsim.assets.generate import _figure as figure
from vehsim.assets.generate._shapes import (
    Array,
    Field,
    Surface,
    both,
    box,
    by_material,
    convex,
    join,
    lattice,
    outer_hull,
    painted,
    revolve,
    ring,
    superellipse,
    tube,
)
from vehsim.assets.generate._slim import slimmed
from vehsim.assets.generate._usd import Material, PartShape
from vehsim.assets.generate._wheels import wheel_hull
from vehsim.vehicles.models.rider import Legs

PHYSICS = tomllib.loads((Path(__file__).parents[1] / "vehicles/snakeboard/vehicle.toml").read_text())["physics"]
HALF_LENGTH, HALF_TRACK, RADIUS = (PHYSICS[key] for key in ("half_length", "half_track", "wheel_radius"))
LEGS = Legs(PHYSICS["shin"], PHYSICS["thigh"], PHYSICS["hip_rise"], PHYSICS["hip_spread"], HALF_LENGTH)
WIDTH, PLATE, ANKLE = 0.036, 0.088, 0.195  # of a wheel; heights of the foot plate's top and of the ankles, m
HIPS = ANKLE + LEGS.rise
DOC = "Snakeboard with a jointed rider. X forward, Y left, Z up; root on the ground below the board's middle."

MATERIALS = {
    "plate": Material((0.80, 0.24, 0.02), roughness=0.35, clearcoat=0.5),
    "grip": Material((0.03, 0.03, 0.032), roughness=0.95),
    "bar": Material((0.34, 0.35, 0.37), roughness=0.3, metallic=0.85),
    "casting": Material((0.12, 0.125, 0.13), roughness=0.45, metallic=0.6),
    "wheel": Material((0.72, 0.70, 0.62), roughness=0.45),
    "mark": Material((0.05, 0.16, 0.55), roughness=0.4),
    "hub": Material((0.05, 0.05, 0.053), roughness=0.5),
    "boot": Material((0.10, 0.105, 0.11), roughness=0.6),
    "sole": Material((0.66, 0.65, 0.62), roughness=0.7),
    "strap": Material((0.02, 0.02, 0.021), roughness=0.6),
    "trousers": Material((0.075, 0.085, 0.105), roughness=0.85),
    "pad": Material((0.025, 0.026, 0.028), roughness=0.5),
    "belt": Material((0.02, 0.02, 0.021), roughness=0.6),
    "jacket": Material((0.03, 0.14, 0.36), roughness=0.7),
    "accent": Material((0.85, 0.42, 0.03), roughness=0.55),
    "trim": Material((0.02, 0.022, 0.026), roughness=0.7),
    "glove": Material((0.03, 0.031, 0.034), roughness=0.8),
    "skin": Material((0.42, 0.23, 0.15), roughness=0.55),
    "helmet": Material((0.78, 0.79, 0.80), roughness=0.25, clearcoat=0.8),
    "goggles": Material((0.012, 0.014, 0.018), roughness=0.06, clearcoat=1.0),
}
LIVERIES = {
    "blue": {name: MATERIALS[name] for name in ("plate", "wheel", "mark", "trousers", "jacket", "accent", "helmet")},
    "crimson": {
        "plate": Material((0.02, 0.30, 0.28), roughness=0.35, clearcoat=0.5),
        "wheel": Material((0.66, 0.10, 0.03), roughness=0.45),
        "mark": Material((0.78, 0.76, 0.70), roughness=0.4),
        "trousers": Material((0.20, 0.17, 0.12), roughness=0.85),
        "jacket": Material((0.36, 0.018, 0.028), roughness=0.7),
        "accent": Material((0.78, 0.76, 0.70), roughness=0.55),
        "helmet": Material((0.02, 0.022, 0.025), roughness=0.25, clearcoat=0.8),
    },
}


def build() -> dict[str, PartShape]:
    """The parts by name: board, trucks with wheels, boots and legs, pelvis, and torso with the head."""
    bar, trunk = slimmed(board(), 0.0002), slimmed(figure.torso(), 0.0004, glove=0.0008)
    skull = slimmed(figure.head(), 0.0002, trim=0.0005)
    head = PartShape((0.0, 0.08, 0.555), skull, {"bounds": held(skull)}, turn=(0.0, 0.0, -62.0))
    return {
        "board": PartShape(look=bar, collision={"bounds": held(bar)}),
        "truck_front": truck("front", 1.0),
        "truck_rear": truck("rear", -1.0),
        "pelvis": PartShape((0, 0, HIPS), hips := slimmed(figure.pelvis(LEGS.spread), 0.0004), {"bounds": held(hips)}),
        "torso": PartShape((0, 0, HIPS), trunk, {"bounds": held(trunk)}, {"head": head}),
    }


def held(look: dict[str, Surface]) -> Surface:
    return outer_hull(np.concatenate([s.points for s in look.values()]), 16.0)


# ---------------------------------------------------------------- board and trucks


def board() -> dict[str, Surface]:
    """The crossbar and the knuckles in which the trucks turn."""
    sections = []
    for x in np.linspace(-HALF_LENGTH + 0.02, HALF_LENGTH - 0.02, 13):
        y, z = superellipse(0.026 - 0.006 * np.cos(np.pi * x / (2 * HALF_LENGTH)), 0.0115, 3.0, 24).T
        sections.append(np.column_stack([np.full(24, x), y, 0.058 - 0.004 * np.cos(np.pi * x / (2 * HALF_LENGTH)) + z]))
    profile = [(0.0, 0.040), (0.028, 0.040), (0.033, 0.044), (0.033, 0.070), (0.028, 0.074), (0.0, 0.074)]
    knuckles = join(*(revolve(profile, 28).moved([x, 0, 0]) for x in (-HALF_LENGTH, HALF_LENGTH)))
    label = both(lambda p: np.abs(p[:, 0]) - 0.085, lambda p: np.abs(p[:, 1]) - 0.012, lambda p: 0.058 - p[:, 2])
    return by_material(painted(lattice(sections, crease=60), [("plate", label)], "bar"), {"casting": knuckles})


def truck(name: str, end: float) -> PartShape:
    """A truck about its pivot, on the ground below it: plate, axle, wheels, the boot strapped on, and the leg."""
    look = by_material(
        slimmed(foot_plate(), 0.0002), hanger(), {n: s.moved([0, 0, ANKLE]) for n, s in figure.boot().items()}
    )
    wheels = {}
    for side, y in (("l", HALF_TRACK), ("r", -HALF_TRACK)):
        left = wheel()
        spun = left if side == "l" else {n: s.mirrored() for n, s in left.items()}
        hull = {"bounds": wheel_hull(0.0, RADIUS, WIDTH)}
        wheels[f"wheel_{name[0]}{side}"] = PartShape((0.0, y, RADIUS), spun, hull)
    turned = [np.concatenate([s.points for s in look.values()]) @ _yaw(a).T for a in np.radians([-40, -20, 0, 20, 40])]
    hull = {"bounds": outer_hull(np.concatenate(turned), 16.0)}
    return PartShape((end * HALF_LENGTH, 0, 0), look, hull, {**wheels, f"leg_{name}": leg(name, end)})


def _yaw(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def leg(name: str, end: float) -> PartShape:
    """The leg's plane about the ankle, in it the shin, and at its end the thigh; with their rest rotations."""
    across, lean, bend = (float(np.degrees(float(angle))) for angle in LEGS.angles(end, 0.0, 0.0))
    low, high = slimmed(figure.shin(LEGS.shin), 0.0004), slimmed(figure.thigh(LEGS.thigh), 0.0004)
    thigh = PartShape((0, 0, LEGS.shin), high, {"bounds": held(high)}, turn=(bend, 0.0, 0.0))
    shin = PartShape((0, 0, 0), low, {"bounds": held(low)}, {f"thigh_{name}": thigh}, (lean, 0.0, 0.0))
    return PartShape((0, 0, ANKLE), parts={f"shin_{name}": shin}, turn=(0.0, across, 0.0))


def foot_plate() -> dict[str, Surface]:
    """The plate under a boot, along the foot, its grip tape and the binding's heel cup."""
    rows = []
    for z, grow in ((PLATE - 0.016, -0.006), (PLATE - 0.012, 0.0), (PLATE - 0.004, 0.0), (PLATE, -0.004)):
        x, y = superellipse(0.072 + grow, 0.158 + grow, 3.2, 56).T
        lift = 0.010 * np.clip((np.abs(y) - 0.10) / 0.05, 0, 1) ** 2  # toe and heel kick up
        rows.append(np.column_stack([x, y + 0.018, z + lift]))
    plate = lattice(rows, crease=40)
    grip: Field = both(
        lambda p: np.abs(p[:, 0]) - 0.058, lambda p: np.abs(p[:, 1] - 0.018) - 0.142, lambda p: PLATE - 0.002 - p[:, 2]
    )
    turn = np.linspace(np.pi * 1.08, np.pi * 1.92, 17)
    path = np.stack([0.056 * np.cos(turn), -0.046 + 0.062 * np.sin(turn), 0 * turn + PLATE + 0.028], 1)
    cup = tube(path, 0.009, 8)
    return by_material(painted(plate, [("grip", grip)], "plate"), {"casting": cup})


def hanger() -> dict[str, Surface]:
    """The support of the axle below the plate."""
    stem = revolve([(0.0, 0.034), (0.022, 0.034), (0.024, 0.040), (0.024, PLATE - 0.014), (0.0, PLATE - 0.014)], 24)
    base = box([0.075, 0.10, 0.010], [0, 0, PLATE - 0.020], 0.004, 2)
    y = HALF_TRACK - 0.5 * WIDTH - 0.004
    beam = [[0.016, -0.03, 0.052], [0.016, 0.03, 0.052], [0.010, y, RADIUS + 0.010], [0.010, -y, RADIUS + 0.010]]
    beam += [[0.010, y, RADIUS - 0.010], [0.010, -y, RADIUS - 0.010], [0.014, -0.03, 0.024], [0.014, 0.03, 0.024]]
    body = convex(np.array([[s * x, b, c] for x, b, c in beam for s in (-1, 1)]), 20.0)
    axle = tube([[0, -HALF_TRACK - 0.026, RADIUS], [0, HALF_TRACK + 0.026, RADIUS]], 0.004, 12)
    nuts = join(
        *(
            revolve([(0, -0.004), (0.0075, -0.004), (0.0075, 0.004), (0, 0.004)], 6, "y").moved(
                [0, s * (HALF_TRACK + 0.021), RADIUS]
            )
            for s in (-1, 1)
        )
    )
    return {"casting": join(stem, base, body), "bar": join(axle, nuts)}


def wheel() -> dict[str, Surface]:
    """A urethane wheel on its bearing, with two of its faces' six sectors marked, on both sides."""
    h, r, core = WIDTH / 2, RADIUS, 0.0145
    lip = [(r - 0.007 + 0.007 * np.sin(t), h - 0.007 + 0.007 * np.cos(t)) for t in np.linspace(0, np.pi / 2, 4)]
    outer = [(core, h - 0.006), (core + 0.004, h - 0.001), *lip]
    tyre = ring([*outer, *((a, -y) for a, y in outer[::-1])], 36)
    angle: Field = lambda p: np.abs(np.arctan2(p[:, 2], p[:, 0])) * r - 0.55 * r
    other: Field = lambda p: np.abs(np.abs(np.arctan2(p[:, 2], p[:, 0])) - np.pi) * r - 0.16 * r
    face: Field = lambda p: np.hypot(p[:, 0], p[:, 2]) - (r - 0.002)
    hub = ring([(0.0040, h - 0.008), (0.0040, -h + 0.008), (core + 0.001, -h + 0.008), (core + 0.001, h - 0.008)], 24)
    return by_material(painted(tyre, [("mark", both(angle, face)), ("mark", both(other, face))], "wheel"), {"hub": hub})
