"""The light of lamps in the dark: beams and glows of a stage's vehicles on what they reach, and halos around the lamps.

A lamp is a glowing part of a vehicle. White lamps that face one way have a dipped beam, as headlamps do; all of them
glow. MuJoCo lights the corners of faces only, and would show no beam on wide ground, so pixels are lit one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery.shading import Light
from vehsim.exporters.usd.stage import Shape, StageReader

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
DepthFrom = Callable[[Array, Array, Array], Floats]
"""The depth (h, w) m of the solid things seen from an eye (3,) along a forward (3,) with an up (3,), over `VIEW`."""
PartOf = Callable[[Array], tuple[slice, slice] | None]
"""The rows and columns of a picture that a box with corners (8, 3) m may cover; None if it is not seen."""
Sight = tuple[tuple[Array, Array, Array], tuple[float, float], tuple[float, float], tuple[float, float]]
"""A camera's eye, forward and up (3,); half its view at distance 1, its shift, and (near, far) m."""

DARK = 0.35
"""Light on level ground, linear and in the units of USD, below which lamps are lit."""
GLOWING = 0.1
"""Emission from which a part of a vehicle is a lamp."""
APART, CELLS = 0.3, 60
"""Distance between two lamps of one material, m, and most cells along a glowing part when they are told apart."""
WHITE, DIRECTED = 0.8, 0.5
"""A lamp has a beam if its least primary is more than this share of its greatest, and the mean of its unit normals is
longer than this."""
WARM = (1.0, 0.93, 0.80)
"""Linear colour of white lamps."""
BEAM, GLOW = 1.0, 4.0
"""Strength of a beam, and of a glow per emission and area in 1/m^2: our choice, as is the moon that they are seen
with."""
WIDTH, DIP, CUT_OFF = 0.45, 0.05, 0.016
"""Of a dipped beam, as tangents: its half width, the angle below its axis at which it has half its strength, and the
width of its upper edge."""
SPILL = 0.0002
"""Share of a beam's strength that goes to all places ahead."""
REACH = 70.0
"""Distance up to which lamps light anything, m."""
NEAREST, FAINT = 0.15, 0.004
"""Distance to a lamp from which it gets no brighter, m, and light, in the units of USD, that is not seen."""
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
BRIGHTEST = 1.6
"""Light of lamps, in linear display values of white, that is not exceeded: faces close to a lamp keep their colour."""
SPOT, HALO, GLARE = 0.045, 0.16, 0.004
"""Radii of the bright spot at a lamp and of the halo around it, m, and what a camera's lens adds to both, rad."""
VIEW, PIXELS, CLEAR = (1.2, 0.3), (768, 192), 0.8
"""Half the width and height of the picture from a beam at distance 1, its size in pixels, and its near plane, m: the
lamp's own lens throws no shadow."""
DAZZLE = 18.0
"""Brightness of a halo per strength of a glow."""
SEEN = 0.4
"""A lamp is seen where nothing is nearer than this in front of it, m."""
NEARER = 0.06
"""Share of its distance by which something must be nearer to a lamp to throw a shadow there."""


@dataclass(frozen=True)
class Lamp:
    """Glowing parts of one material, in the frame of their ``group``: the middles ``spots`` (k, 3) m of those that are
    apart, ``ahead`` (3,) along their beam, linear ``colour`` (3,).

    ``glow`` and ``beam``: strengths; ``directed``: length of the mean of their unit normals.
    """

    group: str
    spots: Array
    ahead: Array
    colour: Array
    glow: float
    beam: float
    directed: float

    @classmethod
    def of(cls, shape: Shape, R_wg: Array) -> Lamp:
        """The lamp of a glowing shape whose frame is turned by ``R_wg`` (3, 3) on a level vehicle."""
        a, b, c = shape.points[shape.faces].swapaxes(0, 1)
        areas, middles = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2, (a + b + c) / 3
        mean = areas @ shape.normals[shape.face_normals].mean(axis=1) / areas.sum()
        level = R_wg @ mean * (1.0, 1.0, 0.0)
        ahead = R_wg.T @ level / max(float(np.linalg.norm(level)), 1e-9)
        spots = np.array([np.average(middles[one], axis=0, weights=areas[one]) for one in _apart(middles)])
        colour = np.array(shape.surface.colour) / max(*shape.surface.colour, 1e-9)
        white, directed = bool(colour.min() > WHITE), float(np.linalg.norm(mean))
        glow = GLOW * shape.surface.emission * float(areas.sum()) / len(spots)
        beam = BEAM if white and directed > DIRECTED else 0.0
        return cls(shape.group, spots, ahead, colour * (WARM if white else 1.0), glow, beam, directed)


