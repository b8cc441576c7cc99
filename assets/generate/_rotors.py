"""The helicopter's rotors: blades, heads, blurred discs, and hulls that contain them at every angle."""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._shapes import (
    Array,
    Surface,
    box,
    by_material,
    convex,
    curve,
    join,
    lattice,
    outer_hull,
    revolve,
    split,
    tube,
    wing,
)
from vehsim.assets.generate._usd import PartShape

RADIUS, CHORD, BLADES, CONING = 5.35, 0.35, 3, np.radians(3.2)
HINGE = 0.02 * RADIUS
"""Distance of the blades' hinges from the axis, m: the stiffness of the hub follows from it."""
TAIL_RADIUS, TAIL_CHORD = 0.93, 0.19


def about_z(turn: float) -> Array:
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def main_rotor() -> PartShape:
    """A star-plate head that carries three coned blades on their hinges, leading edges counter-clockwise."""
    links = []
    for k in range(BLADES):
        link = tube([[0.15, 0.10, -0.22], [0.20, 0.42, -0.02]], 0.016, 8)
        horn = box([0.26, 0.06, 0.035], [0.12, 0.44, 0.005], 0.01)
        links.append(join(link, horn).mirrored().turned(about_z(2 * np.pi * k / BLADES)))
    shaft = revolve([(0.0, -0.34), (0.075, -0.34), (0.075, -0.09), (0.10, -0.05), (0.0, -0.05)], 20)
    head = revolve([(0.0, -0.075), (0.15, -0.07), (0.20, -0.05), (0.20, 0.05), (0.15, 0.07), (0.0, 0.075)], 24)
    cap = revolve([(0.0, 0.16), (0.05, 0.155), (0.105, 0.12), (0.13, 0.06), (0.13, 0.0), (0.0, 0.0)], 20)
    swash = revolve(
        [(0.0, -0.245), (0.15, -0.245), (0.165, -0.235), (0.165, -0.215), (0.15, -0.205), (0.0, -0.205)], 24
    )
    look = by_material({"steel": head, "metal": join(shaft, swash, *links)}, {"dark": cap})
    return PartShape(look=look, collision=rotor_hulls(look), parts=blades())


def blades() -> dict[str, PartShape]:
    """The blades, each with its cuff and its share of the blurred disc, in frames at their hinges: Y outward.

    The shares meet at equal heights however far the blades cone, because each turns its edges by the same angle.
    """
    main, tip = (part.mirrored().turned(about_z(np.pi)) for part in blade())  # seen from above counter-clockwise
    arm = tube([[0, 0.10, 0.0], [0, 0.42, 0.01], [0, 0.62, 0.025]], [0.085, 0.06, 0.055], 12, 8)
    sleeve = box([0.15, 0.46, 0.085], [0, 0.66, 0.028], 0.02)
    rings = {"blur_root": [0.55, 1.5], "blur": [1.5, 5.0], "blur_tip": [5.0, RADIUS]}
    look = {
        "blade": main,
        "tip": tip,
        "steel": join(arm, sleeve),
        **{name: blur(radii, CONING, 24, share=(np.pi / 6, 5 * np.pi / 6)) for name, radii in rings.items()},
    }
    at_hinge = {name: surface.moved([0, -HINGE, 0]) for name, surface in look.items()}
    turns = [180 + 360 * k / BLADES for k in range(BLADES)]
    pivots = [about_z(np.radians(turn)) @ [0, HINGE, 0] for turn in turns]
    return {
        f"blade_{k + 1}": PartShape(tuple(pivots[k]), at_hinge, turn=(0.0, 0.0, turns[k] % 360)) for k in range(BLADES)
    }


def blade() -> tuple[Surface, Surface]:
    """One blade along Y, for a rotor that turns clockwise, and its painted tip.

    Root cut-out, linear twist of -10 degrees, swept tip corner.
    """
    radii = np.concatenate([[0.72, 0.85, 1.05, 1.3], np.linspace(1.8, 4.85, 9), [5.0, 5.12, 5.24, 5.31, RADIUS]])
    chord = curve([0.72, 0.85, 1.3, 5.1, 5.31, RADIUS], [0.13, 0.18, CHORD, CHORD, 0.27, 0.17])
    thick = curve([0.72, 1.3, 2.5, RADIUS], [0.42, 0.13, 0.12, 0.09])
    sweep = curve([0.72, 5.1, RADIUS], [0.0, 0.0, -0.05])
    twist = np.radians(11.0) - np.radians(10.0) * radii / RADIUS
    rise = np.tan(CONING) * radii
    stations = [
        ([sweep(r), r, z], float(chord(r)), float(thick(r)), t) for r, z, t in zip(radii, rise, twist, strict=True)
    ]
    tip, main = split(wing(stations, [0, 0, 1.0], 11), lambda p: 4.98 - p[:, 1])
    return main, tip


