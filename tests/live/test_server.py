"""The server of a live session, driven through its socket as a browser does; no browser is needed."""

import asyncio
import errno
import json
import signal
import subprocess
import sys
import threading
import time
import tomllib
import urllib.error
import urllib.request
from contextlib import asynccontextmanager

import numpy as np
import pytest

pytest.importorskip("websockets", reason='needs the extra: pip install "vehsim[live]"')

from websockets.asyncio.client import connect

from benchmarks.hostile_messages import MARK, SHOT, hostile
from tests.live.block import Block
from vehsim import Shot
from vehsim.errors import InputError
from vehsim.live import edit
from vehsim.live import server as live_server
from vehsim.live import session as live_session
from vehsim.live.messages import Drag, Place, Step
from vehsim.live.server import Server
from vehsim.live.session import Session
from vehsim.planning import drafts
from vehsim.planning.problem.solver import Patience
from vehsim.runtime.signals import raising

PATIENCE = 600.0  # s, on a busy machine


class Browser:
    """A socket, the kinds of the messages it received, and the last of each kind."""

    def __init__(self, socket):
        self.socket, self.seen, self.last = socket, [], {}

    async def send(self, **message):
        await self.socket.send(json.dumps(message))

    async def until(self, kind, where=lambda message: True):
        """The next message of a kind: a dictionary, or a block for scene, motion and draft."""
        while True:
            raw = await asyncio.wait_for(self.socket.recv(), PATIENCE)
            message = Block(raw) if isinstance(raw, bytes) else json.loads(raw)
            header = message.header if isinstance(message, Block) else message
            self.seen.append(header["kind"])
            self.last[header["kind"]] = message
            if header["kind"] == kind and where(message):
                return message


@asynccontextmanager
async def served(path, **how):
    """A running server, as its address."""
    address = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(Server(path, path.parent / "out", **how).run(address.set_result))
    try:
        yield (await asyncio.wait_for(address, PATIENCE)).replace("http://", "")
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@asynccontextmanager
async def browser(address, query="", **how):
    async with connect(f"ws://{address}socket{query}", max_size=None, **how) as socket:
        yield Browser(socket)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "drive.toml"
    path.write_text(SHOT)
    return path


def points(draft):
    """The path (n, 3) m that a draft draws."""
    return draft.array(draft.header["paths"][0]["points"]).reshape(-1, 3)


def centre(scene, obstacle):
    """The middle (2,) m of an obstacle's mesh, from above."""
    (found,) = [shape for shape in scene.header["shapes"] if f"/obstacles/{obstacle}/" in shape["name"]]
    corners = scene.array(found["points"]).reshape(-1, 3)[:, :2]
    return (corners.min(axis=0) + corners.max(axis=0)) / 2


def texts(state):
    return " ".join(problem["text"] for problem in state["problems"])


def moved(kind, x, y, heading=None, **more):
    return {"kind": kind, "key": MARK, "position": [x, y, 0.0], "heading": heading} | more


def test_a_drag_is_drawn_solved_saved_and_undone(path):
    async def play():
        async with served(path) as address, browser(address) as page:
            scene = await page.until("scene")
            assert [mark["frame"] for mark in scene.header["marks"]] == [1001, 1073]
            state = await page.until("state")
            assert state["solved"] and not state["changed"]
            handle = state["handles"][1]
            assert handle["key"] == MARK and handle["place"] == [8, 1, 0]
            assert (handle["vehicle"], handle["mark"], handle["follows"]) == ("car", 1, ["car"])

            for y in (1.1, 1.3, 1.5):
                await page.send(**moved("drag", 8.0, y, 4.0))
                draft = await page.until("draft")
                path_drawn = points(draft)
                assert path_drawn[-1] == pytest.approx([8.0, y, 0.0], abs=1e-4)
            assert path.read_text() == SHOT and not (path.parent / "drive.toml.autosave").exists()

            await page.send(**moved("place", 8.0, 1.5, 4.0))
            motion = await page.until("motion")
            assert motion.header["marks"][1]["position"] == [8.0, 1.5, 0.0]
            assert motion.header["marks"][1]["heading"] == pytest.approx(4.0, abs=1e-3)
            state = await page.until("state", lambda message: message["solved"])
            assert state["changed"] and state["undo"] and path.read_text() == SHOT
            assert (path.parent / "drive.toml.autosave").exists()

            await page.send(kind="save")
            await page.until("said")
            text = SHOT.replace("[8, 1, 0]\nheading = 0\n", "[8, 1.5, 0]\nheading = 4.0\n")
            assert path.read_text() == text and not (path.parent / "drive.toml.autosave").exists()

            await page.send(kind="undo")
            motion = await page.until("motion")
            assert motion.header["marks"][1]["position"] == [8.0, 1.0, 0.0]

    asyncio.run(play())


def test_a_motion_that_lags_behind_the_handle_follows_when_the_drag_pauses(path, monkeypatch):
    """Also on release: the dragged motion, which is compared with the solved one, is then at its end."""
    whole = Session(path, path.parent / "out", lambda what, done: None)
    whole.solve()
    whole.scene()
    wanted = points(Block(whole.drag(Drag(**moved("drag", 8.0, 3.0, 20.0)))))
    monkeypatch.setattr(drafts, "GLANCE", Patience(1, unfinished=np.inf))

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            await page.send(**moved("drag", 8.0, 3.0, 20.0))
            # on a busy machine, the draft before is never sent, because a newer one takes its place
            await page.until("draft", lambda block: np.abs(points(block) - wanted).max() < 0.01)

    asyncio.run(play())
    whole.drag(Drag(**moved("drag", 8.0, 1.0, 0.0)))
    assert whole.lags
    whole.place(Place(**moved("place", 8.0, 1.0, 0.0)))
    assert not whole.lags and not whole._drafts["car"].draft.unfinished
    whole.close()


def test_the_page_exports_the_bytes_of_the_command(path):
    """After a drag, a retime, an undo and a redo, in another process: every file, reports included."""

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            await page.send(**moved("drag", 8.0, 1.4, 4.0))
            await page.until("draft")
            placed = moved("place", 8.0, 1.5, 4.0)
            for message in (placed, placed | {"frame": 1085}, {"kind": "undo"}, {"kind": "redo"}):
                await page.send(**message)
            await page.send(kind="save")
            await page.until("said")
            await page.send(kind="export")
            await page.until("said", lambda message: "exported" in message["text"])

    asyncio.run(play())
    assert "frame = 1085" in path.read_text()
    command = [sys.executable, "-m", "vehsim", "export", path, "--out", path.parent / "cli", "--to", "usd,html"]
    subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)
    ours, theirs = (content(path.parent / name / "drive") for name in ("out", "cli"))
    assert "drive.html" in ours and ours == theirs


