"""Read a vehicle's USD asset as a list of parts, and as convex hulls in a MuJoCo spec.

Any asset, ours or another, becomes rigid parts with geometry in metres, Z up. The exporters write USD and draw it;
`world` queries the hulls.

The rig root's frame is the space *above* the root prim: transforms on the root prim itself, and the change of units and
up axis, are part of the geometry, so an animated pose multiplies everything from the left.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.intake.foreign import check_parts, limit
from vehsim.intake.polygons import has_polygons
from vehsim.intake.usd import complaints, dependencies, is_drawn, open_stage
from vehsim.rig.hulls import Faces, Mesh, apply, convex_hulls, hull_moments, mesh_of
from vehsim.rig.rig import Rig
from vehsim.runtime.cache import content_of, lookup, made_of, packed, store, unpacked

Array = NDArray[np.float64]

Y_UP_TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
QUERY_GROUP = 3
"""MuJoCo geom group of the hulls: not drawn by default."""


@dataclass(frozen=True)
class Part:
    """A rigid part: an Xform prim with meshes below it, its geometry expressed in a rigid frame at its pivot.

    ``path`` is the prim's path below the rig root ("" for the root itself), ``parent`` that of its parent part (None
    for the root). ``T_pr`` (4, 4) maps the part's frame to its parent part's at rest, ``T_rp`` to the rig root's.
    ``points`` (n, 3) m and ``faces`` (m, 3), counter-clockwise from outside, are the visible geometry, empty for a part
    that only carries others; ``collision`` are the points (k, 3) of its collision meshes. ``rgba`` (4,) is the linear
    colour of its largest mesh.
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
        """Whether it has collision meshes."""
        return bool(self.collision)

    @cached_property
    def hulls(self) -> tuple[Array, ...]:
        """The vertices (k, 3) m of its collision meshes' convex hulls."""
        return tuple(convex_hulls(self.collision)) if self.collision else ()


@dataclass(frozen=True)
class Solid:
    """The collision geometry of a part: the vertices (k, 3) m of its ``hulls``; and ``T_rp`` (4, 4), the part's own
    frame.

    Both in the rig root's frame.
    """

    name: str
    path: str
    T_rp: Array
    hulls: tuple[Array, ...]


def read_parts(asset: str | Path, root: str | None = None) -> list[Part]:
    """The parts of ``asset`` below ``root`` (a prim path; the default prim if empty), parents before children.

    Raises ``InputError`` naming file and prim if the file or the root is missing, there is no mesh, a mesh is broken,
    or a transform cannot be inverted. Warns of geometry other than meshes and simple shapes, which is skipped.
    """
    about = root, limit("VEHSIM_READ_PARTS")
    names, messages, arrays = recalled("parts-2", asset, about, lambda: _parts(asset, root))
    for message in messages:
        warnings.warn(message, stacklevel=2)
    frames, colours, *rows = arrays
    points, faces, collision = (
        _divided(row, [count for *_, counts in names for count in counts[k]]) for k, row in enumerate(rows)
    )
    return [
        Part(name, path, parent, T_pr, T_rp, next(points), next(faces), tuple(islice(collision, len(counts[2]))), rgba)
        for (name, path, parent, counts), (T_pr, T_rp), rgba in zip(names, frames, map(tuple, colours), strict=True)
    ]


def _divided(rows: NDArray[Any], counts: Sequence[int]) -> Iterator[NDArray[Any]]:
    """Consecutive ``counts`` of ``rows``."""
    return iter(np.split(rows, np.cumsum(counts)))


def _parts(asset: str | Path, root: str | None) -> Recalled:
    parts, messages = _read(asset, root)
    names = [
        [part.name, part.path, part.parent, [[len(part.points)], [len(part.faces)], [*map(len, part.collision)]]]
        for part in parts
    ]
    clouds = [cloud for part in parts for cloud in part.collision]
    arrays = [
        np.array([[part.T_pr, part.T_rp] for part in parts]),
        np.array([part.rgba for part in parts]),
        np.vstack([part.points for part in parts]),
        np.vstack([part.faces for part in parts]),
        np.vstack([np.zeros((0, 3)), *clouds]),
    ]
    return names, messages, arrays


def solids(asset: str | Path, root: str | None = None) -> list[Solid]:
    """The collision geometry of every part: the convex hull of each collision mesh. Raises as `read_parts` does.

    An asset without collision meshes gets the convex hull of each part's visible mesh, with a warning.
    """
    names, messages, (frames, points) = recalled("solids", asset, root, lambda: _solids(asset, root))
    for message in messages:
        warnings.warn(message, stacklevel=2)
    hulls = _divided(points, [count for _, _, counts in names for count in counts])
    return [
        Solid(name, path, frame, tuple(islice(hulls, len(counts))))
        for (name, path, counts), frame in zip(names, frames, strict=True)
    ]


