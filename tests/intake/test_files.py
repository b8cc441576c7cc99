"""Broken files are refused with file, key and remedy; accepted data is plain, finite and consistent."""

from __future__ import annotations

import json
import os
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tools.hostile_files.writers import CUBE, FACES, WRITERS, glb, usda, written, wrong_arrays, wrong_meshes
from vehsim.errors import InputError, ShotError
from vehsim.intake.arrays import read_array, read_arrays
from vehsim.intake.foreign import reason_of
from vehsim.intake.meshes import read_triangles
from vehsim.intake.toml import lines_of, read_toml
from vehsim.intake.usd import dependencies
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.water.grids import KEYS, WaterGrids

pytestmark = [pytest.mark.broken_stages, pytest.mark.filterwarnings("ignore")]


def says_what_to_do(error: InputError, path: Path) -> bool:
    text = str(error)
    return path.name in text and "; " in text and "unexpected" not in text


@pytest.mark.parametrize("suffix", WRITERS)
def test_whole_meshes_are_read(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"cube{suffix}").write_bytes(WRITERS[suffix]())
    points, faces = read_triangles(tmp_path / f"cube{suffix}")
    assert sorted(np.ptp(points, axis=0)) == pytest.approx([1, 1, 1])
    assert faces.shape == FACES.shape


@pytest.mark.parametrize("read", [read_triangles, Terrain.load])
@pytest.mark.parametrize("seed", [1, 2])
def test_broken_meshes_are_refused_or_read_as_valid_arrays(tmp_path: Path, read: object, seed: int) -> None:
    refused = 0
    for path in written(tmp_path, wrong_meshes(seed)):
        try:
            found = read(path)
        except InputError as error:
            assert says_what_to_do(error, path), error
            refused += 1
            continue
        points, faces = found if isinstance(found, tuple) else (found.vertices, found.faces)
        assert np.isfinite(points).all() and faces.min() >= 0 and faces.max() < len(points)
        assert not path.name.startswith(("index", "point", "empty", "no_faces")), path
    assert refused > 50


def gltf(path: Path, nodes: list[dict[str, object]]) -> Path:
    """A glTF file of nodes below the first one; its only mesh is the cube of `glb`."""
    binary = glb()
    length = int.from_bytes(binary[12:16], "little")
    scene = json.loads(binary[20 : 20 + length]) | {"nodes": nodes, "scenes": [{"nodes": [0]}], "scene": 0}
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    rest = binary[20 + length :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    path.write_bytes(head + text + rest)
    return path


def chain(depth: int, **more: object) -> list[dict[str, object]]:
    return [{"children": [k + 1], **more} for k in range(depth - 1)] + [{"mesh": 0}]


def test_nodes_of_a_gltf_are_placed_by_all_nodes_above_them(tmp_path: Path) -> None:
    half = float(np.sqrt(0.5))
    nodes = [
        {"children": [1, 3], "translation": [1, 2, 3], "mesh": 0},
        {"children": [2], "rotation": [0, half, 0, half]},
        {"mesh": 0, "scale": [1, -2, 1], "translation": [0, 0, 5]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 2, 0, 0, 0, 0, 3, 0, 7, 8, 9, 1]},
    ]
    points, faces = read_triangles(gltf(tmp_path / "a.glb", nodes))
    expected = trimesh.load_scene(tmp_path / "a.glb", process=False).to_mesh().triangles[..., [0, 2, 1]] * [1, -1, 1]
    found = points[faces]
    assert len(found) == 3 * len(FACES)
    in_order = [np.array(sorted(each.reshape(-1, 9).round(3).tolist())) for each in (found, expected)]
    np.testing.assert_allclose(*in_order, atol=2e-3)


@pytest.mark.parametrize(
    ("nodes", "says"),
    [
        (chain(498), None),
        (chain(499), "nodes nested deeper than 498; group them in fewer levels"),
        (chain(20_000, mesh=0), "nodes nested deeper than 498"),
        ([{"children": [1, 1]}, {"mesh": 0}], "a node has two parents"),
        ([{"mesh": 0}, {"children": [2]}, {"children": [1]}], "nodes that are above themselves"),
        ([{"children": [1]}], "nodes name children that its 1 nodes do not have"),
        ([{"mesh": 0, "extras": "deep"}], "nested too deeply"),
        ([{"mesh": 0}] * 200_001, "more than 200,000 nodes; give a smaller file, or raise the limit"),
    ],
)
def test_nodes_of_a_gltf_that_are_no_tree_or_too_deep_are_refused(
    tmp_path: Path, nodes: list[dict[str, object]], says: str | None
) -> None:
    path = gltf(tmp_path / "a.glb", nodes)
    if says == "nested too deeply":
        path = path.with_suffix(".gltf")
        path.write_text(json.dumps({"nodes": nodes}).replace('"deep"', "[" * 50_000 + "]" * 50_000))
    if says is None:
        assert len(read_triangles(path)[1]) == len(FACES)
    else:
        with pytest.raises(InputError, match=f"{path.name}: mesh: {says}"):
            read_triangles(path)


