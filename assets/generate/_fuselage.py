"""The helicopter's cabin and tail boom: the skin, the outlines of glass and doors, and the visible interior.

This module holds lines and interior; coats, rotors, landing gear and hulls are in `helicopter.py`.
"""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._crew import driver, lining, seat
from vehsim.assets.generate._shapes import (
    Array,
    Field,
    Surface,
    both,
    box,
    by_material,
    curve,
    join,
    lattice,
    polygon,
    sheet,
    split,
    tube,
)
from vehsim.assets.generate._slim import slimmed

NOSE, TAIL = 3.50, -6.78


def superellipses(xs: Array, top, bottom, width, power, middle: float = 0.42, around: int = 56) -> Array:
    """Sections (m, around, 3): superellipses from ``bottom(x)`` to ``top(x)``, widest at ``middle`` of the height."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 400)
    sections = []
    for x in xs:
        w, low, high, n = width(x), bottom(x), top(x), power(x)
        waist = low + middle * (high - low)
        y = w * np.cos(turn).clip(0) ** (2 / n)
        z = waist + np.where(turn > 0, high - waist, waist - low) * np.sign(turn) * np.abs(np.sin(turn)) ** (2 / n)
        s = np.concatenate([[0], np.cumsum(np.hypot(np.diff(y), np.diff(z)))])
        even = np.linspace(0, s[-1], around // 2 + 1)
        y, z = np.interp(even, s, y), np.interp(even, s, z)
        y, z = np.concatenate([y, -y[-2:0:-1]]), np.concatenate([z, z[-2:0:-1]])
        sections.append(np.stack([np.full(len(y), x), y, z], 1))
    return np.array(sections)


def _from_nose(xs: list[float], values: list[float]):
    """A profile of x, smooth in sqrt(nose - x), so that the nose is round."""
    profile = curve([np.sqrt(NOSE - x) for x in xs], values)
    return lambda x: profile(np.sqrt(np.maximum(NOSE - x, 0.0)))


HULL_TOP = _from_nose(
    [3.5, 3.4, 3.2, 3.0, 2.6, 2.2, 1.8, 1.4, 1.0, 0.0, -1.0, -1.8, -2.6, -3.2, -5.0, -6.55, -6.72, TAIL],
    [1.10, 1.33, 1.51, 1.65, 1.87, 2.04, 2.15, 2.21, 2.235, 2.22, 2.16, 2.08, 1.99, 1.96, 1.94, 1.93, 1.90, 1.83],
)
HULL_BOTTOM = _from_nose(
    [3.5, 3.4, 3.2, 3.0, 2.6, 2.2, 1.4, 0.0, -0.6, -1.0, -1.4, -1.8, -2.4, -3.0, -5.0, -6.55, -6.72, TAIL],
    [1.10, 0.92, 0.80, 0.735, 0.665, 0.635, 0.62, 0.62, 0.66, 0.75, 0.91, 1.10, 1.33, 1.46, 1.60, 1.69, 1.72, 1.79],
)
HULL_WIDTH = _from_nose(
    [3.5, 3.4, 3.2, 3.0, 2.6, 2.2, 1.8, 1.4, 0.6, 0.0, -0.6, -1.0, -1.4, -1.8, -2.4, -3.0, -5.0, -6.55, -6.72, TAIL],
    [0, 0.29, 0.47, 0.6, 0.77, 0.87, 0.92, 0.935, 0.93, 0.9, 0.81, 0.72, 0.61, 0.5, 0.37, 0.28, 0.2, 0.13, 0.1, 0.02],
)
HULL_POWER = _from_nose([3.5, 2.8, 1.8, 0.0, -1.5, -3.0, -6.95], [2.1, 2.35, 2.75, 2.8, 2.5, 2.1, 2.0])


def bare_hull() -> Surface:
    """Cabin and tail boom in one skin."""
    xs = np.concatenate(
        [
            NOSE - np.linspace(0.0, np.sqrt(0.5), 10) ** 2,
            np.arange(2.93, -2.4, -0.125),
            np.linspace(-2.5, -6.5, 13),
            [-6.6, -6.68, -6.74, TAIL],
        ]
    )
    return lattice(superellipses(xs, HULL_TOP, HULL_BOTTOM, HULL_WIDTH, HULL_POWER))


def windows() -> list[Field]:
    """The panes: inside is glass."""

    foot, head = np.array([3.10, 1.20]), np.array([1.83, 2.16])  # of the windscreen pillar, in side view
    across = np.array([head[1] - foot[1], foot[0] - head[0]]) / np.linalg.norm(head - foot)
    windscreen = both(
        lambda p: (foot - p[:, [0, 2]]) @ across,
        lambda p: 1.20 + 0.02 * (3.4 - p[:, 0]) - p[:, 2],
        lambda p: 1.72 - p[:, 0],
        lambda p: 0.035 - np.abs(p[:, 1]),
        blend=0.09,
    )
    front = polygon([(2.86, 1.27), (1.36, 1.24), (1.36, 2.00), (1.93, 2.00)], 0.07)
    rear = polygon([(1.22, 1.24), (0.16, 1.26), (0.30, 1.98), (1.22, 2.00)], 0.09)
    chin = both(
        polygon([(3.30, 1.00), (2.68, 0.985), (2.60, 0.80), (2.95, 0.765), (3.22, 0.87)], 0.05),
        lambda p: 0.16 - np.abs(p[:, 1]),
        blend=0.05,
    )
    roof = both(
        polygon([(1.58, 0.14), (1.56, 0.56), (1.02, 0.60), (1.02, 0.14)], 0.07, axes=(0, 1)),
        lambda p: 2.0 - p[:, 2],
    )
    return [windscreen, front, rear, chin, roof, lambda p: roof(p * [1.0, -1.0, 1.0])]


def doors() -> list[Field]:
    """Outlines of the cabin and baggage doors, in side view."""
    return [
        polygon([(2.98, 1.14), (2.30, 0.80), (1.29, 0.78), (1.29, 2.07), (1.90, 2.07)], 0.06),
        polygon([(1.29, 0.78), (0.02, 0.80), (0.16, 2.06), (1.29, 2.07)], 0.05),
        polygon([(-0.18, 0.98), (-0.86, 1.10), (-0.86, 1.72), (-0.18, 1.72)], 0.06),
    ]


FLOOR, BULKHEAD = 0.80, -0.05
"""Height of the cabin's floor, and x of its rear end, m."""
HIPS = np.array([1.60, -0.42, 1.10])
"""The pilot's hips, in the seat on the right."""


