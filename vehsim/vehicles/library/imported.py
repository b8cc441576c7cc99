"""Prepare a studio's asset: convert GLB and OBJ to USD, and place the asset in the rig root's frame.

A wrapper in the cache references the asset and converts it to metres, Z up, nose along +X, with its variants selected.
All code that reads a vehicle reads the wrapper; deliveries reference the studio's own file.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import unicodedata
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vehsim.errors import InputError
from vehsim.intake import gltf
from vehsim.intake.foreign import check_parts, reading
from vehsim.intake.reader import Answer, read_cached, read_in_process
from vehsim.intake.usd import SUFFIXES, open_stage
from vehsim.runtime.cache import SOURCE, cache_folder, is_whole, seal
from vehsim.runtime.files import making_folder, write_file

MESHES = (".glb", ".gltf", ".obj")
KEYS = {"up_axis", "meters_per_unit", "forward", "offset", "variants"}
"""Keys of a vehicle.toml that describe the orientation and units of the asset."""
FORWARD = {"+X": 0, "+Y": 1, "-X": 2, "-Y": 3, "+Z": 1, "-Z": 3}
"""Quarter turns counter-clockwise, seen from above, from world X to the asset's nose."""


def ready_asset(toml: Path, data: Mapping[str, Any]) -> tuple[Path, Path]:
    """``(asset, source)``: the file that vehsim reads, and the USD file that deliveries reference; often the same.

    Raises ``InputError`` naming file, key, value and the fix.
    """
    source, up, metres = _usd_file(toml, data)
    if not KEYS & set(data):
        return source, source
    up = _choice(toml, data, "up_axis", ("Y", "Z")) or up
    metres = _metres(toml, data, metres)
    offset = data.get("offset", [0.0, 0.0, 0.0])
    if not isinstance(offset, list) or len(offset) != 3 or not all(isinstance(x, int | float) for x in offset):
        raise InputError(
            "not an offset",
            "give three numbers, m, along the nose, to the left and up",
            key="offset",
            value=offset,
            file=toml,
        )
    turns = _quarter_turns(toml, data, up)
    variants = data.get("variants", {})
    ops: dict[str, Any] = {}
    if any(offset):
        ops["xformOp:translate:offset"] = [float(x) for x in offset]
    if turns:
        ops["xformOp:rotateZ:forward"] = -90.0 * turns
    if up == "Y":
        ops["xformOp:rotateX:assetUpAxis"] = 90.0
    if metres != 1.0:
        ops["xformOp:scale:assetUnits"] = [float(metres)] * 3
    named = toml.parent / str(data["asset"])
    return _wrapper(toml, source, str(data.get("root", "")), ops, variants, named), source


def _usd_file(toml: Path, data: Mapping[str, Any]) -> tuple[Path, str, float]:
    """The asset as USD, its up axis and metres per unit."""
    named = str(data["asset"])
    path = toml.parent / named
    if not path.is_file():
        from pxr import Ar

        resolved = str(Ar.GetResolver().Resolve(named))  # a studio's asset resolver may find it
        if not resolved or not Path(resolved).is_file():
            raise InputError(
                "no such file", "give a USD, GLB or OBJ file beside it", key="asset", value=named, file=toml
            )
        path = Path(resolved)
    if path.suffix.lower() in MESHES:
        if path.suffix.lower() == ".obj" and not {"up_axis", "meters_per_unit"} <= set(data):
            raise InputError(
                "an OBJ states neither up axis nor unit",
                "give up_axis and meters_per_unit",
                key="asset",
                value=named,
                file=toml,
            )
        up, metres = _choice(toml, data, "up_axis", ("Y", "Z")) or "Y", _metres(toml, data, 1.0)
        return _converted(path, up, metres), up, metres
    if path.suffix.lower() not in SUFFIXES:
        raise InputError("not USD, GLB or OBJ", "export it as one of them", key="asset", value=named, file=toml)
    if not KEYS & set(data):
        return path, "Z", 1.0  # readers take the up axis and unit from the file itself
    from pxr import UsdGeom

    stage = open_stage(path, load=False)
    return path, str(UsdGeom.GetStageUpAxis(stage)), UsdGeom.GetStageMetersPerUnit(stage)


def _choice(toml: Path, data: Mapping[str, Any], key: str, choices: tuple[str, ...]) -> Any:
    value = data.get(key)
    if value is not None and value not in choices:
        raise InputError("unknown", f"choose one of {', '.join(choices)}", key=key, value=value, file=toml)
    return value