def content(folder):
    """The bytes of every file below a folder."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("wait", (0.0, 60.0), ids=("drawn before it is solved", "drawn when it is solved"))
def test_a_browser_that_drags_during_the_first_solve_gets_one_scene_and_a_draft(path, monkeypatch, wait):
    drawn, began = Session.scene, threading.Event()
    monkeypatch.setattr(live_session, "WAIT", wait)

    def slow(session):
        began.set()
        time.sleep(0.5)
        return drawn(session)

    monkeypatch.setattr(Session, "scene", slow)

    async def play():
        async with served(path) as address:
            await asyncio.to_thread(began.wait, PATIENCE)  # the scene is on its way
            async with browser(address) as page:
                await page.until("scene")
                await page.send(**moved("drag", 8.0, 1.1))
                await page.until("draft")
                assert page.seen.count("scene") == 1

    asyncio.run(play())


def test_a_browser_that_comes_after_a_drag_gets_the_scene(path):
    """The others hear that it was drawn, and the state again when it is."""

    async def play():
        async with served(path) as address, browser(address) as first:
            await first.until("state", lambda message: message["solved"])
            await first.send(**moved("place", 8.0, 1.1))
            await first.until("motion")
            await first.send(**moved("drag", 8.0, 1.2))
            await first.until("draft")
            async with browser(address) as second:
                await second.until("scene")
            drafted = len(first.seen)
            await first.send(kind="unknown")
            await first.until("refused")  # the answer comes after all that was told before
            told = [kind for kind in first.seen[drafted:] if kind in ("progress", "state")]
            assert told[-1:] == ["state"]  # a page that hears of progress last says "drawing" for ever

    asyncio.run(play())


WALL = """
[[world.obstacle]]
shape = "box"
centre = [12, 5, 0]    # in the way
size = [1, 2, 2]
heading = 10
[[world.obstacle]]
shape = "polygon"
points = [[0, -9], [2, -9], [1, -8.0]]
base = 0.5
[camera]
rig = "static"
position = [-5, -14, 6]
look_at = [8, 0, 0]   # the garage
"""


@pytest.fixture
def afloat(tmp_path):
    path = tmp_path / "afloat.toml"
    water = "[[world.water.wave]]\nheight = 0.2\nlength = 9\n"
    path.write_text(
        SHOT.replace("[[vehicle]]", water + "[[vehicle]]", 1).replace('"car"', '"boat"').replace("1073", "1145")
    )
    return path


def test_a_boat_is_shown_before_the_water_moves(afloat):
    async def run():
        async with served(afloat) as address, browser(address) as page:
            scene = await page.until("scene")
            water = await page.until("water")
            still = scene.header["water"]
            # on a busy machine, the scene is that of straight guesses, on another grid
            counts = [np.prod(one["shape"]) for one in (still, water.header)]
            assert len(scene.array(still["foam"])) == counts[0]
            assert len(water.array(water.header["foam"])) == 145 * counts[1]
            height = scene.array(still["start"])[2::3].max()
            assert height == pytest.approx(0.1, abs=0.01)  # the wave itself is there, half of 0.2 m
            before = len(page.seen)
            await page.send(**moved("place", 9, 1))  # a boat in plan view, which makes no wake
            await page.until("state", lambda state: state["solved"] and state["changed"])
            assert "motion" in page.seen[before:] and not {"scene", "water"} & set(page.seen[before:])
            async with browser(address) as late:  # it sees what the others see
                assert (await late.until("water")).header == page.last["water"].header

    asyncio.run(run())


def test_water_is_drawn_again_only_if_something_moves_it(afloat, monkeypatch):
    """Not for a note; for an obstacle beside it, whose motion is then solved again, but to the same water; and for
    another wave."""
    drawn, block = [], live_session.draw_water
    monkeypatch.setattr(live_session, "draw_water", lambda *given: drawn.append(given[0]) or block(*given))
    afloat.write_text(afloat.read_text() + '[[world.obstacle]]\nshape = "sphere"\ncentre = [30, 40, 5]\nradius = 2\n')

    async def run():
        async with served(afloat) as address, browser(address) as page:
            first = await page.until("water")
            await page.send(kind="add_note", frame=1010, text="look")
            await page.until("state", lambda state: len(state["notes"]) == 1 and state["solved"])
            assert len(drawn) == 1
            await page.send(**(moved("place", 30, 41) | {"key": "world.obstacle[0].centre"}))
            await page.until("scene")
            assert (await page.until("water")).content == first.content and len(drawn) <= 2
            await page.send(kind="change", key="world.water.wave[0].height", value=0.3)
            await page.until("scene")
            assert (await page.until("water")).content != first.content and len(drawn) <= 3

    asyncio.run(run())


def test_what_is_requested_does_not_wait_for_the_water(afloat, monkeypatch):
    pouring, block = threading.Event(), live_session.draw_water

    def slowly(take, stage, progress):
        def told(share):
            progress(share)
            if share > 0 and not pouring.is_set():
                pouring.set()
                while True:
                    progress(share)  # until it is interrupted
                    time.sleep(0.01)

        return block(take, stage, told)

    monkeypatch.setattr(live_session, "draw_water", slowly)

    async def run(first):
        async with served(afloat) as address, browser(address) as page:
            await asyncio.to_thread(pouring.wait, PATIENCE)
            await first(page)

    async def save(page):
        await page.send(kind="save")
        assert "saved" in (await page.until("said"))["text"] and "water" not in page.seen
        await page.until("water")  # it starts again

    async def drive(page):
        """Its boat rides the waves of the picture, so these come first."""
        await page.send(kind="drive", vehicle="boat")
        await page.until("driving")
        assert "water" in page.seen
        await page.send(kind="stop")
        await page.until("driven")

    for first in (save, drive):
        pouring.clear()
        asyncio.run(run(first))


def test_obstacles_and_what_a_camera_looks_at_are_dragged(path):
    far = SHOT.replace("1073", "1145").replace("[8, 1, 0]", "[24, 1, 0]").replace("segments = 8", "clearance = 0.3")
    path.write_text(far + WALL)

    async def play():
        async with served(path) as address, browser(address) as page:
            assert centre(await page.until("scene"), "box_0") == pytest.approx([12, 5], abs=1e-3)
            state = await page.until("state", lambda message: message["solved"])
            found = {one["key"]: one for one in state["handles"]}
            box, prism = found["world.obstacle[0].centre"], found["world.obstacle[1].points"]
            assert (box["obstacle"], box["heading"], box["follows"]) == ("box_0", 10, ["car"])
            assert prism["place"] == pytest.approx([1, -26 / 3, 0.5]) and not prism["turns"]
            assert found["camera.look_at"]["follows"] == [] and found["camera.look_at"]["vehicle"] is None

            for y in (3.0, 2.0, 1.0):
                await page.send(kind="drag", key=box["key"], position=[12.0, y, 0.0], heading=10)
                draft = await page.until("draft")
            drawn = points(draft)
            beside = drawn[np.abs(drawn[:, 0] - 12).argmin()]
            assert abs(beside[1] - 1) > 1 + 0.8  # half of the box, half of the car
            assert "in the way" in path.read_text()
            await page.send(kind="place", key=box["key"], position=[12.0, 1.0, 0.0], heading=15.0)
            moved = await page.until("scene")
            assert centre(moved, "box_0") == pytest.approx([12, 1], abs=1e-3)
            state = await page.until("state", lambda message: message["solved"])
            box = next(one for one in state["handles"] if one["key"] == box["key"])
            assert box["place"] == [12, 1, 0] and box["drawn"] == {"place": [12, 1, 0], "heading": 15}

            await page.send(kind="place", key=prism["key"], position=[1.0, -10.0, 0.5])
            moved = await page.until("scene")  # states come twice, so that the last one may be the box's
            await page.until("state", lambda message: message["solved"])
            await page.send(kind="drag", key="camera.look_at", position=[8.0, 2.0, 1.0])
            assert "on release" in (await page.until("undrawn"))["text"]
            await page.send(kind="place", key="camera.look_at", position=[8.0, 2.0, 1.0])
            motion = await page.until("motion")  # no vehicle moves otherwise
            before, after = (
                block.array(block.header["cameras"][0]["poses"]).reshape(-1, 7) for block in (moved, motion)
            )
            assert np.abs(before[:, :3] - after[:, :3]).max() < 1e-6 < np.abs(before - after).max()
            await page.send(kind="save")
            await page.until("said")
            text = path.read_text()
            for line in (
                "centre = [12, 1.0, 0]    # in the way", "heading = 15.0\n", "look_at = [8, 2.0, 1.0]   # the garage",
                "points = [[0, -10.333], [2, -10.333], [1, -9.333]]\nbase = 0.5\n",
            ):  # fmt: skip
                assert line in text
            for _ in range(3):
                await page.send(kind="undo")
            await page.until("state", lambda message: message["solved"] and not message["undo"])
        assert path.with_name("drive.toml.autosave").read_text().endswith(WALL)

    asyncio.run(play())


def test_a_dragged_motion_that_was_not_found_again_is_kept_as_guess(path):
    """A box is pushed through the path, which stays before it; solved anew, the car passes behind the box."""
    far = SHOT.replace("1073", "1145").replace("[8, 1, 0]", "[24, 1, 0]").replace("segments = 8", "clearance = 0.3")
    path.write_text(far + WALL)
    box = "world.obstacle[0].centre"

    def side(block):
        line = points(block)
        return line[np.abs(line[:, 0] - 12).argmin(), 1]

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            for y in (3.0, 2.0, 1.0, 0.0, -0.5):
                await page.send(kind="drag", key=box, position=[12.0, y, 0.0])
                draft = await page.until("draft")
            assert side(draft) < -2
            await page.send(kind="place", key=box, position=[12.0, -0.5, 0.0])
            assert side(await page.until("scene")) > 1
            state = await page.until("state", lambda message: message["solved"])
            assert [one["keeps"] for one in state["problems"] if "keeps" in one] == ["car"]
            await page.send(kind="keep_dragged", vehicle="boat")
            assert "drag again" in (await page.until("refused"))["text"]
            await page.send(kind="keep_dragged", vehicle="car")
            assert side(await page.until("motion")) < -2
            state = await page.until("state", lambda message: message["solved"])
            assert not any("keeps" in one for one in state["problems"])
            await page.send(kind="keep_dragged", vehicle="car")  # the file has changed since
            assert "drag again" in (await page.until("refused"))["text"]
            await page.send(kind="save")
            await page.until("said")
        assert 'guess = "drive.car.guess.001.npz"' in path.read_text()
        assert Shot.load(path).solve().clips["car"].positions[:, 1].min() < -2
        (path.parent / "drive.car.guess.001.npz").unlink()
        (problem,) = Shot.load(path).check()
        assert problem.key == "vehicle[0].motion.guess" and "no such file" in problem.message

    asyncio.run(play())


@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize("helps", [True, False])
def test_a_release_that_would_be_a_stunt_starts_from_the_dragged_motion(path, monkeypatch, helps, earlier):
    """If that does not help either, the file stays as it was. An ``earlier`` guess of the file stays beside it."""
    own, text = path.with_name("own.npz"), SHOT.replace("frame = 1073", "frame = 1169").replace("= 8", "= 16", 1)
    if earlier:
        Shot.from_dict(tomllib.loads(text)).solve().clips["car"].save(own)
        text = text.replace("segments = 16", 'segments = 16\nguess = "own.npz"')
    path.write_text(text)
    session, real = Session(path, path.parent, lambda *_: None), Session.solve

    def solve(self):
        shown = real(self)
        guessed = "car.guess" in self.document.text
        if self.take is not None and not (guessed and helps):
            self.take.report["vehicles"]["car"]["character"] = "stunt"
        return shown

    session.solve()
    session.prepare()
    place = {"key": MARK, "position": [9.0, 2.0, 0.0]}
    session.drag(Drag(kind="drag", **place))
    assert session._drafts["car"].draft.character != "stunt"
    monkeypatch.setattr(Session, "solve", solve)
    session.place(Place(kind="place", **place))
    before = session.document.text
    shown = session.compare_dragged()
    assert shown is not None and session.solved
    said = json.dumps(session.problems)
    if helps:
        assert 'guess = "drive.car.guess.001.npz"' in session.document.text and 'driven as \\"stunt\\"' in said
        assert Shot.from_dict(session.document.data, path.parent).solve().report["vehicles"]["car"]["success"]
        assert ("own.npz" in said) == earlier and "undo" in said
        session.undo(Step(kind="undo"))
    else:
        assert "its guess now" not in said and not session.document.redoable
    assert session.document.text == before
    guess = path.with_name("drive.car.guess.001.npz")
    assert guess.exists()  # for redo, if it helped
    session.close()
    assert not guess.exists() and own.exists() == earlier


def test_a_difference_that_comes_from_the_grid_offers_no_guess(path, monkeypatch):
    """The car speeds up and slows down: on 4 segments it does so elsewhere than on 16, also from a guess."""
    path.write_text(SHOT.replace("segments = 8", "segments = 16"))
    monkeypatch.setattr(drafts, "UNKNOWNS", 2 * 4)
    session = Session(path, path.parent, lambda *_: None)
    session.solve()
    session.prepare()
    place = {"key": MARK, "position": [9.0, 2.0, 0.0]}
    session.drag(Drag(kind="drag", **place))
    session.place(Place(kind="place", **place))
    session.compare_dragged()
    (told,) = [one for one in session.problems if "dragged" in one["text"]]
    assert "the dragged one, because a drag is solved on a coarser grid" in told["text"] and "keeps" not in told


def test_what_cannot_be_met_says_why_and_can_be_undone(path):
    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("scene")
            await page.until("state")
            await page.send(**moved("drag", 8.0, 900.0))
            assert "off by" in (await page.until("undrawn"))["text"]
            await page.send(**moved("place", 8.0, 900.0))
            state = await page.until("state", lambda message: message["problems"])
            assert not state["solved"] and "need 300 m/s" in texts(state)
            await page.send(kind="undo")
            await page.until("motion")
            state = await page.until("state", lambda message: message["solved"])
            assert "need 300 m/s" not in texts(state)

    asyncio.run(play())


def test_motion_from_the_cache_needs_no_straight_guesses(path, monkeypatch):
    """Not on a slow machine either, where it takes longer than a solve may before guesses are drawn."""
    monkeypatch.setenv("VEHSIM_CACHE", str(path.parent / "cache"))
    monkeypatch.setenv("VEHSIM_CACHE_GB", "1")
    solve, drawn = Shot.solve, []

    def slow(shot, *given):
        time.sleep(1.2 * live_session.WAIT)
        return solve(shot, *given)

    monkeypatch.setattr(Shot, "solve", slow)
    for expected in (1, 0):
        session = Session(path, path.parent / "out", lambda what, done: None, drawn.append)
        session.solve()
        session.close()
        assert len([block for block in drawn if Block(block).header["kind"] == "scene"]) == expected
        drawn.clear()


def test_each_iterate_is_drawn(path, monkeypatch):
    """The first solve moves the vehicle along its iterates; later ones draw their paths beside the present motion."""
    monkeypatch.setattr(live_session, "WAIT", 0.0)
    monkeypatch.setattr(live_session, "SHARE", np.inf)
    monkeypatch.setenv("VEHSIM_CACHE", str(path.parent / "cache"))

    async def play():
        async with served(path) as address, browser(address) as page:
            scene = await page.until("scene")
            line = points(scene)
            assert [mark["position"] for mark in scene.header["marks"]] == [[0, 0, 0], [8, 1, 0]]
            assert np.ptp(line[:, 1] / np.maximum(line[:, 0], 1e-3)[-1]) == pytest.approx(1 / 8, abs=1e-3)
            first = points(await page.until("preview"))
            solved = points(await page.until("motion"))
            assert page.seen.count("scene") == 1 and page.seen.count("preview") > 5
            last = points(page.last["preview"])
            away = [np.abs(drawn - solved).max() for drawn in (line, first, last)]
            assert away[2] < 0.01 < away[0] and away[1] > 0.01

            await page.send(**moved("place", 8.0, 2.0))
            drawn = points(await page.until("iterate"))
            assert drawn.shape == solved.shape and await page.until("motion")

    asyncio.run(play())


def test_a_shot_that_is_not_solved_has_marks_to_drag(tmp_path):
    path = tmp_path / "rock.toml"
    flight = SHOT.replace('"car"', '"helicopter"').replace("[[vehicle]]", '[world]\nterrain = "hills"\n[[vehicle]]', 1)
    flight = flight.replace("1073", "1121").replace("[0, 0, 0]\nheading", "[0, 0, 30]\nheading")
    path.write_text(flight.replace("[8, 1, 0]", "[8, 1, -9]"))

    async def play():
        async with served(path) as address, browser(address) as page:
            scene = await page.until("scene")
            assert [mark["position"] for mark in scene.header["marks"]] == [[0, 0, 30], [8, 1, -9]]
            state = await page.until("state", lambda message: message["problems"])
            assert not state["solved"] and "inside rock" in texts(state)
            assert [handle["follows"] for handle in state["handles"]] == [[], []]
            async with browser(address) as second:
                await second.until("scene")

            await page.send(kind="add_mark", vehicle="helicopter", frame=1061)
            added = await page.until("motion")
            assert [mark["frame"] for mark in added.header["marks"]] == [1001, 1061, 1121]
            await page.send(kind="undo")
            assert len((await page.until("motion")).header["marks"]) == 2

            await page.send(**moved("drag", 8.0, 1.0) | {"position": [8.0, 1.0, -8.0]})
            assert "on release" in (await page.until("undrawn"))["text"]
            await page.send(**moved("place", 8.0, 1.0) | {"position": [8.0, 1.0, -8.0]})
            motion = await page.until("motion")
            assert motion.header["marks"][1]["position"] == [8, 1, -8]
            assert not (await page.until("state"))["solved"]
            await page.send(**moved("place", 8.0, 1.0) | {"position": [8.0, 1.0, 30.0]})
            state = await page.until("state", lambda message: message["solved"])
            assert state["handles"][1]["follows"] == ["helicopter"]

    asyncio.run(play())


def slowly(monkeypatch, began):
    """Solves take half a second more, can be interrupted, and are counted."""
    solve = Shot.solve

    def slow(self, progress, **how):
        began.append(self.file.shot.end_frame)
        for _ in range(50):
            progress("solving", 0.0)
            time.sleep(0.01)
        return solve(self, progress, **how)

    monkeypatch.setattr(Shot, "solve", slow)


CLEARANCE = "vehicle[0].motion.clearance"


def test_changes_that_wait_are_solved_once(path, monkeypatch):
    began = []
    slowly(monkeypatch, began)

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            first = len(began)
            for k in range(20):
                await page.send(kind="change", key=CLEARANCE, value=0.5 + k / 100)
            state = await page.until("state", lambda message: message["solved"] and message["changed"])
            assert next(one["value"] for one in state["settings"] if one["key"] == CLEARANCE) == 0.69
            assert len(began) - first <= 3
            for _ in range(20):
                await page.send(kind="undo")
            await page.until("state", lambda message: message["solved"] and not message["undo"])

    asyncio.run(play())


def test_saving_and_exporting_during_a_solve_do_not_end_it(path, monkeypatch):
    """What is said comes after the state, so that the page still shows it."""
    began = []
    slowly(monkeypatch, began)

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            first = len(began)
            await page.send(kind="change", key=CLEARANCE, value=0.6)
            await page.until("progress")
            await page.send(kind="save")
            await page.send(kind="export")
            said = await page.until("said")
            assert said["text"] == "saved drive.toml" and page.seen[-2] == "state"
            assert page.last["state"]["solved"] and not page.last["state"]["changed"]
            assert "exported" in (await page.until("said"))["text"] and len(began) == first + 1
            await page.send(kind="change", key=CLEARANCE, value=0.7)
            await page.send(kind="delete_mark", vehicle="car", mark=7)
            assert "no such mark" in (await page.until("refused"))["text"] and page.seen[-2] == "state"
            await page.until("state", lambda message: message["solved"])  # the refused change has interrupted it

    asyncio.run(play())


def test_a_browser_that_leaves_in_a_drag_releases_the_mark(path):
    """Others see the motion solved where it was dragged last; it is in the autosave; undo takes it back."""

    autosave = path.with_name("drive.toml.autosave")

    async def play():
        async with served(path) as address, browser(address) as first:
            await first.until("state", lambda message: message["solved"])
            async with browser(address) as second:
                scene = await second.until("scene")
                await first.send(**moved("drag", 8.0, 1.4))
                draft = await second.until("draft")
                assert points(draft)[-1] == pytest.approx([8, 1.4, 0], abs=1e-4)
                await first.socket.close()
                motion = await second.until("motion")
                assert points(motion)[-1] == pytest.approx([8, 1.4, 0], abs=1e-4)
                state = await second.until("state", lambda message: message["solved"])
                assert state["changed"] and "position = [8, 1.4, 0]" in autosave.read_text()
                await second.send(kind="undo")
                assert (points(await second.until("motion")) == points(scene)).all()
        assert path.read_text() == SHOT

    asyncio.run(play())


def test_what_refers_to_earlier_tables_is_refused(path):
    """An added mark has taken the index of the one that a browser drags, deletes or changes before it hears of it."""

    async def play():
        async with served(path) as address, browser(address) as page:
            state = await page.until("state", lambda message: message["solved"])
            then = state["tables"]
            late = [
                moved("place", 5.0, 5.0, tables=then),
                {"kind": "delete_mark", "vehicle": "car", "mark": 1, "tables": then},
                {"kind": "change", "key": "vehicle[0].motion.mark[1].frame", "value": 1050, "tables": then},
            ]
            await page.send(kind="add_mark", vehicle="car", frame=1037)
            for message in late:
                await page.send(**message)
                assert "other tables" in (await page.until("refused"))["text"]
            await page.send(**moved("drag", 5.0, 5.0, tables=then))
            assert "other tables" in (await page.until("undrawn"))["text"]
            await page.send(kind="delete_mark", vehicle="car", mark=1, tables=then + 1)
            state = await page.until("state", lambda message: message["solved"])
            assert [one["place"] for one in state["handles"]] == [[0, 0, 0], [8, 1, 0]]

    asyncio.run(play())


def test_a_session_that_ends_in_a_drag_keeps_it(path):
    """The next session opens with the mark where it was dragged last, and an edit and a save that waited are done."""
    autosave = path.with_name("drive.toml.autosave")

    async def play(*messages):
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            for message in messages:
                await page.send(**message)
            await page.until("draft" if messages[-1]["kind"] == "drag" else "progress")

    asyncio.run(play(moved("drag", 8.0, 1.2), moved("drag", 8.0, 1.4)))
    assert path.read_text() == SHOT and "position = [8, 1.4, 0]" in autosave.read_text()
    asyncio.run(play(moved("place", 9.0, 1.4), {"kind": "add_note", "frame": 1010, "text": "slow"}, {"kind": "save"}))
    assert not autosave.exists()
    assert "position = [9.0, 1.4, 0]" in path.read_text() and 'text = "slow"' in path.read_text()


def test_a_save_waits_for_the_edit_before_it_when_the_session_ends(path, monkeypatch):
    """The session ends while an edit is made in the solver's thread: the save that came after it has the edit."""
    entered, add_note = threading.Event(), Session.add_note

    def slow(session, wanted):
        entered.set()
        session._ending.wait()
        time.sleep(0.3)
        return add_note(session, wanted)

    monkeypatch.setattr(Session, "add_note", slow)

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            await page.send(kind="add_note", frame=1010, text="slow")
            await page.send(kind="save")
            await asyncio.to_thread(entered.wait)

    asyncio.run(play())
    assert 'text = "slow"' in path.read_text() and not path.with_name("drive.toml.autosave").exists()


