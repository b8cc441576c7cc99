"""The motor boat: `python -m vehsim.assets.generate boat` writes `assets/vehicles/boat/boat.usdc`.

An open runabout with a deep-V planing hull: 6.3 m long, 2.4 m in the beam, 150 hp outboard. X forward, Y left, Z up;
the root is midships on the still waterline. The outboard steers about Z at its bracket, its propeller turns about X;
seen from astern it turns clockwise when it drives ahead. The guide mesh `hull` is closed and watertight: buoyancy is
integrated over it.
"""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._crew import ABOARD, SPRAY_WEAR, driver, driver_materials
from vehsim.assets.generate._outboard import PIVOT, outboard
from vehsim.assets.generate._shapes import (
    Array,
    Field,
    Surface,
    aimed,
    both,
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
    sheet,
    torus,
    tube,
)
from vehsim.assets.generate._slim import slimmed
from vehsim.assets.generate._usd import Material, PartShape

BOW, TRANSOM = 3.25, -3.00
DOC = "Motor boat. X forward, Y left, Z up; root midships on the still waterline."

MATERIALS = {
    "topsides": Material((0.80, 0.81, 0.80), roughness=0.22, clearcoat=1.0),
    "stripe": Material((0.010, 0.045, 0.16), roughness=0.22, clearcoat=1.0),
    "bottom": Material((0.012, 0.030, 0.075), roughness=0.6),
    "boot": Material((0.62, 0.30, 0.04), roughness=0.3, clearcoat=1.0),
    "deck": Material((0.74, 0.74, 0.71), roughness=0.5),
    "sole": Material((0.30, 0.165, 0.075), roughness=0.65),
    "liner": Material((0.62, 0.62, 0.60), roughness=0.55),
    "cushion": Material((0.70, 0.66, 0.57), roughness=0.7),
    "piping": Material((0.010, 0.045, 0.16), roughness=0.6),
    "glass": Material((0.10, 0.13, 0.145), roughness=0.04, opacity=0.45, clearcoat=1.0),
    "chrome": Material((0.62, 0.63, 0.65), roughness=0.15, metallic=1.0),
    "rubber": Material((0.03, 0.031, 0.033), roughness=0.75),
    "dash": Material((0.05, 0.052, 0.056), roughness=0.45),
    "screen": Material((0.02, 0.06, 0.09), roughness=0.1, glow=(0.01, 0.05, 0.07)),
    "cowl": Material((0.045, 0.048, 0.052), roughness=0.25, clearcoat=1.0),
    "cowl_band": Material((0.80, 0.81, 0.80), roughness=0.25, clearcoat=1.0),
    "casing": Material((0.060, 0.063, 0.068), roughness=0.4, metallic=0.3),
    "steel": Material((0.42, 0.43, 0.45), roughness=0.25, metallic=0.9),
    "blade_mark": Material((0.80, 0.36, 0.035), roughness=0.4),
    "red": Material((0.6, 0.02, 0.02), roughness=0.2, glow=(0.5, 0.0, 0.0)),
    "green": Material((0.02, 0.5, 0.08), roughness=0.2, glow=(0.0, 0.4, 0.05)),
    "lamp": Material((0.9, 0.9, 0.85), roughness=0.1, glow=(0.25, 0.25, 0.22)),
    **driver_materials(SPRAY_WEAR),
}
ABSENT = ABOARD
LIVERIES = {
    "navy": {name: MATERIALS[name] for name in ("topsides", "stripe", "bottom", "boot", "cushion", "piping")},
    "red": {
        "topsides": Material((0.36, 0.012, 0.014), roughness=0.2, clearcoat=1.0),
        "stripe": Material((0.80, 0.78, 0.70), roughness=0.22, clearcoat=1.0),
        "bottom": Material((0.018, 0.020, 0.022), roughness=0.6),
        "boot": Material((0.80, 0.78, 0.70), roughness=0.3, clearcoat=1.0),
        "cushion": Material((0.42, 0.23, 0.11), roughness=0.6),
        "piping": Material((0.80, 0.78, 0.70), roughness=0.6),
    },
}


