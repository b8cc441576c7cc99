"""The car: `python -m vehsim.assets.generate car` writes `assets/vehicles/car/car.usdc`.

A compact two-door coupe: 4.3 m long, 1.8 m wide, 1.35 m high, wheelbase 2.6 m. X forward, Y left, Z up; the root is on
the ground midway between the axles. Wheels turn about Y; the front ones are children of parts that steer about Z.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from vehsim.assets.generate._crew import (
    ABOARD,
    STREET_WEAR,
    driver,
    driver_materials,
    lining,
    seat,
    steering_wheel,
)
from vehsim.assets.generate._shapes import (
    Array,
    Field,
    Surface,
    both,
    both_sides,
    box,
    by_material,
    convex,
    curve,
    grown,
    join,
    lattice,
    outer_hull,
    painted,
    polygon,
    revolve,
    seam,
    sharpened,
    sheet,
    split,
    tube,
)
from vehsim.assets.generate._slim import slimmed
from vehsim.assets.generate._usd import Material, PartShape
from vehsim.assets.generate._wheels import RADIUS, wheel, wheel_hull

AXLE, HALF_TRACK = 1.30, 0.77
ARCH = 0.372
STEER_LIMIT = np.radians(40.0)  # the inner wheel of the tightest Ackermann turn

DOC = "Compact coupe. X forward, Y left, Z up; root on the ground between the axles."

MATERIALS = {
    "paint": Material((0.008, 0.105, 0.36), roughness=0.24, metallic=0.2, clearcoat=1.0),
    "glass": Material((0.05, 0.068, 0.075), roughness=0.04, opacity=0.38, clearcoat=1.0),
    "lining": Material((0.060, 0.061, 0.064), roughness=0.85),
    "seat": Material((0.11, 0.075, 0.05), roughness=0.75),
    "seal": Material((0.012, 0.012, 0.013), roughness=0.65),
    "trim": Material((0.03, 0.031, 0.033), roughness=0.55),
    "lamp": Material((0.80, 0.82, 0.85), roughness=0.08, clearcoat=1.0, glow=(0.15, 0.15, 0.16)),
    "lens": Material((0.09, 0.095, 0.10), roughness=0.06, clearcoat=1.0),
    "tail_lamp": Material((0.42, 0.006, 0.008), roughness=0.12, clearcoat=1.0, glow=(0.2, 0.0, 0.0)),
    "plate": Material((0.72, 0.72, 0.68), roughness=0.5),
    "tyre": Material((0.018, 0.018, 0.019), roughness=0.85),
    "rim": Material((0.30, 0.305, 0.315), roughness=0.3, metallic=0.85),
    "disc": Material((0.20, 0.20, 0.21), roughness=0.45, metallic=0.8),
    "chrome": Material((0.62, 0.63, 0.65), roughness=0.15, metallic=1.0),
    "mark": Material((0.80, 0.78, 0.72), roughness=0.6),
    **driver_materials(STREET_WEAR),
}
ABSENT = ABOARD
LIVERIES = {
    "blue": {name: MATERIALS[name] for name in ("paint", "rim", "mark")},
    "red": {
        "paint": Material((0.36, 0.014, 0.012), roughness=0.22, metallic=0.15, clearcoat=1.0),
        "rim": Material((0.05, 0.051, 0.054), roughness=0.35, metallic=0.7),
        "mark": Material((0.72, 0.07, 0.02), roughness=0.6),
    },
}


def build() -> dict[str, PartShape]:
    """The car's parts by name: body, rear wheels, and steered front wheels."""
    skins, rest = (shell(), cabin()), (wheel_wells(), fittings())
    # hulls from the full-resolution surfaces, so that they do not depend on the decimation
    whole = by_material(*skins, *rest)
    look = by_material(*(slimmed(skin, 0.0003, trim=0.001) for skin in skins), *rest, interior(), whoever_drives())
    parts = {"body": PartShape(look=look, collision=body_hulls(whole))}
    for side, y in (("l", HALF_TRACK), ("r", -HALF_TRACK)):
        left = wheel()
        spun = left if side == "l" else {name: s.mirrored() for name, s in left.items()}
        parts[f"wheel_r{side}"] = PartShape((-AXLE, y, RADIUS), spun, {"hull": wheel_hull(0.0)})
        front = PartShape((0.0, 0.0, 0.0), spun, {"hull": wheel_hull(STEER_LIMIT)})
        parts[f"steer_f{side}"] = PartShape((AXLE, y, RADIUS), parts={f"wheel_f{side}": front})
    return parts