def test_ctrl_c_does_not_break_a_step_of_the_session(path, monkeypatch):
    """An exception between two steps of the event loop would lose the next one, for which it waited for ever."""
    steps = []

    class Interrupted:
        def __init__(self, *where):
            pass

        async def run(self, ready):
            signal.raise_signal(signal.SIGINT)
            steps.append("the rest of the step")
            with pytest.raises(asyncio.CancelledError):
                await asyncio.sleep(PATIENCE)
            steps.append("cleanup")
            with pytest.raises(ArithmeticError):  # who does not want to wait for it
                signal.raise_signal(signal.SIGINT)
            raise asyncio.CancelledError

    monkeypatch.setattr(live_server, "Server", Interrupted)
    before = signal.signal(signal.SIGINT, raising(ArithmeticError))
    mine = signal.getsignal(signal.SIGINT)
    try:
        edit(path, path.parent, "localhost", 0, "", print)
        assert signal.getsignal(signal.SIGINT) is mine
    finally:
        signal.signal(signal.SIGINT, before)
    assert steps == ["the rest of the step", "cleanup"]


def test_the_session_ends_while_its_scene_is_made(path, monkeypatch):
    """Such as that of a boat in a sea, which takes a while; its browser is busy, too."""
    made = []

    def forever(take, folder, names, progress):
        made.append(take)
        while True:
            progress("usd", 0.5)
            time.sleep(0.01)

    monkeypatch.setattr("vehsim.delivery.exporters.write_files", forever)

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("progress", lambda message: message["text"] == "usd")

    asyncio.run(asyncio.wait_for(play(), PATIENCE))
    assert made