def build() -> dict[str, PartShape]:
    """The boat's parts by name: the hull with everything fixed to it, the outboard, and its propeller."""
    look = by_material(shell(), deck(), cockpit(), windscreen(), helm(), seats(), rails(), fittings())
    engine, propeller = outboard()
    crew = driver([0.16, -0.585, 0.635], hands=[0.15, 0.50, 0.05], ankles=[0.17, 0.46, SOLE + 0.107 - 0.635], lean=0.22)
    held = outer_hull(np.concatenate([surface.points for surface in crew.values()]), 14.0)
    return {
        "hull": PartShape(
            look=by_material(slimmed(look, 0.0004), crew),
            collision={"": hull(), **outer_hulls(look), "bounds_driver": held},
        ),
        "outboard": PartShape(PIVOT, engine, swept(engine, propeller), {"propeller": propeller}),
    }


def swept(engine: dict[str, Surface], propeller: PartShape) -> dict[str, Surface]:
    """Hulls of the outboard's cowling and of its leg with the propeller, swept over 30 degrees of steering to either
    side."""
    everything = join(*engine.values(), *(s.moved(propeller.pivot) for s in propeller.collision.values()))
    high = everything.points[everything.faces].mean(1)[:, 2] > 0.1
    turns = [aimed([np.cos(t), np.sin(t), 0.0]) for t in np.radians(np.linspace(-30, 30, 9))]
    hulls = {}
    for name, region in (("bounds_cowling", high), ("bounds_leg", ~high)):
        points = everything.points[np.unique(everything.faces[region])]
        hulls[name] = outer_hull(np.concatenate([points @ turn.T for turn in turns]), 12.0)
    return hulls


# ---------------------------------------------------------------- lines of the hull

KEEL = curve(
    [-3.0, 0.8, 1.4, 1.9, 2.3, 2.6, 2.85, 3.05, 3.17, 3.23, BOW],
    [-0.365, -0.365, -0.345, -0.285, -0.175, -0.03, 0.18, 0.42, 0.62, 0.76, 0.88],
)
CHINE_WIDTH = curve(
    [-3.0, -1.0, 0.4, 1.2, 1.8, 2.3, 2.7, 2.95, 3.12, 3.2, BOW],
    [0.99, 1.03, 1.01, 0.90, 0.73, 0.53, 0.33, 0.20, 0.11, 0.06, 0.006],
)
CHINE = curve(
    [-3.0, -1.0, 0.4, 1.2, 1.8, 2.3, 2.7, 2.95, 3.12, 3.2, BOW],
    [-0.035, -0.02, 0.03, 0.10, 0.19, 0.31, 0.45, 0.575, 0.69, 0.77, 0.883],
)
SHEER_WIDTH = curve(
    [-3.0, -1.0, 0.4, 1.2, 1.8, 2.3, 2.7, 2.95, 3.12, 3.2, BOW],
    [1.11, 1.19, 1.20, 1.14, 1.01, 0.80, 0.54, 0.34, 0.18, 0.10, 0.012],
)
SHEER = curve([-3.0, -2.0, 0.0, 1.2, 2.2, BOW], [0.60, 0.595, 0.63, 0.70, 0.80, 0.93])
STATIONS = np.concatenate(
    [np.linspace(-3.0, 0.6, 19), np.linspace(0.75, 2.4, 16), [2.5, 2.6, 2.7, 2.8, 2.88, 2.95, 3.01, 3.07, 3.12, 3.16]]
)
STATIONS = np.concatenate([STATIONS, [3.19, 3.215, 3.235, BOW]])


