"""Hostile files: a seed gives files that are broken in some way, and the command that a user would give them to.

Whole files are written, or taken from the repository, and then cut, changed, exchanged or lied about; others are built
by rule. Standard library, numpy, Pillow and USD only.
"""

from __future__ import annotations

import io
import json
import math
import os
import random
import re
import shutil
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from tools.hostile_files.writers import CUBE, FACES, WRITERS, glb, npy, usda, zipped

ROOT = Path(__file__).resolve().parents[2]
ELSEWHERE, VEHICLES, EXAMPLES = ROOT / "tests" / "assets_elsewhere", ROOT / "assets" / "vehicles", ROOT / "examples"

HEAD = '[shot]\nschema = 1\nname = "{name}"\n'
DRIVE = '[[vehicle]]\nname = "car"\nasset = "{asset}"\n[vehicle.motion]\nmethod = "simulate"\nduration = 0.1\n'
GOOD = HEAD.format(name="good") + DRIVE.format(asset="car")
MARK = "[[vehicle.motion.mark]]\nframe = {frame}\nposition = [{x}, 0, 0]\nvelocity = [2, 0, 0]\n"
MOVES = HEAD.format(name="good") + '[[vehicle]]\nname = "car"\nasset = "car"\n[vehicle.motion]\nmethod = "plan"\n'
MOVES += MARK.format(frame=1001, x=0) + MARK.format(frame=1025, x=2)


@dataclass
class Case:
    """What is done: a ``command`` in a folder with files; ``words`` say what is hostile about it; ``good``: the command
    exports another shot too, which has to be delivered."""

    chance: random.Random
    folder: Path
    command: list[str] = field(default_factory=list)
    words: list[str] = field(default_factory=list)
    good: bool = False

    def write(self, name: str, content: bytes | str) -> str:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return name

    def shot(self, more: str = "", asset: str = "car", text: str | None = None) -> None:
        """A shot, and the command that checks or exports it, at times with a good one."""
        self.write("bad.toml", HEAD.format(name="bad") + DRIVE.format(asset=asset) + more if text is None else text)
        kind = self.chance.choice(("check", "check", "export", "both"))
        self.command = ["check", "bad.toml"]
        if kind != "check":
            self.command = ["export", "bad.toml", "--out", "out", "--to", self.chance.choice(("npz", "usd"))]
        if kind == "both":
            self.good = True
            self.write("good.toml", GOOD)
            self.command.insert(2, "good.toml")


def make_case(seed: int, folder: Path) -> Case:
    """Write the files of a seed into ``folder``, and what is done with them."""
    case = Case(random.Random(seed), folder)
    folder.mkdir(parents=True, exist_ok=True)
    kind = case.chance.choices(list(KINDS), [weight for weight, _ in KINDS.values()])[0]
    case.words.append(kind)
    KINDS[kind][1](case)
    return case


# ---------------------------------------------------------------- how files are broken


def broken(case: Case, whole: bytes) -> bytes:
    """The same bytes, broken in one way or several; at times not at all."""
    for _ in range(case.chance.choice((1, 1, 1, 2, 3))):
        choice = case.chance.choice(list(DAMAGES))
        case.words.append(choice)
        whole = DAMAGES[choice](case.chance, whole)
    return whole


def _cut(chance: random.Random, whole: bytes) -> bytes:
    return whole[: chance.randrange(len(whole) + 1)]


def _changed(chance: random.Random, whole: bytes) -> bytes:
    changed = bytearray(whole)
    for _ in range(chance.choice((1, 8, 64, 512))):
        if changed:
            changed[chance.randrange(len(changed))] = chance.randrange(256)
    return bytes(changed)


def _flipped(chance: random.Random, whole: bytes) -> bytes:
    changed = bytearray(whole)
    for _ in range(chance.choice((1, 4))):
        if changed:
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def _whole_numbers(chance: random.Random, whole: bytes) -> bytes:
    """Binary whole numbers that are far too large, negative or zero, more of them near the start."""
    changed = bytearray(whole)
    for _ in range(chance.choice((1, 3, 10))):
        size = chance.choice((2, 4, 8))
        if len(changed) > size:
            at = int(len(changed) * chance.random() ** 3)
            at = min(at - at % 4, len(changed) - size)
            value = chance.choice(
                (0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1) - 1, 2 ** (8 * size - 1), 2 ** (8 * size - 2))
            )
            changed[at : at + size] = value.to_bytes(size, "little")
    return bytes(changed)


def _moved(chance: random.Random, whole: bytes) -> bytes:
    """A piece that is repeated, taken away, or filled with zeros."""
    a, b = sorted(chance.randrange(len(whole) + 1) for _ in range(2))
    b = min(b, a + chance.choice((4, 64, 4096)))
    middle = chance.choice((b"", whole[a:b] * chance.choice((2, 50)), bytes(b - a)))
    return whole[:a] + middle + whole[b:]


NUMBERS = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"-1e308", b"1e-308", b"2147483647", b"2147483648", b"-2147483649",
    b"18446744073709551616", b"9" * 400, b"0x7fffffff", b"1e999", b"", b"--1", b"1_0", b"true", b'"text"', b"[]", b"{}",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