def test_nothing_that_is_sent_ends_the_session(path):
    """Every malformed message is answered; the last, good one still works."""
    good = moved("drag", 8.0, 1.2)
    broken = [
        "", "{", "null", "[]", "3", '"drag"', "\x00", b"\x00\xff", b"{}", "{}", "[" * 5000,
        *(
            json.dumps(good | change)
            for change in (
                {"kind": "delete"}, {"kind": 7}, {"key": MARK.replace("1", "2")}, {"key": None}, {"key": "x" * 201},
                {"key": "shot.name"}, {"position": []}, {"position": [1, 2]}, {"position": "here"},
                {"heading": "north"}, {"position": [1e300, 0, 0]}, {"position": [None] * 3}, {"frame": 0.5},
                {"path": "/etc/passwd"},
            )
        ),
        '{"kind": "drive"}', '{"kind": "drive", "vehicle": "car", "frame": "now"}',
        '{"kind": "sticks", "values": ["up"]}',
        json.dumps(good).replace("8.0", "NaN"), json.dumps(good).replace("8.0", "Infinity"),
    ]  # fmt: skip

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("scene")
            await page.until("state")
            for text in broken:
                await page.socket.send(text)
                kind = "undrawn" if "mark[2]" in str(text) or "shot.name" in str(text) else "refused"
                assert (await page.until(kind))["text"], text
            async with browser(address) as flood:
                await flood.socket.send("x" * 200_000)
                with pytest.raises(Exception, match="1009"):
                    await flood.until("refused")
            await page.socket.send(json.dumps(good))
            assert await page.until("draft")
        assert path.read_text() == SHOT

    asyncio.run(play())