def half_section(x: float, bottom: int = 7, side: int = 8) -> Array:
    """(n, 2) points (y, z) of the left skin at ``x``: keel, the flat of the chine, up the flared side to the sheer."""
    w, z = float(CHINE_WIDTH(x)), float(CHINE(x))
    flat = 0.055 * min(1.0, w / 0.5)
    t = np.linspace(0, 1, bottom)
    low = np.stack([(w - flat) * t, KEEL(x) + (z - KEEL(x)) * (t - 0.10 * t * (1 - t))], 1)
    up = np.linspace(0, 1, side)
    # towards the bow the side is hollow, so that it throws spray outwards
    flare = 0.55 * np.clip((x - 0.2) / 2.4, 0, 1)
    out = (1 - flare) * (1 - (1 - up) ** 1.6) + flare * up**1.7
    top = np.stack([w + (SHEER_WIDTH(x) - w) * out, z - 0.008 + (SHEER(x) - z + 0.008) * up], 1)
    return np.concatenate([low, top])


def shell() -> dict[str, Surface]:
    """The outer skin from sheer to sheer and the transom, painted; lifting strakes below, a rub rail above."""
    halves = [half_section(x) for x in STATIONS]
    rows = [
        np.column_stack(
            [
                np.full(2 * len(h) - 1, x),
                np.concatenate([-h[:0:-1, 0], h[:, 0]]),
                np.concatenate([h[:0:-1, 1], h[:, 1]]),
            ]
        )
        for x, h in zip(STATIONS, halves, strict=True)
    ]
    skin = sheet(rows, [0, 0, -1], crease=24.0)
    edge = rows[0]
    transom = sheet([edge * [1, s, 1] for s in (1.0, 0.66, 0.33, 0.0)], [-1, 0, 0])
    strakes = []
    for share in (0.36, 0.68):
        xs = np.linspace(-3.0, 1.9, 26)
        strakes.append(lattice([_strake(x, share) for x in xs], crease=24.0))
    rail = [[x, SHEER_WIDTH(x) + 0.005, SHEER(x) - 0.012] for x in STATIONS[np.r_[0:19:3, 19 : len(STATIONS)]]]
    rub = tube(rail, 0.026, 8)
    stern = tube([[TRANSOM - 0.005, y, SHEER(TRANSOM) - 0.012] for y in np.linspace(-1.11, 1.11, 5)], 0.026, 10)
    coats: list[tuple[str, Field]] = [
        ("bottom", lambda p: p[:, 2] - WATERLINE_PAINT(p[:, 0])),
        ("boot", lambda p: p[:, 2] - WATERLINE_PAINT(p[:, 0]) - 0.045),
        (
            "stripe",
            both(
                lambda p: SHEER(p[:, 0]) - 0.24 + 0.02 * p[:, 0] - p[:, 2],
                lambda p: p[:, 2] - SHEER(p[:, 0]) + 0.10 - 0.012 * p[:, 0],
            ),
        ),
    ]
    return by_material(
        painted(join(skin, transom), coats, "topsides"),
        {"bottom": join(*strakes).pair(), "rubber": join(rub.pair(), stern)},
    )


WATERLINE_PAINT = curve([-3.0, 0.0, 1.5, BOW], [0.05, 0.055, 0.085, 0.15])


def _strake(x: float, share: float) -> list[list[float]]:
    """A triangular section on the bottom, ``share`` of the way to the chine, fading out forward."""
    fade = float(np.clip((1.9 - x) / 0.5, 0.02, 1))
    low = half_section(x, 40)[:40]
    y = share * float(CHINE_WIDTH(x))
    z = float(np.interp(y, low[:, 0], low[:, 1]))
    inner = float(np.interp(y - 0.07, low[:, 0], low[:, 1]))
    return [[x, y, z + 0.01], [x, y, z - 0.018 * fade], [x, y - 0.05, inner + 0.005], [x, y - 0.07, inner + 0.012]]