def _apart(places: Array) -> list[NDArray[np.bool_]]:
    """Which of ``places`` (n, 3) m belong to each of the lamps that are `APART`."""
    from scipy.cluster.hierarchy import fclusterdata

    cell = max(APART / 3, float(np.ptp(places, axis=0).max()) / CELLS)
    cells, of_place = np.unique((places / cell).round(), axis=0, return_inverse=True)
    if len(cells) == 1:
        return [np.ones(len(places), bool)]
    lamp = fclusterdata(cells * cell, max(APART, 2 * cell), criterion="distance", method="single")[of_place.ravel()]
    return [lamp == each for each in np.unique(lamp)]


def lamps_of(stage: StageReader, light: Light) -> list[Lamp]:
    """The lamps of a stage's vehicles that are lit in its ``light``."""
    if light.level > DARK:
        return []
    poses = stage.matrices(stage.frames[0])
    glowing = [shape for shape in stage.shapes if shape.group and shape.surface.emission >= GLOWING]
    return [Lamp.of(shape, poses[shape.group][:3, :3]) for shape in glowing]


def lit(
    picture: NDArray[np.uint8],
    places: Array,
    lamps: list[Lamp],
    poses: Mapping[str, Array],
    light: Light,
    part_of: PartOf,
    depth_from: DepthFrom,
) -> NDArray[np.uint8]:
    """A picture (h, w, 3) of ``places`` (h, w, 3) m in the light of ``lamps``, whose groups have ``poses``; the pixels
    of the background are far away."""
    places = places.astype(np.float32)
    normals = np.cross(np.gradient(places, axis=1), np.gradient(places, axis=0))
    normals /= np.maximum(_length(normals), 1e-12)[..., None]
    added = np.zeros_like(places)
    for lamp in lamps:
        T_wg = poses[lamp.group]
        spots, ahead, up = lamp.spots @ T_wg[:3, :3].T + T_wg[:3, 3], T_wg[:3, :3] @ lamp.ahead, T_wg[:3, 2]
        shines = [(spot, lamp.glow, np.sqrt(lamp.glow / FAINT), _glow(ahead, lamp.directed)) for spot in spots]
        if lamp.beam:
            shines.append((spots.mean(axis=0), lamp.beam, REACH, _beam(spots.mean(axis=0), ahead, up, depth_from)))
        for spot, strength, reach, share in shines:
            part = part_of(spot + reach * CORNERS)
            if part is None:
                continue
            away = places[part] - spot.astype(np.float32)
            distance = _length(away)
            near = distance < reach
            away, distance = away[near], np.maximum(distance[near], NEAREST)
            facing = np.maximum(-np.einsum("ij,ij->i", away, normals[part][near]) / distance, 0)
            light_there = strength * share(away) * facing / distance**2
            added[part][near] += light_there[:, None] * lamp.colour.astype(np.float32)
    shine = np.flatnonzero(added.max(axis=2) > FAINT)
    before, added = _lighting(normals.reshape(-1, 3)[shine], light), added.reshape(-1, 3)[shine] * light.exposure
    added *= BRIGHTEST / (BRIGHTEST + added)
    changed = picture.copy()
    bright = changed.reshape(-1, 3)[shine] * np.sqrt(1 + added / before)
    changed.reshape(-1, 3)[shine] = np.clip(bright + 0.5, 0, 255)
    return changed


def _length(vectors: Floats) -> Floats:
    """Lengths (...) of vectors (..., 3)."""
    return np.asarray(np.sqrt(np.einsum("...i,...i", vectors, vectors)))


def _glow(ahead: Array, directed: float) -> Callable[[Floats], Floats]:
    """The share of a glow that goes to places (n, 3) m from the lamp: ``directed`` of it shines ``ahead`` (3,)."""
    return lambda away: 1 - directed + directed * np.maximum(away @ ahead.astype(np.float32) / _length(away), 0)


