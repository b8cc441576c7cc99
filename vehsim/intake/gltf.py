"""Read the scene of a glTF file, checked before a library walks its nodes."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from vehsim.intake import usd
from vehsim.intake.foreign import limit, raise_limit, refuse

SUFFIXES = (".glb", ".gltf")
MAX_DEPTH = usd.MAX_DEPTH - 2
"""Largest depth of a node: vehicles become USD, where a node is below the root prim and above its mesh."""
_AGAIN = "export the file again"


def scene_of(path: Path, key: str) -> dict[str, Any]:
    """The scene's description (JSON) in a file. Raises ``InputError`` if its nodes are not a tree, or too deep or many:
    libraries would follow them for ever, or multiply all matrices above each node."""
    data = path.read_bytes()
    if path.suffix.lower() == ".glb":  # 12 bytes of header, then length, type and text of the JSON
        data = data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]
    try:
        scene = json.loads(data)
    except RecursionError:
        raise refuse(path, key, "nested too deeply", _AGAIN) from None
    nodes = scene.get("nodes", [])
    if len(nodes) > (most := limit("VEHSIM_READ_PRIMS")):
        raise refuse(path, key, f"more than {most:,.0f} nodes", raise_limit("VEHSIM_READ_PRIMS"))
    below = [node.get("children", []) for node in nodes]
    named = [child for children in below for child in children]
    if any(not 0 <= child < len(nodes) for child in named):
        raise refuse(path, key, f"nodes name children that its {len(nodes)} nodes do not have", _AGAIN)
    if len(named) > len(set(named)):
        raise refuse(path, key, "a node has two parents", _AGAIN)
    level, depth, count = set(range(len(nodes))).difference(named), 0, 0
    while level:
        depth, count = depth + 1, count + len(level)
        if depth > MAX_DEPTH:
            raise refuse(path, key, f"nodes nested deeper than {MAX_DEPTH}", "group them in fewer levels")
        level = {child for node in level for child in below[node]}
    if count < len(nodes):
        raise refuse(path, key, "nodes that are above themselves", _AGAIN)
    return scene


def parts_of(scene: dict[str, Any]) -> int:
    """How many parts a vehicle from the scene has: its nodes, or the primitives of their meshes if these are more."""
    nodes, meshes = scene.get("nodes", []), scene.get("meshes", [])
    drawn = [node["mesh"] for node in nodes if 0 <= node.get("mesh", -1) < len(meshes)]
    return max(len(nodes), sum(len(meshes[mesh]["primitives"]) for mesh in drawn))