@pytest.mark.parametrize(
    ("written", "says"),
    [
        (b"string points = 'a'", "of type string, not point3f"),
        (b"string[] points = ['a']", "of type string"),
        (b"points[] points = [1, 2]", "of type points"),
        (b"float2[] points = [(0, 0), (1, 0), (0, 1)]", "of type float2"),
        (b"point3f points = (0, 0, 0)", "of type point3f, not point3f"),
        (b"rel points = </rig>", "of type rel"),
        (b"float3[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]", None),
        (b"double3[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]", None),
    ],
)
def test_a_value_of_another_type_is_refused(tmp_path: Path, written: bytes, says: str | None) -> None:
    mesh = b"int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\n" + written.replace(b"'", b'"')
    head = b'#usda 1.0\n(\ndefaultPrim = "rig"\nmetersPerUnit = 1\nupAxis = "Z"\n)\ndef Mesh "rig"\n{\n'
    (tmp_path / "a.usda").write_bytes(head + mesh + b"\n}\n")
    if says is None:
        points, faces = read_triangles(tmp_path / "a.usda")
        assert points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]] and faces.tolist() == [[0, 1, 2]]
    else:
        with pytest.raises(InputError, match=rf"a.usda: /rig.points: {says}.*; export it again"):
            read_triangles(tmp_path / "a.usda")


@pytest.mark.parametrize("written", ["paint", "float", "color4f"])
def test_the_colour_of_a_shader_has_the_type_of_a_colour(tmp_path: Path, written: str) -> None:
    value = {"paint": "(1, 0, 0)", "float": "1", "color4f": "(1, 0, 0, 1)"}[written]
    shader = (
        f'def Shader "s"\n{{\nuniform token info:id = "UsdPreviewSurface"\n{written} inputs:diffuseColor = {value}\n}}'
    )
    (tmp_path / "a.usda").write_text(f'#usda 1.0\ndef Xform "rig"\n{{\n{shader}\n}}\n')
    with pytest.raises(
        InputError, match=rf"/rig/s.inputs:diffuseColor: of type {written}, not color3f; export it again"
    ):
        dependencies(tmp_path / "a.usda")


def test_a_skeleton_without_bounds_is_refused_where_it_is_read(tmp_path: Path) -> None:
    """USD raises an error of it in whatever process asks for the stage's bounds, such as `inspect` and exports."""
    joints = 'uniform token[] joints = ["a", "a/b"]\nuniform matrix4d[] restTransforms = []\n'
    head = '#usda 1.0\n(\ndefaultPrim = "rig"\nmetersPerUnit = 1\nupAxis = "Z"\n)\ndef Xform "rig"\n{\n'
    (tmp_path / "a.usda").write_text(f'{head}def Cube "c" {{}}\ndef Skeleton "s"\n{{\n{joints}}}\n}}\n')
    with pytest.raises(InputError, match=r"a.usda: asset: cannot be read \(.*'Skeleton' prim </rig/s>\); export"):
        dependencies(tmp_path / "a.usda")


def test_an_index_out_of_range_is_named(tmp_path: Path) -> None:
    """A terrain with such a mesh once crashed the process."""
    faces = FACES.copy()
    faces[2] = 10**8
    (tmp_path / "t.usda").write_bytes(usda(CUBE * 50, faces))
    with pytest.raises(InputError, match=r"t.usda: /rig/mesh: its faces do not fit its 8 points; export"):
        Terrain.load(tmp_path / "t.usda")


def test_a_stage_without_a_length_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t.usda").write_bytes(usda(head="    metersPerUnit = -1\n"))
    with pytest.raises(InputError, match=r"t.usda: metersPerUnit = -1.0: not a length; give metres"):
        read_triangles(tmp_path / "t.usda")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_broken_grids_are_refused(tmp_path: Path, seed: int) -> None:
    for path in written(tmp_path, wrong_arrays(("heights", "cell", "origin"), seed)):
        with pytest.raises(InputError) as refused:
            Terrain.load(path)
        assert says_what_to_do(refused.value, path)
    for path in written(tmp_path, wrong_arrays(KEYS, seed)):
        with pytest.raises(InputError) as refused:
            WaterGrids.load(path)
        assert says_what_to_do(refused.value, path), refused.value