def test_random_messages_neither_end_the_session_nor_leave_its_folder(tmp_path):
    path = tmp_path / "shots" / "drive.toml"
    path.parent.mkdir()
    path.write_text(SHOT)
    rng = np.random.default_rng(20)

    async def play():
        async with served(path) as address, browser(address) as page:
            state = await page.until("state", lambda message: message["solved"])
            for _ in range(300):
                await page.socket.send(hostile(rng))
            await page.send(kind="save")
            await page.until("said", lambda message: "saved" in message["text"])
            state = await page.until("state", lambda message: message["solved"] or message["problems"])
            while state["undo"]:
                await page.send(kind="undo")
                state = await page.until("state")
            await page.send(**moved("place", 8.0, 1.2))
            await page.until("state", lambda now: now["solved"] and now["handles"][1]["place"] == [8, 1.2, 0])

    asyncio.run(asyncio.wait_for(play(), PATIENCE))
    assert [file.name for file in tmp_path.iterdir()] == ["shots"]
    known = {"drive.toml", "drive.toml.autosave", "out"}
    assert all(file.name in known or file.name.startswith("drive.car.") for file in path.parent.iterdir())


def test_one_browser_edits_and_the_next_takes_over(path):
    async def play():
        async with served(path) as address:
            async with browser(address) as first:
                assert (await first.until("role"))["editor"]
                await first.until("scene")
                async with browser(address) as second:
                    assert not (await second.until("role"))["editor"]
                    scene = await second.until("scene")
                    await second.send(**moved("place", 9.0, 1.0))
                    assert "another browser" in (await second.until("refused"))["text"]
                    await first.send(**moved("drag", 8.0, 1.2))
                    assert await second.until("draft")
                    await first.socket.close()
                    assert (await second.until("role"))["editor"]
                    await second.send(**moved("place", 8.2, 1.0))
                    motion = await second.until("motion")
                    assert motion.header["marks"][1]["position"][0] == 8.2
                    assert scene.header["marks"][1]["position"][0] == 8.0
            async with browser(address) as late:  # a browser that opens again loses nothing
                scene = await late.until("scene")
                assert scene.header["marks"][1]["position"][0] == 8.2

    asyncio.run(play())


