"""Parts that turn out of a vehicle as it moves, such as trailers and a rotor's disc; trailers also in plan view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.rig.linkage import screws
from vehsim.rig.rig import Drive, Rig
from vehsim.runtime.cache import Stamp, kept_arrays
from vehsim.world.obstacles.obstacles import asset_of, footprint, seen_from_above
from vehsim.world.obstacles.plane import distance

Array = NDArray[np.float64]

ASIDE = 0.2
"""Threshold, m per radian, of how far a part moves out of the footprint when it turns. Below it, the part counts in its
rest pose: a steered wheel (0.05). Above it, it is measured in its actual pose: arms of a rider (0.28), a trailer."""


@dataclass(frozen=True)
class ArticulatedPart:
    """A part that turns about vertical pivots as the vehicle moves, such as a trailer, seen from above.

    ``outline`` (k, 2) m at rest, convex, ``bottom`` and ``top`` m; ``pivots``: channel, factor and place (2,) m,
    parents before children. All in the rig root's frame. ``name``: that of the prim that the last of them turns.
    """

    outline: Array
    bottom: float
    top: float
    pivots: tuple[tuple[str, float, Array], ...]
    name: str = ""

    @property
    def reach(self) -> float:
        """Upper bound of the distance of any of its points from any of its pivots, m, in all poses of the others."""
        places = np.array([place for _, _, place in self.pivots])
        last = float(np.linalg.norm(self.outline - places[-1], axis=1).max())
        return last + float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())

    def meets(self, obstacle: Any, level: float) -> bool:
        """Whether an obstacle is as high above the root at a ``level`` m as the part."""
        return bool(obstacle.bottom < level + self.top and obstacle.top > level + self.bottom)

    def at(self, channels: Mapping[str, Array]) -> Array:
        """Outlines (n, k, 2) m in the root's frame for values (n,) of the channels, rad."""
        found = self.outline[None]
        for channel, factor, place in reversed(self.pivots):
            angle = factor * np.asarray(channels[channel], float)
            c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
            x, y = (found - place)[..., 0], (found - place)[..., 1]
            found = np.stack([c * x - s * y, s * x + c * y], axis=-1) + place
        return found


def articulated_footprint(vehicle: Any) -> tuple[ArticulatedPart, ...]:
    """The parts that a vehicle's channels turn about vertical axes by more than `ASIDE` out of its footprint; none
    without an asset."""
    if vehicle.rig is None:
        return ()
    drives = tuple(
        (drive.prim, channel, drive.factor, drive.pivot if isinstance(drive.pivot, tuple) else None)
        for channel, drive in vehicle.rig.drives.items()
        if drive.op == "rotateZ" and channel in vehicle.channels
    )
    return _read_articulated(*asset_of(vehicle), drives, footprint(vehicle).tobytes())


def fixed_footprint(vehicle: Any) -> Array:
    """A vehicle's hulls from above without its articulated parts, as one convex polygon (k, 2) m in the rig root's
    frame; `footprint` without such parts or other hulls."""
    from vehsim.rig.parts import solids

    turned = {vehicle.rig.drives[name].prim for part in articulated_footprint(vehicle) for name, _, _ in part.pivots}
    fixed = [
        hull
        for solid in (solids(vehicle.rig.asset, vehicle.rig.root or None) if turned else ())
        if not any(f"{solid.path}/".startswith(f"{prim}/") for prim in turned)
        for hull in solid.hulls
    ]
    return seen_from_above(np.vstack(fixed)) if fixed else footprint(vehicle)


def carriers_of(vehicle: Any) -> tuple[str, ...]:
    """Paths of the parts that turn by more than `ASIDE` out of a vehicle as it moves, such as trailers and a rotor's
    disc, parents before children."""
    found = {vehicle.rig.drives[channel].prim for channel in swings_of(vehicle)}
    return tuple(sorted(found, key=lambda path: path.count("/")))


def swung(vehicle: Any, channels: Mapping[str, Array]) -> dict[str, Array]:
    """Those of the ``channels`` that turn the `carriers_of` a vehicle. A spin is none: hulls contain it at rest."""
    return {name: channels[name] for name in swings_of(vehicle) if name in channels}


