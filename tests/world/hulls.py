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