def _metres(toml: Path, data: Mapping[str, Any], otherwise: float) -> float:
    metres = data.get("meters_per_unit", otherwise)
    if isinstance(metres, bool) or not isinstance(metres, int | float) or not 0 < metres < 1e6:
        raise InputError(
            "not a length", "give metres, such as 0.01 for centimetres", key="meters_per_unit", value=metres, file=toml
        )
    return float(metres)


def _quarter_turns(toml: Path, data: Mapping[str, Any], up: str) -> int:
    """Number of clockwise turns of 90 degrees that bring the asset's ``forward`` axis to world X."""
    axes = ("+X", "-X", "+Z", "-Z") if up == "Y" else ("+X", "-X", "+Y", "-Y")
    forward = _choice(toml, data, "forward", axes) or "+X"
    turns = FORWARD[forward]
    # after the asset is turned upright, +Z points along -Y
    return -turns if up == "Y" and forward.endswith("Z") else turns


def _wrapper(
    toml: Path, source: Path, root: str, ops: Mapping[str, Any], variants: Mapping[str, str], named: Path
) -> Path:
    """A layer in the cache, keyed by content, that references ``source`` and turns it upright; messages name
    ``named``."""
    inputs = {
        "source": str(source.resolve()),
        "named": str(named),
        "root": root,
        "ops": ops,
        "variants": variants,
        "made": 5,
    }
    key = hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()[:24]
    file = cache_folder() / "vehicles" / f"{toml.parent.name}-{key}.usda"
    _check_variants(toml, source, root, variants)
    if not _is_whole(file, file.with_suffix(".seal")):
        from pxr import Gf, Sdf, Usd, UsdGeom

        stage = Usd.Stage.CreateInMemory(".usda")
        UsdGeom.SetStageUpAxis(stage, "Z")
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        own = open_stage(source, load=False)
        for name in ("timeCodesPerSecond", "framesPerSecond"):
            stage.GetRootLayer().pseudoRoot.SetInfo(name, own.GetTimeCodesPerSecond())
        xform = UsdGeom.Xform.Define(stage, f"/{_asset_root(toml, own, root).GetName()}")
        stage.SetDefaultPrim(xform.GetPrim())
        path = Sdf.Path() if not root else Sdf.Path(root if root.startswith("/") else f"/{root}")
        xform.GetPrim().GetReferences().AddReference(str(source.resolve()), path)
        for name, choice in variants.items():
            xform.GetPrim().GetVariantSet(name).SetVariantSelection(choice)
        order = list(xform.GetXformOpOrderAttr().Get() or [])
        for op, value in ops.items():
            kind = Sdf.ValueTypeNames.Double3 if isinstance(value, list) else Sdf.ValueTypeNames.Double
            attribute = xform.GetPrim().CreateAttribute(op, kind, custom=False)
            attribute.Set(Gf.Vec3d(*value) if isinstance(value, list) else value)
        xform.GetXformOpOrderAttr().Set([*ops, *(name for name in order if name != "!resetXformStack!")])
        stage.GetRootLayer().customLayerData = {SOURCE: str(named)}
        text = stage.GetRootLayer().ExportToString().encode()
        file.parent.mkdir(parents=True, exist_ok=True)
        seal(file.with_suffix(".seal"), {file.name: text})
        write_file(file, text)
    return file


def _asset_root(toml: Path, stage: Any, root: str) -> Any:
    prim = stage.GetPrimAtPath(root if root.startswith("/") else f"/{root}") if root else stage.GetDefaultPrim()
    if not prim:
        tops = ", ".join(str(child.GetPath()) for child in stage.GetPseudoRoot().GetChildren())
        raise InputError(
            "no such prim in the asset", f"it holds {tops or 'nothing'}", key="root", value=root, file=toml
        )
    return prim


def _check_variants(toml: Path, source: Path, root: str, variants: Any) -> None:
    if not variants:
        return
    stage = open_stage(source, load=False)
    sets = _asset_root(toml, stage, root).GetVariantSets()
    if not isinstance(variants, Mapping):
        raise InputError(
            "not a table", "give a table of variant set = variant", key="variants", value=variants, file=toml
        )
    for name, choice in variants.items():
        if not sets.HasVariantSet(name):
            known = ", ".join(sets.GetNames()) or "none"
            raise InputError(
                "no such variant set on its root", f"it has {known}", key=f"variants.{name}", value=choice, file=toml
            )
        if choice not in (names := sets.GetVariantSet(name).GetVariantNames()):
            raise InputError(
                "no such variant", f"choose one of {', '.join(names)}", key=f"variants.{name}", value=choice, file=toml
            )