def swings_of(vehicle: Any) -> Mapping[str, float]:
    """The channels that turn the `carriers_of` a vehicle, and how far each moves any point of them, at most, m/rad."""
    if vehicle.rig is None:
        return MappingProxyType({})
    turning = {channel for part in articulated_footprint(vehicle) for channel, _, _ in part.pivots}
    drives = tuple(
        (channel, drive)
        for channel, drive in vehicle.rig.drives.items()
        if drive.op.startswith("rotate") and channel in vehicle.channels and vehicle.channels[channel].rate is None
    )
    return _read_swings(*asset_of(vehicle), drives, frozenset(turning)) if drives else MappingProxyType({})


@lru_cache(maxsize=32)
def _read_swings(
    asset: Path, root: str | None, written: Stamp, drives: tuple[tuple[str, Drive], ...], turning: frozenset[str]
) -> Mapping[str, float]:
    from vehsim.rig.parts import solids

    rig = Rig(asset, root or "", drives=dict(drives))
    parts = {solid.path: np.vstack(solid.hulls) for solid in solids(asset, root) if solid.hulls}
    corners = np.vstack(list(parts.values()))
    [whole] = kept_arrays("swings", [corners], lambda: [_facets(corners)])
    reach: dict[str, float] = {}
    prims = {drive.prim for channel, drive in drives if channel in turning}
    for path, points in parts.items():
        chain = screws(rig, path)
        for k, screw in enumerate(chain):
            places = [each.pivot for each in chain[k:]]
            last = float(np.linalg.norm(points - places[-1], axis=1).max())
            along = last + sum(float(np.linalg.norm(b - a)) for a, b in pairwise(places))
            reach[screw.channel] = max(reach.get(screw.channel, 0.0), along * float(np.linalg.norm(screw.axis)))
            if rig.drives[screw.channel].op != "rotateZ":  # what turns about the vertical is judged in plan view
                turns, shifts = screw.at(np.array([-1.0, 1.0]))
                moved = points @ turns.transpose(0, 2, 1) + shifts[:, None]
                if (moved @ whole[:, :3].T + whole[:, 3]).max() > ASIDE:
                    prims.add(screw.prim)
    return MappingProxyType({name: reach[name] for name, drive in drives if drive.prim in prims and name in reach})


def _facets(points: Array) -> Array:
    """Outward normals and offsets (m, 4) of the facets of a convex hull of points (n, 3) m."""
    from scipy.spatial import ConvexHull

    return np.asarray(ConvexHull(points).equations)


@lru_cache(maxsize=32)
def _read_articulated(
    asset: Path, root: str | None, written: Stamp, drives: Any, outline: bytes
) -> tuple[ArticulatedPart, ...]:
    from vehsim.rig.parts import solids

    whole = np.frombuffer(outline).reshape(-1, 2)
    parts = {solid.path: solid for solid in solids(asset, root)} if drives else {}
    groups: dict[Any, list[Array]] = {}
    for part in parts.values():
        chain = [
            (channel, factor * parts[prim].T_rp[2, 2], tuple((pivot or parts[prim].T_rp[:3, 3])[:2]))
            for prim, channel, factor, pivot in sorted(drives)
            if prim in parts and (part.path + "/").startswith(prim + "/") and abs(parts[prim].T_rp[2, 2]) > 0.999
        ]
        if chain and part.hulls:
            groups.setdefault(tuple(chain), []).append(np.vstack(part.hulls))
    made, names = [], {channel: prim.rpartition("/")[2] for prim, channel, _, _ in drives}
    for chain, bodies in groups.items():
        points = np.vstack(bodies)
        pivots = tuple((name, float(factor), np.array(place)) for name, factor, place in chain)
        heights, name = (float(points[:, 2].min()), float(points[:, 2].max())), names[chain[-1][0]]
        moved = ArticulatedPart(seen_from_above(points), *heights, pivots, name)
        turned = moved.at({name: np.array([-1.0, 1.0]) for name, _, _ in pivots}).reshape(-1, 1, 2)
        if distance(turned, whole).max() > ASIDE:
            made.append(moved)
    return tuple(made)
