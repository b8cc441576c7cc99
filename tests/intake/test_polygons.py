"""The polygons of USD's cubes, spheres, cylinders, cones and capsules fill the bounds and volumes of the shapes."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from vehsim.errors import InputError
from vehsim.intake.polygons import has_polygons, polygons
from vehsim.intake.usd import triangles_of

SHAPES = {
    "Cube": ({"size": 3.0}, 27.0),
    "Sphere": ({"radius": 2.0}, 4 / 3 * np.pi * 8),
    "Cylinder": ({"radius": 2.0, "height": 3.0}, np.pi * 4 * 3),
    "Cylinder_1": ({"radiusBottom": 2.0, "radiusTop": 1.0, "height": 3.0}, np.pi * 3 * (4 + 2 + 1) / 3),
    "Cone": ({"radius": 2.0, "height": 3.0}, np.pi * 4),
    "Capsule": ({"radius": 2.0, "height": 3.0}, np.pi * 4 * 3 + 4 / 3 * np.pi * 8),
}

STAGES: list[Usd.Stage] = []


def shape(kind, **sizes):
    stage = Usd.Stage.CreateInMemory()
    STAGES.append(stage)  # a prim does not keep its stage open
    prim = stage.DefinePrim("/shape", kind)
    for name, value in sizes.items():
        prim.GetAttribute(name).Set(value)
    return prim


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
@pytest.mark.parametrize("kind", SHAPES)
def test_a_shape_fills_its_volume_and_bounds_and_faces_outwards(kind, axis):
    sizes, volume = SHAPES[kind]
    round_ = kind not in ("Cube", "Sphere")
    prim = shape(kind, **sizes, **({"axis": axis} if round_ else {}))
    assert has_polygons(prim)
    now = Usd.TimeCode.Default()
    points, faces = triangles_of(prim, now, "shape.usda")
    corners = points[faces]
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(volume, rel=1e-9 if kind == "Cube" else 8e-3)
    bounds = np.array(UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), now))
    assert np.abs([points.min(axis=0), points.max(axis=0)] - bounds).max() < 1e-6
    found = polygons(prim, now, "shape.usda")
    assert np.linalg.norm(found.normals, axis=1) == pytest.approx(1.0)
    starts = np.cumsum(found.counts) - found.counts
    a, b, c = (found.points[found.indices[starts + k]] for k in range(3))
    own = found.normals[starts] + found.normals[starts + 1] + found.normals[starts + 2]
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), own) > 0).all(), "normals point as the faces do"
    if kind == "Cone":
        tip = points[:, "XYZ".index(axis)].argmax()
        assert np.delete(points[tip], "XYZ".index(axis)) == pytest.approx([0.0, 0.0], abs=1e-12)


def test_a_shape_without_size_is_empty_and_one_of_no_length_is_refused():
    now = Usd.TimeCode.Default()
    assert polygons(shape("Sphere", radius=0.0), now, "shape.usda") is None
    for size in (-1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="/shape") as refused:
            polygons(shape("Cube", size=size), now, "shape.usda")
        assert "not a size" in str(refused.value)
