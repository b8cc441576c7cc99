"""Hulls with closed forms, and a body for them."""

import numpy as np

from vehsim.lie import SE3
from vehsim.vehicles.definition.holonomic import Holonomic
from vehsim.vehicles.definition.hydrodynamics import Hull


def box(length, width, height, at=(0.0, 0.0, 0.0)):
    """Corners and triangles of a box about ``at``."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return corners * [length, width, height] + np.asarray(at), np.array(faces)


def join(*hulls):
    points = np.concatenate([p for p, _ in hulls])
    offsets = np.cumsum([0, *(len(p) for p, _ in hulls)])
    return points, np.concatenate([f + o for (_, f), o in zip(hulls, offsets[:-1], strict=True)])


def sphere(radius, splits=4):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=splits, radius=radius)
    return np.array(ball.vertices), np.array(ball.faces)


def wigley(x, z):
    """Half-breadth over half the beam at ``x`` (-1 to 1, ahead) and ``z`` (-1 to 0, the draft): Wigley's parabolic
    hull."""
    return (1 - x**2) * (1 - z**2)


def tug(x, z):
    """The same of a full hull, finer at the bow than at the stern."""
    return (1 - np.abs(x) ** np.where(x > 0, 2.5, 5.0)) * (1 - z**4)


FORMS = {"wigley": wigley, "tug": tug}


def sections(form, size, many=(40, 10), even=True):
    """Starboard and port sides (2, n, m, 3) m of a hull below its waterline, whose length, beam and draft are ``size``;
    unless ``even``, with narrow panels at ends and keel."""
    length, beam, draft = size
    x, z = np.linspace(-1, 1, many[0] + 1), np.linspace(-1, 0, many[1] + 1)
    if not even:
        x, z = np.sin(np.pi / 2 * x), np.cos(np.pi / 2 * z) - 1
    x, z = np.meshgrid(x, z, indexing="ij")
    y = FORMS[form](x, z) * beam / 2
    return np.array([np.stack([x * length / 2, side * y, z * draft], axis=-1) for side in (-1, 1)])


def lofted(form, size, freeboard):
    """Points and triangles of such a hull, closed by vertical sides above the waterline and a deck."""
    sides = sections(form, size)
    sides = np.concatenate([sides, sides[:, :, -1:] + [0, 0, freeboard]], axis=2)
    n, m = sides.shape[1:3]
    at = np.arange(2 * n * m).reshape(2, n, m)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m - 1), indexing="ij")

    def quads(grid, turned):
        a, b, c, d = grid[i, j], grid[i + 1, j], grid[i + 1, j + 1], grid[i, j + 1]
        order = (a, d, c, b) if turned else (a, b, c, d)
        a, b, c, d = (corner.ravel() for corner in order)
        return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])

    deck = np.arange(n - 1)
    right, left = at[0, :, -1], at[1, :, -1]
    faces = np.concatenate(
        [
            quads(at[0], False),
            quads(at[1], True),
            np.column_stack([right[deck], right[deck + 1], left[deck + 1]]),
            np.column_stack([right[deck], left[deck + 1], left[deck]]),
        ]
    )
    points, same = np.unique(np.round(sides.reshape(-1, 3), 9) + 0.0, axis=0, return_inverse=True)
    faces = same.ravel()[faces]
    a, b, c = faces.T
    flat = (points[faces, 1] == 0).all(axis=1)  # of both sides, at the ends of the keel
    return points, faces[(a != b) & (b != c) & (c != a) & ~flat]


def floating(hull, mass, inertia=(1.0, 1.0, 1.0), **data):
    """A rigid body with such a hull about its centre of mass."""
    points, faces = hull
    return Holonomic(
        name="float",
        group=SE3,
        inertia=(*inertia, mass, mass, mass),
        mass=mass,
        hull=Hull(points=points, faces=faces, **data),
    )