def test_oversized_headers_take_no_memory(tmp_path: Path) -> None:
    np.save(tmp_path / "t.npy", np.zeros((4, 4)))
    (tmp_path / "t.npy").write_bytes((tmp_path / "t.npy").read_bytes().replace(b"(4, 4)", b"(9999, 99999)"))
    with pytest.raises(InputError, match=r"announces 7,999,120,008 bytes and holds [0-9]+;"):
        read_array(tmp_path / "t.npy", "heights")
    np.savez(tmp_path / "t.npz", heights=np.zeros(3))
    assert read_arrays(tmp_path / "t.npz", "heights", ("heights", "cell"))["heights"].shape == (3,)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (f"[{'.'.join('a' * 2000)}]", "nested too deeply"),
        (f"a = {'[' * 5000}{']' * 5000}", "nested too deeply"),
        (f"[b]\na = {'9' * 400}", "b.a: a whole number of more than 64 bits"),
        (f"a = {'9' * 9000}", "not TOML"),
        (f"a = 1\n\n{' . '.join(['b', *['c'] * 300_000])} = 1", "a key of more than 50 parts in line 3; nest"),
        (f"b = {{ {'.'.join(['c'] * 100_000)} = 1 }}", "a key of more than 50 parts in line 1; nest"),
        ("a = 1\n" * 1_000_000, "larger than 5 MB; give a smaller file"),
        ("a = ", "not TOML"),
        ("\udce4".encode("utf-8", "surrogateescape"), "not UTF-8"),
    ],
)
def test_excessive_tables_are_refused(tmp_path: Path, text: str | bytes, says: str) -> None:
    path = tmp_path / "t.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ShotError, match=says) as refused, warnings.catch_warnings():
        read_toml(path)
    assert says_what_to_do(refused.value, path)


def test_a_named_pipe_is_refused(tmp_path: Path) -> None:
    """Nothing writes to it, so that to read it would never end."""
    os.mkfifo(tmp_path / "shot.toml")
    with pytest.raises(ShotError, match=r"shot.toml: file: a named pipe; give the path of a TOML file"):
        read_toml(tmp_path / "shot.toml")


def test_a_device_without_an_end_is_refused(tmp_path: Path) -> None:
    """Its stated size is 0; read as a whole, it took all the memory of the machine."""
    (tmp_path / "t.toml").symlink_to("/dev/zero")
    with pytest.raises(ShotError, match="larger than 5 MB"):
        read_toml(tmp_path / "t.toml")


def test_lines_that_look_like_headers_take_no_time(tmp_path: Path) -> None:
    """The search for line numbers once took minutes for spaces in a text, and years for these lines."""
    text = f"""a = '''\n[{" " * 1_000_000}\n[[{"b " * 100_000}\n'''\n[ c . "d" ]\ne = 0.{"1" * 100_000}\n"""
    (tmp_path / "t.toml").write_text(text)
    data, content = read_toml(tmp_path / "t.toml")
    assert data["c"]["d"]["e"] == pytest.approx(1 / 9)
    assert lines_of(content)["c.d.e"] == 6


def test_foreign_clip_files_are_refused(tmp_path: Path) -> None:
    from vehsim.clip.clip import Clip

    np.savez(tmp_path / "c.npz", header=np.array('{"fps": "24"}'), twists=np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"c.npz: not a clip saved by vehsim"):
        Clip.load(tmp_path / "c.npz")
    for header in (
        "[]",
        "{}",
        '{"fps": [], "start_frame": 1, "events": [], "vehicle": "car", "folder": ""}',
        "nonsense",
    ):
        names = ("times", "positions", "orientations", "twists", "joints", "joint_rates", "controls")
        np.savez(tmp_path / "c.npz", header=np.array(header), **{name: np.zeros((3, 3)) for name in names})
        with pytest.raises(InputError, match=r"c.npz: not a clip saved by vehsim"):
            Clip.load(tmp_path / "c.npz")
    for path in written(tmp_path, wrong_arrays(("header", "twists"))):
        with pytest.raises(InputError):
            Clip.load(path)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ("cannot identify image file <_io.BytesIO object at 0x7fc6dd835530>", "cannot identify image file"),
        ("cannot identify image file '/a/b.png'", "cannot identify image file '/a/b.png'"),
        (
            "\n\tError in 'f' at line 5 in file /a.cpp : 'Used expired prim on stage with rootLayer @a@'",
            "Used expired prim",
        ),
    ],
)
def test_reasons_are_for_users(message: str, reason: str) -> None:
    assert reason_of(ValueError(message)) == reason


def test_usd_errors_are_given_without_source_locations(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_bytes(usda().replace(b"[3, 3", b"[3 3", 1))
    (tmp_path / "a.usdz").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(InputError) as refused:
        read_triangles(tmp_path / "a.usda")
    assert "faceVertexCounts" in str(refused.value) and " at line " not in str(refused.value)
    with pytest.raises(InputError, match=r"a.usdz: asset: (not readable|cannot be read)"):
        read_triangles(tmp_path / "a.usdz")