def _numbers(chance: random.Random, whole: bytes) -> bytes:
    """Numbers in a text that are none, or beyond reason."""
    found = list(_NUMBER.finditer(whole[:200_000]))
    for match in sorted(chance.sample(found, min(len(found), chance.choice((1, 1, 3, 20)))), key=lambda m: -m.start()):
        whole = whole[: match.start()] + chance.choice(NUMBERS) + whole[match.end() :]
    return whole


def _words(chance: random.Random, whole: bytes) -> bytes:
    """Words of a text that are exchanged for one another."""
    found = list(re.finditer(rb"[A-Za-z_]\w+", whole[:200_000]))
    if len(found) > 1:
        for _ in range(chance.choice((1, 2, 8))):
            one, other = chance.choice(found), chance.choice(found)
            whole = whole[: one.start()] + other[0] + whole[one.end() :]
            found = list(re.finditer(rb"[A-Za-z_]\w+", whole[:200_000]))
    return whole


def _lines(chance: random.Random, whole: bytes) -> bytes:
    """Lines of a text in another order, repeated, or without their end."""
    lines = whole.split(b"\n")
    for _ in range(chance.choice((1, 3))):
        at, to = chance.randrange(len(lines)), chance.randrange(len(lines))
        lines[at] = chance.choice((lines[to], lines[at] + b" " + lines[to], b"", lines[at][:10_000] * 200))
    return b"\n".join(lines)


def _other(chance: random.Random, whole: bytes) -> bytes:
    """The bytes of another kind of file."""
    return chance.choice((b"", b"\0" * 5000, bytes(chance.randbytes(3000)), picture("PNG"), usda(), glb(), npy(CUBE)))


def _tail(chance: random.Random, whole: bytes) -> bytes:
    return whole + chance.choice((whole, b"\0" * 1000, chance.randbytes(1000), b"\n" * 100_000, b"(" * 10_000))


def _values(chance: random.Random, whole: bytes) -> bytes:
    """Valid JSON with values that are missing or of another kind; other files stay."""
    try:
        root = json.loads(whole)
    except ValueError:
        return whole
    inner, found = [root], []
    while inner:
        node = inner.pop()
        children = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in children:
            found.append((node, key))
            if isinstance(value, dict | list):
                inner.append(value)
    others = (
        None,
        True,
        -1,
        0,
        1e308,
        math.nan,
        10**400,
        "",
        "text",
        "../..",
        "\udc80",
        [],
        [[]],
        {},
        [None],
        {"": {}},
    )
    for node, key in chance.sample(found, min(len(found), chance.choice((1, 1, 3, 20)))):
        if isinstance(node, dict) and chance.random() < 0.3:
            node.pop(key, None)
        else:
            node[key] = chance.choice(others)
    return json.dumps(root).encode()


def _members(chance: random.Random, whole: bytes) -> bytes:
    """Archives with members that are missing or hold other arrays; other files stay."""
    try:
        with zipfile.ZipFile(io.BytesIO(whole)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, zlib.error):
        return whole
    for name in chance.sample(sorted(members), min(len(members), chance.choice((1, 1, 2, 5)))):
        shapes = ((), (0,), (1,), (3,), (2, 3), (4, 4), (1, 1, 1))
        others = [np.full(chance.choice(shapes), value) for value in (0.0, math.nan, math.inf, 1e308, -1, True, "a")]
        content = chance.choice((None, b"", b"hello", *map(npy, others)))
        if name == "header.npy" and members[name].startswith(b"\x93NUMPY"):  # of a clip
            header = str(np.load(io.BytesIO(members[name]), allow_pickle=False))
            content = npy(np.array(_values(chance, header.encode()).decode()))
        if content is None:
            del members[name]
        else:
            members[name] = content
    return zipped(members)


DAMAGES: dict[str, Callable[[random.Random, bytes], bytes]] = {
    "cut": _cut,
    "changed": _changed,
    "flipped": _flipped,
    "whole numbers": _whole_numbers,
    "moved": _moved,
    "numbers": _numbers,
    "words": _words,
    "lines": _lines,
    "other": _other,
    "tail": _tail,
    "values": _values,
    "members": _members,
    "none": lambda chance, whole: whole,
}


# ---------------------------------------------------------------- whole files


@cache
def picture(kind: str, mode: str = "RGB", size: tuple[int, int] = (40, 30)) -> bytes:
    from PIL import Image

    values = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    image = Image.fromarray(values)
    if mode in ("L", "F"):
        image = image.convert(mode)
    elif mode == "I;16":
        image = Image.fromarray(values[..., 0].astype(np.uint16) * 200)
    buffer = io.BytesIO()
    image.save(buffer, kind)
    return buffer.getvalue()


@cache
def usdc(text: bytes) -> bytes:
    """A text layer as a binary one."""
    import tempfile

    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(text.decode())
    with tempfile.TemporaryDirectory() as folder:
        layer.Export(f"{folder}/a.usdc")
        return Path(folder, "a.usdc").read_bytes()


