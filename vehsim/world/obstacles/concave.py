"""Concave bodies as several convex hulls, so that the space inside a harbour, a door or a hangar is free."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from vehsim.runtime.cache import kept_arrays

Array = NDArray[np.float64]

CONCAVE = 0.02
"""Bodies whose convex hull is larger by this share are divided."""
CONCAVITY = 0.02
"""CoACD's threshold: how far a hull may stand out from the body, as a share of the body's size."""


def convex_pieces(points: Array, faces: NDArray[np.int64], name: str) -> list[Array]:
    """Corners (k, 3) of convex hulls that together cover a body with ``points`` (n, 3) and ``faces`` (m, 3).

    A concave body is divided by CoACD (Wei et al. 2022), an optional dependency; its volume error is a warning, and so
    is the space that its convex hull would fill without CoACD. An open surface, whose inside is unknown, becomes its
    hull. Raises scipy's ``QhullError`` for a flat body.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    corners = points[faces] - points.mean(axis=0)
    volume = abs(float(np.einsum("ki,ki->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6))
    whole = [points[hull.vertices]]
    if hull.volume <= (1 + CONCAVE) * volume or not _closed(faces):
        return whole
    try:
        import coacd
    except ImportError:
        warnings.warn(
            f"obstacle {name!r}: concave: its convex hull also fills {hull.volume - volume:.3g} m^3 of free space;"
            ' pip install "vehsim[concave]" to divide it, or model it as several convex bodies',
            stacklevel=4,
        )
        return whole

    def divided() -> list[Array]:
        coacd.set_log_level("error")
        pieces = coacd.run_coacd(coacd.Mesh(points, faces), threshold=CONCAVITY, seed=0)
        return [np.asarray(piece, float) for piece, _ in pieces]

    pieces = kept_arrays("convex_pieces", [points, faces.astype(float), np.array([CONCAVITY])], divided)
    share = sum(ConvexHull(piece).volume for piece in pieces) / volume - 1
    warnings.warn(
        f"obstacle {name!r}: concave: divided into {len(pieces)} convex hulls; their volume differs by"
        f" {100 * share:+.1f} %",
        stacklevel=4,
    )
    return pieces


def _closed(faces: NDArray[np.int64]) -> bool:
    """Whether every edge has a neighbour that runs the other way."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    size = int(faces.max()) + 1
    return bool(np.isin(edges @ [size, 1], edges @ [1, size]).all())
