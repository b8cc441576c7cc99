"""A vehicle's USD asset read as a list of parts, and as convex hulls in a MuJoCo spec.

What belongs here is reading: any asset, ours or a stranger's, becomes rigid parts with geometry in metres, Z up.
Writing USD belongs to the exporters, drawing to their `stage.py`, and what the hulls are asked belongs to `world`.

The rig root's frame is the space *above* the root prim: transforms authored on the root prim itself, and the change
of units and up axis, are part of the geometry, so an animated pose multiplies everything from the left.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim._cache import kept_arrays, made_of
from vehsim.errors import InputError
from vehsim.vehicles._base import Rig

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

Y_UP_TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
QUERY_GROUP = 3
"""MuJoCo geom group of the hulls: not drawn by default."""


@dataclass(frozen=True)
class Part:
    """A rigid part: an Xform prim with meshes below it, its geometry baked into a rigid frame at its pivot.

    ``path`` is the prim's path below the rig root ("" for the root itself), ``parent`` its parent part's (None for
    the root's). ``T_pr`` (4, 4) maps the part's frame to its parent part's at rest, ``T_rp`` to the rig root's.
    ``points`` (n, 3) m and ``faces`` (m, 3), counter-clockwise from outside, are the look, both empty for a part that
    only carries others; ``collision`` are the points (k, 3) of its collision meshes. ``rgba`` (4,) is the linear colour
    of its largest mesh.
    """

    name: str
    path: str
    parent: str | None
    T_pr: Array
    T_rp: Array
    points: Array
    faces: Faces
    collision: tuple[Array, ...]
    rgba: tuple[float, float, float, float]

    @property
    def collides(self) -> bool:
        """It has collision meshes."""
        return bool(self.collision)

    @cached_property
    def hulls(self) -> tuple[Array, ...]:
        """The vertices (k, 3) m of its collision meshes' convex hulls."""
        return tuple(_hulls(self.collision)) if self.collision else ()


def read_parts(asset: str | Path, root: str | None = None) -> list[Part]:
    """The parts of ``asset`` below ``root`` (a prim path; the default prim when empty), parents before children.

    Raises ``InputError`` naming file and prim when the file or the root is missing, there is no mesh, a mesh is
    broken, or a transform cannot be inverted. Warns of geometry that is not a mesh and so is left out.
    """
    stage, prim = _open(asset, root)  # a prim lives only as long as its stage is held
    drafts: dict[str, _Draft] = {}
    owner: dict[Any, _Draft | None] = {}
    skipped = []
    for node in _walk(prim, _to_metres_z_up(stage)):
        parent = owner.get(node.prim.GetParent().GetPath())
        draft = parent
        if node.is_part:
            draft = _Draft(node.path, parent, _rigid(asset, node), node.prim.GetName(), [], [])
            drafts[node.path] = draft
        owner[node.prim.GetPath()] = draft
        if node.is_mesh:
            mesh = _read_mesh(asset, node)
            if mesh is not None and draft is not None:
                (draft.look if node.is_look else draft.collision).append(mesh)
                if node.is_look and node.collides:
                    draft.collision.append(mesh)
        elif node.is_gprim and node.is_look:
            skipped.append(f"{node.prim.GetPath()} ({node.prim.GetTypeName()})")
    if skipped:
        warnings.warn(f"{made_of(asset)}: only meshes are read; left out: {', '.join(skipped)}", stacklevel=2)
    parts = [draft.part() for draft in drafts.values() if draft.carries(drafts)]
    if not parts:
        where = f"{made_of(asset)}: {prim.GetPath()}"
        raise InputError(f"{where}: no mesh at or below it; give the prim that holds the vehicle")
    return parts


def collision_hulls(asset: str | Path, root: str | None = None) -> list[Array]:
    """The vertices (n, 3) of each collision mesh's convex hull, in the rig root's frame, m.

    An asset that marks no collision mesh gets the convex hull of each part's look, with a warning.
    """
    return [hull for _, hull in _named_hulls(asset, root)]


def read_mesh(asset: str | Path, root: str | None, path: str) -> tuple[Array, Faces]:
    """Points (n, 3) m and triangles (m, 3) of one mesh, ``path`` below the rig root, in the rig root's frame.

    Raises ``InputError`` naming file and prim when there is none, or it is broken.
    """
    stage, prim = _open(asset, root)
    for node in _walk(prim, _to_metres_z_up(stage)):
        if node.is_mesh and node.path == path.strip("/"):
            mesh = _read_mesh(asset, replace(node, collides=True))
            if mesh is not None:
                return mesh.points, mesh.faces
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    where = f"{made_of(asset)}: {prim.GetPath()}/{path.strip('/')}"
    raise InputError(f"{where}: no such mesh; name one below the rig's root")


def add_to_spec(spec: Any, rig: Rig, name: str, free: bool = True) -> Any:
    """Add a vehicle's hulls to a ``mujoco.MjSpec``; returns its body, whose frame is the rig root's.

    The body has a free joint called like it when ``free``, and unit mass: it is there to be placed and asked, not
    simulated. One mesh geom per hull, named ``<name>/<part>/<k>``, in group 3, collides with nothing; MuJoCo's own
    distance and ray queries still see it. MuJoCo recentres meshes: read the body's pose, not a geom's.
    """
    import mujoco

    body = spec.worldbody.add_body(name=name, mass=1.0, inertia=[1.0, 1.0, 1.0], explicitinertial=True)
    if free:
        body.add_freejoint(name=name)
    for k, (part, hull) in enumerate(_named_hulls(rig.asset, rig.root or None)):
        mesh = f"{name}/{part}/{k}"
        spec.add_mesh(name=mesh, uservert=hull.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        body.add_geom(
            name=mesh,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh,
            group=QUERY_GROUP,
            contype=0,
            conaffinity=0,
        )
    return body


def _named_hulls(asset: str | Path, root: str | None) -> list[tuple[str, Array]]:
    """(part name, hull vertices in the rig root's frame) for every collision mesh."""
    parts = read_parts(asset, root)
    if any(part.collides for part in parts):
        return [(part.name, _apply(part.T_rp, hull)) for part in parts for hull in part.hulls]
    warnings.warn(
        f"{made_of(asset)}: no mesh carries UsdPhysics.CollisionAPI; the convex hull of each part stands in, which may "
        "be far too large; mark collision meshes for honest clearances",
        stacklevel=3,
    )
    return [(part.name, _apply(part.T_rp, *_hulls([part.points]))) for part in parts if len(part.points)]


# ---------------------------------------------------------------- the stage


@dataclass(frozen=True)
class _Node:
    """A prim below the rig root and ``matrix`` (4, 4), its local space to the rig root's frame."""

    prim: Any
    path: str
    matrix: Array
    pivot: Array
    is_part: bool
    is_mesh: bool
    is_gprim: bool
    is_look: bool
    collides: bool


def _open(asset: str | Path, root: str | None) -> tuple[Any, Any]:
    """The stage of ``asset`` and the rig's root prim on it."""
    from pxr import Sdf, Tf, Usd

    if not Path(asset).is_file():
        raise InputError(f"{asset}: no such file; give a USD asset (.usd, .usda, .usdc, .usdz)")
    try:
        stage = Usd.Stage.Open(str(asset))
    except Tf.ErrorException as error:
        raise InputError(f"{asset}: not readable as USD: {error}") from None
    if not root:
        prim = stage.GetDefaultPrim()
        if not prim:
            raise InputError(f"{made_of(asset)}: no defaultPrim; author one or name the rig's root prim")
        return stage, prim
    prim = (
        stage.GetPrimAtPath(root if root.startswith("/") else f"/{root}") if Sdf.Path.IsValidPathString(root) else None
    )
    if not prim:
        tops = ", ".join(str(child.GetPath()) for child in stage.GetPseudoRoot().GetChildren())
        raise InputError(f"{made_of(asset)}: root = {root!r}: no such prim; the file holds {tops or 'nothing'}")
    return stage, prim


def _to_metres_z_up(stage: Any) -> Array:
    from pxr import UsdGeom

    scale = UsdGeom.GetStageMetersPerUnit(stage)
    turn = Y_UP_TO_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
    return turn @ np.diag([scale, scale, scale, 1.0])


def _walk(root: Any, convert: Array) -> Iterator[_Node]:
    """Every visible prim from ``root`` down, inside instances too, parents first."""
    from pxr import Usd, UsdGeom, UsdPhysics

    when = Usd.TimeCode.EarliestTime()
    matrices: dict[Any, Array] = {}
    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in prims:
        imageable = UsdGeom.Imageable(prim)
        if imageable and imageable.ComputeVisibility(when) == UsdGeom.Tokens.invisible:
            prims.PruneChildren()
            continue
        above = matrices.get(prim.GetParent().GetPath(), convert)
        xformable = UsdGeom.Xformable(prim)
        local, to_pivot = np.eye(4), np.eye(4)
        if xformable:
            local, to_pivot = _local(xformable, when)
            if xformable.GetResetXformStack() and prim != root:
                above = convert
                warnings.warn(
                    f"{prim.GetPath()}: !resetXformStack! detaches it from the vehicle in USD; it is read where it "
                    "stands and moves with the vehicle here; take the reset away",
                    stacklevel=3,
                )
        matrices[prim.GetPath()] = above @ local
        is_mesh, is_gprim = prim.IsA(UsdGeom.Mesh), prim.IsA(UsdGeom.Gprim)
        placed = is_mesh and (prim == root or len(xformable.GetOrderedXformOps()) > 0)  # transform and shape in one
        collider: Any = UsdPhysics.CollisionAPI(prim) if prim.HasAPI(UsdPhysics.CollisionAPI) else None
        yield _Node(
            prim=prim,
            path=str(prim.GetPath())[len(str(root.GetPath())) + 1 :],
            matrix=above @ local,
            pivot=(above @ to_pivot)[:3, 3],
            is_part=bool(xformable) and (placed or not is_gprim),
            is_mesh=is_mesh,
            is_gprim=is_gprim,
            is_look=bool(imageable) and imageable.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render),
            collides=collider is not None and collider.GetCollisionEnabledAttr().Get(when) is not False,
        )


def _local(xformable: Any, when: Any) -> tuple[Array, Array]:
    """A prim's local transform, and its leading ops through the pivot (all of them when there is no pivot op)."""
    whole, to_pivot, ops = np.eye(4), None, xformable.GetOrderedXformOps()
    taken_back = {op.GetName() for op in ops if op.IsInverseOp()}  # a pivot is a move that is undone, whatever its name
    for op in ops:
        whole = whole @ np.array(op.GetOpTransform(when)).T
        if to_pivot is None and op.GetName() in taken_back and not op.IsInverseOp():
            to_pivot = whole
    return whole, whole if to_pivot is None else to_pivot


def _rigid(asset: str | Path, node: _Node) -> Array:
    """The rigid frame of a part: at its pivot, turned as its transform turns, without scale, shear or mirroring."""
    linear = node.matrix[:3, :3]
    u, stretch, v = np.linalg.svd(linear)
    if stretch[-1] <= 1e-9 * max(stretch[0], 1e-30):
        raise InputError(f"{made_of(asset)}: {node.prim.GetPath()}: its transform cannot be inverted; mend its scale")
    rotation = u @ v
    if np.linalg.det(rotation) < 0:
        rotation = rotation @ np.diag([-1.0, 1.0, 1.0])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, node.pivot
    return frame


# ---------------------------------------------------------------- meshes


@dataclass(frozen=True)
class _Mesh:
    """A mesh in the rig root's frame."""

    points: Array
    faces: Faces
    rgba: tuple[float, float, float, float]


@dataclass
class _Draft:
    """A part being gathered: meshes still in the rig root's frame."""

    path: str
    parent: _Draft | None
    frame: Array
    name: str
    look: list[_Mesh]
    collision: list[_Mesh]

    def carries(self, drafts: dict[str, _Draft]) -> bool:
        """Whether this part has geometry, or another part that has rides on it. The root part needs its own."""
        if self.look or self.collision:
            return True
        return self.path != "" and any(d.parent is self and d.carries(drafts) for d in drafts.values())

    def part(self) -> Part:
        parent = self.parent
        while parent is not None and parent.path == "" and not (parent.look or parent.collision):
            parent = None
        to_frame = np.linalg.inv(self.frame)
        offsets = np.cumsum([0] + [len(mesh.points) for mesh in self.look])
        faces = [mesh.faces + offset for mesh, offset in zip(self.look, offsets, strict=False)]
        points = [_apply(to_frame, mesh.points) for mesh in self.look]
        largest = max(self.look, key=lambda mesh: len(mesh.faces), default=None)
        return Part(
            name=self.name,
            path=self.path,
            parent=None if parent is None else parent.path,
            T_pr=self.frame if parent is None else np.linalg.inv(parent.frame) @ self.frame,
            T_rp=self.frame,
            points=np.concatenate([np.zeros((0, 3)), *points]),
            faces=np.concatenate([np.zeros((0, 3), np.int64), *faces]),
            collision=tuple(_apply(to_frame, mesh.points) for mesh in self.collision),
            rgba=largest.rgba if largest else (0.5, 0.5, 0.5, 1.0),
        )


def _read_mesh(asset: str | Path, node: _Node) -> _Mesh | None:
    """A mesh that is seen or collides, triangulated, in the rig root's frame; None when it is neither."""
    from pxr import Usd, UsdGeom

    if not (node.is_look or node.collides):
        return None
    when, mesh = Usd.TimeCode.EarliestTime(), UsdGeom.Mesh(node.prim)
    points = np.array(mesh.GetPointsAttr().Get(when) or [], float).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(when) or [], np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(when) or [], np.int64)
    where = f"{made_of(asset)}: {node.prim.GetPath()}"
    if not len(points) or not len(counts):
        warnings.warn(f"{where}: an empty mesh; left out", stacklevel=3)
        return None
    if counts.sum() != len(indices) or indices.min() < 0 or indices.max() >= len(points):
        raise InputError(f"{where}: its faces do not fit its {len(points)} points; export the mesh again")
    if not np.isfinite(points).all():
        raise InputError(f"{where}: points that are not finite numbers; export the mesh again")
    faces = triangulate(counts, indices, np.array(mesh.GetHoleIndicesAttr().Get(when) or [], np.int64))
    left_handed = mesh.GetOrientationAttr().Get(when) == UsdGeom.Tokens.leftHanded
    mirrored = np.linalg.det(node.matrix[:3, :3]) < 0
    return _Mesh(_apply(node.matrix, points), faces[:, ::-1] if left_handed != mirrored else faces, _colour(mesh, when))