def _solids(asset: str | Path, root: str | None) -> Recalled:
    parts, messages = _read(asset, root)
    meshes = [part.collision for part in parts]
    if not any(meshes):
        meshes = [(part.points,) * bool(len(part.points)) for part in parts]
        messages.append(
            f"{made_of(asset)}: no mesh carries UsdPhysics.CollisionAPI; the convex hull of each part is used, "
            "which may be far too large; mark collision meshes for accurate clearances"
        )
    hulls = convex_hulls([points for own in meshes for points in own])
    frames = [part.T_rp for part, own in zip(parts, meshes, strict=True) for _ in own]
    placed = [apply(T_rp, hull) for T_rp, hull in zip(frames, hulls, strict=True)]
    counts = iter(map(len, placed))
    names = [[part.name, part.path, [*islice(counts, len(own))]] for part, own in zip(parts, meshes, strict=True)]
    return names, messages, [np.array([part.T_rp for part in parts]), np.vstack([np.zeros((0, 3)), *placed])]


def moments(parts: Sequence[Part]) -> list[tuple[Part, float, Array, Array]]:
    """Volume m^3, centre (3,) m, and inertia (3, 3) m^5 about it at unit density, in the rig root's frame, of each hull
    of each part: of its collision meshes, or of its visible points if no part has any."""
    marked = any(part.collides for part in parts)
    found = [(part, hull) for part in parts for hull in (part.hulls if marked else (part.points,)) if len(hull)]
    measured = hull_moments([apply(part.T_rp, hull) for part, hull in found])
    return [(part, *each) for (part, _), each in zip(found, measured, strict=True)]


def collision_hulls(asset: str | Path, root: str | None = None) -> list[Array]:
    """The vertices (n, 3) of the hulls of `solids`, in the rig root's frame, m."""
    return [hull for solid in solids(asset, root) for hull in solid.hulls]


def is_animated(asset: str | Path, root: str | None = None) -> bool:
    """Whether an asset animates prims of its own, at or below the rig's root."""
    from pxr import Usd, UsdGeom

    _, prim = _open(asset, root)
    prims = Usd.PrimRange(prim, Usd.TraverseInstanceProxies())
    return any(UsdGeom.Xformable(p).TransformMightBeTimeVarying() for p in prims if p.IsA(UsdGeom.Xformable))


def read_mesh(asset: str | Path, root: str | None, path: str) -> tuple[Array, Faces]:
    """Points (n, 3) m and triangles (m, 3) of one mesh, ``path`` below the rig root, in the rig root's frame.

    Raises ``InputError`` naming file and prim if the mesh is missing or broken.
    """
    stage, prim = _open(asset, root)
    messages: list[str] = []
    for node in _walk(prim, _to_metres_z_up(stage), messages):
        if node.is_mesh and node.path == path.strip("/"):
            mesh = mesh_of(asset, replace(node, collides=True), messages)
            for message in messages:
                warnings.warn(message, stacklevel=2)
            if mesh is not None:
                return mesh.points, mesh.faces
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    place = f"{prim.GetPath()}/{path.strip('/')}"
    raise InputError("no such mesh", "name one below the rig's root", key=place, file=made_of(asset))


