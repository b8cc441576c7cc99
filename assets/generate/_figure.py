"""A smooth figure in sportswear, as parts about their joints: the snakeboard's rider, drivers and pilots.

Every function returns surfaces in its part's frame: the joint is the origin, Z up at rest, Y ahead of the figure, X to
its right. This module holds shapes; each vehicle's script assembles them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

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
    painted,
    revolve,
    split,
    superellipse,
    tube,
)


def ball(radius: float, at: ArrayLike = (0, 0, 0), squash: ArrayLike = (1, 1, 1), sides: int = 28) -> Surface:
    """An ellipsoid with half axes ``radius * squash``."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    profile = np.stack([np.maximum(np.cos(turn), 0.0), np.sin(turn)], 1)
    sphere = revolve(profile, sides, crease=80)
    scale = radius * np.asarray(squash, float)
    normals = sphere.normals / scale
    return Surface(
        sphere.points * scale + np.asarray(at, float), normals / np.linalg.norm(normals, axis=1)[:, None], sphere.faces
    )


def loft(rows: ArrayLike, power: float = 2.3, around: int = 28, spacing: float = 0.03) -> Surface:
    """A closed skin through rows (z, half width X, half depth Y, y of the middle), in sections ``spacing`` apart."""
    rows = np.asarray(rows, float)
    between = np.arange(rows[0, 0] + spacing, rows[-1, 0], spacing)
    between = between[np.abs(between[:, None] - rows[:, 0]).min(1) > 0.4 * spacing]
    profiles = [curve(rows[:, 0], rows[:, k]) for k in (1, 2, 3)]
    sections = []
    for z in np.sort(np.concatenate([rows[:, 0], between])):
        w, d, y = (float(profile(z)) for profile in profiles)
        outline = superellipse(w, d, power, around)
        sections.append(np.column_stack([outline[:, 0], outline[:, 1] + y, np.full(around, z)]))
    return lattice(sections, crease=60)


def limb(path: ArrayLike, radii: ArrayLike, samples: int = 10, sides: int = 18) -> Surface:
    """A rounded tube through ``path``; its ends are domes."""
    path, radii = np.asarray(path, float), np.asarray(radii, float)
    ends = []
    for tip, inner, radius in ((path[0], path[1], radii[0]), (path[-1], path[-2], radii[-1])):
        out = (tip - inner) / np.linalg.norm(tip - inner)
        ends.append([(tip + out * radius * h, radius * r) for h, r in ((0.5, 0.86), (0.86, 0.5), (0.98, 0.2))])
    spine = [*ends[0][::-1], *zip(path, radii, strict=True), *ends[1]]
    return tube(np.array([p for p, _ in spine]), np.array([r for _, r in spine]), sides, samples + 8, crease=80)


def boot() -> dict[str, Surface]:
    """A boot, the same left and right, below the ankle, which is the origin: sole 0.107 m lower, upper, and two
    straps."""
    sole = loft(
        [
            (-0.107, 0.040, 0.122, 0.035),
            (-0.101, 0.047, 0.136, 0.036),
            (-0.082, 0.047, 0.137, 0.036),
            (-0.078, 0.043, 0.130, 0.036),
        ],
        2.8,
    )
    upper = loft(
        [
            (-0.085, 0.042, 0.128, 0.036),
            (-0.060, 0.045, 0.124, 0.032),
            (-0.035, 0.046, 0.104, 0.018),
            (-0.012, 0.046, 0.074, -0.004),
            (0.010, 0.044, 0.056, -0.012),
            (0.022, 0.036, 0.046, -0.012),
        ]
    )
    rand: Field = lambda p: p[:, 2] + 0.064
    straps = [
        box([0.098, 0.036, 0.018], bevel=0.008, steps=2).turned(_pitch(angle)).moved(at)
        for angle, at in ((-0.62, (0, 0.092, -0.026)), (-0.80, (0, 0.050, 0.008)))
    ]
    return by_material(painted(upper, [("trim", rand)], "boot"), {"sole": sole, "strap": join(*straps)})