def _beam(eye: Array, ahead: Array, up: Array, depth_from: DepthFrom) -> Callable[[Floats], Floats]:
    """The strength of a dipped beam at places (n, 3) m from a lamp at ``eye`` (3,) m, with shadows."""
    axes = np.column_stack([ahead, np.cross(ahead, up), up]).astype(np.float32)
    seen = depth_from(eye, ahead, up).astype(np.float32)

    def share(away: Floats) -> Floats:
        depth, *aside = (away @ axes).T
        before = depth > 1e-3
        across, rise = (np.where(before, each / np.where(before, depth, 1), 9.0) for each in aside)
        edge = np.clip(0.5 - rise / CUT_OFF, 0, 1)
        strength = np.exp(-((across / WIDTH) ** 2)) / (rise**2 + DIP**2) * edge + SPILL / DIP**2
        column, row = (
            np.floor((each / half + 1) / 2 * size).astype(int)
            for each, half, size in zip((across, rise), VIEW, PIXELS, strict=True)
        )
        inside = (depth > CLEAR) & (row >= 0) & (row < len(seen)) & (column >= 0) & (column < seen.shape[1])
        nearest = seen[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.asarray(strength * before * (~inside | (nearest > (1 - NEARER) * depth)))

    return share


def haloed(
    picture: NDArray[np.uint8], distance: Array, lamps: list[Lamp], poses: Mapping[str, Array], sight: Sight
) -> NDArray[np.uint8]:
    """A picture (h, w, 3) with halos around the lamps that are seen; ``distance`` (h, w) m along the view."""
    (eye, forward, up), half, shift, _ = sight
    height, width = distance.shape
    focal = width / 2 / half[0]  # pixels at distance 1
    shown = picture.astype(np.float32)
    for lamp in lamps:
        T_wg = poses[lamp.group]
        for away in lamp.spots @ T_wg[:3, :3].T + T_wg[:3, 3] - eye:
            depth = float(away @ forward)
            if depth < CLEAR:
                continue
            column = ((away @ np.cross(forward, up) / depth - shift[0]) / half[0] + 1) / 2 * width
            row = ((away @ up / depth - shift[1]) / half[1] + 1) / 2 * height
            spot, halo = (focal * (radius / depth + GLARE) for radius in (SPOT, HALO))
            around, close = (_window(row, column, radius, distance.shape) for radius in (6 * halo, 2.5))
            visible = (distance[close] > depth - SEEN).mean() if distance[close].size else 0.0
            towards = max(-float(away @ T_wg[:3, :3] @ lamp.ahead) / float(np.linalg.norm(away)), 0.0)
            power = DAZZLE * lamp.glow * (1 - lamp.directed * (1 - towards)) + lamp.beam * towards**6
            rows, columns = np.mgrid[around]
            radius = np.hypot(rows + 0.5 - row, columns + 0.5 - column)
            bright = np.exp(-((radius / spot) ** 2)) + 0.3 * np.exp(-radius / halo)
            share = np.clip(min(power, 1.0) * visible * bright[..., None] * np.sqrt(lamp.colour), 0, 1)
            shown[around] += (255 - shown[around]) * share
    return np.asarray(shown.round(), np.uint8)


def _window(row: float, column: float, radius: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The rows and columns of a picture of ``shape`` within ``radius`` of a place."""
    ends = [
        (max(int(at - radius), 0), min(int(at + radius) + 1, size))
        for at, size in zip((row, column), shape, strict=True)
    ]
    low, left = (slice(first, max(first, last)) for first, last in ends)
    return low, left


def _lighting(normals: Floats, light: Light) -> Floats:
    """The linear display value (n, 3) of white with ``normals`` (n, 3) in the stage's own light, without shadows."""
    ambient, sky, bounce, sun, direction = (
        each.astype(np.float32) for each in (light.ambient, light.sky, light.bounce, light.sun, light.direction)
    )
    up = normals[:, 2:]
    shown = ambient + sky * np.maximum(up, 0) - bounce * np.minimum(up, 0)
    shown -= np.minimum(normals @ direction, 0)[:, None] * sun
    return np.asarray(shown**2)