def status(url, **headers):
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def test_only_this_machine_or_a_token_opens_it(path):
    with pytest.raises(InputError, match="others could edit"):
        Server(path, path.parent, "0.0.0.0")

    async def play():
        async with served(path) as address:
            url = f"http://{address}"
            port = address.rstrip("/").rpartition(":")[2]
            ask = asyncio.to_thread
            assert await ask(status, url) == 200
            assert await ask(status, f"{url}../drive.toml") == 404
            assert await ask(status, f"{url}drive.toml") == 404
            assert await ask(status, url, Host=f"evil.example:{port}") == 403
            assert await ask(status, url, Origin="http://evil.example") == 403
            assert await ask(status, url, Host="[") == await ask(status, url, Origin="http://[") == 403
            with pytest.raises(Exception, match="403"):
                async with browser(address, origin="http://evil.example"):
                    pass
        async with served(path, token="sesame") as address:
            url, _, query = f"http://{address}".partition("?")
            assert query == "token=sesame"
            assert await ask(status, f"{url}?{query}") == 200
            for wrong in ("", "?token=", "?token=open", "?token=sesame2", "?token=%FF"):
                assert await ask(status, f"{url}{wrong}") == 403
            with pytest.raises(Exception, match="403"):
                async with browser(address.partition("?")[0]):
                    pass
            async with browser(address.partition("?")[0], "?token=sesame") as page:
                assert await page.until("role")

    asyncio.run(play())


def test_a_broken_file_is_explained_and_the_page_stays(path):
    path.write_text(SHOT.replace("segments", "segmnts"))

    async def play():
        async with served(path) as address, browser(address) as page:
            state = await page.until("state", lambda message: message["problems"])
            assert "segmnts" in texts(state) and not state["solved"]
            await page.send(kind="export")
            assert "not solved" in (await page.until("refused"))["text"]

    asyncio.run(play())


