"""Cost of a batch, every figure next to its peer, in one run: ``make bench-export`` (about ten minutes on two cores).

Baking is measured in CPU time of one core, best of several, and compared with MuJoCo's ``USDExporter`` and with bare
``Sdf`` calls on the same motion; pictures in CPU time of one core, the median of pairs, compared with a bare
``mujoco.Renderer`` loop over the same model; batches in wall time, which needs an otherwise idle machine.
``--clips N`` and ``--short N`` make the batches smaller, ``--only NAME`` runs a part.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("MUJOCO_GL", "egl")

import vehsim
from vehsim.clip.clip import Clip
from vehsim.runtime.processes import NAME

FREE_SPACE = """
[shot]
schema = 1
name = "fly"
[[vehicle]]
name = "heli"
asset = "helicopter"
[vehicle.motion]
method = "plan"
segments = 16
[[vehicle.motion.mark]]
frame = 1001
position = [0, 0, 10]
heading = 0
velocity = [0, 0, 0]
[[vehicle.motion.mark]]
frame = 1097
position = [12, 0, 11]
velocity = [0, 0, 0]
[sweep]
"vehicle.heli.motion.mark[1].position[0]" = {{ uniform = [8, 16] }}
"vehicle.heli.motion.mark[1].position[1]" = {{ uniform = [-6, 6] }}
seeds = {count}
"""


PAIRS = 5
"""Number of pairs of batches, with one worker and with two, in turn."""
LOOP = "x = 0\nfor k in range(30_000_000): x += k * k"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=1000)
    parser.add_argument("--short", type=int, default=40)
    parser.add_argument("--only", choices=sorted(PARTS))
    arguments = parser.parse_args()
    print(f"vehsim {vehsim.__version__}, Python {sys.version.split()[0]}, {os.cpu_count()} cores, load {load()}\n")
    for name, part in PARTS.items():
        if arguments.only in (None, name):
            with tempfile.TemporaryDirectory(prefix="bench-") as folder:
                part(Path(folder), arguments)


def row(what: str, measured: str, wanted: str, met: bool) -> None:
    print(f"{'met ' if met else 'MISS'}  {what:<58} {measured:>22}   wanted {wanted}", flush=True)


def load() -> str:
    return f"{os.getloadavg()[0]:.1f}"


def cpu(work: Callable[[], Any], times: int = 5) -> float:
    """The smallest CPU time of this process, s."""
    best = np.inf
    for _ in range(times):
        begin = time.process_time()
        work()
        best = min(best, time.process_time() - begin)
    return float(best)


# ---------------------------------------------------------------- baking


def motion(frames: int) -> Clip:
    """A helicopter in a climbing bend, rotors turning, with a sample for every frame."""
    from scipy.spatial.transform import Rotation

    heli = vehsim.load_vehicle("helicopter")
    t = np.arange(frames) / 24.0
    positions = np.stack([30 * np.sin(0.1 * t), 30 - 30 * np.cos(0.1 * t), 10 + np.sin(0.3 * t)], axis=1)
    euler = np.stack([0.1 * t, 0.1 * np.sin(t), 0.2 * np.sin(0.7 * t)], axis=1)
    orientations = Rotation.from_euler("ZYX", euler).as_quat(scalar_first=True)
    signs = np.where((orientations[1:] * orientations[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    orientations *= np.concatenate([[1.0], np.cumprod(signs)])[:, None]
    empty = np.zeros((frames, 0))
    channels = {name: (35.0 + k) * t for k, name in enumerate(heli.rig.drives)}
    controls = np.zeros((frames, len(heli.controls)))
    return Clip(
        heli, t, positions, orientations, np.zeros((frames, 6)), empty, empty, controls, channels, Fraction(24), 1001
    )


def baking(folder: Path, arguments: argparse.Namespace) -> None:
    from vehsim.exporters.usd.animation import write_animation
    from vehsim.exporters.usd.packing import Pack

    clip = motion(20_000)
    prims = 1 + len(clip.channels)
    span = (1001, 1000 + len(clip))
    count = iter(range(1_000_000))

    def ours() -> None:
        place = folder / f"ours{next(count)}"
        write_animation(clip, "heli", Pack(place), place / "heli.usdc", clip.fps, span)

    ours_s, bare_s = cpu(ours), cpu(lambda: bare_sdf(clip, folder / f"bare{next(count)}.usdc"))
    few = motion(240)
    peer_s = cpu(lambda: mujoco_usd(few, folder / f"peer{next(count)}"), times=2) / len(few)
    poses = prims * len(clip) / ours_s
    row("arrays to usdc, one core: poses of moving prims", f"{poses:,.0f} /s", "200,000 /s", poses >= 200_000)
    row("  the same, whole vehicles", f"{len(clip) / ours_s:,.0f} /s", "-", True)
    ratio = ours_s / bare_s
    row("  beside bare Sdf authoring of the same samples", f"{ratio:.2f} x its time", "1.3 x", ratio <= 1.3)
    faster = peer_s / (ours_s / len(clip))
    row("  beside mujoco.usd.USDExporter, same motion", f"{faster:,.0f} x as fast", "20 x", faster >= 20)


def bare_sdf(clip: Clip, path: Path) -> None:
    """The minimum: the same samples, written straight into a layer."""
    from pxr import Sdf, Vt

    layer = Sdf.Layer.CreateNew(str(path))
    turns = clip.orientations[:, [1, 2, 3, 0]].copy()
    with Sdf.ChangeBlock():
        root = Sdf.PrimSpec(layer, "heli", Sdf.SpecifierDef, "Xform")
        tracks = [
            (root, "xformOp:translate", Sdf.ValueTypeNames.Double3, Vt.Vec3dArray.FromNumpy(clip.positions)),
            (root, "xformOp:orient", Sdf.ValueTypeNames.Quatd, Vt.QuatdArray.FromNumpy(turns)),
        ]  # fmt: skip
        for name, drive in clip.vehicle.rig.drives.items():
            prim = Sdf.CreatePrimInLayer(layer, root.path.AppendPath(drive.prim))
            values = Vt.DoubleArray.FromNumpy(np.degrees(clip.channels[name]))
            tracks.append((prim, f"xformOp:{drive.op}:spin", Sdf.ValueTypeNames.Double, values))
        frames = clip.frames.tolist()
        for prim, name, kind, values in tracks:
            place = Sdf.AttributeSpec(prim, name, kind).path
            for frame, value in zip(frames, values, strict=True):
                layer.SetTimeSample(place, frame, value)
    layer.Save()


def mujoco_usd(clip: Clip, folder: Path) -> None:
    """The same motion through MuJoCo: a mocap body for the hull and one for each rotor, frame by frame."""
    import mujoco
    from mujoco.usd.exporter import USDExporter
    from scipy.spatial.transform import Rotation

    from vehsim.exporters.usd.readback import expected_matrices
    from vehsim.rig.parts import read_parts

    spec = mujoco.MjSpec()
    poses = expected_matrices(clip)
    names = ["", *(path for path in poses if path)]
    parts = {part.path: part for part in read_parts(clip.vehicle.rig.asset)}
    for k, name in enumerate(names):
        body = spec.worldbody.add_body(name=f"b{k}", mocap=True)
        part = parts.get(name) or next(part for part in parts.values() if len(part.faces))
        mesh = spec.add_mesh(name=f"m{k}")
        mesh.uservert, mesh.userface = part.points.astype(np.float32).ravel(), part.faces.astype(np.int32).ravel()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{k}")
    model = spec.compile()
    data = mujoco.MjData(model)
    quaternions = {name: Rotation.from_matrix(poses[name][:, :3, :3]).as_quat(scalar_first=True) for name in names}
    exporter = USDExporter(model, output_directory=folder.name, output_directory_root=str(folder.parent), verbose=False)
    for frame in range(len(clip)):
        for k, name in enumerate(names):
            data.mocap_pos[k], data.mocap_quat[k] = poses[name][frame, :3, 3], quaternions[name][frame]
        mujoco.mj_kinematics(model, data)
        exporter.update_scene(data)
    exporter.save_scene("usdc")


# ---------------------------------------------------------------- pictures


def pictures(folder: Path, arguments: argparse.Namespace) -> None:
    """The same pictures by a bare loop over the same model, poses, lenses and lights; ours also reads the stage."""
    os.environ["LP_NUM_THREADS"] = "0"  # run Mesa's rasteriser in this thread, as when every core has a worker
    import mujoco

    from vehsim.exporters.pictures.render import StageRenderer
    from vehsim.exporters.usd.stage import StageReader

    shot = vehsim.Shot.load(write(folder, FREE_SPACE.partition("[sweep]")[0], 1))
    stage = StageReader(shot.solve().export(folder, ["usd"]) / "fly.usda")
    frames = range(1001, 1097, 4)
    for what, size, look in (
        ("drafts", (480, 270), {"samples": 1, "shadows": False}),
        ("pictures at 1 sample", (960, 540), {"samples": 1}),
        ("pictures at 4 samples", (960, 540), {"samples": 4}),
    ):
        with StageRenderer(stage, size, **look) as ours:
            side = ours._supersample
            peer = mujoco.Renderer(ours._model, size[1] * side, size[0] * side)
            for name, wanted in (("SHADOW", look.get("shadows", True)), ("FOG", True), ("SKYBOX", True)):
                peer.scene.flags[mujoco.mjtRndFlag.__members__[f"mjRND_{name}"]] = wanted
            views = [_view(ours, frame) for frame in frames]
            data = mujoco.MjData(ours._model)

            def bare(peer: Any = peer, ours: Any = ours, data: Any = data, views: Any = views) -> None:
                for positions, quaternions, eyes, sun in views:
                    data.mocap_pos[:], data.mocap_quat[:] = positions, quaternions
                    mujoco.mj_kinematics(ours._model, data)
                    mujoco.mj_camlight(ours._model, data)
                    peer.update_scene(data)
                    for theirs, eye in zip(peer.scene.camera, eyes, strict=True):
                        for key, value in zip(LENS, eye, strict=True):
                            setattr(theirs, key, value)
                    peer.scene.lights[1].pos = sun
                    peer.render()

            def own(ours: Any = ours) -> None:
                for frame in frames:
                    ours.render("chase", frame)

            own(), bare()
            ratio = float(np.median([cpu(own, 1) / cpu(bare, 1) for _ in range(9)]))
            peer.close()
        row(f"{what}, beside a bare mujoco.Renderer", f"{ratio:.2f} x its time", "1.05 x", ratio <= 1.05)


def _view(ours: Any, frame: int) -> tuple[Any, Any, list[Any], Any]:
    """Poses in a frame of our renderer: movers, both eyes of the camera, the sun."""
    ours.render("chase", frame)
    scene, data = ours._canvas.scene, ours._data
    eyes = [[np.copy(getattr(eye, key)) for key in LENS] for eye in scene.camera]
    return data.mocap_pos.copy(), data.mocap_quat.copy(), eyes, np.copy(scene.lights[1].pos)


# ---------------------------------------------------------------- batches


def write(folder: Path, text: str, count: int) -> Path:
    path = folder / "fly.toml"
    path.write_text(text.format(count=count))
    return path


def batch(folder: Path, count: int, workers: int) -> tuple[float, dict[str, Any]]:
    """Seconds of a batch by the command line, and its summary."""
    shot = write(folder, FREE_SPACE, count)
    out = folder / f"out{workers}"
    command = [sys.executable, "-m", "vehsim", "export", str(shot), "--out", str(out), "--quiet"]
    begin = time.perf_counter()
    process = subprocess.Popen([*command, "--workers", str(workers)])
    watch = Watch(process.pid)
    code = process.wait()
    seconds = time.perf_counter() - begin
    memory, busy = watch.end()
    clips = json.loads((out / "summary.json").read_text())["clips"]
    done = sum(clip["state"] == "done" for clip in clips)
    return seconds, {"code": code, "done": done, "cpu": round(busy, 1), "memory": memory}


class Watch(threading.Thread):
    """Monitors a process and its descendants: their CPU time, s, and the resident memory of the largest worker, MB."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self._pid, self._going = pid, True
        self._sizes: list[float] = []
        self._busy: dict[int, float] = {}
        self.start()

    def run(self) -> None:
        while self._going:
            largest = 0.0
            for pid in family(self._pid):
                with suppress(OSError, ValueError):
                    name, _, rest = Path(f"/proc/{pid}/stat").read_text().partition("(")[2].rpartition(")")
                    fields = rest.split()
                    self._busy[pid] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
                    if name == NAME:
                        largest = max(largest, int(fields[21]) * resource.getpagesize() / 1e6)
            self._sizes += [largest] if largest else []
            time.sleep(0.1)

    def end(self) -> tuple[tuple[float, float, float], float]:
        """Memory after a quarter of the time, at the end, and at its peak; and the total CPU time."""
        self._going = False
        self.join()
        sizes = self._sizes or [0.0]
        return (sizes[len(sizes) // 4], sizes[-2 if len(sizes) > 1 else -1], max(sizes)), sum(self._busy.values())


def family(pid: int) -> Iterator[int]:
    """A process and its descendants."""
    yield pid
    with suppress(OSError):
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            yield from family(int(child))


def scaling(folder: Path, arguments: argparse.Namespace) -> None:
    ratios, machine = [], []
    for _ in range(PAIRS):
        before, times = load(), [batch(folder, arguments.short, workers)[0] for workers in (1, 2)]
        ratios.append(times[0] / times[1])
        machine.append(2 * loops(1) / loops(2))
        what = f"{arguments.short} short clips: {times[0]:.1f} s with one worker, {times[1]:.1f} s with two"
        print(f"      {what}, load before {before}; the machine gives two loops {machine[-1]:.2f} x", flush=True)
    ratio, gives = float(np.median(ratios)), float(np.median(machine))
    row(f"two workers beside one, {arguments.short} short clips", f"{ratio:.2f} x as fast", "1.8 x", ratio >= 1.8)
    row("  two plain loops beside one, in the same run", f"{gives:.2f} x as fast", "-", True)


def loops(count: int) -> float:
    """Seconds of several loops of plain Python in parallel, each in its own process: the machine's own speed-up."""
    begin = time.monotonic()
    running = [subprocess.Popen([sys.executable, "-c", LOOP]) for _ in range(count)]
    for process in running:
        process.wait()
    return time.monotonic() - begin


def thousand(folder: Path, arguments: argparse.Namespace) -> None:
    seconds, summary = batch(folder, arguments.clips, 2)
    early, late, most = summary["memory"]
    print(f"      {arguments.clips} clips: {summary['cpu']} s of CPU time in all, load after {load()}", flush=True)
    limit = 240 * arguments.clips / 1000
    row(
        f"{summary['done']} free-space clips planned and baked, 2 workers",
        f"{seconds:.0f} s",
        f"{limit:.0f} s",
        seconds <= limit,
    )
    grown = f"{early:.0f} -> {late:.0f} MB"
    row(
        "  memory of the larger worker, a quarter through and last",
        grown,
        "flat, 1000 MB",
        late < 1.15 * early and most < 1000,
    )


def starting(folder: Path, arguments: argparse.Namespace) -> None:
    for what, code, wanted in (
        ("vehsim --help", "import sys; sys.argv[1:] = ['--help']; from vehsim.__main__ import main; main()", 0.3),
        ("import vehsim", "import vehsim", 0.5),
    ):
        spent = []
        for _ in range(7):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            begin = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=True)
            wall = time.perf_counter() - begin
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent.append((wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime))
        wall, busy = min(w for w, _ in spent), min(b for _, b in spent)
        row(what, f"{wall:.2f} s ({busy:.2f} s CPU)", f"{wanted} s", wall < wanted)


LENS = ("pos", "forward", "up", "frustum_near", "frustum_far", "frustum_width", "frustum_bottom", "frustum_top")
PARTS = {"starting": starting, "baking": baking, "pictures": pictures, "scaling": scaling, "thousand": thousand}

if __name__ == "__main__":
    main()
