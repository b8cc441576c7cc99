"""Small files of every kind, and seeded generators of broken ones: each yields a name and its content."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

CUBE = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
SIDES = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
FACES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])


def usda(points: np.ndarray = CUBE, faces: np.ndarray = FACES, head: str = "    metersPerUnit = 1\n") -> bytes:
    """A stage with a mesh; ``head``: more metadata."""
    corners = ", ".join(f"({x}, {y}, {z})" for x, y, z in points.tolist())
    return (
        f'#usda 1.0\n(\n    defaultPrim = "rig"\n    upAxis = "Z"\n{head})\n'
        'def Xform "rig"\n{\n    def Mesh "mesh"\n    {\n'
        f"        int[] faceVertexCounts = {[3] * len(faces)}\n"
        f"        int[] faceVertexIndices = {faces.ravel().tolist()}\n"
        f"        point3f[] points = [{corners}]\n    }}\n}}\n"
    ).encode()


def glb(points: np.ndarray = CUBE, faces: np.ndarray = FACES) -> bytes:
    """A binary glTF with a mesh."""
    body = points.astype("<f4").tobytes() + faces.astype("<u4").tobytes()
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": points.size * 4}]
    views += [{"buffer": 0, "byteOffset": points.size * 4, "byteLength": faces.size * 4}]
    accessors = [{"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3"}]
    accessors += [{"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"}]
    scene = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "it"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def obj(points: np.ndarray = CUBE, faces: np.ndarray = FACES) -> bytes:
    rows = [f"v {x} {y} {z}" for x, y, z in points.tolist()] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    return "\n".join(rows).encode()


def ply(points: np.ndarray = CUBE, faces: np.ndarray = FACES) -> bytes:
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [f"{x} {y} {z}" for x, y, z in points.tolist()] + [f"3 {a} {b} {c}" for a, b, c in faces]
    return (head + "\n".join(rows) + "\n").encode()


def stl(points: np.ndarray = CUBE, faces: np.ndarray = FACES) -> bytes:
    rows = [struct.pack("<12fH", 0, 0, 0, *points[face].ravel().tolist(), 0) for face in faces]
    return bytes(80) + struct.pack("<I", len(rows)) + b"".join(rows)


WRITERS = {".usda": usda, ".glb": glb, ".obj": obj, ".ply": ply, ".stl": stl}


def wrong_meshes(seed: int = 0) -> Iterator[tuple[str, bytes]]:
    """Indices slightly and far out of range, points that are not finite, and files cut and changed at random."""
    chance = random.Random(seed)
    nothing = np.array([np.nan, np.inf, 1e30])
    for suffix, write in WRITERS.items():
        if suffix != ".stl":  # it has no indices
            for far in (8, 10**6, 2**31 - 1):
                faces = FACES.copy()
                faces[5, 1] = far
                yield f"index_{far}{suffix}", write(CUBE, faces)
        for value in nothing[: 3 if suffix != ".usda" else 0].tolist():
            points = CUBE.copy()
            points[3, 2] = value
            yield f"point_{value}{suffix}", write(points)
        whole = write()
        yield f"empty{suffix}", b""
        yield f"no_faces{suffix}", write(CUBE, FACES[:0])
        for k in range(6):
            cut = chance.randrange(len(whole))
            yield f"cut_{k}{suffix}", whole[:cut]
        for k in range(6):
            changed = bytearray(whole)
            for _ in range(chance.choice((1, 8, 64))):
                changed[chance.randrange(len(whole))] = chance.randrange(256)
            yield f"changed_{k}{suffix}", bytes(changed)


def wrong_arrays(keys: tuple[str, ...], seed: int = 0) -> Iterator[tuple[str, bytes]]:
    """NPZ files cut, changed, foreign, with text, with objects, and with headers that announce excessive sizes."""
    chance = random.Random(seed)
    arrays = {key: np.zeros((3, 3)) for key in keys}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    whole = buffer.getvalue()
    yield "empty.npz", b""
    yield "text.npz", b"heights"
    yield "foreign.npz", zipped({"readme.txt": b"hello"})
    yield "broken_array.npz", zipped({f"{key}.npy": b"hello" for key in keys})
    vast = npy(np.zeros((3, 3))).replace(b"(3, 3)", b"(9999999, 999999)")
    yield "vast.npz", zipped({f"{key}.npy": vast for key in keys})
    yield "words.npz", zipped({f"{key}.npy": npy(np.array(["a", "b"])) for key in keys})
    objects = io.BytesIO()
    np.save(objects, np.array([object]), allow_pickle=True)
    yield "objects.npz", zipped({f"{key}.npy": objects.getvalue() for key in keys})
    for k in range(6):
        yield f"cut_{k}.npz", whole[: chance.randrange(len(whole))]
        changed = bytearray(whole)
        for _ in range(chance.choice((1, 8, 64))):
            changed[chance.randrange(len(whole))] = chance.randrange(256)
        yield f"changed_{k}.npz", bytes(changed)


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def zipped(members: dict[str, bytes], deflated: bool = False, align: int = 1) -> bytes:
    """An archive; ``align``: the alignment of its members in bytes, which packages of USD need."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED if deflated else zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            info = zipfile.ZipInfo(name)
            info.compress_type = archive.compression
            pad = -(archive.fp.tell() + 30 + len(name.encode()) + 4) % align
            info.extra = b"\x86\x19" + pad.to_bytes(2, "little") + bytes(pad) if align > 1 else b""
            archive.writestr(info, content)
    return buffer.getvalue()


def written(folder: Path, files: Iterator[tuple[str, bytes]]) -> Iterator[Path]:
    for name, content in files:
        (folder / name).write_bytes(content)
        yield folder / name