def blur(
    radii: list[float],
    coning: float,
    sides: int = 72,
    axis: str = "z",
    height: float = 0.012,
    share: tuple[float, float] | None = None,
) -> Surface:
    """A ring between two ``radii`` that represents moving blades: a thin shell, visible from both sides.

    ``share``: the angles between which it is made, rad; all of it by default.
    """
    profile = [(r, r * np.tan(coning) + height / 2) for r in radii] + [
        (r, r * np.tan(coning) - height / 2) for r in radii[::-1]
    ]
    ring = np.array(profile + profile[:1])
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False) if share is None else np.linspace(*share, sides + 1)
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))], 1)
    rows = ring[:, None, :1] * around + ring[:, None, 1:] * np.array([0, 0, 1.0])
    rows = np.roll(rows, {"z": 0, "y": 2}[axis], axis=2)
    surface = lattice(rows, wrap=share is None, caps=False, crease=30)
    a, b, c = (surface.points[surface.faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->", a, np.cross(b, c)) < 0
    return Surface(surface.points, -surface.normals, surface.faces[:, ::-1]) if inward else surface


def tail_rotor() -> dict[str, Surface]:
    """Two blades along Z on a teetering hub, turning about Y; their pitch drives the tail along -Y."""
    radii = np.concatenate([[0.14, 0.22, 0.28], np.linspace(0.4, 0.78, 4), [0.86, 0.90, TAIL_RADIUS]])
    chord = curve([0.14, 0.22, 0.28, 0.9, TAIL_RADIUS], [0.08, 0.12, TAIL_CHORD, TAIL_CHORD, 0.13])
    stations = [([0, 0, r], float(chord(r)), 0.12, np.radians(-9.0)) for r in radii]
    tip, rest = split(wing(stations, [0, 1.0, 0], 9), lambda p: 0.80 - p[:, 2])
    band, root = split(rest, lambda p: 0.66 - p[:, 2])
    half = np.diag([-1.0, 1.0, -1.0])
    double = {name: join(s, s.turned(half)) for name, s in (("tip", tip), ("white", band), ("blade", root))}
    hub = revolve([(0.0, -0.09), (0.045, -0.085), (0.06, -0.03), (0.06, 0.04), (0.035, 0.075), (0.0, 0.085)], 16, "y")
    yoke = box([0.085, 0.045, 0.36], bevel=0.012)
    return by_material(
        double,
        {"steel": join(hub, yoke)},
        {"blur": blur([0.25, 0.80], 0.0, 40, "y"), "blur_tip": blur([0.80, TAIL_RADIUS], 0.0, 40, "y")},
    )


def rotor_hulls(look: dict[str, Surface]) -> dict[str, Surface]:
    """Hulls of the main rotor at every angle: the disc of its blades, coned by 0 to 5.53 degrees, as without load and
    at 1.77 g, the most that it gives, and the shaft with its links below it."""
    everything = join(*look.values())
    low = everything.faces[(everything.points[everything.faces][:, :, 2] < -0.1).any(1)]
    turns = [about_z(turn) for turn in np.linspace(0, 2 * np.pi, 24, endpoint=False)]
    shaft = np.concatenate([everything.points[np.unique(low)] @ turn.T for turn in turns])
    base, top, tip = -0.02, 0.535, RADIUS + 0.012
    disc = [(0.75, -0.1), (tip, base), (tip, top), (0.2, top)]
    return {"disc": _swept(disc, 32, "z"), "shaft": outer_hull(shaft * [1.01, 1.01, 1.0], 25.0)}


def tail_disc() -> Surface:
    """The swept disc of the tail rotor."""
    r = TAIL_RADIUS + 0.01
    return _swept([(r, -0.09), (r, 0.09)], 24, "y")


def _swept(profile: list[tuple[float, float]], sides: int, axis: str) -> Surface:
    """The hull around a convex ``profile`` of (radius, height) turned about ``axis``; its sides touch from outside."""
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], 1) / np.cos(np.pi / sides)
    points = np.concatenate([np.column_stack([r * ring, np.full(sides, z)]) for r, z in profile])
    return convex(np.roll(points, {"z": 0, "y": 2}[axis], axis=1), crease=180.0)
