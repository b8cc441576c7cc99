"""The glb exporter: geometry, materials, moving parts and cameras as one glTF 2.0 file, for game engines and the web.

Everything comes from the composed stage. Each moving prim is a node below the moving prim that carries it. Keys are on
whole frames, or as many between them as linear interpolation needs, so that no wheel turns backwards. Tyre marks do not
move: what is made by each frame is a node whose scale steps from 0 to 1.
"""

from __future__ import annotations

import json
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.exporters.pictures.tyre_marks import across
from vehsim.exporters.usd.sampling import slerp_errors
from vehsim.lie.quaternions import continuous, quaternions
from vehsim.runtime.progress import Progress

if TYPE_CHECKING:
    from vehsim.exporters.usd.stage import Material, Ribbon, Shape, StageReader

Array = NDArray[np.float64]

FINEST = 16
"""Largest number of keys per frame."""
OFF, TURNED = 2e-4, 5e-4
"""Largest distance, m, and angle, rad, of interpolated keys from the stage."""
WIDEST = np.radians(120.0)
"""Largest rotation between two keys: readers differ near half a turn."""
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])
FLOAT, ARRAYS = 5126, {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
"""glTF's number of 32-bit floats, and its name of an array with so many of them per row."""


def write_glb(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<shot>.glb``: metres, Y up, times in seconds from the first frame; returns the file.

    Warns of what glTF cannot hold: water, and cameras that change their lens.
    """
    from vehsim.exporters.usd.stage import StageReader

    progress("glb: reading the stage", 0.0)
    stage = StageReader(folder / f"{take.name}.usda")
    if stage.water is not None:
        warnings.warn(f"{take.name}.glb: the water is left out; glTF has no surface that changes", stacklevel=2)
    frames = take.frames[0] + np.arange((take.frames[1] - take.frames[0]) * FINEST + 1) / FINEST
    poses = [stage.matrices(frame) for frame in frames.tolist()]
    worlds = {group: np.stack([pose[group] for pose in poses]) for group in stage.groups}
    carriers = {group: _carrier(group, stage.groups) for group in stage.groups}
    local = {
        group: worlds[group] if not up else np.linalg.inv(worlds[up]) @ worlds[group] for group, up in carriers.items()
    }
    progress("glb: geometry", 0.5)
    file = _Glb(_geometry(take.name, stage, carriers, local))
    seconds = (frames - frames[0]) / float(take.fps)
    for group, matrices in local.items():
        file.animate(file.node(group), seconds, matrices)
    aspect = take.render.size[0] / take.render.size[1]
    for name in stage.cameras:
        _add_camera(file, take.name, stage, name, frames, seconds, aspect)
    _add_tyre_marks(file, take, stage)
    names = _short_names([node["name"] for node in file.tree["nodes"]])
    for node in file.tree["nodes"]:
        node["name"] = names[node["name"]]
    file.tree["scenes"][0]["extras"] = {"fps": str(take.fps), "frames": list(take.frames)}
    path = folder / f"{take.name}.glb"
    path.write_bytes(file.content())
    return [path]


def _carrier(path: str, groups: Sequence[str]) -> str:
    """The closest moving prim above ``path``; "" for none."""
    while path := path.rpartition("/")[0]:
        if path in groups:
            return path
    return ""


def _short_names(paths: Sequence[str]) -> dict[str, str]:
    """Path -> the shortest end of it that no other path has, with underscores."""
    names: dict[str, str] = {}
    for path in paths:
        steps = path.strip("/").split("/")
        for count in range(1, len(steps) + 1):
            end = "/".join(steps[-count:])
            if sum(other == end or other.endswith(f"/{end}") for other in paths) == 1:
                break
        names[path] = end.replace("/", "_")
    return names


def _geometry(name: str, stage: StageReader, carriers: dict[str, str], local: dict[str, Array]) -> bytes:
    """Meshes and materials on nodes that are called as their prims, at rest, by trimesh."""
    import trimesh

    root = f"/{name}"
    scene = trimesh.Scene(base_frame="world")
    scene.graph.update(frame_from="world", frame_to=root, matrix=Y_UP)
    for group in sorted(carriers, key=lambda path: path.count("/")):
        scene.graph.update(frame_from=carriers[group] or root, frame_to=group, matrix=local[group][0])
    materials: dict[Any, Any] = {}
    for shape in stage.shapes:
        key = shape.surface, shape.closed
        if key not in materials:
            materials[key] = _material(f"material{len(materials)}", *key)
        mesh = _mesh(shape, materials[key])
        node = f"{shape.name}/mesh" if shape.name in carriers else shape.name
        scene.add_geometry(mesh, node_name=node, geom_name=node, parent_node_name=shape.group or root)

    def exact(tree: dict[str, Any]) -> None:  # trimesh keeps colours in eight bits
        by_name = {f"material{k}": surface for k, (surface, _) in enumerate(materials)}
        for material in tree.get("materials", ()):
            surface = by_name[material["name"]]
            material["pbrMetallicRoughness"]["baseColorFactor"] = _base_colour(surface)

    content: bytes = trimesh.exchange.gltf.export_glb(scene, include_normals=True, tree_postprocessor=exact)
    return content


def _base_colour(surface: Material) -> list[float]:
    """Linear red, green, blue and opacity, which multiply a texture."""
    colour = (1.0, 1.0, 1.0) if surface.texture is not None else surface.colour
    return [min(max(part, 0.0), 1.0) for part in (*colour, surface.opacity)]


def _material(name: str, surface: Material, closed: bool) -> Any:
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    from vehsim.intake.images import read_colours

    return PBRMaterial(
        name=name,
        baseColorFactor=np.round(255 * np.array(_base_colour(surface))).astype(np.uint8),
        baseColorTexture=None if surface.texture is None else Image.fromarray(read_colours(surface.texture)),
        metallicFactor=surface.metallic,
        roughnessFactor=surface.roughness,
        emissiveFactor=[min(surface.emission, 1.0)] * 3,
        alphaMode="OPAQUE" if surface.opacity == 1 else "BLEND",
        doubleSided=not closed,
    )


def _mesh(shape: Shape, material: Any) -> Any:
    """A mesh with one vertex per combination of point, normal and texture coordinates."""
    import trimesh

    textured = shape.uvs is not None and shape.face_uvs is not None
    corners = [shape.faces, shape.face_normals, *([shape.face_uvs] if textured else [])]
    used, faces = np.unique(np.stack(corners, axis=-1).reshape(-1, len(corners)), axis=0, return_inverse=True)
    uv = shape.uvs[used[:, 2]] if shape.uvs is not None and textured else None
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(
        shape.points[used[:, 0]],
        faces.reshape(-1, 3),
        vertex_normals=shape.normals[used[:, 1]],
        visual=visual,
        process=False,
        validate=False,
    )


def _add_camera(
    file: _Glb, root: str, stage: StageReader, name: str, frames: Array, seconds: Array, aspect: float
) -> None:
    views = [stage.camera(name, frame) for frame in frames.tolist()]
    widths = np.array([view.half_width for view in views])
    if np.ptp(widths) > 1e-9:
        warnings.warn(f"{root}.glb: camera {name}: glTF keeps only its first lens", stacklevel=3)
    near, far = views[0].clip
    perspective = {"yfov": 2 * float(np.arctan(widths[0] / aspect)), "aspectRatio": aspect, "znear": near, "zfar": far}
    cameras = file.tree.setdefault("cameras", [])
    cameras.append({"name": name, "type": "perspective", "perspective": perspective})
    node = {"name": stage.cameras[name], "camera": len(cameras) - 1}
    file.tree["nodes"].append(node)
    file.node(f"/{root}").setdefault("children", []).append(len(file.tree["nodes"]) - 1)
    file.animate(node, seconds, np.stack([view.T_wc for view in views]))


def _add_tyre_marks(file: _Glb, take: Take, stage: StageReader) -> None:
    """Add a node per frame, with what all tyres made since the frame before; it shows from then on."""
    made: dict[float, list[tuple[Array, Array]]] = {}
    for ribbon, times in stage.tyre_marks_made():
        points, colours = _mark_quads(ribbon)
        for frame in np.unique(times[1:]).tolist():
            rows = times[1:] == frame  # a piece of the ribbon is there when its second row is
            made.setdefault(frame, []).append((points[rows].reshape(-1, 3), colours[rows].reshape(-1, 4)))
    if not made:
        return
    materials = file.tree["materials"]
    rough = {"metallicFactor": 0.0, "roughnessFactor": 0.85}
    materials.append(
        {"name": "tyre_marks", "pbrMetallicRoughness": rough, "alphaMode": "BLEND", "doubleSided": True},
    )
    for frame, parts in sorted(made.items()):
        points, colours = (np.concatenate(each) for each in zip(*parts, strict=True))
        name = f"/{take.name}/env/tyre_marks_{frame:g}"
        node = file.add_triangles(name, points, colours, len(materials) - 1)
        file.node(f"/{take.name}").setdefault("children", []).append(node)
        if frame > take.frames[0]:
            file.show_from(node, (frame - take.frames[0]) / float(take.fps))


def _mark_quads(ribbon: Ribbon) -> tuple[Array, Array]:
    """Corners (k - 1, c, 3) m of the triangles between a ribbon's rows, and their linear colours with opacity
    (k - 1, c, 4)."""
    grid, opacity = across(ribbon)
    colours = np.concatenate([np.broadcast_to(ribbon.colour, grid.shape), opacity[..., None]], axis=-1)

    def triangles(each: Array) -> Array:
        a, b, c, d = each[:-1, :-1], each[:-1, 1:], each[1:, 1:], each[1:, :-1]
        corners = np.stack([a, b, c, a, c, d], axis=2)  # the way runs along, left to right: the front is above
        return corners.reshape(len(corners), -1, each.shape[-1])

    return triangles(grid), triangles(colours)


class _Glb:
    """A GLB file: its ``tree`` of JSON, and binary arrays that are appended to it."""

    def __init__(self, content: bytes) -> None:
        size = struct.unpack_from("<I", content, 12)[0]
        self.tree: dict[str, Any] = json.loads(content[20 : 20 + size])
        self._arrays = content[28 + size :]
        self._times: dict[bytes, int] = {}

    def node(self, name: str) -> dict[str, Any]:
        """The node of a name."""
        found: dict[str, Any] = next(node for node in self.tree["nodes"] if node["name"] == name)
        return found

    def animate(self, node: dict[str, Any], seconds: Array, matrices: Array) -> None:
        """Give a node translation and rotation: ``matrices`` (n, 4, 4) at ``seconds`` (n,), on as few of them as
        suffice."""
        places, q = matrices[:, :3, 3], continuous(quaternions(matrices[:, :3, :3]))
        node.pop("matrix", None)
        node["translation"], node["rotation"] = places[0].tolist(), np.roll(q[0], -1).tolist()
        rows = _rows(seconds, places, q)
        moves = {"translation": np.ptp(places, axis=0).max() > 0, "rotation": np.ptp(q, axis=0).max() > 0}
        values = {"translation": places, "rotation": np.roll(q, -1, axis=1)}
        if not any(moves.values()):
            return
        for path, moving in moves.items():
            if moving:
                self._add_channel(self.tree["nodes"].index(node), path, "LINEAR", seconds[rows], values[path][rows])

    def add_triangles(self, name: str, points: Array, colours: Array, material: int) -> int:
        """Add a node with triangles: corners (n, 3) m, and their linear colours with opacity (n, 4); returns its
        number."""
        attributes = {"POSITION": self._append(points, bounds=True), "COLOR_0": self._append(colours)}
        self.tree["meshes"].append({"name": name, "primitives": [{"attributes": attributes, "material": material}]})
        self.tree["nodes"].append({"name": name, "mesh": len(self.tree["meshes"]) - 1})
        return len(self.tree["nodes"]) - 1

    def show_from(self, node: int, seconds: float) -> None:
        """Hide a node until ``seconds``: by glTF, what is scaled to 0 need not be drawn."""
        self._add_channel(node, "scale", "STEP", np.array([0.0, seconds]), np.array([[0.0] * 3, [1.0] * 3]))

    def _add_channel(self, node: int, path: str, interpolation: str, seconds: Array, values: Array) -> None:
        """Animate a property of a node: ``values`` (n, m) at ``seconds`` (n,)."""
        (animation,) = self.tree.setdefault("animations", [{"name": "shot", "samplers": [], "channels": []}])
        key = seconds.tobytes()
        if key not in self._times:
            self._times[key] = self._append(seconds, bounds=True)
        sampler = {"input": self._times[key], "output": self._append(values), "interpolation": interpolation}
        animation["samplers"].append(sampler)
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})

    def _append(self, values: Array, bounds: bool = False) -> int:
        """Add an array (n,) or (n, m) of floats; returns the number of its accessor."""
        block = np.ascontiguousarray(values, "<f4")
        rows = block.reshape(len(block), -1)
        self.tree["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self._arrays), "byteLength": block.nbytes},
        )
        self._arrays += block.tobytes()
        view = len(self.tree["bufferViews"]) - 1
        accessor = {"bufferView": view, "componentType": FLOAT, "count": len(rows), "type": ARRAYS[rows.shape[1]]}
        if bounds:  # glTF requires them of times and points
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def content(self) -> bytes:
        """The file."""
        self.tree["buffers"] = [{"byteLength": len(self._arrays)}]
        text = json.dumps(self.tree, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self._arrays)
        header = struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON")
        return header + text + struct.pack("<I4s", len(self._arrays), b"BIN\0") + self._arrays


def _rows(seconds: Array, places: Array, q: Array) -> NDArray[np.intp]:
    """The fewest equal parts of every frame at which linear interpolation of keys is close to all samples."""
    n, step = len(seconds), FINEST
    while step > 1:
        rows = np.unique([*range(0, n, step), n - 1])
        between = np.stack([np.interp(seconds, seconds[rows], column[rows]) for column in places.T], axis=1)
        widest = 2 * np.arccos(np.clip(np.abs(np.sum(q[rows[1:]] * q[rows[:-1]], axis=1)), 0, 1)).max(initial=0.0)
        off = np.linalg.norm(between - places, axis=1).max()
        if off <= OFF and widest <= WIDEST and slerp_errors(seconds, q, rows).max() <= TURNED:
            return rows
        step //= 2
    return np.arange(n)


exporter = Exporter(
    name="glb",
    suffixes=(".glb",),
    write=write_glb,
    needs=("usd",),
    makes="one glTF file with moving parts and cameras",
)