def cabin() -> dict[str, Surface]:
    """The visible interior: lining, floor and bulkhead, two seats and a bench, instrument panel, stick and lever."""
    skin, _ = split(bare_hull(), lambda p: BULKHEAD - p[:, 0])
    for pane in windows():
        _, skin = split(skin, pane)
    walls = slimmed({"lining": lining(skin, 0.02)}, 0.004, shade=14.0)
    xs = np.linspace(BULKHEAD, 3.2, 9)
    floor = sheet([[[x, s * half_width(x, FLOOR), FLOOR] for s in (1, -1)] for x in xs], [0, 0, 1])
    zs = np.linspace(FLOOR, HULL_TOP(BULKHEAD) - 0.03, 7)
    bulkhead = sheet([[[BULKHEAD, s * half_width(BULKHEAD, z), z] for s in (1, -1)] for z in zs], [1, 0, 0])
    bench = [box([0.50, 1.36, 0.16], [0.42, 0, 1.0], 0.05, 2), box([0.14, 1.36, 0.62], [0.14, 0, 1.30], 0.05, 2)]
    panel = [box([0.22, 0.86, 0.30], [2.60, 0, 1.10], 0.05, 2), box([0.46, 0.20, 0.36], [2.38, 0, 0.97], 0.04, 2)]
    hood = box([0.40, 0.92, 0.04], [2.62, 0, 1.26], 0.018, 2)
    stick = tube([[1.98, HIPS[1], FLOOR], [2.06, HIPS[1], 1.02], [2.0, HIPS[1], 1.22]], 0.016, 8, 6)
    lever = tube([[1.50, -0.13, FLOOR + 0.08], [1.86, -0.13, 1.10]], 0.02, 8)
    return by_material(
        walls,
        {"lining": join(floor, bulkhead), "seat": join(seat(HIPS, 0.06).pair(), *bench)},
        {"dark": join(*panel, hood, stick, lever)},
    )


def below_hull(p: Array) -> Array:
    """Negative more than 0.1 m below the hull's top: excludes what would hang from the cabin's ceiling."""
    share = np.abs(p[:, 1] / HULL_WIDTH(p[:, 0])).clip(0, 1) ** HULL_POWER(p[:, 0])
    low, high = HULL_BOTTOM(p[:, 0]), HULL_TOP(p[:, 0])
    waist = low + 0.42 * (high - low)
    return p[:, 2] - waist - (high - waist) * (1 - share) ** (1 / HULL_POWER(p[:, 0])) + 0.03


def half_width(x: float, z: float) -> float:
    """Half width of the cabin's lining at height ``z`` (that of `superellipses`, moved slightly inwards)."""
    low, high = HULL_BOTTOM(x), HULL_TOP(x)
    waist = low + 0.42 * (high - low)
    up = (z - waist) / (high - waist if z > waist else waist - low)
    return float(HULL_WIDTH(x) * np.clip(1 - abs(up) ** HULL_POWER(x), 0, 1) ** (1 / HULL_POWER(x))) - 0.01


def pilot() -> dict[str, Surface]:
    """The pilot, right hand on the cyclic stick, left hand on the collective lever."""
    reach, ankles = [0.02, 0.40, 0.13], [0.13, 0.62, FLOOR + 0.107 - HIPS[2]]
    return driver(HIPS, reach, ankles, lean=0.02, left_hand=[-0.28, 0.26, 0.0], close=False)