# ---------------------------------------------------------------- body


def sections(xs: Array, rows: list, around: int) -> Array:
    """Closed sections (m, around, 3): per x, a cubic B-spline over ``rows`` (y(x), z(x)) and their mirror."""
    result = []
    for x in xs:
        half = np.array([[float(y(x)), float(z(x))] for y, z in rows])
        loop = np.concatenate([half, half[-2:0:-1] * [-1, 1]])
        n = len(loop)
        spline = BSpline(np.arange(-3, n + 4), np.concatenate([loop[-1:], loop, loop[:2]]), 3)
        dense = spline(np.linspace(0, n / 2, 300))
        s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
        even = np.linspace(0, s[-1], around // 2 + 1)
        y, z = np.interp(even, s, dense[:, 0]), np.interp(even, s, dense[:, 1])
        y[[0, -1]] = 0.0
        y, z = np.concatenate([y, -y[-2:0:-1]]), np.concatenate([z, z[-2:0:-1]])
        result.append(np.stack([np.full(len(y), x), y, z], 1))
    return np.array(result)


HALF_WIDTH = curve(
    [2.15, 2.13, 2.08, 1.98, 1.8, 1.5, 1.2, 0.6, 0.0, -0.6, -1.2, -1.6, -1.9, -2.05, -2.12, -2.15],
    [0.46, 0.60, 0.70, 0.79, 0.86, 0.91, 0.925, 0.905, 0.90, 0.915, 0.94, 0.925, 0.87, 0.80, 0.72, 0.60],
)
FLOOR = curve(
    [2.15, 2.12, 2.05, 1.9, 0.0, -1.6, -1.9, -2.06, -2.13, -2.15],
    [0.36, 0.27, 0.22, 0.185, 0.175, 0.195, 0.25, 0.31, 0.38, 0.45],
)
SHOULDER = curve(
    [2.15, 2.12, 2.04, 1.9, 1.6, 1.3, 0.9, 0.3, -0.4, -1.0, -1.4, -1.8, -2.02, -2.12, -2.15],
    [0.49, 0.56, 0.63, 0.70, 0.775, 0.81, 0.825, 0.845, 0.875, 0.905, 0.915, 0.90, 0.87, 0.81, 0.73],
)
CENTRE = curve(
    [2.15, 2.12, 2.04, 1.9, 1.6, 1.3, 0.9, 0.3, -1.2, -1.7, -1.95, -2.07, -2.12, -2.15],
    [0.51, 0.585, 0.655, 0.715, 0.79, 0.835, 0.87, 0.87, 0.88, 0.925, 0.955, 0.94, 0.85, 0.75],
)


def _scaled(profile, factor: float, offset: float = 0.0):
    return lambda x: factor * profile(x) + offset


def _between(a, b, t: float):
    return lambda x: (1 - t) * a(x) + t * b(x)


def shell_sections(xs: Array, around: int = 64) -> Array:
    w, zero = HALF_WIDTH, lambda x: 0.0
    rows = [
        (zero, FLOOR),
        (_scaled(w, 0.55), FLOOR),
        (_scaled(w, 0.93), FLOOR),
        (_scaled(w, 0.975), _between(FLOOR, SHOULDER, 0.14)),
        (_scaled(w, 0.965), _between(FLOOR, SHOULDER, 0.42)),
        (_scaled(w, 1.02), _between(FLOOR, SHOULDER, 0.72)),
        (_scaled(w, 1.00), _between(FLOOR, SHOULDER, 0.95)),
        (_scaled(w, 0.93), _scaled(SHOULDER, 1.0, 0.015)),
        (_scaled(w, 0.80), _between(SHOULDER, CENTRE, 0.15)),
        (_scaled(w, 0.45), _between(SHOULDER, CENTRE, 0.9)),
        (zero, CENTRE),
    ]
    return sections(xs, rows, around)


def above(height: float) -> Field:
    return lambda p: height - p[:, 2]


def facing(end: float, corners: list[tuple[float, float]], radius: float) -> Field:
    """A rounded polygon of (y, z) on the front (``end`` = 1) or the rear (-1) of the car, on both sides."""
    return both(both_sides(polygon(corners, radius, (1, 2))), lambda p: 1.2 - end * p[:, 0])


def shell() -> dict[str, Surface]:
    """The painted body below the glass, with wheel arches, lamps, grilles, seams and sills cut into it."""
    ends = 0.25 * (1 - np.cos(np.linspace(0, np.pi / 2, 9)))
    xs = np.concatenate([2.15 - ends, np.arange(1.85, -1.86, -0.072), (-2.15 + ends)[::-1]])
    skin = lattice(shell_sections(xs), crease=50)
    for x in (AXLE, -AXLE):
        _, skin = split(skin, arch(x, ARCH))
    door = polygon([(0.72, 0.30), (0.80, 0.86), (0.70, 1.2), (-0.52, 1.2), (-0.55, 0.62), (-0.42, 0.30)], 0.06)
    bonnet = polygon([(2.0, -0.60), (2.0, 0.60), (0.80, 0.78), (0.80, -0.78)], 0.1, (0, 1))
    boot = polygon([(-1.72, -0.60), (-1.72, 0.60), (-2.6, 0.62), (-2.6, -0.62)], 0.06, (0, 1))
    panels = [door, both(bonnet, above(0.5)), both(boot, above(0.66))]
    skin, lines = seam(skin, panels, 0.004)
    _, skin = split(skin, OPENING)
    skin = sharpened(skin, LENS, 0.014)
    skin = sharpened(skin, VENT, 0.06)
    arches: list[tuple[str, Field]] = [("trim", arch(x, ARCH + 0.014)) for x in (AXLE, -AXLE)]
    coats = [*front_details(), *rear_details(), *arches, ("trim", lambda p: p[:, 2] - 0.235)]
    return by_material(painted(skin, coats, "paint"), {"seal": lines})


def spot(y: float, z: float, radius: float) -> Field:
    """A round lamp in the front, on both sides."""
    return both(both_sides(lambda p: np.hypot(p[:, 1] - y, p[:, 2] - z) - radius), lambda p: 1.2 - p[:, 0])


LENS = facing(1, [(0.44, 0.565), (0.46, 0.615), (0.80, 0.72), (0.87, 0.705), (0.80, 0.60), (0.62, 0.555)], 0.02)
VENT = facing(1, [(0.60, 0.29), (0.78, 0.31), (0.78, 0.45), (0.66, 0.42)], 0.03)


def front_details() -> list[tuple[str, Field]]:
    """Headlamps with two projectors behind each lens, grille, vents and the slot above the plate."""
    streak = facing(
        1, [(0.46, 0.560), (0.64, 0.563), (0.81, 0.615), (0.80, 0.628), (0.63, 0.578), (0.46, 0.574)], 0.004
    )
    return [
        ("lamp", spot(0.585, 0.612, 0.031)),
        ("lamp", spot(0.695, 0.647, 0.031)),
        ("lamp", streak),
        ("lens", LENS),
        ("trim", grown(LENS, 0.010)),
        ("trim", facing(1, [(-0.1, 0.245), (0.52, 0.245), (0.44, 0.40), (-0.1, 0.40)], 0.05)),
        ("trim", facing(1, [(-0.1, 0.49), (0.36, 0.49), (0.36, 0.525), (-0.1, 0.525)], 0.015)),
        ("trim", VENT),
    ]


def rear_details() -> list[tuple[str, Field]]:
    """Tail lamps joined by a dark band, and the diffuser."""
    lamp = facing(-1, [(0.40, 0.765), (0.42, 0.705), (0.62, 0.675), (0.93, 0.69), (0.93, 0.755), (0.7, 0.775)], 0.02)
    band = facing(-1, [(-0.1, 0.715), (0.45, 0.715), (0.45, 0.755), (-0.1, 0.755)], 0.0)
    return [
        ("tail_lamp", lamp),
        ("trim", grown(lamp, 0.012)),
        ("trim", band),
        ("trim", facing(-1, [(-0.1, 0.1), (0.66, 0.1), (0.56, 0.44), (-0.1, 0.44)], 0.05)),
    ]


def arch(x: float, radius: float) -> Field:
    """Inside the wheel arch at ``x``: a cylinder about the wheel's axle, outboard of the chassis."""
    return both(lambda p: np.hypot(p[:, 0] - x, p[:, 2] - RADIUS) - radius, lambda p: 0.5 - np.abs(p[:, 1]))


ROOF = curve(
    [1.06, 0.9, 0.7, 0.45, 0.2, 0.0, -0.25, -0.55, -0.9, -1.25, -1.55, -1.8, -1.95],
    [0.80, 0.905, 1.02, 1.155, 1.265, 1.32, 1.35, 1.35, 1.305, 1.215, 1.11, 1.01, 0.93],
)
RAIL = curve([1.06, 0.7, 0.2, -0.3, -0.9, -1.5, -1.95], [0.66, 0.665, 0.60, 0.585, 0.575, 0.56, 0.52])
BELT = curve([1.06, 0.7, 0.2, -0.4, -0.9, -1.4, -1.95], [0.70, 0.775, 0.80, 0.80, 0.79, 0.72, 0.56])


def bare_cabin() -> Surface:
    """The skin of the greenhouse, open below."""
    crown = curve([1.06, 0.5, -0.3, -1.0, -1.95], [0.02, 0.05, 0.045, 0.05, 0.02])
    zero = lambda x: 0.0
    low = lambda x: np.minimum(SHOULDER(x) - 0.05, ROOF(x) - 0.02)
    edge = lambda x: np.maximum(ROOF(x) - crown(x), low(x))
    rows = [
        (zero, lambda x: low(x) - 0.15),
        (_scaled(BELT, 0.95), lambda x: low(x) - 0.12),
        (BELT, low),
        (_between(BELT, RAIL, 0.35), _between(low, edge, 0.4)),
        (_scaled(RAIL, 1.0, 0.035), _between(low, edge, 0.84)),
        (_scaled(RAIL, 1.0, 0.0), _between(low, edge, 1.03)),
        (_scaled(RAIL, 0.86), _between(edge, ROOF, 0.35)),
        (_scaled(RAIL, 0.45), _between(edge, ROOF, 0.95)),
        (zero, ROOF),
    ]
    xs = np.concatenate([np.arange(1.06, -1.9, -0.055), [-1.95]])
    return split(lattice(sections(xs, rows, 48), crease=50), lambda p: p[:, 2] - SHOULDER(p[:, 0]) + 0.045)[1]


def windows() -> tuple[list[Field], list[Field]]:
    """The panes, and the outlines of their seals."""
    inner = lambda p: np.abs(p[:, 1]) - RAIL(p[:, 0]) + 0.055
    windscreen = both(inner, lambda p: 0.16 - p[:, 0] + 0.05 * p[:, 1] ** 2, blend=0.06)
    backlight = both(inner, lambda p: p[:, 0] + 0.95, lambda p: -1.72 - p[:, 0], blend=0.08)
    frame = curve([1.06, 0.2, -0.5, -1.0, -1.4], [0.115, 0.085, 0.07, 0.085, 0.11])
    side = both(
        lambda p: p[:, 2] - ROOF(p[:, 0]) + frame(p[:, 0]),
        lambda p: SHOULDER(p[:, 0]) + 0.05 - p[:, 2],
        lambda p: -1.36 - p[:, 0],
        lambda p: 0.45 - np.abs(p[:, 1]),
        blend=0.04,
    )
    post, side_panes = lambda p: np.abs(p[:, 0] + 0.56 + 0.12 * (p[:, 2] - 0.9)) - 0.03, side
    panes: list[Field] = [windscreen, backlight, lambda p: np.maximum(side_panes(p), -post(p))]
    return panes, [windscreen, backlight, side]


def cabin() -> dict[str, Surface]:
    """The greenhouse: screens and side windows cut into a painted roof."""
    panes, framed = windows()
    coats: list[tuple[str, Field]] = [("glass", pane) for pane in panes]
    coats += [("seal", grown(pane, 0.018)) for pane in framed]
    return painted(bare_cabin(), coats, "paint")


FOOTWELL, HIPS = 0.27, np.array([-0.12, 0.36, 0.42])
"""Height of the floor, and the driver's hips, m."""
OPENING: Field = both(
    lambda p: np.abs(p[:, 1]) - BELT(p[:, 0]) + 0.025,
    lambda p: p[:, 0] - 0.91,
    lambda p: -1.76 - p[:, 0],
    lambda p: 0.7 - p[:, 2],
)
"""The openings of the shell below the greenhouse."""


def interior() -> dict[str, Surface]:
    """The visible interior: roof lining, tub, dashboard, shelf, seats and steering wheel."""
    skin = bare_cabin()
    for pane in windows()[0]:
        _, skin = split(skin, pane)
    walls = slimmed({"lining": lining(skin, 0.012)}, 0.003, shade=14.0)
    tub = []
    for x in np.linspace(-1.78, 0.86, 12):
        w = float(BELT(x)) - 0.015
        half = [[w, float(SHOULDER(x)) - 0.01], [w - 0.03, 0.74], [w - 0.05, FOOTWELL], [0.0, FOOTWELL]]
        tub.append([[x, s * y, z] for s, side in ((1, half), (-1, half[-2::-1])) for y, z in side])
    shelf = box([0.56, 1.16, 0.06], [-1.45, 0, 0.875], 0.02)
    top = [(0.36, 0.60), (0.34, 0.80), (0.37, 0.845), (0.48, 0.86), (0.66, 0.86), (0.80, 0.855), (0.94, 0.83)]
    hood = sheet([[[x, s * (float(BELT(x)) - 0.02), z] for s in (1, -1)] for x, z in top], [0, 0, 1])
    binnacle = box([0.22, 0.40, 0.10], [0.44, HIPS[1], 0.865], 0.045, 2)
    bench = [box([0.48, 1.16, 0.16], [-0.92, 0, 0.42], 0.05, 2), box([0.13, 1.16, 0.50], [-1.22, 0, 0.66], 0.05, 2)]
    return by_material(
        walls,
        {"lining": join(sheet(tub, [0, 0, 1]), shelf), "seat": join(seat(HIPS, 0.30).pair(), *bench)},
        {"trim": join(hood, binnacle, steering_wheel([0.36, HIPS[1], 0.75], 0.42))},
    )


def whoever_drives() -> dict[str, Surface]:
    """The driver, leaning back, both hands on the wheel."""
    hands, ankles = [0.165, 0.46, 0.36], [0.13, 0.74, FOOTWELL + 0.107 - HIPS[2]]
    return driver(HIPS, hands, ankles, lean=-0.28, helmet=False, close=False)


def side_of_shell(x: float, z: float) -> float:
    """Half width of the shell at height ``z`` in the section at ``x``."""
    section = shell_sections(np.array([x]), 240)[0]
    right = section[section[:, 1] >= 0]
    outer = right[np.argsort(right[:, 2])]
    near = outer[np.abs(outer[:, 2] - z) < 0.03]
    return float(near[:, 1].max()) if len(near) else 0.6


def wheel_wells() -> dict[str, Surface]:
    """The inside of the four wheel arches: dark liners from the chassis out to the body's skin."""
    wells = []
    for x in (AXLE, -AXLE):
        turn = np.linspace(-0.30, np.pi + 0.30, 32)
        rim = np.stack(
            [x + (ARCH + 0.008) * np.cos(turn), RADIUS + (ARCH + 0.008) * np.sin(turn)], 1
        )  # behind the edge
        outer = np.array([[px, side_of_shell(px, pz) + 0.001, pz] for px, pz in rim])
        inner = np.column_stack([rim[:, 0], np.full(len(rim), 0.5), rim[:, 1]])
        wall = np.column_stack([np.full(len(rim), x), np.full(len(rim), 0.5), np.full(len(rim), RADIUS)])
        wells.append(lattice([outer, inner, wall], wrap=False, crease=30))
    liner = join(*wells)
    a, b, c = (liner.points[liner.faces[:, k]] for k in range(3))
    to_axle = np.array([0, 0.8, RADIUS]) + np.where(a[:, :1] > 0, AXLE, -AXLE) * np.array([1.0, 0, 0]) - a
    if np.einsum("ij,ij->", np.cross(b - a, c - a), to_axle) < 0:
        liner = Surface(liner.points, -liner.normals, liner.faces[:, ::-1])
    return {"seal": liner.pair()}


def fittings() -> dict[str, Surface]:
    """Mirrors, handles, plates, wipers, exhausts and the aerial fin."""
    ball = revolve(
        [(0.0, -1.0), (0.4, -0.9), (0.75, -0.62), (0.95, -0.25), (1.0, 0.1), (0.9, 0.5), (0.6, 0.85), (0.0, 1.0)],
        18,
        "x",
    )
    blunt = ball.points.clip([-0.72, -1, -1]) * [0.09, 0.105, 0.065]
    mirror = Surface(blunt, ball.normals, ball.faces).moved([0.66, 0.93, 0.955])
    stalk = tube([[0.68, 0.76, 0.90], [0.67, 0.88, 0.935]], 0.02, 8)
    mirrored = convex(ball.points * [0.012, 0.088, 0.052] + [0.582, 0.93, 0.957])
    handle = box([0.17, 0.022, 0.025], [-0.33, 0.918, 0.765], 0.008)
    plates = join(
        box([0.012, 0.46, 0.105], [2.145, 0, 0.445], 0.003), box([0.012, 0.46, 0.105], [-2.152, 0, 0.585], 0.003)
    )
    pipes = join(*(tube([[-1.95, y, 0.33], [-2.15, y, 0.33]], 0.045, 16) for y in (-0.42, 0.42)))
    bores = join(*(tube([[-2.10, y, 0.33], [-2.152, y, 0.33]], 0.036, 14) for y in (-0.42, 0.42)))
    fin = [
        [x, y, float(ROOF(x)) + dz]
        for x, y, dz in ((-0.62, 0.012, -0.02), (-0.86, 0.022, -0.02), (-0.86, 0.004, 0.055))
    ]
    fin = convex(np.array([*fin, *([x, -y, z] for x, y, z in fin)]))
    return by_material(
        {"paint": join(mirror.pair(), handle.pair(), fin)},
        {"trim": join(stalk.pair(), bores)},
        {"plate": plates, "chrome": join(pipes, mirrored.pair())},
    )


# ---------------------------------------------------------------- collision


def body_hulls(look: dict[str, Surface]) -> dict[str, Surface]:
    """A few hulls that together contain every triangle of the body; no triangle is split between regions."""
    everything = join(*look.values())
    x, y, z = everything.points[everything.faces].mean(1).T
    mirror = (x > 0.5) & (z > 0.86) & (np.abs(y) > 0.80)
    left, right = mirror & (y > 0), mirror & (y < 0)
    high = ~mirror & (z > 0.97)
    regions = {"mirror_left": left, "mirror_right": right, "cabin": high, "shell": ~mirror & ~high}
    return {n: outer_hull(everything.points[np.unique(everything.faces[r])], 17.0) for n, r in regions.items()}