def _pitch(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def shin(length: float) -> dict[str, Surface]:
    """From the ankle up to the knee, calf behind: the boot's cuff, which leans with it, and a knee pad."""
    calf = limb(
        [[0, -0.006, 0.06], [0, -0.012, 0.13], [0, -0.018, 0.25], [0, 0.0, length - 0.04], [0, 0.004, length]],
        [0.050, 0.054, 0.064, 0.058, 0.060],
    )
    cuff = loft(
        [
            (-0.022, 0.034, 0.040, -0.010),
            (-0.010, 0.045, 0.054, -0.010),
            (0.03, 0.049, 0.058, -0.008),
            (0.095, 0.055, 0.062, -0.010),
            (0.108, 0.050, 0.056, -0.010),
        ]
    )
    band: Field = lambda p: np.abs(p[:, 2] - 0.052) - 0.010
    top: Field = lambda p: 0.094 - p[:, 2]
    pad = ball(0.055, [0, 0.034, length + 0.010], [0.95, 0.62, 1.2])
    return by_material({"trousers": calf}, painted(cuff, [("trim", top), ("accent", band)], "boot"), {"pad": pad})


def thigh(length: float) -> dict[str, Surface]:
    """From the knee up to the hip joint."""
    return {
        "trousers": limb(
            [[0, 0.0, 0.0], [0, 0.006, 0.10], [0, 0.004, 0.26], [0, 0.0, length - 0.02]],
            [0.063, 0.072, 0.086, 0.090],
        )
    }


def pelvis(spread: float) -> dict[str, Surface]:
    """Hips and seat, about the middle between the hip joints."""
    seat = loft(
        [
            (-0.105, 0.060, 0.060, -0.010),
            (-0.085, 0.130, 0.098, -0.012),
            (-0.03, spread + 0.088, 0.122, -0.016),
            (0.04, spread + 0.078, 0.116, -0.012),
            (0.11, spread + 0.050, 0.090, 0.004),
            (0.15, spread + 0.028, 0.076, 0.012),
        ],
        2.5,
    )
    return painted(seat, [("belt", lambda p: np.abs(p[:, 2] - 0.098) - 0.016)], "trousers")


def torso() -> dict[str, Surface]:
    """Trunk and arms, held out for balance."""
    return by_material(trunk(), arm(), {n: _other_side(s) for n, s in arm().items()})


def trunk() -> dict[str, Surface]:
    """The trunk in a jacket, held a little forward, with a stripe across chest and back."""
    rows = [
        (0.085, 0.120, 0.088, 0.004),
        (0.095, 0.146, 0.110, 0.006),
        (0.16, 0.148, 0.110, 0.016),
        (0.27, 0.165, 0.116, 0.034),
        (0.38, 0.184, 0.118, 0.052),
        (0.46, 0.180, 0.106, 0.062),
        (0.505, 0.130, 0.082, 0.066),
        (0.53, 0.075, 0.066, 0.070),
        (0.56, 0.064, 0.064, 0.074),
        (0.575, 0.060, 0.060, 0.076),
    ]
    skin = loft(rows, 2.5, 56, 0.018)
    slant: Field = lambda p: np.abs(p[:, 2] - 0.315 - 0.45 * p[:, 0]) - 0.034
    thin: Field = lambda p: np.abs(p[:, 2] - 0.245 - 0.45 * p[:, 0]) - 0.014
    zip_: Field = lambda p: np.maximum(np.abs(p[:, 0]) - 0.004, -p[:, 1])
    hem: Field = lambda p: p[:, 2] - 0.118
    collar: Field = lambda p: 0.538 - p[:, 2]
    return painted(
        skin, [("trim", hem), ("trim", collar), ("trim", zip_), ("accent", slant), ("accent", thin)], "jacket"
    )


def arm() -> dict[str, Surface]:
    """The arm on the figure's right, held out and bent for balance, with an accent on the sleeve and a glove."""
    upper = limb([[0.165, 0.055, 0.455], [0.25, 0.045, 0.40], [0.355, 0.045, 0.30]], [0.070, 0.062, 0.050])
    lower = limb([[0.355, 0.045, 0.30], [0.41, 0.11, 0.255], [0.455, 0.20, 0.235]], [0.051, 0.047, 0.037])
    sleeve: Field = lambda p: np.abs(p[:, 0] - 0.292 - 0.5 * (p[:, 2] - 0.36)) - 0.018
    palm = limb([[0.462, 0.215, 0.234], [0.485, 0.265, 0.228], [0.488, 0.300, 0.222]], [0.038, 0.041, 0.030], 8)
    fingers = [
        limb([[x, 0.295, 0.228], [x + 0.004, 0.330, 0.216], [x, 0.352, 0.196]], [0.0125, 0.0115, 0.010], 1, 6)
        for x in (0.462, 0.481, 0.500, 0.517)
    ]
    thumb = limb([[0.458, 0.262, 0.240], [0.440, 0.290, 0.238], [0.432, 0.312, 0.232]], [0.015, 0.0125, 0.011], 1, 8)
    return by_material(
        painted(upper, [("accent", sleeve)], "jacket"), {"jacket": lower, "glove": join(palm, thumb, *fingers)}
    )


def _other_side(surface: Surface) -> Surface:
    """The reflection through the plane x = 0."""
    flip = np.array([-1.0, 1.0, 1.0])
    return Surface(surface.points * flip, surface.normals * flip, surface.faces[:, ::-1])


def face() -> Surface:
    """Neck, face, nose and ears, about the base of the neck."""
    neck = limb([[0, -0.012, -0.02], [0, 0.0, 0.05], [0, 0.012, 0.10]], [0.054, 0.052, 0.052], 8)
    front = loft(
        [
            (0.070, 0.020, 0.030, 0.042),
            (0.078, 0.040, 0.056, 0.036),
            (0.10, 0.058, 0.078, 0.026),
            (0.14, 0.070, 0.092, 0.016),
            (0.19, 0.076, 0.096, 0.012),
            (0.24, 0.070, 0.088, 0.010),
            (0.27, 0.040, 0.050, 0.008),
        ],
        2.2,
    )
    nose = ball(0.016, [0, 0.108, 0.145], [0.75, 1.0, 1.5], 16)
    ears = join(*(ball(0.022, [s * 0.073, 0.004, 0.155], [0.35, 0.8, 1.2], 16) for s in (-1, 1)))
    return join(neck, front, nose, ears)


def lens() -> Surface:
    """Goggles or dark glasses before the eyes."""
    return loft(
        [
            (0.150, 0.056, 0.030, 0.082),
            (0.156, 0.066, 0.036, 0.080),
            (0.188, 0.070, 0.038, 0.080),
            (0.196, 0.062, 0.032, 0.082),
        ],
        2.6,
    )


def head() -> dict[str, Surface]:
    """Neck, face, goggles and a helmet with vents, about the base of the neck; it looks along Y."""
    shell = ball(0.106, [0, 0.004, 0.205], [0.92, 1.14, 0.92], 40)
    brow: Field = lambda p: p[:, 2] - 0.188 - 0.20 * (p[:, 1] - 0.02)
    _, shell = split(shell, brow)
    turn = np.linspace(0, 2 * np.pi, 49)
    loop = np.stack(
        [0.0955 * np.cos(turn), 0.004 + 0.1175 * np.sin(turn), 0.188 + 0.20 * (0.1175 * np.sin(turn) - 0.016)], 1
    )
    band = tube(np.vstack([loop, loop[1:2]]), 0.008, 8)
    vents: list[Field] = [
        both(
            lambda p, x=x: np.abs(p[:, 0] - x) - 0.009,
            lambda p: np.abs(p[:, 1] - 0.01) - 0.062,
            lambda p: 0.25 - p[:, 2],
            blend=0.01,
        )
        for x in (-0.044, 0.0, 0.044)
    ]
    stripe: Field = lambda p: np.abs(np.abs(p[:, 0]) - 0.022) - 0.006
    strap = join(
        *(
            tube(
                [[s * 0.079, 0.0, 0.18], [s * 0.078, 0.02, 0.13], [s * 0.050, 0.055, 0.072], [0, 0.068, 0.062]],
                0.006,
                6,
                12,
            )
            for s in (-1, 1)
        )
    )
    return by_material(
        {"skin": face()},
        painted(shell, [("trim", vent) for vent in vents] + [("accent", stripe)], "helmet"),
        {"trim": join(band, strap), "goggles": lens()},
    )


def bare_head() -> dict[str, Surface]:
    """Neck, face, dark glasses and short hair, about the base of the neck; it looks along Y."""
    scalp = ball(0.104, [0, 0.0, 0.198], [0.86, 1.13, 0.92], 32)
    hairline: Field = lambda p: p[:, 2] - 0.165 - 0.75 * np.maximum(p[:, 1] - 0.005, -0.06)
    return {"skin": face(), "hair": split(scalp, hairline)[1], "goggles": lens()}


def seated(
    hands: ArrayLike,
    ankles: ArrayLike,
    lean: float,
    left_hand: ArrayLike | None = None,
    top: Mapping[str, Surface] | None = None,
) -> dict[str, Surface]:
    """The figure on a seat, about the middle between its hip joints; its trunk leans forward by ``lean`` rad.

    ``hands`` and ``ankles`` (3,): places of those on its right, m; the left ones mirror them, unless ``left_hand`` is
    given. ``top``: its head, about the base of the neck; default: `head`.
    """
    upright = _pitch(-lean)
    hip, ankle, hand = np.array([0.10, 0.0, 0.0]), np.asarray(ankles, float), np.asarray(hands, float)
    other = hand if left_hand is None else np.asarray(left_hand, float) * [-1.0, 1.0, 1.0]
    knee = _bend(hip, ankle, 0.42, 0.44, np.array([0.25, 0.6, 0.75]))
    leg = by_material(
        {"trousers": limb([hip, knee], [0.088, 0.064])},
        {"trousers": limb([knee, 0.45 * knee + 0.55 * ankle, ankle], [0.062, 0.058, 0.044])},
        {name: surface.moved(ankle) for name, surface in boot().items()},
    )
    crown = {name: surface.turned(upright.T).moved([0, 0.08, 0.555]) for name, surface in (top or head()).items()}
    return by_material(
        pelvis(0.09),
        {name: surface.turned(upright) for name, surface in by_material(trunk(), crown).items()},
        leg,
        _reaching(upright, hand),
        *({name: _other_side(surface) for name, surface in side.items()} for side in (leg, _reaching(upright, other))),
    )


def _reaching(upright: Array, hand: Array) -> dict[str, Surface]:
    """The arm on the right from its shoulder, turned by ``upright``, to the ``hand`` (3,)."""
    shoulder = upright @ np.array([0.165, 0.055, 0.455])
    elbow = _bend(shoulder, hand, 0.29, 0.28, np.array([0.7, 0.0, -0.7]))
    sleeve = join(limb([shoulder, elbow], [0.068, 0.050]), limb([elbow, hand], [0.051, 0.038]))
    return {"jacket": sleeve, "glove": ball(0.052, hand, [0.8, 1.1, 0.9], 20)}


def _bend(root: Array, tip: Array, upper: float, lower: float, direction: Array) -> Array:
    """The joint (3,) of a limb with two lengths from ``root`` to ``tip``, bent towards ``direction``; straight if the
    tip is too far."""
    along = tip - root
    reach = float(np.linalg.norm(along))
    along /= reach
    foot = min((reach**2 + upper**2 - lower**2) / (2 * reach), upper)
    aside = direction - (direction @ along) * along
    return root + foot * along + np.sqrt(max(upper**2 - foot**2, 0.0)) * aside / np.linalg.norm(aside)