TEXTURED = b"""#usda 1.0
(
    defaultPrim = "rig"
    startTimeCode = 1001
    endTimeCode = 1004
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "rig"
{
    double3 xformOp:translate.timeSamples = { 1001: (0, 0, 0), 1004: (1, 0, 0), }
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "mesh" (
        prepend apiSchemas = ["MaterialBindingAPI", "PhysicsCollisionAPI"]
    )
    {
        rel material:binding = </rig/look>
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
        point3f[] points = [(0,0,0), (0,0,1), (0,1,0), (0,1,1), (1,0,0), (1,0,1), (1,1,0), (1,1,1)]
        normal3f[] normals = [(0,0,1)] (
            interpolation = "constant"
        )
        texCoord2f[] primvars:st = [(0,0), (0,1), (1,0), (1,1), (0,0), (0,1), (1,0), (1,1)] (
            interpolation = "vertex"
        )
        uniform token subdivisionScheme = "none"
    }
    def Material "look"
    {
        token outputs:surface.connect = </rig/look/s.outputs:surface>
        def Shader "s"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </rig/look/t.outputs:rgb>
            token outputs:surface
        }
        def Shader "t"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./texture.png@
            float3 outputs:rgb
        }
    }
    def Camera "camera"
    {
        float2 clippingRange = (0.1, 100)
        double3 xformOp:translate = (0.5, 0.5, 8)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def DomeLight "sky"
    {
        asset inputs:texture:file = @./texture.png@
    }
}
"""

EDIT = b"""#usda 1.0
(
    defaultPrim = "car"
    endTimeCode = 1025
    metersPerUnit = 1
    startTimeCode = 1001
    timeCodesPerSecond = 24
    upAxis = "Z"
)
def Xform "car"
{
    double3 xformOp:translate.timeSamples = { 1001: (0, 0, 0), 1013: (1, 0.02, 0), 1025: (2, 0, 0), }
    double3 xformOp:rotateXYZ.timeSamples = { 1001: (0, 0, 0), 1013: (0, 0, 0.5), 1025: (0, 0, 0), }
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
}
"""


@cache
def delivery(shot: str = GOOD) -> dict[str, bytes]:
    """The files of a delivery of a shot, as the command writes them."""
    import tempfile

    from vehsim import Shot

    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "good.toml").write_text(shot)
        made = Shot.load(Path(folder, "good.toml")).solve().export(Path(folder, "out"), to=("usd", "npz"))
        return {str(file.relative_to(made)): file.read_bytes() for file in made.rglob("*") if file.is_file()}


def stage_of(case: Case) -> tuple[str, bytes]:
    """Suffix and content of a whole stage, from here or from the repository."""
    pick = case.chance.randrange(8)
    if pick == 0:
        return ".usda", usda(CUBE * 50)
    if pick == 1:
        return ".usdc", usdc(usda(CUBE * 50))
    if pick == 2:
        return ".usda", TEXTURED
    if pick == 3:
        return ".usdc", usdc(TEXTURED)
    if pick == 4:
        return ".usdz", zipped({"a.usda": TEXTURED, "texture.png": picture("PNG")}, align=64)
    if pick == 5:
        return ".usd", case.chance.choice((usda(), usdc(usda())))
    file = case.chance.choice(
        (ELSEWHERE / "crawler/crawler.usdc", ELSEWHERE / "pickup/wheel.usdc", VEHICLES / "car/car.usdc")
    )
    return ".usdc", file.read_bytes()


# ---------------------------------------------------------------- built by rule


