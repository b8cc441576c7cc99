"""No work is lost and no partial file is used: kills, full disks, other exports, broken caches, no memory."""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from vehsim.batch import export_batch, load_shots
from vehsim.runtime.processes import NAME, THREADS

Content = Callable[[Path], dict[str, str]]
Write = Callable[..., Path]
Undisturbed = tuple[Path, dict[str, str]]
PATIENCE = 600.0
"""Time limit on a busy machine, s: only a failing test waits that long."""
SWEEP = '"vehicle.car.motion.duration" = {{ from = 0.25, to = 1.0, count = {} }}'


def start(shot: Path, out: Path, *more: str, workers: int = 2, limit: int | None = None) -> subprocess.Popen[str]:
    """Start a batch in its own process group. ``limit``: the largest file it may write, bytes."""
    arguments = [sys.executable, "-m", "vehsim", "export", str(shot), "--out", str(out), "--to", "usd,npz"]
    arguments += ["--workers", str(workers), *more]
    preparation = None
    if limit is not None:
        preparation = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    return subprocess.Popen(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=preparation,
    )


def workers_of(pid: int) -> list[int]:
    """The workers below a process; none while its batch starts."""
    return [child for child in descendants(pid) if comm(child) == NAME]


def descendants(pid: int) -> Iterator[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return
    for child in map(int, children):
        yield child
        yield from descendants(child)


def comm(pid: int) -> str:
    """The system's name of a process."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def test_killed_at_random_again_and_again(undisturbed: Undisturbed, tmp_path: Path, content: Content) -> None:
    """kill -9 for a worker, then for the whole batch, in the middle of clips; the final result is that of an
    undisturbed batch.

    Every kill waits for another clip, not for a time, so that it happens during work on slow and on fast machines;
    `benchmarks/bench_kills.py` kills at random instants, fifty times in 200 clips.
    """
    shot, expected = undisturbed
    chance, out = random.Random(1), tmp_path / "out"
    for _ in range(2):
        process = start(shot, out, "--resume")
        for whole in (False, True):
            goal = done(out) + 1
            while done(out) < goal:
                assert process.poll() is None
                time.sleep(0.005)
            time.sleep(chance.uniform(0.0, 0.05))
            if whole:
                os.killpg(process.pid, signal.SIGKILL)
            else:
                os.kill(chance.choice(workers_of(process.pid)), signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert done(out) < 12
    assert start(shot, out, "--resume").wait() == 0
    assert content(out) == expected


def done(out: Path) -> int:
    """Number of delivered clips."""
    return len(list(out.glob("drive*")))


@pytest.mark.broken_stages
def test_workers_end_with_their_batch(write: Write, tmp_path: Path) -> None:
    """They end at once, also in the middle of millions of steps that never return to the interpreter."""
    shot = write(sweep='"shot.start_frame" = [1, 2]', duration=90.0)
    shot.write_text(shot.read_text().replace("duration = 90.0", "duration = 90.0\nstep = 0.00001"))
    process = start(shot, tmp_path / "out", "--log", "json")
    assert process.stdout is not None
    while '"planning"' not in process.stdout.readline():
        assert process.poll() is None
    deadline = time.monotonic() + PATIENCE
    while len(workers := workers_of(process.pid)) < 2:  # the first may plan before the second has its name
        assert time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(1.0)
    worked = {pid: _seconds(pid) for pid in workers}
    process.kill()
    process.wait()
    while left := [pid for pid in workers if _runs(pid)]:  # a busy machine may be slow to end them
        assert all(_seconds(pid) - worked[pid] < 5.0 for pid in left)
        time.sleep(0.05)


def _seconds(pid: int) -> float:
    """CPU time of a process, s; zero if it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _runs(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_batch_cleans_up(write: Write, tmp_path: Path, number: int) -> None:
    process = start(write(sweep=SWEEP.format(30)), tmp_path / "out")
    while not list((tmp_path / "out").glob("drive*")):
        time.sleep(0.02)
    os.kill(process.pid, number)
    _, output = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "Traceback" not in output
    assert "interrupted" in output and "--resume" in output
    assert not list((tmp_path / "out").glob(".*"))
    states = {clip["state"] for clip in json.loads((tmp_path / "out" / "summary.json").read_text())["clips"]}
    assert "unfinished" in states and states <= {"done", "unfinished"}  # the last delivery may go unrecorded


def test_a_file_that_cannot_grow_fails_only_its_clip(
    undisturbed: Undisturbed, tmp_path: Path, content: Content
) -> None:
    """As on a disk that is full for large files: every clip reports it, no partial file remains, and --resume fixes
    it."""
    shot, expected = undisturbed
    out = tmp_path / "out"
    process = start(shot, out, limit=20_000)
    _, output = process.communicate()
    assert process.returncode == 1
    assert "could not be written" in output
    assert {path.name for path in out.iterdir()} == {"summary.json"}
    clips = json.loads((out / "summary.json").read_text())["clips"]
    assert {(clip["state"], clip["error"]["kind"]) for clip in clips} == {("failed", "ExportError")}
    assert all(clip["error"]["problems"][0]["remedy"] for clip in clips)
    assert start(shot, out, "--resume").wait() == 0
    assert content(out) == expected


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of two and a half megabytes."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2500k", "tmpfs", str(place)], capture_output=True)
    if mounted.returncode != 0:
        pytest.skip("mounting a small file system needs root")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk(undisturbed: Undisturbed, small_disk: Path, content: Content) -> None:
    shot, expected = undisturbed
    process = start(shot, small_disk / "out")
    _, output = process.communicate()
    assert process.returncode == 1, output
    found = content(small_disk / "out")
    whole = {path: digest for path, digest in found.items() if path != "summary.json"}
    assert whole.items() <= expected.items()  # what is there is whole
    assert not [path for path in found if path.startswith(".")]
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    assert start(shot, small_disk / "out", "--resume").wait() == 0
    assert content(small_disk / "out") == expected