def test_every_moving_part_is_where_the_stage_has_it(tmp_path):
    """Poses computed from clips equal those read from the stage: rotors, steered and sprung wheels, trailers."""
    from vehsim.exporters.usd.stage import StageReader
    from vehsim.exporters.web.scene import Kinematics, group_poses
    from vehsim.lie.quaternions import angles_between

    shot = {
        "shot": {"schema": 1, "name": "parts"},
        "world": {"terrain": "hills"},
        "vehicle": [
            {
                "name": name,
                "asset": name,
                "motion": {
                    "method": "simulate",
                    "duration": 0.5,
                    "commands": [{"frame": 1001, **controls}],
                    "start": start,
                },
            }
            for name, controls, start in (
                ("truck", {"torque": 2000, "steering_rate": 0.4}, {"velocity": [3, 0, 0]}),
                ("helicopter", {"collective": 11000}, {"position": [0, 30, 40], "heading": 70}),
            )
        ],
    }
    take = Shot.from_dict(shot).solve()
    stage = StageReader(take.export(tmp_path, to=("usd",)) / "parts.usda")
    kinematics = Kinematics(take, stage)
    shown = group_poses(stage, np.arange(take.frames[0], take.frames[1] + 1, dtype=float))
    made = kinematics.poses(take, range(len(stage.groups)))
    assert len(stage.groups) > 8 and kinematics.can_show(take)
    assert np.abs(made[..., :3] - shown[..., :3]).max() < 1e-4
    turns = [np.roll(poses[..., 3:], 1, axis=-1).reshape(-1, 4) for poses in (made, shown)]
    assert angles_between(*turns).max() < 1e-3
    moved_by = [set(kinematics.moved_by(name)) for name in ("truck", "helicopter")]
    assert moved_by[0] | moved_by[1] == set(range(len(stage.groups))) and not moved_by[0] & moved_by[1]


def test_a_livery_the_light_and_tyre_marks_need_a_new_scene():
    """Everything else of a motion is shown in the scene that is there."""
    from vehsim.exporters.web.scene import Kinematics

    def solved(livery, mood="noon", asset="car"):
        motion = {"method": "simulate", "duration": 0.2, "start": {"velocity": [9, 0, 0]}}
        vehicle = {"name": "car", "asset": asset, "variants": {"livery": livery}, "motion": motion}
        shot = {"schema": 1, "name": "dressed", "end_frame": 1005}
        return Shot.from_dict({"shot": shot, "vehicle": [vehicle], "render": {"mood": mood}}).solve()

    class Stage:
        groups, tyre_marks, origin = (), (), np.zeros(3)

        def matrices(self, frame):
            return np.zeros((0, 4, 4))

    take = solved("red")
    kinematics = Kinematics(take, Stage())
    assert kinematics.can_show(take)
    assert not kinematics.can_show(solved("blue")) and not kinematics.can_show(solved("red", "dusk"))
    Stage.tyre_marks = ("/dressed/env/tyre_marks/car_front_0",)
    assert not kinematics.can_show(take)


def test_a_flight_that_no_longer_shows_its_ground_needs_a_new_scene():
    """Dragged below z = 0, a flight past a tower would have the ground above it."""
    from vehsim.exporters.web.scene import Kinematics

    def solved(height):
        motion = {"method": "simulate", "duration": 0.2, "start": {"position": [0, 0, height]}}
        tower = {"shape": "box", "name": "tower", "centre": [30, 0, 0], "size": [5, 5, 30]}
        vehicle = {"name": "heli", "asset": "helicopter", "motion": motion}
        shot = {"schema": 1, "name": "low", "end_frame": 1005}
        return Shot.from_dict({"shot": shot, "world": {"obstacle": [tower]}, "vehicle": [vehicle]}).solve()

    class Stage:
        groups, tyre_marks, origin = (), (), np.zeros(3)

        def matrices(self, frame):
            return np.zeros((0, 4, 4))

    kinematics = Kinematics(solved(20.0), Stage())
    assert kinematics.can_show(solved(15.0)) and not kinematics.can_show(solved(-15.0))


def test_a_drag_is_in_the_character_of_the_solved_motion(tmp_path):
    """Marks that leave too little time for the requested character: the draft begins where the plan is."""
    path = tmp_path / "hurried.toml"
    path.write_text(SHOT.replace("frame = 1073", "frame = 1065"))
    session = Session(path, tmp_path, lambda *_: None)
    assert session.solve() is not None
    assert "driven as" in session.problems[0]["text"], session.problems
    report = session.take.report["vehicles"]["car"]
    assert report["character"] != "normal"
    drawn = session._follow(session.shot, "car").clip()
    assert np.abs(drawn.positions - session.take.clips["car"].resample().positions).max() < 0.03


SPHERE = '[[world.obstacle]]\nshape = "sphere"\ncentre = [30, 5, 30]\nradius = 6\n'


def test_a_drag_has_the_segments_of_the_solved_motion(tmp_path):
    """Those of the shot are too few to pass the obstacle: a draft on them was up to 4 m away."""
    path = tmp_path / "past.toml"
    text = SHOT.replace('"car"', '"helicopter"').replace("1073", "1241") + SPHERE
    path.write_text(text.replace("[0, 0, 0]\nheading", "[0, 0, 30]\nheading").replace("[8, 1, 0]", "[60, 10, 30]"))
    session = Session(path, tmp_path, lambda *_: None)
    assert session.solve() is not None
    solved = session.take.clips["helicopter"]
    segments = session.take.report["vehicles"]["helicopter"]["segments"]
    drawn = session._follow(session.shot, "helicopter")
    assert sum(drawn._iterate.layout.legs) == segments > 8
    assert np.linalg.norm(drawn.clip().positions - solved.resample().positions, axis=1).max() < 1.0