def add_to_spec(spec: Any, rig: Rig, name: str, free: bool = True, only: Collection[str] | None = None) -> Any:
    """Add a vehicle's hulls to a ``mujoco.MjSpec``; returns its body, whose frame is the rig root's. ``only``: paths of
    the parts, all by default.

    The body has unit mass and, if ``free``, a free joint of the same name: it is placed and queried, not simulated.
    Each hull is a mesh geom ``<name>/<part>/<k>`` in group 3 that collides with nothing; MuJoCo's distance and ray
    queries still see it. MuJoCo recentres meshes: read the body's pose, not a geom's.
    """
    import mujoco

    body = spec.worldbody.add_body(name=name, mass=1.0, inertia=[1.0, 1.0, 1.0], explicitinertial=True)
    if free:
        body.add_freejoint(name=name)
    chosen = [solid for solid in solids(rig.asset, rig.root or None) if only is None or solid.path in only]
    named = [(solid.name, hull) for solid in chosen for hull in solid.hulls]
    for k, (part, hull) in enumerate(named):
        mesh = f"{name}/{part}/{k}"
        spec.add_mesh(name=mesh, uservert=hull.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        look = {"group": QUERY_GROUP, "contype": 0, "conaffinity": 0}
        body.add_geom(name=mesh, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, **look)
    return body


Recalled = tuple[Any, list[str], list[NDArray[Any]]]
"""JSON data, warnings and arrays that were read from an asset."""


def recalled(kind: str, asset: str | Path, about: Any, read: Callable[[], Recalled]) -> Recalled:
    """What ``read`` finds out about an asset, cached by the content of its file and of the files to which that refers,
    because loading USD takes longer than many a plan. ``kind``, ``about``: what is read."""
    key = str(asset), content_of(asset), about
    kept = lookup(kind, key)
    if kept is not None:
        header, *arrays = unpacked(kept)
        files, data, messages = json.loads(header.tobytes())
        if all(content_of(file) == content for file, content in files.items()):
            return data, messages, arrays
    from pxr import Sdf

    # layers in memory may differ from their files
    held = {layer.identifier for layer in Sdf.Layer.GetLoadedLayers()}
    before = {str(file): content_of(file) for file in dependencies(asset)[0]}
    data, messages, arrays = read()
    files = _files(asset, held)
    if files and files.items() <= before.items():  # nothing was written while it was read
        header = np.frombuffer(json.dumps([files, data, messages]).encode(), np.uint8)
        store(kind, key, packed([header, *arrays]))
    return data, messages, arrays


def _files(asset: str | Path, held: AbstractSet[str]) -> dict[str, str | None]:
    """All files from which an asset was read, with their checksums. Empty if this is uncertain: a file is missing, a
    resolver chooses the files, or a layer was ``held`` in memory."""
    from pxr import Usd

    stage = Usd.Stage.Open(str(asset))
    layers = [layer for layer in stage.GetUsedLayers() if not layer.anonymous]
    files = {str(Path(layer.realPath.partition("[")[0]).resolve()) for layer in layers}
    plain = all(layer.identifier == layer.realPath and layer.identifier not in held for layer in layers)
    if not plain or stage.GetCompositionErrors():
        return {}
    return {file: content_of(file) for file in sorted(files)}


# ---------------------------------------------------------------- the stage


def _read(asset: str | Path, root: str | None) -> tuple[list[Part], list[str]]:
    """The parts, and the warnings."""
    with complaints(asset), np.errstate(over="ignore", invalid="ignore"):  # a product that overflows is refused
        return _read_stage(asset, root)


def _read_stage(asset: str | Path, root: str | None) -> tuple[list[Part], list[str]]:
    stage, prim = _open(asset, root)  # a prim is valid only while its stage is held
    drafts: dict[str, _Draft] = {}
    owner: dict[Any, _Draft | None] = {}
    skipped: list[str] = []
    messages: list[str] = []
    for node in _walk(prim, _to_metres_z_up(stage), messages):
        parent = owner.get(node.prim.GetParent().GetPath())
        draft = parent
        if node.is_part:
            check_parts(len(drafts), made_of(asset))  # beside the root's own
            draft = _Draft(node.path, parent, _rigid(asset, node), node.prim.GetName(), [], [])
            drafts[node.path] = draft
        owner[node.prim.GetPath()] = draft
        if node.is_mesh:
            mesh = mesh_of(asset, node, messages)
            if mesh is not None and draft is not None:
                (draft.look if node.is_look else draft.collision).append(mesh)
                if node.is_look and node.collides:
                    draft.collision.append(mesh)
        elif node.is_gprim and node.is_look:
            skipped.append(f"{node.prim.GetPath()} ({node.prim.GetTypeName()})")
    if skipped:
        messages.append(f"{made_of(asset)}: only meshes and simple shapes are read; left out: {', '.join(skipped)}")
    carrying = {draft.path for draft in drafts.values() if draft.look or draft.collision}
    for draft in reversed(drafts.values()):  # parents come first; the root part needs geometry of its own
        if draft.path in carrying and draft.parent is not None and draft.parent.path:
            carrying.add(draft.parent.path)
    parts = [draft.part() for draft in drafts.values() if draft.path in carrying]
    if not parts:
        place, remedy = str(prim.GetPath()), "give the prim that holds the vehicle"
        raise InputError("no mesh or shape at or below it", remedy, key=place, file=made_of(asset))
    return parts, messages


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
    from pxr import Sdf

    stage = open_stage(asset)
    if not root:
        prim = stage.GetDefaultPrim()
        if not prim:
            raise InputError("no defaultPrim", "author one or name the rig's root prim", file=made_of(asset))
        return stage, prim
    prim = (
        stage.GetPrimAtPath(root if root.startswith("/") else f"/{root}") if Sdf.Path.IsValidPathString(root) else None
    )
    if not prim:
        tops = ", ".join(str(child.GetPath()) for child in stage.GetPseudoRoot().GetChildren())
        raise InputError(
            "no such prim", f"the file holds {tops or 'nothing'}", key="root", value=root, file=made_of(asset)
        )
    return stage, prim


def _to_metres_z_up(stage: Any) -> Array:
    from pxr import UsdGeom

    scale = UsdGeom.GetStageMetersPerUnit(stage)
    turn = Y_UP_TO_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
    return turn @ np.diag([scale, scale, scale, 1.0])


def _walk(root: Any, convert: Array, messages: list[str]) -> Iterator[_Node]:
    """Every visible prim from ``root`` down, also inside instances, parents first; adds warnings to ``messages``."""
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
                messages.append(
                    f"{prim.GetPath()}: !resetXformStack! detaches it from the vehicle in USD; it is read where it "
                    "stands and moves with the vehicle here; remove the reset"
                )
        matrices[prim.GetPath()] = above @ local
        is_mesh, is_gprim = has_polygons(prim), prim.IsA(UsdGeom.Gprim)
        # transform and shape in one prim
        placed = is_mesh and (prim == root or len(xformable.GetOrderedXformOps()) > 0)
        collider: Any = UsdPhysics.CollisionAPI(prim) if prim.HasAPI(UsdPhysics.CollisionAPI) else None
        yield _Node(
            prim=prim,
            path=str(prim.GetPath())[len(str(root.GetPath())) + 1 :],
            matrix=above @ local,
            pivot=(above @ to_pivot)[:3, 3],
            is_part=bool(xformable) and (placed or not is_gprim),
            is_mesh=is_mesh,
            is_gprim=is_gprim,
            is_look=bool(imageable) and is_drawn(prim),
            collides=collider is not None and collider.GetCollisionEnabledAttr().Get(when) is not False,
        )


def _local(xformable: Any, when: Any) -> tuple[Array, Array]:
    """A prim's local transform, and its leading ops through the pivot (all ops if there is no pivot op)."""
    whole, to_pivot, ops = np.eye(4), None, xformable.GetOrderedXformOps()
    # a pivot is a translation that is undone later, whatever its name
    taken_back = {op.GetName() for op in ops if op.IsInverseOp()}
    for op in ops:
        whole = whole @ np.array(op.GetOpTransform(when)).T
        if to_pivot is None and op.GetName() in taken_back and not op.IsInverseOp():
            to_pivot = whole
    return whole, whole if to_pivot is None else to_pivot


def _rigid(asset: str | Path, node: _Node) -> Array:
    """The rigid frame of a part: at its pivot, with its rotation, without scale, shear or mirroring."""
    linear = node.matrix[:3, :3]
    if not np.isfinite(node.matrix).all():
        raise InputError(
            "its transform is not finite",
            "fix its translation, rotation or scale",
            key=str(node.prim.GetPath()),
            file=made_of(asset),
        )
    u, stretch, v = np.linalg.svd(linear)
    if stretch[-1] <= 1e-9 * max(stretch[0], 1e-30):
        raise InputError(
            "its transform cannot be inverted", "fix its scale", key=str(node.prim.GetPath()), file=made_of(asset)
        )
    rotation = u @ v
    if np.linalg.det(rotation) < 0:
        rotation = rotation @ np.diag([-1.0, 1.0, 1.0])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, node.pivot
    return frame


# ---------------------------------------------------------------- meshes


@dataclass
class _Draft:
    """A part under construction: its meshes are still in the rig root's frame."""

    path: str
    parent: _Draft | None
    frame: Array
    name: str
    look: list[Mesh]
    collision: list[Mesh]

    def part(self) -> Part:
        parent = self.parent
        while parent is not None and parent.path == "" and not (parent.look or parent.collision):
            parent = None
        to_frame = np.linalg.inv(self.frame)
        offsets = np.cumsum([0] + [len(mesh.points) for mesh in self.look])
        faces = [mesh.faces + offset for mesh, offset in zip(self.look, offsets, strict=False)]
        points = [apply(to_frame, mesh.points) for mesh in self.look]
        largest = max(self.look, key=lambda mesh: len(mesh.faces), default=None)
        return Part(
            name=self.name,
            path=self.path,
            parent=None if parent is None else parent.path,
            T_pr=self.frame if parent is None else np.linalg.inv(parent.frame) @ self.frame,
            T_rp=self.frame,
            points=np.concatenate([np.zeros((0, 3)), *points]),
            faces=np.concatenate([np.zeros((0, 3), np.int64), *faces]),
            collision=tuple(apply(to_frame, mesh.points) for mesh in self.collision),
            rgba=largest.rgba if largest else (0.5, 0.5, 0.5, 1.0),
        )