def _strange_stage(case: Case) -> str:
    """Layers that are whole, and whose content is beyond reason."""
    chance = case.chance
    many = chance.choice((100, 3000, 60_000))
    instances = 'class "c0"\n{\n    def Mesh "m"\n    {\n    }\n}\n' + "".join(
        f'class "c{k}"\n{{\n'
        + "".join(
            f'    def "i{j}" (\n        instanceable = true\n        inherits = </c{k - 1}>\n    )\n    {{\n    }}\n'
            for j in range(6)
        )
        + "}\n"
        for k in range(1, chance.choice((4, 12, 30)))
    )
    nested = chance.choice((50, 500, 5000))
    texts = {
        "itself": 'def "rig" (\n    references = @./it.usda@\n)\n{\n}\n',
        "sublayer": '(\n    subLayers = [@./it.usda@, @./gone.usda@]\n)\ndef "rig"\n{\n}\n',
        "inherits itself": 'def "rig" (\n    inherits = </rig/a>\n)\n{\n    def "a" (\n'
        "        inherits = </rig>\n    )\n"
        "    {\n    }\n}\n",
        "outside": 'def Xform "rig" (\n    references = @../../../../../etc/passwd@\n)\n{\n'
        "    asset a = @/etc/hostname@\n}\n",
        "device": 'def Xform "rig" (\n    payload = @/dev/zero@\n)\n{\n    asset a = @/dev/random@\n}\n',
        "scheme": 'def Xform "rig" (\n    references = @http://localhost:1/a.usd@\n)\n{\n    asset a = @file:///etc/passwd@\n}\n',
        "deep": "".join(f'def Xform "a{k}"\n{{\n' for k in range(nested)) + "}\n" * nested,
        "many": 'def Xform "rig"\n{\n'
        + "".join(f'    def Xform "p{k}"\n    {{\n    }}\n' for k in range(many))
        + "}\n",
        "instances": f'{instances}def Xform "rig" (\n    inherits = </c3>\n)\n{{\n}}\n',
        "samples": 'def Xform "rig"\n{\n    double xformOp:rotateX.timeSamples = {'
        + ", ".join(f"{k}: {k}" for k in range(many))
        + '}\n    uniform token[] xformOpOrder = ["xformOp:rotateX", "xformOp:gone", "!invert!xformOp:rotateX"]\n}\n',
        "types": 'def Mesh "rig"\n{\n    string points = "a"\n    float faceVertexCounts = 3\n'
        '    token visibility = "sideways"\n'
        '    token purpose = "none"\n    rel material:binding = </rig.points>\n}\n',
        "singular": 'def Xform "rig"\n{\n    matrix4d xformOp:transform = ((0,0,0,0),(0,0,0,0),(0,0,0,0),(0,0,0,0))\n'
        '    uniform token[] xformOpOrder = ["xformOp:transform"]\n    def Mesh "m"\n    {\n'
        "        point3f[] points = [(0,0,0),(1,0,0),(0,1,0)]\n"
        "        int[] faceVertexCounts = [3]\n        int[] faceVertexIndices = [0, 1, 2]\n    }\n}\n",
        "polygon": 'def Mesh "rig"\n{\n    point3f[] points = [(0,0,0),(1,0,0),(0,1,0)]\n'
        "    int[] faceVertexCounts = [0, 1, 2, -3, 2147483647]\n"
        "    int[] faceVertexIndices = [0, 1, 2]\n    int[] holeIndices = [-1, 99]\n}\n",
        "timing": "(\n    startTimeCode = nan\n    endTimeCode = 1e300\n    timeCodesPerSecond = 0\n"
        "    framesPerSecond = -1\n"
        ')\ndef Xform "rig"\n{\n}\n',
        "relocates": 'def "rig" (\n    variantSets = ["v"]\n    variants = {\n        string v = "none"\n    }\n)\n'
        '{\n    variantSet "v" = {\n    }\n}\n',
        "unicode": 'def Xform "rig"\n{\n    def Mesh "Ünïcode_名前"\n    {\n    }\n    string s = "'
        + "\\u0000\\xff"
        + '"\n}\n',
    }
    choice = chance.choice(list(texts))
    case.words.append(choice)
    text = texts[choice]
    if not text.startswith("("):
        text = '(\n    defaultPrim = "rig"\n    metersPerUnit = 1\n    upAxis = "Z"\n)\n' + text
    return f"#usda 1.0\n{text}"


def _strange_array(case: Case) -> tuple[str, bytes]:
    """Archives that unpack to far more than they are, and headers that lie."""
    chance, heights = case.chance, np.zeros((3, 3))
    zeros = npy(np.zeros((4000, 4000))) if chance.random() < 0.5 else npy(np.zeros((1000, 1000, 3)))
    vast = chance.choice(
        (b"(9999999, 99)", b"(-3, -3)", b"(3,)", b"(True, 3)", b"(3.5, 3)", b"(99999999999999999999,)")
    )
    choices = {
        "bomb": lambda: (".npz", zipped({"heights.npy": zeros}, deflated=True)),
        "vast": lambda: (".npy", npy(heights).replace(b"(3, 3)", vast)),
        "vast in zip": lambda: (".npz", zipped({"heights.npy": npy(heights).replace(b"(3, 3)", vast)})),
        "twice": lambda: (
            ".npz",
            zipped({"heights.npy": npy(heights), "heights": b"x", "../heights.npy": npy(heights)}),
        ),
        "text": lambda: (".npy", npy(np.array([["a", "b"], ["c", "d"]]))),
        "complex": lambda: (".npy", npy(np.ones((3, 3)) * 1j)),
        "times": lambda: (".npy", npy(np.zeros((3, 3), "datetime64[s]"))),
        "record": lambda: (".npy", npy(np.zeros((3, 3), [("a", "f8")]))),
        "not finite": lambda: (".npy", npy(heights * np.nan)),
        "booleans": lambda: (".npy", npy(heights > 0)),
        "depth": lambda: (".npy", npy(np.zeros((1,) * 30))),
        "none": lambda: (".npy", npy(np.zeros((0, 3)))),
        "cell": lambda: (
            ".npz",
            zipped(
                {"heights.npy": npy(np.eye(9)), "cell.npy": npy(np.zeros((4, 4))), "origin.npy": npy(np.array(np.nan))}
            ),
        ),
    }
    choice = chance.choice(list(choices))
    case.words.append(choice)
    return choices[choice]()