def hull() -> Surface:
    """The buoyancy hull: outer skin, transom and a flat lid from sheer to sheer; closed, symmetric, welded."""
    xs = [-3.0, -2.0, -1.0, 0.0, 0.7, 1.3, 1.8, 2.2, 2.55, 2.85, 3.05, 3.17]
    rows = []
    for x in xs:
        half = half_section(x, 3, 3)
        lid = half[-1] * [0.0, 1.0] + [0.0, 0.012]
        rows.append(np.column_stack([np.full(len(half) + 1, x), np.vstack([half, lid])]))
    stem = np.array([BOW, 0.0, 0.90])
    n = len(rows[0])
    left = np.concatenate([*rows, [stem]])
    quads = [(i * n + j, i * n + j + 1) for i in range(len(rows) - 1) for j in range(n - 1)]
    faces = [(a, b, b + n) for a, b in quads] + [(a, b + n, a + n) for a, b in quads]
    faces += [(len(left) - 1 - n + j, len(left) - n + j, len(left) - 1) for j in range(n - 1)]
    faces += [(0, j + 1, j) for j in range(1, n - 1)]
    both_halves = Surface(left, left, np.array(faces, np.int64)).pair()
    points, weld = np.unique(np.round(both_halves.points, 6) + 0.0, axis=0, return_inverse=True)
    triangles = weld.reshape(-1)[both_halves.faces]
    a, b, c = (points[triangles[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->", a, np.cross(b, c)) > 0
    return Surface(points, points, triangles if outward else triangles[:, ::-1])


# ---------------------------------------------------------------- deck and cockpit

SOLE = 0.02
FRONT, BACK = 1.30, -2.52  # of the cockpit


def inner(x: float) -> float:
    """Half width of the cockpit at the coaming."""
    ahead = np.clip((FRONT - x) / 0.55, 0, 1)
    astern = np.clip((x - BACK) / 0.25, 0, 1)
    return float((SHEER_WIDTH(x) - 0.19) * (0.86 + 0.14 * ahead**0.5) * (0.93 + 0.07 * astern**0.5))


def deck() -> dict[str, Surface]:
    """Foredeck, side decks and stern deck, crowned, with the rounded coaming down to the cockpit."""
    fore = sheet(
        [
            [[x, SHEER_WIDTH(x) * t, crown(x, t)] for t in np.linspace(-1, 1, 15)]
            for x in [FRONT, *STATIONS[STATIONS > FRONT + 0.02]]
        ],
        [0, 0, 1],
    )
    aft = sheet(
        [[[x, SHEER_WIDTH(x) * t, crown(x, t)] for t in np.linspace(-1, 1, 15)] for x in np.linspace(TRANSOM, BACK, 5)],
        [0, 0, 1],
    )
    xs = np.linspace(BACK, FRONT, 30)
    side = sheet([[[x, *p] for p in coaming(x)] for x in xs], [0, -0.3, 1])
    ends = []
    for x, sign in ((FRONT, 1), (BACK, -1)):
        w = inner(x)
        ys = np.linspace(-w, w, 15)
        top = [[x, y, crown(x, y / SHEER_WIDTH(x))] for y in ys]
        lip = [[x - sign * 0.02, y, crown(x, y / SHEER_WIDTH(x)) - 0.03] for y in ys]
        foot = [[x - sign * 0.02, y * coaming(x)[-1][0] / w, SOLE] for y in ys]
        ends.append(sheet([top, lip, foot], [-sign, 0, 0.3]))
    hatch = polygon([(1.75, -0.30), (1.75, 0.30), (2.32, 0.22), (2.32, -0.22)], 0.06, (0, 1))
    tread: Field = both(
        lambda p: np.abs(p[:, 1]) - 0.5 * SHEER_WIDTH(p[:, 0]), lambda p: 1.50 - p[:, 0], lambda p: p[:, 0] - 2.75
    )
    look = painted(join(fore, aft), [("glass_hatch", hatch), ("rubber", grown(hatch, 0.022)), ("sole", tread)], "deck")
    look["dash"] = look.pop("glass_hatch")
    return by_material(look, {"deck": side.pair(), "liner": join(*ends)})


def crown(x: float, t: float) -> float:
    """Height of the deck at ``t`` of the half width: it rises to the middle, more so forward."""
    rise = 0.03 + 0.075 * np.clip((x - 0.8) / 0.8, 0, 1) * np.clip((BOW - x) / 1.2, 0, 1)
    return float(SHEER(x) + 0.012 + rise * (1 - t * t))


def coaming(x: float) -> list[list[float]]:
    """(y, z) from the sheer over the side deck and down the liner to the sole."""
    w, z, i = float(SHEER_WIDTH(x)), float(SHEER(x)), inner(x)
    rise = crown(x, i / w)
    floor = min(i - 0.05, float(np.interp(SOLE + 0.02, *half_section(x, 12, 12).T[::-1])) - 0.06)
    return [
        [w, z],
        [w - 0.02, z + 0.014],
        [i + 0.05, rise],
        [i + 0.015, rise - 0.004],
        [i, rise - 0.03],
        [i - 0.01, rise - 0.08],
        [floor, SOLE + 0.08],
        [floor - 0.03, SOLE],
    ]


def cockpit() -> dict[str, Surface]:
    """The sole: planks with caulked seams between them."""
    xs = np.linspace(BACK - 0.03, FRONT + 0.03, 10)
    half = [coaming(float(np.clip(x, BACK, FRONT)))[-1][0] + 0.03 for x in xs]

    def strip(right: float, left: float) -> Surface:
        rows = [[[x, np.clip(y, -w, w), SOLE] for y in (right, left)] for x, w in zip(xs, half, strict=True)]
        return sheet(rows, [0, 0, 1])

    seams = np.arange(-9, 9) * 0.11 + 0.055
    planks = [strip(y + 0.004, y + 0.106) for y in seams[:-1]]
    return {"sole": join(*planks), "rubber": join(*(strip(y - 0.004, y + 0.004) for y in seams))}


# ---------------------------------------------------------------- what stands on it


def windscreen() -> dict[str, Surface]:
    """A screen that wraps around the front of the cockpit, raked aft, in a chromed frame."""
    s = np.linspace(-1, 1, 31)
    foot_x, foot_y = 1.52 - 0.95 * np.abs(s) ** 3.2, 1.02 * np.sin(0.5 * np.pi * s)
    foot_z = np.array([crown(x, y / SHEER_WIDTH(x)) for x, y in zip(foot_x, foot_y, strict=True)]) - 0.005
    foot = np.stack([foot_x, foot_y, foot_z], 1)
    top = np.stack([foot_x - 0.30 + 0.04 * np.abs(s), 0.93 * foot_y, foot_z + 0.40 - 0.10 * np.abs(s) ** 3], 1)
    out = np.stack([0.004 + 0 * s, 0.004 * s, 0 * s], 1)
    pane = lattice(np.stack([foot + out, top + out, top - out, foot - out], 1), crease=30)
    posts = [tube([foot[k], top[k]], 0.012, 8) for k in (0, 10, 20, 30)]
    return {"glass": pane, "chrome": join(tube(top, 0.014, 8), *posts), "rubber": tube(foot, 0.016, 6)}


def helm() -> dict[str, Surface]:
    """The two consoles below the screen; the starboard one with wheel, instruments and throttle."""
    consoles, tops = [], []
    for y in (0.60, -0.60):
        consoles.append(box([0.46, 0.54, 0.50], [1.06, y * 0.97, 0.43], 0.06, 3))
        tops.append(box([0.42, 0.56, 0.05], [1.05, y, 0.69], 0.024, 3))
    tilt = aimed([-0.82, 0, 0.57])  # X out of the instrument panel, towards the driver
    at = np.array([0.845, -0.60, 0.60])
    panel = box([0.03, 0.50, 0.20], bevel=0.012, steps=2).turned(tilt).moved(at)
    screen = box([0.01, 0.24, 0.14], [0.017, -0.09, 0.0], 0.004).turned(tilt).moved(at)
    dials = [
        revolve([(0.0, 0.012), (0.040, 0.012), (0.045, 0.022), (0.0, 0.024)], 20, "x").moved([0, y, 0.02])
        for y in (0.09, 0.19)
    ]
    wheel_at, out = np.array([0.70, -0.60, 0.50]), tilt
    hoop = torus(0.17, 0.014, 32, "x")
    spokes = [tube([[0.01, 0, 0], [0.0, 0.165 * np.cos(t), 0.165 * np.sin(t)]], 0.011, 8) for t in (0.5, 2.6, 4.71)]
    boss = revolve([(0.0, -0.02), (0.045, -0.02), (0.045, 0.015), (0.03, 0.028), (0.0, 0.03)], 20, "x")
    column = tube([[-0.22, 0, 0], [0.0, 0, 0]], 0.026, 10)
    turned = [s.turned(out).moved(wheel_at) for s in (hoop, join(*spokes, boss, column))]
    lever = tube([[0.88, -0.96, 0.62], [0.83, -0.96, 0.70], [0.77, -0.96, 0.73]], [0.012, 0.012, 0.018], 8, 10)
    mount = box([0.14, 0.06, 0.10], [0.90, -0.94, 0.60], 0.018, 2)
    return by_material(
        {"liner": join(*consoles), "dash": join(*tops, panel, mount), "screen": screen},
        {"chrome": join(turned[1], lever, *(d.turned(tilt).moved(at) for d in dials)), "rubber": turned[0]},
    )


def seats() -> dict[str, Surface]:
    """Two bucket seats on pedestals and the bench across the stern."""
    cushions, piping, frames = [], [], []
    for y in (0.56, -0.56):
        cushions.append(box([0.46, 0.48, 0.13], [0.10, y, 0.475], 0.05, 3))
        cushions += [box([0.44, 0.09, 0.11], [0.09, y + side * 0.23, 0.55], 0.042, 3) for side in (-1, 1)]
        lean = aimed([0.985, 0, 0.17])
        cushions.append(box([0.12, 0.50, 0.50], bevel=0.05, steps=3).turned(lean).moved([-0.17, y, 0.72]))
        piping.append(box([0.07, 0.53, 0.55], bevel=0.034, steps=3).turned(lean).moved([-0.205, y, 0.72]))
        piping.append(box([0.48, 0.50, 0.06], [0.09, y, 0.405], 0.028, 3))
        profile = [
            (0.0, SOLE),
            (0.15, SOLE),
            (0.15, SOLE + 0.02),
            (0.055, SOLE + 0.05),
            (0.05, 0.36),
            (0.13, 0.385),
            (0.0, 0.39),
        ]
        frames.append(revolve(profile, 20).moved([0.08, y, 0]))
    for y in (-0.56, 0.0, 0.56):
        cushions.append(box([0.46, 0.54, 0.11], [-2.24, y, 0.40], 0.045, 3))
        cushions.append(box([0.11, 0.54, 0.30], [-2.45, y, 0.56], 0.045, 3))
    bench = box([0.50, 1.76, 0.32], [-2.27, 0, 0.18], 0.03, 2)
    return {"cushion": join(*cushions), "piping": join(*piping), "liner": bench, "chrome": join(*frames)}


def rails() -> dict[str, Surface]:
    """The bow rail of either side on its stanchions, grab rails on the side decks."""
    xs = np.array([1.55, 1.75, 2.1, 2.5, 2.82, 3.0])
    lift = np.array([0.02, 0.13, 0.20, 0.23, 0.24, 0.24])
    path = [[x, SHEER_WIDTH(x) - 0.075, SHEER(x) + h] for x, h in zip(xs, lift, strict=True)]
    nose = [[3.10, 0.13, SHEER(3.1) + 0.24], [3.13, 0.0, SHEER(3.1) + 0.24]]
    bow = tube([*path, *nose], 0.0125, 8, 26)
    posts = [
        tube([[x, SHEER_WIDTH(x) - 0.075, SHEER(x) + 0.0], [x, SHEER_WIDTH(x) - 0.075, SHEER(x) + h]], 0.011, 8)
        for x, h in ((2.1, 0.20), (2.5, 0.23), (2.82, 0.24))
    ]
    grab = tube(
        [
            [x, SHEER_WIDTH(x) - 0.10, SHEER(x) + h]
            for x, h in ((-1.3, 0.0), (-1.25, 0.05), (-0.9, 0.055), (-0.55, 0.05), (-0.5, 0.0))
        ],
        0.011,
        8,
        14,
    )
    return {"chrome": join(bow, *posts, grab).pair()}


def fittings() -> dict[str, Surface]:
    """Cleats, bow eye, anchor roller, lights, swim platforms with a ladder, and the outboard's bracket."""
    cleats = []
    for x in (2.55, -2.75):
        y, z = SHEER_WIDTH(x) - 0.16, SHEER(x) + 0.02
        bar = tube(
            [[x - 0.10, y, z + 0.045], [x - 0.05, y, z + 0.036], [x + 0.05, y, z + 0.036], [x + 0.10, y, z + 0.045]],
            [0.008, 0.012, 0.012, 0.008],
            6,
            7,
        )
        legs = join(*(tube([[x + d, y, z - 0.02], [x + d, y, z + 0.036]], 0.010, 8) for d in (-0.03, 0.03)))
        cleats.append(join(bar, legs))
    eye = torus(0.028, 0.009, 14, "y").moved([3.075, 0, 0.42])
    roller = box([0.26, 0.09, 0.03], [3.20, 0, 0.965], 0.012, 2)
    red = box([0.075, 0.03, 0.035], [2.90, 0.31, 0.945], 0.012, 2)
    green = red.mirrored()
    pole = tube([[-2.72, 0.0, 0.60], [-2.72, 0.0, 1.35]], 0.010, 8)
    lamp = revolve([(0.0, 1.35), (0.03, 1.35), (0.034, 1.37), (0.034, 1.41), (0.02, 1.43), (0.0, 1.43)], 10).moved(
        [-2.72, 0, 0]
    )
    platform = box([0.42, 0.62, 0.055], [-3.20, 0.66, 0.13], 0.026, 3)
    tread = box([0.36, 0.54, 0.012], [-3.20, 0.66, 0.158], 0.004)
    bracket = convex(
        np.array(
            [[x, y, z] for y in (-0.11, 0.11) for x, z in ((-2.99, 0.10), (-2.99, 0.56), (-3.11, 0.52), (-3.11, 0.24))]
        )
    )
    clamp = box([0.20, 0.34, 0.10], [-2.98, 0, 0.60], 0.03, 2)
    ladder = join(*(tube([[-3.42, y, 0.11], [-3.44, y, -0.12], [-3.44, y, -0.30]], 0.012, 8, 8) for y in (0.52, 0.80)))
    rungs = join(*(tube([[-3.44, 0.52, z], [-3.44, 0.80, z]], 0.013, 8) for z in (-0.12, -0.28)))
    return by_material(
        {"chrome": join(*cleats).pair(), "deck": platform.pair(), "rubber": tread.pair()},
        {"chrome": join(eye, roller, pole, ladder, rungs), "casing": join(bracket, clamp)},
        {"red": red, "green": green, "lamp": lamp},
    )


# ---------------------------------------------------------------- collision


def outer_hulls(look: dict[str, Surface]) -> dict[str, Surface]:
    """A few convex hulls that together contain every visible triangle of the hull and everything fixed to it."""
    everything = join(*look.values())
    x, _, z = everything.points[everything.faces].mean(1).T
    forward, low = x > 0.55, z < SHEER(np.clip(x, TRANSOM, BOW)) + 0.11
    regions = {
        "swim_platforms": (x < -3.03) & (z < 0.3),
        "shell": low,
        "rail": (x > 1.5) & ~low,
        "screen": forward & ~low,
    }
    regions["pole"] = (x < -2.6) & ~low
    regions["seats"] = ~low
    hulls, left = {}, np.ones(len(x), bool)
    for name, region in regions.items():
        hulls[f"bounds_{name}"] = outer_hull(everything.points[np.unique(everything.faces[left & region])], 12.0)
        left &= ~region
    return hulls