def test_a_hurried_flight_on_few_segments_is_dragged(tmp_path, monkeypatch):
    """The plan is a stunt, which these segments cannot follow: the draft is in the character of the shot."""
    monkeypatch.setattr("vehsim.planning.planner.WORSE", np.inf)  # else it exceeds its own character by less
    path = tmp_path / "hurried.toml"
    bare = 'asset = "helicopter_lie"'
    text = (
        SHOT.replace('"car"', '"helicopter"')
        .replace('asset = "helicopter"', bare)
        .replace("segments = 8", "segments = 16")
        .replace("1073", "1121")
    )
    path.write_text(text.replace("[0, 0, 0]\nheading", "[0, 0, 30]\nheading").replace("[8, 1, 0]", "[60, 10, 30]"))
    session = Session(path, tmp_path, lambda *_: None)
    assert session.solve() is not None
    assert session.take.report["vehicles"]["helicopter"]["character"] == "stunt"
    for x in (60.0, 59.5):
        assert session.drag(Drag(key=MARK, position=[x, 10, 30])) is not None
        assert session._drafts["helicopter"].draft.clip().positions[-1] == pytest.approx([x, 10, 30], abs=1e-3)


BOX = '[[world.obstacle]]\nshape = "box"\ncentre = {}\nsize = [1, 1, 1]\n'
FAR = np.array([500_000.0, 4_212_000.0, 0.0])
"""As UTM coordinates are, m."""


def test_far_from_the_origin_everything_is_drawn_as_near_it(tmp_path):
    """Single precision resolves 0.5 m there: the page's positions are relative to a place nearby, its messages not."""
    more = BOX + '[[note]]\nframe = 1010\ntext = "here"\nposition = {}\n'
    drawn = {}
    for name, offset in (("near", 0 * FAR), ("far", FAR)):
        path = tmp_path / name / "drive.toml"
        path.parent.mkdir()
        places = {text: str((np.array(json.loads(text)) + offset).tolist()) for text in ("[0, 0, 0]", "[8, 1, 0]")}
        text = SHOT
        for old, new in places.items():
            text = text.replace(f"position = {old}", f"position = {new}")
        path.write_text(text + more.format(*((np.array(at) + offset).tolist() for at in ([4, 9, 0], [4, 1, 2]))))
        session = Session(path, tmp_path, lambda *_: None)
        session.solve()
        scene = Block(session.scene())
        origin = np.array(scene.header["origin"])
        place = [*(np.array([8.0, 1.5, 0.0]) + offset)]
        draft = Block(session.drag(Drag(key=MARK, position=place)))
        motion = Block(session.place(Place(key=MARK, position=place)))
        assert session.document.data["vehicle"][0]["motion"]["mark"][1]["position"] == place
        session.close()
        drawn[name] = [
            points(draft) + origin - offset,
            points(motion) + origin - offset,
            *(np.array(block.header["marks"][1]["position"]) + origin - offset for block in (scene, motion)),
            np.array(scene.header["notes"][0]["position"]) + origin - offset,
            np.append(centre(scene, "box_0"), 0) + origin - offset,
            *(
                block.array(group["poses"]).reshape(-1, 7)[:, :3] + origin - offset
                for block in (scene, draft, motion)
                for group in block.header["groups"]
            ),
            *(
                block.array(curve["values"])[:, None]
                for block in (scene, motion)
                for curve in block.header["curves"]
                if curve["name"] == "clearance"
            ),
        ]
    assert len(drawn["near"]) == len(drawn["far"]) > 20
    for near, far in zip(drawn["near"], drawn["far"], strict=True):
        assert np.abs(near - far).max() < 1e-3


class Stuck:
    """A socket whose browser reads nothing after the first message."""

    def __init__(self):
        self.sent, self.closed, self.reads = [], asyncio.Event(), asyncio.Event()

    async def send(self, message):
        self.sent.append(message)
        if len(self.sent) > 1:
            await self.reads.wait()

    async def close(self, code, reason):
        self.closed.set()


def test_a_browser_that_does_not_read_holds_up_nothing(monkeypatch):
    """It gets the newest draft when it reads again; if it never does, it is disconnected."""
    monkeypatch.setattr(live_server, "MOST", 1000)

    async def play():
        socket = Stuck()
        one = live_server.Browser(socket)
        sending = asyncio.create_task(one.send())
        for k in range(40):
            one.tell({"kind": "progress", "done": k})
            one.tell({"kind": "state", "k": k % 2})
            await asyncio.sleep(0)
            if k == 1:
                one.tell({"kind": "progress", "done": 7})
        socket.reads.set()
        for _ in range(100):
            await asyncio.sleep(0)
        await asyncio.wait_for(socket.closed.wait(), 10)
        sent = [json.loads(text) for text in socket.sent]
        assert [one["k"] for one in sent if one["kind"] == "state"][:4] == [0, 1, 0, 1]
        assert sum(one["kind"] == "progress" for one in sent) <= 3
        sending.cancel()

    asyncio.run(play())


def test_where_nothing_can_be_written_the_page_works(path, monkeypatch):
    """Such as in a folder that is read-only: the page says that changes are not kept."""
    session = Session(path, path.parent, lambda *_: None)
    session.solve()
    assert "cannot be written" not in texts(session.state)

    def refused(path, text):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr("vehsim.live.document._write", refused)
    session.place(Place(kind="place", key=MARK, position=[9.0, 2.0, 0.0]))
    assert session.solved and "drive.toml.autosave cannot be written: Read-only file system" in texts(session.state)
    session.undo(Step(kind="undo"))
    assert session.solved and "cannot be written" not in texts(session.state)
    session.close()


def test_a_file_whose_name_is_no_text_is_opened(tmp_path):
    path = tmp_path / "dr\udcffive.toml"
    path.write_text(SHOT)

    async def play():
        async with served(path) as address:
            answer = await asyncio.to_thread(urllib.request.urlopen, f"http://{address}")
            assert b"<title>dr?ive</title>" in answer.read()

    asyncio.run(play())


def test_an_error_of_the_system_does_not_end_the_session(path, monkeypatch):
    """Such as a full disk, in the first solve: the page says it, and the next solve works."""
    solve, failed, opened = Session.solve, [], threading.Event()

    def full_once(self):
        if not failed:
            failed.append(opened.wait(PATIENCE))
            raise OSError(errno.ENOSPC, "No space left on device", "/scratch")
        return solve(self)

    monkeypatch.setattr(Session, "solve", full_once)

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("role")
            opened.set()
            refused = await page.until("refused")
            assert refused["text"] == "/scratch: No space left on device"
            assert live_server._described(OSError(errno.ENOSPC, "No space left on device")) == "No space left on device"
            await page.send(kind="undo")
            assert await page.until("scene")

    asyncio.run(play())
    assert failed == [True]