def _strange_gltf(case: Case) -> tuple[str, bytes]:
    """Scenes that refer to themselves, to other files, or to numbers that are not there."""
    chance = case.chance
    scene = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "name": "it"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": 400, "uri": "it.bin"}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 96}, {"buffer": 0, "byteOffset": 96, "byteLength": 144}
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 36, "type": "SCALAR"},
        ],
    }  # fmt: skip
    uri = chance.choice(
        ("/etc/passwd", "../../../etc/hostname", "http://localhost:1/a", "data:,abc", "it.bin", "/dev/zero", ".")
    )
    choices: dict[str, Callable[[], object]] = {
        "cycle": lambda: scene.update(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}]),
        "itself": lambda: scene.update(nodes=[{"children": [0], "mesh": 0}]),
        "uri": lambda: scene["buffers"][0].update(uri=uri),
        "count": lambda: scene["accessors"][chance.randrange(2)].update(
            count=chance.choice((-1, 10**9, 2**40, 0, 1.5))
        ),
        "view": lambda: scene["bufferViews"][0].update(
            byteOffset=chance.choice((-5, 10**12)), byteStride=chance.choice((0, 3, 10**9))
        ),
        "image": lambda: scene.update(
            images=[{"uri": uri}],
            textures=[{"source": 0}],
            materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        ),
        "deep": lambda: scene.update(extras=json.loads("[" * 900 + "]" * 900)),
        "many": lambda: scene.update(
            nodes=[{"mesh": 0, "children": [k + 1]} for k in range(chance.choice((500, 5000)))] + [{"mesh": 0}]
        ),
        "matrix": lambda: scene["nodes"][0].update(matrix=[chance.choice((0, 1e308, "a"))] * 16),
        "names": lambda: scene["nodes"][0].update(
            name=chance.choice(("", "../../a", "a/b", "\n", "x" * 10**5, "{}", "0"))
        ),
    }
    choice = chance.choice(list(choices))
    case.words.append(choice)
    choices[choice]()
    case.write("it.bin", CUBE.astype("<f4").tobytes() + FACES.astype("<u4").tobytes() + bytes(200))
    return ".gltf", json.dumps(scene).encode()


def _strange_text(case: Case) -> bytes:
    """TOML that is whole or almost, and beyond reason."""
    chance = case.chance
    count = chance.choice((100, 3000, 100_000))
    choices = {
        "tables": f"[{'.'.join('a' * count)}]\n",
        "arrays": f"a = {'[' * count}{']' * count}\n",
        "header": f"[{' ' * count}\n",
        "header of words": f"[{'a ' * count}\n",
        "key": f"{'a' * count} = 1\n",
        "keys": "".join(f"k{k} = {k}\n" for k in range(count)),
        "entries": "[[vehicle]]\n" * count,
        "comment": f"#{' x' * count}\n",
        "inline": f"a = {'{ b = ' * min(count, 3000)}1{' }' * min(count, 3000)}\n",
        "digits": f"a = {'9' * count}\nb = 0x{'f' * count}\nc = 1e{'9' * min(count, 3000)}\n",
        "text": f'a = "{chr(0x10FFFF) * count}"\n',
        "null": 'a = "\\u0000"\n[shot]\nname = "\\u0000/../x"\n',
        "quotes": f"a = {chr(34) * count}\n",
        "dates": "a = 1979-05-27T07:32:00Z\n[shot]\nschema = 1979-05-27\nname = 07:32:00\n",
        "names": '[shot]\nschema = 1\nname = "../../escape"\n[[vehicle]]\nname = ".."\nasset = "../.."\n',
        "folder": HEAD.format(name="bad")
        + DRIVE.format(asset=chance.choice((".", "/", "/dev/null", "bad.toml", "~", "a\\u0000b", "x" * 5000))),
    }
    choice = chance.choice(list(choices))
    case.words.append(choice)
    return choices[choice].encode("utf-8", "surrogatepass")


# ---------------------------------------------------------------- what a user does with them


def _mesh(case: Case) -> bytes | str:
    """A mesh file of some kind, broken: its name."""
    if case.chance.random() < 0.15:
        suffix, content = _strange_gltf(case)
        return case.write(f"it{suffix}", content)
    suffix = case.chance.choice([*WRITERS, ".usdc", ".usdz"])
    size = case.chance.choice((1.0, 50.0))
    if suffix == ".usdc":
        whole = usdc(usda(CUBE * size))
    elif suffix == ".usdz":
        whole = zipped({"a.usdc": usdc(usda(CUBE * size))}, align=64)
    else:
        whole = WRITERS[suffix](CUBE * size)
    if suffix == ".obj":
        whole = b"mtllib " + case.chance.choice((b"it.mtl", b"../../../etc/passwd", b"/dev/zero", b".")) + b"\n" + whole
    return case.write(f"it{suffix}", broken(case, whole))


def terrain_mesh(case: Case) -> None:
    case.shot(f'[world]\nterrain = "{_mesh(case)}"\n')


def obstacle(case: Case) -> None:
    case.shot(f'[[world.obstacle]]\nshape = "mesh"\npath = "{_mesh(case)}"\n')