# ---------------------------------------------------------------- GLB and OBJ


def _converted(path: Path, up: str, metres: float) -> Path:
    """A GLB, glTF or OBJ file as USD in the cache, keyed by content: nodes become Xforms, in the file's own units."""
    with reading(path, "asset"):
        data = path.read_bytes()
    if path.suffix.lower() != ".obj":
        found = read_cached(contents, path, "asset")[0]
        check_parts(found["parts"], path)
        if found["motion"]:
            remedy = "export the asset as USD to keep its motion"
            warnings.warn(
                f"{path}: has {' and '.join(found['motion'])}; only its rest pose is read; {remedy}", stacklevel=2
            )
    digest = hashlib.sha256(f"7 {path.name} {up} {metres}".encode() + data).hexdigest()[:24]
    folder = cache_folder() / "vehicles" / f"{path.stem}-{digest}"
    file = folder / f"{path.stem}.usdc"
    if _is_whole(folder, folder / "seal"):
        return file
    with making_folder(folder) as beside:
        read_in_process(convert, path, "asset", str(beside / file.name), up, metres)
        made = [each for each in beside.rglob("*") if each.is_file()]
        seal(beside / "seal", {each.relative_to(beside).as_posix(): each.read_bytes() for each in made})
        if folder.exists() and not is_whole(folder / "seal"):
            shutil.rmtree(folder, ignore_errors=True)
    return file


def convert(path: Path, file: str, up: str, metres: float) -> Answer:
    """Write a GLB, glTF or OBJ file as the USD ``file``, with its textures beside it. It runs in the reader process."""
    import trimesh

    scene = _read_obj(path) if path.suffix.lower() == ".obj" else trimesh.load(path, force="scene", process=False)
    _write_scene(scene, Path(file), path, up, metres)
    return None, []


def _is_whole(made: Path, by: Path) -> bool:
    """Whether ``made`` is in the cache and matches its checksum."""
    if not made.exists() or is_whole(by):
        return made.exists()
    warnings.warn(f"{made}: damaged cache entry, made again", stacklevel=2)
    return False


def contents(path: Path) -> Answer:
    """How many parts a glTF has, and what of animation and skins, such as "2 skins". It runs in the reader process."""
    scene = gltf.scene_of(path, "asset")
    motion = [f"{len(scene[key])} {key}" for key in ("animations", "skins") if scene.get(key)]
    return {"parts": gltf.parts_of(scene), "motion": motion}, []


def _read_obj(path: Path) -> Any:
    """An OBJ file as a scene of its objects (``o``, or ``g``) by name; trimesh alone loses the names."""
    import trimesh

    shared: list[str] = []
    objects: dict[str, list[str]] = {}
    materials: dict[str, str] = {}
    name, material = path.stem, ""
    keys = "o" if re.search(r"^o\s", text := path.read_text(encoding="utf-8", errors="replace"), re.MULTILINE) else "g"
    for line in text.splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == keys:
            name = rest.strip() or path.stem
        elif word == "usemtl":
            material = line
        elif word == "f":
            lines = objects.setdefault(name, [])
            if materials.get(name) != material:
                lines.append(material)
                materials[name] = material
            lines.append(line)
        elif word in ("v", "vt", "vn", "mtllib"):
            shared.append(line)
    scene = trimesh.Scene()
    resolver = trimesh.resolvers.FilePathResolver(str(path))
    for name, faces in objects.items():
        text = "\n".join([*shared, *faces])
        found: Any = trimesh.load(io.StringIO(text), file_type="obj", resolver=resolver, force="scene", process=False)
        scene.graph.update(frame_to=name, frame_from=scene.graph.base_frame)
        for k, mesh in enumerate(found.geometry.values()):
            mesh.remove_unreferenced_vertices()
            scene.add_geometry(mesh, node_name=f"{name}_{k}", geom_name=f"{name}_{k}", parent_node_name=name)
    return scene