def test_a_read_only_output_folder(write: Write, small_disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    process = start(write(sweep=SWEEP.format(2)), small_disk / "out")
    _, output = process.communicate()
    assert process.returncode == 2  # before anything is solved
    assert output.count("no permission to write there") == 1
    assert "Traceback" not in output


def test_unreadable_files_are_named(write: Write, tmp_path: Path) -> None:
    """A folder or a rig without permissions stops only its own shot, with a message that names it."""
    out, rig = tmp_path / "out", tmp_path / "rig"
    for folder in (out / "taken", rig):
        folder.mkdir(parents=True)
        folder.chmod(0)
    shots = [write("good"), write("taken"), write("rigged", asset="rig/car")]
    command = [sys.executable, "-m", "vehsim", "export", *map(str, shots), "--out", str(out), "--to", "npz"]
    answer = subprocess.run(command, capture_output=True, text=True, preexec_fn=_obey_permissions)
    for folder in (out / "taken", rig):
        folder.chmod(0o700)
    assert answer.returncode == 1
    assert f"{out / 'taken'}: no permission to read it" in answer.stderr
    assert f"{rig / 'car'}: Permission denied" in answer.stderr
    assert "unexpected" not in answer.stderr
    assert {path.name for path in out.iterdir()} == {"good", "taken", "summary.json"}


def _obey_permissions() -> None:
    """Make permissions apply to root too, by dropping CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH (Linux)."""
    import ctypes

    for capability in (1, 2):
        ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


def test_a_failed_export_may_delete_the_parent_folder_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The failed export made that folder, and deletes it just when another starts in it: the other makes it again."""
    from vehsim.delivery.folders import staging

    make, out = Path.mkdir, tmp_path / "out"

    def dropped(folder: Path, *how: object, **more: object) -> None:
        monkeypatch.setattr(Path, "mkdir", make)
        raise FileNotFoundError(folder)

    monkeypatch.setattr(Path, "mkdir", dropped)
    with staging(out / "clip") as beside:
        assert beside.is_dir()
    assert not out.exists()


def test_two_exports_into_one_folder(undisturbed: Undisturbed, tmp_path: Path, content: Content) -> None:
    shot, expected = undisturbed
    for _ in range(2):  # into an empty folder, then over the earlier delivery
        both = [start(shot, tmp_path / "out", workers=1) for _ in range(2)]
        assert [process.communicate() and process.returncode for process in both] == [0, 0]
        assert content(tmp_path / "out") == expected


def test_many_exports_replace_one_delivery_at_once(tmp_path: Path) -> None:
    """Eight threads replace one delivery repeatedly: at any time it is a complete one of theirs."""
    from concurrent.futures import ThreadPoolExecutor

    from vehsim.delivery.folders import SIGN, replacing

    target = tmp_path / "shot"

    def deliver(k: int) -> None:
        for _ in range(10):
            with replacing(target) as folder:
                for name in ("a", "b", SIGN):
                    (folder / name).write_text(str(k))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(deliver, range(8)))
    assert len({(target / name).read_text() for name in ("a", "b", SIGN)}) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["shot"]


def test_hidden_folders_of_running_processes_and_other_machines_stay(tmp_path: Path) -> None:
    from vehsim.delivery.folders import clean_up
    from vehsim.runtime.files import machine

    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    stay = [f".shot.{machine()}-{os.getpid()}-00.partial", f".shot.00000000-{gone.pid}-00.partial"]
    for name in (*stay, f".shot.{machine()}-{gone.pid}-00.partial"):
        (tmp_path / name).mkdir()
    (tmp_path / "shot").mkdir()
    clean_up(tmp_path / "shot")
    assert {path.name for path in tmp_path.iterdir()} == {*stay, "shot"}


def test_a_killed_process_is_not_alive_before_its_parent_waits_for_it() -> None:
    from vehsim.delivery.folders import _alive

    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    assert _alive(process.pid) and _alive(os.getpid())
    process.kill()
    assert not _alive(process.pid)  # immediately after the kill: perhaps still running, or ended but not yet waited for
    process.wait()
    assert not _alive(process.pid)


def test_a_cached_field_full_of_zeros_is_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power cut may leave a file of the right size and shape whose data never reached the disk."""
    from vehsim.world.terrain.terrain import Terrain
    from vehsim.world.world import World

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    terrain = Terrain("hill", np.add.outer(np.arange(12.0), np.arange(12.0)), (0.0, 0.0), (1.0, 1.0))
    first = World(terrain).distance_field()
    (file,) = tmp_path.iterdir()
    body = file.read_bytes()
    file.write_bytes(body[:128] + bytes(len(body) - 128))
    with pytest.warns(UserWarning, match="damaged"):
        again = World(terrain).distance_field()
    assert first is not None
    assert again is not None
    assert (first.distances == again.distances).all()
    assert file.read_bytes() == body


def test_results_are_cached_for_other_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is made once, made again when it is damaged, and also returned if nothing can be stored."""
    from vehsim.runtime.cache import kept

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    made: list[int] = []

    def make() -> bytes:
        made.append(1)
        return b"a sky"

    assert [kept("sky", 7, make) for _ in range(3)] == [b"a sky"] * 3
    assert len(made) == 1
    (file,) = (tmp_path / "cache").iterdir()
    for damaged in (b"", file.read_bytes()[:-1], b"A" + file.read_bytes()[1:]):
        file.write_bytes(damaged)
        with pytest.warns(UserWarning, match="damaged"):
            assert kept("sky", 7, make) == b"a sky"
        assert kept("sky", 7, make) == b"a sky"
    assert len(made) == 4
    monkeypatch.setenv("VEHSIM_CACHE", str(file))  # a file, no folder
    with pytest.warns(UserWarning, match="could not be kept"):
        assert kept("sky", 7, make) == b"a sky"


def test_results_of_one_kind_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The least recently used ones go, also when there are many small ones; those of other kinds stay."""
    from vehsim.runtime.cache import kept, lookup, store

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    store("sky", 0, b"another kind")
    most = 5 * 4096
    for key in range(5):
        store("stage-1", key, b"of an earlier version", most)
        os.utime(tmp_path / max(tmp_path.glob("stage-*"), key=lambda file: file.stat().st_mtime_ns), ns=(key, key))
    assert lookup("stage-1", 0) is not None  # used now
    kept("stage-2", 0, lambda: bytes(2 * 4096), most)
    assert [lookup("stage-1", key) is not None for key in range(5)] == [True, False, False, False, True]
    assert store("stage-2", 1, bytes(most + 1), most) == bytes(most + 1)  # too large: nothing makes room for it
    assert len(list(tmp_path.glob("stage-*"))) == 3
    assert lookup("sky", 0) == b"another kind"


@pytest.mark.parametrize("what", ["distance", "screened"])
def test_caches_of_terrains_and_stages_are_bounded(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vehsim.intake import usd
    from vehsim.world import Terrain
    from vehsim.world.distance import field

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    for number in range(4):
        if what == "distance":
            monkeypatch.setattr(field, "MOST_KEPT", 3 * 4096)
            rise = Terrain(f"rise {number}", np.full((4, 4), float(number)), (0.0, 0.0), (2.0, 2.0))
            field.distance_field(rise, spacing=8.0)
        else:
            monkeypatch.setattr(usd, "MOST_KEPT", 3 * 4096)
            stage = tmp_path / f"{number}.usda"
            stage.write_text(
                '#usda 1.0\n(\n    defaultPrim = "a"\n    metersPerUnit = 1\n    upAxis = "Z"\n)\ndef Xform "a"\n{\n}\n'
            )
            usd.dependencies(stage)
    assert len(list((tmp_path / "cache").glob(f"{what}-*"))) == 3


def test_arrays_are_cached_by_their_inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vehsim.runtime.cache import kept_arrays

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    points, made = np.arange(12.0).reshape(4, 3), []

    def make() -> list[np.ndarray]:
        made.append(1)
        return [points[:2], points.T[:0]]

    for given in (points, np.asfortranarray(points), points):
        first, second = kept_arrays("some", [given], make)
        assert np.array_equal(first, points[:2]) and second.shape == (0, 4)
    assert len(made) == 1
    for other in ([points.reshape(3, 4)], [points, points], [np.nextafter(points, 99.0)]):
        kept_arrays("some", other, make)
    assert len(made) == 4


@pytest.mark.parametrize("damage", [lambda body: body[:-9], lambda body: body[:99] + bytes(len(body) - 99)])
@pytest.mark.parametrize("what", ["gyro-*/gyro.usdc", "gyro-*.usda"])
def test_a_truncated_or_zeroed_converted_vehicle_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: Content, what: str, damage: Callable[[bytes], bytes]
) -> None:
    """The cache entry of a converted GLB is compared with its checksum, and made again if it differs."""
    import shutil

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    shutil.copytree(Path(__file__).parents[1] / "assets_elsewhere" / "gyro", tmp_path / "gyro")
    _load_anew(tmp_path / "gyro")
    before = content(tmp_path / "cache")
    (made,) = (tmp_path / "cache" / "vehicles").glob(what)
    made.write_bytes(damage(made.read_bytes()))
    with pytest.warns(UserWarning, match="damaged cache entry"):
        _load_anew(tmp_path / "gyro")
    assert content(tmp_path / "cache") == before


def _load_anew(folder: Path) -> None:
    """Load as another process would: this process remembers a vehicle by the date of its toml."""
    from vehsim.vehicles import load_vehicle

    toml = folder / "vehicle.toml"
    os.utime(toml, ns=(0, toml.stat().st_mtime_ns + 1_000_000_000))
    load_vehicle(folder)


def test_a_clip_without_memory_fails_without_affecting_others(
    write: Write, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its motion does not fit into the worker's share of address space; the clips before and after it do."""
    for name in THREADS:  # each of their threads reserves address space
        monkeypatch.setenv(name, "1")
    names = {"before": 0.25, "long": 400.0, "after": 0.25}
    shots = [shot for name, duration in names.items() for shot in load_shots(write(name, duration=duration))]
    outcomes = export_batch(shots, tmp_path / "out", ["npz"], workers=1, memory=1.7)
    assert [outcome.kind for outcome in outcomes] == ["", "MemoryError", ""]
    assert "ran out of memory" in outcomes[1].message
    assert {path.name for path in (tmp_path / "out").iterdir() if path.name[0] != "."} == {
        "before", "after", "summary.json"
    }  # fmt: skip
    assert "Traceback" not in capfd.readouterr().err


def test_a_picture_too_large_for_opengl_fails_without_affecting_others(write: Write, tmp_path: Path) -> None:
    small = "[render]\nsize = [64, 36]\nevery = 10\n"
    large = "[render]\nsize = [8192, 8192]\nsamples = 16\nevery = 10\n"
    shots = load_shots(write("small", more=small)) + load_shots(write("large", more=large))
    outcomes = export_batch(shots, tmp_path / "out", ["png"], workers=1, memory=2.6)
    assert [outcome.state for outcome in outcomes] == ["done", "failed"]
    output = outcomes[1].message  # OpenGL's memory or ours runs out first, depending on what threads reserve
    assert "render.size" in output or "fewer segments or pixels" in output
    assert {path.name for path in (tmp_path / "out").iterdir() if path.name[0] != "."} == {"small", "summary.json"}


def test_missing_pictures_are_rendered_again(write: Write, tmp_path: Path, content: Content) -> None:
    more = "[render]\nsize = [64, 36]\nevery = 3\nsamples = 1\n"
    (shot,) = load_shots(write(more=more))
    export_batch([shot], tmp_path / "out", ["usd", "png"])
    before = content(tmp_path / "out")
    next((tmp_path / "out" / "drive" / "frames" / "chase").glob("*.1004.png")).unlink()
    (outcome,) = export_batch([shot], tmp_path / "out", ["usd", "png"], resume=True)
    assert outcome.state == "done"
    assert content(tmp_path / "out") == before


@pytest.mark.parametrize("error", [RuntimeError("std::bad_alloc"), SystemError("returned NULL"), MemoryError()])
def test_lack_of_memory_is_recognised_in_many_error_messages(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    from vehsim import Shot
    from vehsim.batch.task import prepare, run_task

    def starve(self: Shot, *args: object, **more: object) -> None:
        raise error

    (shot,) = load_shots(write())
    monkeypatch.setattr(Shot, "solve", starve)
    outcome = run_task(prepare(shot, tmp_path, ["npz"]), lambda *args: None)
    assert (outcome.state, outcome.kind, outcome.retire) == ("failed", "MemoryError", True)
    assert "ran out of memory" in outcome.message