def heights(case: Case) -> None:
    """Height maps: arrays and pictures, some with a placement beside them."""
    chance = case.chance
    pick = chance.randrange(5)
    if pick == 0:
        suffix, content = _strange_array(case)
    elif pick == 1:
        whole = zipped({"heights.npy": npy(np.eye(20)), "cell.npy": npy(np.ones(2)), "origin.npy": npy(np.ones(2))})
        suffix, content = ".npz", broken(case, whole)
    elif pick == 2:
        suffix, content = ".npy", broken(case, npy(np.eye(20)))
    elif pick == 3:
        suffix, content = ".png", broken(case, picture("PNG", chance.choice(("L", "I;16", "RGB"))))
    else:
        suffix, content = (
            chance.choice((".tif", ".tiff")),
            broken(case, picture("TIFF", chance.choice(("F", "I;16", "L")))),
        )
    name = case.write(f"it{suffix}", content)
    if chance.random() < 0.5:
        case.write("it.toml", "cell = 2.0\nrange = [0, 10]\n")
    if chance.random() < 0.2:
        case.command = ["height", "0", "0", "--terrain", name]
        return
    case.shot(f'[world]\nterrain = "{name}"\n')


def water(case: Case) -> None:
    arrays = {"times": np.arange(4.0), "heights": np.zeros((4, 5, 5)), "origin": np.zeros(2), "cell": np.ones(2)}
    if case.chance.random() < 0.4:
        name = case.chance.choice(list(arrays))
        arrays[name] = case.chance.choice(
            (np.zeros(()), np.full((4, 5, 5), np.nan), np.zeros((2, 2)), arrays[name][:1])
        )
    whole = zipped({f"{name}.npy": npy(array) for name, array in arrays.items()})
    case.write("it.npz", broken(case, whole))
    boat = '[[vehicle]]\nname = "boat"\nasset = "boat"\n[vehicle.motion]\nmethod = "simulate"\nduration = 0.1\n'
    case.shot(text=HEAD.format(name="bad") + boat + '[world.water]\nlevel = 0\ngrids = "it.npz"\n')


def stage(case: Case) -> None:
    """Stages that are looked at: validated, inspected, rendered, or used as terrain, blocking or look."""
    chance = case.chance
    if chance.random() < 0.3:
        name = case.write("it.usda", _strange_stage(case))
    else:
        suffix, whole = stage_of(case)
        name = case.write(f"it{suffix}", broken(case, whole))
    case.write("texture.png", broken(case, picture("PNG")) if chance.random() < 0.3 else picture("PNG"))
    use = chance.choice(("validate", "inspect", "render", "terrain", "blocking", "look", "obstacle"))
    case.words.append(use)
    if use == "validate":
        case.command = ["validate", name, *([case.write("whole.usda", usda())] if chance.random() < 0.2 else [])]
    elif use == "inspect":
        case.command = ["inspect", name]
    elif use == "render":
        case.command = ["render", name, "--out", "out", "--size", "32x32", "--quality", "draft"]
        case.command += ["--frames", "1001"] if chance.random() < 0.5 else []
    elif use == "terrain":
        case.shot(f'[world]\nterrain = "{name}"\n')
    elif use == "obstacle":
        case.shot(f'[[world.obstacle]]\nshape = "mesh"\npath = "{name}"\n')
    elif use == "blocking":
        motion = f'method = "plan"\nblocking = {{ usd = "{name}", prim = "/rig" }}\n'
        case.shot(
            text=HEAD.format(name="bad") + f'[[vehicle]]\nname = "car"\nasset = "car"\n[vehicle.motion]\n{motion}'
        )
        case.command, case.good = ["check", "bad.toml"], False
    else:
        case.write("place/terrain.toml", f'schema = 1\nheights = "h.npy"\nlook = "../{name}"\ncell = 1.0\n')
        case.write("place/h.npy", npy(np.zeros((30, 30))))
        case.shot('[world]\nterrain = "place"\n')


def vehicle(case: Case) -> None:
    """A rigger's vehicle with a broken asset or a broken vehicle.toml."""
    chance = case.chance
    home = chance.choice([*sorted(ELSEWHERE.glob("*/vehicle.toml")), VEHICLES / "car/vehicle.toml"]).parent
    shutil.copytree(home, case.folder / "rig")
    files = sorted((case.folder / "rig").iterdir())
    file = chance.choice([each for each in files if each.suffix != ".toml"] if chance.random() < 0.6 else files)
    case.words.append(file.name)
    file.write_bytes(broken(case, file.read_bytes()))
    if chance.random() < 0.2:
        case.command = ["inspect", "rig" if chance.random() < 0.5 else str(file.relative_to(case.folder))]
        return
    case.shot(asset="rig")


def inspected(case: Case) -> None:
    case.command = ["inspect", str(_mesh(case))]
    if case.chance.random() < 0.3:
        case.command += ["--write", "out"]