def _write_scene(scene: Any, file: Path, path: Path, up: str, metres: float) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom

    file.parent.mkdir(parents=True)
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    top = _identifier(path.stem)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, f"/{top}").GetPrim())
    Usd.ModelAPI(stage.GetDefaultPrim()).SetKind("component")
    UsdGeom.Scope.Define(stage, f"/{top}/materials")
    base, children = scene.graph.base_frame, scene.graph.transforms.children
    materials: dict[int, Any] = {}

    places: dict[str, tuple[str, str]] = {}  # node: paths of its Xform and of its mesh

    def place(node: str, parent: str, used: set[str]) -> None:
        name = _free(_identifier(node), used)
        below = {"materials"}
        geometry = scene.geometry.get(scene.graph.transforms.node_data[node].get("geometry"))
        mesh = f"{parent}/{name}/{_free(name, below)}" if hasattr(geometry, "faces") else ""
        places[node] = f"{parent}/{name}", mesh
        for child in children.get(node, []):
            place(child, f"{parent}/{name}", below)

    used = {"materials"}
    for node in children.get(base, []):
        place(node, f"/{top}", used)
    with Sdf.ChangeBlock():  # all prims at once: a stage composes all siblings of a new prim again
        for path_of, mesh in places.values():
            for at, kind in ((path_of, "Xform"), (mesh, "Mesh")):
                if at:
                    spec = Sdf.CreatePrimInLayer(stage.GetRootLayer(), at)
                    spec.specifier, spec.typeName = Sdf.SpecifierDef, kind
    for node, (path_of, mesh) in places.items():
        edge = scene.graph.transforms.edge_data[(scene.graph.transforms.parents[node], node)]
        matrix = np.asarray(edge.get("matrix"))
        if matrix.ndim == 2 and not np.allclose(matrix, np.eye(4)):
            UsdGeom.Xform.Get(stage, path_of).AddTransformOp().Set(Gf.Matrix4d(matrix.T.tolist()))
        if mesh:
            geometry = scene.geometry[scene.graph.transforms.node_data[node]["geometry"]]
            _write_mesh(stage, mesh, geometry, top, materials, file.parent)
    # this file is delivered, so it must not contain a folder of this machine
    stage.GetRootLayer().customLayerData = {SOURCE: path.name}
    stage.GetRootLayer().Save()


def _write_mesh(stage: Any, path: str, mesh: Any, top: str, materials: dict[int, Any], folder: Path) -> None:
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    prim = UsdGeom.Mesh.Get(stage, path)
    points = np.asarray(mesh.vertices, np.float32)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(mesh.faces, np.int32).ravel()))
    prim.CreateExtentAttr([Gf.Vec3f(*points.min(0).tolist()), Gf.Vec3f(*points.max(0).tolist())])
    normals = mesh.vertex_normals
    if len(normals) == len(points):
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, np.float32)))
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    uv = getattr(mesh.visual, "uv", None)
    if uv is not None and len(uv) == len(points):
        st = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv, np.float32)))
    material = getattr(mesh.visual, "material", None)
    key = id(material)
    if key not in materials:
        materials[key] = _write_material(stage, f"/{top}/materials/material_{len(materials)}", material, folder)
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(materials[key])


def _write_material(stage: Any, path: str, material: Any, folder: Path) -> Any:
    """A preview surface with a material's base colour, roughness, metallic value and colour texture."""
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    prim = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, f"{path}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    prim.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    rgba = np.asarray(getattr(material, "main_color", [128, 128, 128, 255]), float) / 255.0
    diffuse = surface.CreateInput("diffuseColor", types.Color3f)
    diffuse.Set(Gf.Vec3f(*rgba[:3].tolist()))  # glTF's factors and OBJ's Kd are linear
    surface.CreateInput("opacity", types.Float).Set(float(rgba[3]))
    for ours, theirs, otherwise in (("roughness", "roughnessFactor", 0.6), ("metallic", "metallicFactor", 0.0)):
        value = getattr(material, theirs, None)
        surface.CreateInput(ours, types.Float).Set(float(otherwise if value is None else value))
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None:
        file = folder / f"{Sdf.Path(path).name}.png"
        image.convert("RGBA" if "A" in image.getbands() else "RGB").save(file)
        reader = UsdShade.Shader.Define(stage, f"{path}/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", types.String).Set("st")
        texture = UsdShade.Shader.Define(stage, f"{path}/texture")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"./{file.name}"))
        texture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
        texture.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
        diffuse.ConnectToSource(texture.CreateOutput("rgb", types.Float3))
    return prim


def _identifier(name: str) -> str:
    """A prim name from a node's name: letters of any language and digits stay, all other characters become ``_``."""
    from pxr import Sdf

    name = unicodedata.normalize("NFC", name)
    name = "".join(letter if Sdf.Path.IsValidIdentifier(f"_{letter}") else "_" for letter in name)
    return name if Sdf.Path.IsValidIdentifier(name) else f"_{name}"


def _free(name: str, used: set[str]) -> str:
    count, free = 1, name
    while free in used:
        count, free = count + 1, f"{name}_{count}"
    used.add(free)
    return free