def triangulate(counts: Faces, indices: Faces, holes: Faces | None = None) -> Faces:
    """Faces of ``counts`` corners as fans of triangles (m, 3), as Hydra draws them; ``holes`` are left out."""
    keep = np.ones(len(counts), bool)
    if holes is not None:
        keep[holes] = False
    start = np.cumsum(counts) - counts
    fans = np.where(keep, np.maximum(counts - 2, 0), 0)
    first = np.repeat(start, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    return np.stack([indices[first], indices[first + step + 1], indices[first + step + 2]], axis=1)


def _colour(mesh: Any, when: Any) -> tuple[float, float, float, float]:
    """The linear colour and opacity of a mesh's preview surface, else its display colour, else grey."""
    from pxr import UsdShade

    rgb, alpha = mesh.GetDisplayColorAttr().Get(when), mesh.GetDisplayOpacityAttr().Get(when)
    colour, opacity = (rgb[0] if rgb else (0.5, 0.5, 0.5)), (alpha[0] if alpha else 1.0)
    material = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0] if material else None
    if shader:
        inputs = {name: shader.GetInput(name) for name in ("diffuseColor", "opacity")}
        values = {name: value.Get(when) for name, value in inputs.items() if value}
        colour = values.get("diffuseColor") or colour
        opacity = opacity if values.get("opacity") is None else values["opacity"]
    return (float(colour[0]), float(colour[1]), float(colour[2]), float(opacity))


def _hulls(clouds: Sequence[Array]) -> list[Array]:
    """`_hull` of each."""
    return kept_arrays("hulls", clouds, lambda: [_hull(points) for points in clouds])


def _hull(points: Array) -> Array:
    """The vertices of the convex hull of ``points``; what is flat is thickened to a millimetre."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * 5e-4
        thick = (points[:, None] + corners).reshape(-1, 3)
        return thick[ConvexHull(thick).vertices]


def _apply(transform: Any, points: Any) -> Array:
    return points @ transform[:3, :3].T + transform[:3, 3]