def textured(case: Case) -> None:
    """A vehicle or a stage whose texture is broken, drawn."""
    chance = case.chance
    kind, suffix = chance.choice((("PNG", ".png"), ("JPEG", ".jpg"), ("TIFF", ".tif"), ("BMP", ".exr")))
    whole = picture(kind)
    if chance.random() < 0.2:  # announces a picture of 2 billion pixels
        case.words.append("vast")
        whole = picture("PNG")[:16] + (50_000).to_bytes(4, "big") * 2 + picture("PNG")[24:]
    case.write(f"texture{suffix}", broken(case, whole))
    text = TEXTURED.replace(b"texture.png", f"texture{suffix}".encode())
    case.write("it.usda", text)
    case.command = ["render", "it.usda", "--out", "out", "--size", "32x32", "--quality", "draft", "--frames", "1001"]
    if chance.random() < 0.3:
        content = (case.folder / f"texture{suffix}").read_bytes()
        case.write("it.usdz", zipped({"a.usda": text, f"texture{suffix}": content}, align=64))
        case.command[1] = "it.usdz"


def shot_file(case: Case) -> None:
    """Shot files: examples that are broken, and texts beyond reason."""
    if case.chance.random() < 0.35:
        case.shot(text=_strange_text(case).decode("utf-8", "replace"))
    else:
        whole = case.chance.choice(sorted(EXAMPLES.glob("*.toml"))).read_bytes()
        case.write("bad.toml", broken(case, whole))
    case.command, case.good = ["check", "bad.toml"], False
    if case.chance.random() < 0.3:
        case.write("good.toml", GOOD)
        case.command = ["check", "bad.toml", "good.toml"]


def vehicle_file(case: Case) -> None:
    shutil.copytree(ELSEWHERE / "crawler", case.folder / "rig")
    case.write("rig/vehicle.toml", _strange_text(case))
    case.shot(asset="rig")


def terrain_file(case: Case) -> None:
    whole = b'schema = 1\nname = "it"\nheights = "h.npy"\nlook = "it.usda"\ncell = [1.0, 2.0]\n'
    whole += b"origin = [0.0, 0.0]\nrange = [0, 1]\n"
    case.write("place/terrain.toml", broken(case, whole) if case.chance.random() < 0.7 else _strange_text(case))
    case.write("place/h.npy", npy(np.zeros((30, 30))))
    case.write("place/it.usda", usda(CUBE * 20))
    case.shot('[world]\nterrain = "place"\n')


def _delivery_with_a_broken_file(case: Case, shot: str = GOOD) -> None:
    """Half of the time it is the report or the motion, with wrong content in a whole file."""
    files = delivery(shot)
    wrong, damage = case.chance.choice(sorted(files)), broken
    if case.chance.random() < 0.5:
        wrong, by = case.chance.choice((("report.json", _values), ("car.npz", _members)))
        case.words.append(by.__name__)
        damage = lambda case, whole: by(case.chance, whole)
    case.words.append(wrong)
    for name, content in files.items():
        case.write(f"good/{name}", damage(case, content) if name == wrong else content)


def delivered(case: Case) -> None:
    """A delivery with a broken file in it: audited, rendered, validated."""
    _delivery_with_a_broken_file(case)
    use = case.chance.choice(("audit", "audit", "audit", "render", "validate"))
    case.words.append(use)
    case.command = {
        "audit": ["audit", "good"],
        "render": [
            "render",
            "good/good.usda",
            "--out",
            "out",
            "--size",
            "32x32",
            "--frames",
            "1001",
            "--quality",
            "draft",
        ],
        "validate": ["validate", "good/good.usda"],
    }[use]


def clip_file(case: Case) -> None:
    case.write("it.npz", broken(case, delivery()["car.npz"]))
    motion = '[[vehicle]]\nname = "car"\nasset = "car"\n[vehicle.motion]\nmethod = "clip"\npath = "it.npz"\n'
    case.shot(text=HEAD.format(name="bad") + motion)


def reviewed(case: Case) -> None:
    """A broken delivery, clip or shot, whose motion is reviewed."""
    use = case.chance.choice(("delivery", "clip", "shot"))
    case.words.append(use)
    if use == "delivery":
        _delivery_with_a_broken_file(case)
        case.command = ["review", "good", "--out", "out"]
    else:
        if use == "clip":
            clip_file(case)
            case.write("it.npz", _members(case.chance, delivery()["car.npz"]))
        else:
            case.write("bad.toml", _numbers(case.chance, GOOD.encode()))
        case.command, case.good = ["review", "bad.toml", "--out", "out"], False


def retouched(case: Case) -> None:
    """A delivery, at times with a broken file, and broken edits of its curves."""
    chance = case.chance
    if chance.random() < 0.4:
        _delivery_with_a_broken_file(case, MOVES)
    else:
        for name, content in delivery(MOVES).items():
            case.write(f"good/{name}", content)
    layer = next(name for name in delivery(MOVES) if name.endswith(".anim.usdc"))
    use = chance.choice(("layer", "layer", "curves", "strange", "stage"))
    case.words.append(use)
    if use == "layer":
        edit = case.write("edit.usdc", broken(case, delivery(MOVES)[layer]))
    elif use == "curves":
        edit = case.write("edit.usda", case.chance.choice((_numbers, _words))(chance, EDIT))
    elif use == "strange":
        edit = case.write("it.usda", _strange_stage(case))
    else:
        suffix, whole = stage_of(case)
        edit = case.write(f"edit{suffix}", broken(case, whole))
    case.command = ["retouch", "good", "--edit", edit, "--out", "out", "--to", chance.choice(("usd", "npz"))]


def hydro(case: Case) -> None:
    """A broken hull, or one of a broken vehicle, and strange masses."""
    chance = case.chance
    if chance.random() < 0.3:
        vehicle(case)
        hull = "rig"
    else:
        hull = str(_mesh(case))
    case.command, case.good = ["hydro", hull, "--out", "out/hull.hydro.npz"], False
    if chance.random() < 0.7:
        case.command += ["--mass", chance.choice(("1", "500", "1e5", "1e308", "nan", "inf", "0", "-1", "text"))]
    if chance.random() < 0.5:
        case.command += ["--origin", "0", "0", chance.choice(("0", "-0.2", "1e9", "nan", "inf"))]


def manoeuvres(case: Case) -> None:
    """Broken shots that are steered by sinusoids."""
    whole = case.chance.choice([f for f in sorted(EXAMPLES.glob("*.toml")) if b"sinusoid" in f.read_bytes()])
    damage = case.chance.choice((_numbers, _numbers, _words, _lines))
    case.write("bad.toml", damage(case.chance, whole.read_bytes()))
    case.command = ["manoeuvres", "bad.toml", "--out", "out"]


def new(case: Case) -> None:
    """A new shot with a strange name, a broken vehicle or a broken terrain."""
    chance = case.chance
    (case.folder / "out").mkdir(parents=True)
    name = chance.choice(
        ("it", "it", "ünï", "a b", "", ".", "..", "\n", "x" * 5000, "-x", "a.b.c", "{}", '"', "it/", "\udc80")
    )
    asset, terrain = chance.choice(("car", "helicopter", "gone", ".")), chance.choice(("flat", "hills", "gone", "."))
    if chance.random() < 0.4:
        vehicle(case)
        asset = "rig"
    elif chance.random() < 0.5:
        terrain = str(_mesh(case))
    case.command, case.good = ["new", f"out/{name}", "--vehicle", asset, "--terrain", terrain], False
    if chance.random() < 0.5:
        case.command += ["--method", chance.choice(("plan", "simulate", "sinusoid", "integrate", "clip", "x"))]


def compared(case: Case) -> None:
    """Pictures of every pass against references."""
    chance = case.chance
    names = {
        "a.1.png": ("PNG", "RGB"),
        "depth/a.depth.1.tif": ("TIFF", "F"),
        "segmentation/a.segmentation.1.png": ("PNG", "RGB"),
    }
    wrong = chance.choice(list(names))
    for name, (kind, mode) in names.items():
        whole = picture(kind, mode)
        case.write(f"references/{name}", picture(kind, mode, chance.choice(((40, 30), (40, 30), (20, 30)))))
        case.write(f"renders/{name}", broken(case, whole) if name == wrong else whole)
    if chance.random() < 0.5:
        case.write(
            "renders/segmentation/legend.json",
            chance.choice(("", "[]", "{", '{"a": 1}', '{"#000000": "/a"}', "null", "[" * 3000)),
        )
    case.command = ["compare", "renders", "references", *(["--out", "out"] if chance.random() < 0.5 else [])]


def places(case: Case) -> None:
    """What stands where a file should: folders, links, pipes, devices."""
    suffix = case.chance.choice((".usda", ".obj", ".npz", ".png", ".glb", ".toml", ".usdz"))
    name, path = f"it{suffix}", case.folder / f"it{suffix}"
    what = case.chance.choice(("folder", "loop", "gone", "pipe", "device", "secret"))
    case.words += [what, suffix]
    if what == "folder":
        path.mkdir()
    elif what == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to({"loop": name, "gone": "nowhere", "device": "/dev/zero", "secret": "/etc/shadow"}[what])
    use = case.chance.choice(("terrain", "obstacle", "validate", "inspect", "render", "check", "asset"))
    if use == "terrain":
        case.shot(f'[world]\nterrain = "{name}"\n')
    elif use == "obstacle":
        case.shot(f'[[world.obstacle]]\nshape = "mesh"\npath = "{name}"\n')
    elif use == "asset":
        case.shot(asset=name)
    else:
        case.command = [use, name, *(["--out", "out"] if use == "render" else [])]


KINDS: dict[str, tuple[int, Callable[[Case], None]]] = {
    "terrain mesh": (10, terrain_mesh),
    "obstacle": (8, obstacle),
    "heights": (8, heights),
    "water": (3, water),
    "stage": (24, stage),
    "vehicle": (14, vehicle),
    "inspected": (6, inspected),
    "textured": (4, textured),
    "shot": (10, shot_file),
    "vehicle file": (2, vehicle_file),
    "terrain file": (3, terrain_file),
    "delivery": (6, delivered),
    "clip": (3, clip_file),
    "compare": (2, compared),
    "places": (2, places),
    "review": (2, reviewed),
    "retouch": (3, retouched),
    "hydro": (2, hydro),
    "manoeuvres": (2, manoeuvres),
    "new": (2, new),
}
"""Kinds of cases and their shares."""
