"""The live page in a real browser: a mark is dragged with the mouse, and the keys do what the help says."""

import asyncio
import math
import re
import subprocess
import sys
import tomllib
from contextlib import asynccontextmanager

import numpy as np
import pytest

pytest.importorskip("websockets", reason='needs the extra: pip install "vehsim[live]"')

from tests.browser import PATIENCE, at, browser
from tests.live.test_server import SHOT, content, served
from tests.shot.test_blocking import KEYS, stage_with

PLACE = """(() => {
  const v = vehsim.viewer, box = document.getElementById("view").getBoundingClientRect();
  const p = v.rings[1].position.clone().project(v.view);
  return [box.left + (p.x + 1) / 2 * box.width, box.top + (1 - p.y) / 2 * box.height];
})()"""
SOLVED = "document.getElementById('status').textContent.endsWith(': solved')"
UNSOLVED = "document.getElementById('status').textContent.endsWith(': not solved')"

OPEN = f"typeof vehsim !== 'undefined' && vehsim.viewer && document.getElementById('message').hidden && {SOLVED}"


def written(folder, text):
    """A shot file; skips the test without a browser."""
    browser()
    path = folder / "drive.toml"
    path.write_text(text)
    return path


@asynccontextmanager
async def opened(path):
    """The page of a served shot, with its solved motion."""
    async with served(path) as address, at(f"http://{address}", path.parent / "profile") as page:
        await page.until(OPEN)
        yield page


def test_a_mark_is_dragged_with_the_mouse(tmp_path):
    path = written(tmp_path, SHOT)

    async def play():
        async with opened(path) as page:
            await page.value("vehsim.viewer.orbit.target.set(5, 1, 0); vehsim.viewer.camera.position.set(-4, -12, 12)")
            await page.value("vehsim.viewer.orbit.update(); vehsim.viewer.draw()")
            x, y = await page.value(PLACE)
            await page.mouse("Moved", x, y)
            await page.until("document.getElementById('view').style.cursor === 'grab'")
            assert await page.value("vehsim.viewer.rings[1].material.color.getHexString()") == "ffe066"
            await page.mouse("Pressed", x, y)
            before = await page.value("vehsim.viewer.lines.get('car').geometry.attributes.position.array.at(-3)")
            for k in range(1, 6):
                await page.mouse("Moved", x + 4 * k, y - k)
            await page.until("document.getElementById('status').textContent.startsWith('dragging')")
            drawn = await page.value("vehsim.viewer.lines.get('car').geometry.attributes.position.array.at(-3)")
            assert drawn != before and path.read_text() == SHOT
            await page.mouse("Released", x + 20, y - 5)
            await page.until("!document.getElementById('do-undo').disabled")
            await page.until(SOLVED)

            await page.key("End", "End")
            assert await page.value("vehsim.viewer.frame") == 1073
            await page.key("ArrowLeft", "ArrowLeft", 8)
            assert await page.value("vehsim.viewer.frame") == 1063

            await page.value("document.getElementById('do-save').click()")
            await page.until("document.getElementById('do-save').disabled")
            moved = tomllib.loads(path.read_text())["vehicle"][0]["motion"]["mark"][1]["position"]
            assert moved != [8, 1, 0] and moved[2] == 0
            ring = await page.value("vehsim.viewer.rings[1].position.toArray()")
            assert ring == pytest.approx(moved, abs=1e-3)

            await page.value("document.getElementById('do-undo').click()")
            await page.until("document.getElementById('do-undo').disabled")
            await page.until(SOLVED)
            assert await page.value("vehsim.viewer.rings[1].position.toArray()") == [8, 1, 0]

    asyncio.run(play())


def test_a_browser_that_is_killed_in_a_drag_loses_nothing(tmp_path):
    """Another browser shows the mark where it was, and undo takes it back."""
    path = written(tmp_path, SHOT)

    async def play():
        async with served(path) as address:
            async with at(f"http://{address}", tmp_path / "first") as page:
                await page.until(OPEN)
                x, y = await page.value(PLACE)
                await page.mouse("Pressed", x, y)
                for k in range(1, 6):
                    await page.mouse("Moved", x + 4 * k, y - k)
                await page.until("document.getElementById('status').textContent.startsWith('dragging')")
                ring = await page.value("vehsim.viewer.rings[1].position.toArray()")
                page.kill()
            async with at(f"http://{address}", tmp_path / "second") as page:
                await page.until(f"{OPEN} && !document.getElementById('do-undo').disabled")
                assert ring != [8, 1, 0] and path.read_text() == SHOT
                assert not await page.value("document.getElementById('do-add').disabled")
                kept = await page.value("vehsim.viewer.rings[1].position.toArray()")
                assert kept == pytest.approx(ring, abs=1e-3)
                await page.value("document.getElementById('do-undo').click()")
                await page.until("document.getElementById('do-undo').disabled")
                await page.until(f"{SOLVED} && vehsim.viewer.rings[1].position.x === 8")

    asyncio.run(play())


ON_TRACK = """((frame) => {
  const box = document.getElementById("track").getBoundingClientRect(), { first, last } = vehsim.viewer;
  return [box.left + box.width * (frame - first) / (last - first), box.top + box.height / 2];
})(%d)"""


def test_a_mark_without_a_motion_is_where_the_file_has_it_in_every_browser(tmp_path):
    """The motion on the screen is the last one, which ends elsewhere."""
    path = written(tmp_path, SHOT)

    async def play():
        async with served(path) as address, at(f"http://{address}", tmp_path / "first") as page:
            await page.until(OPEN)
            far = "kind: 'place', key: 'vehicle[0].motion.mark[1].position', position: [8, 90, 0], heading: 40"
            await page.value(f"vehsim.live.send({{ {far} }})")
            await page.until(UNSOLVED)
            async with at(f"http://{address}", tmp_path / "second") as other:
                await other.until(f"typeof vehsim !== 'undefined' && vehsim.viewer && {UNSOLVED}")
                for each in (page, other):
                    ring = await each.value(
                        "[...vehsim.viewer.rings[1].position.toArray(), vehsim.viewer.rings[1].rotation.z]"
                    )
                    assert ring == pytest.approx([8, 90, 0, math.radians(40)])
                    last = "vehsim.viewer.lines.get('car').geometry.attributes.position.array.at(-2)"
                    assert await each.value(last) == pytest.approx(1)

    asyncio.run(play())


def test_scrubbing_a_mark_retimed_too_early_its_fix_and_the_bytes_of_an_export(tmp_path):
    """What is exported after that is what the command exports from the saved file."""
    path = written(tmp_path, SHOT)

    async def play():
        async with opened(path) as page:
            await page.value("vehsim.viewer.seek(1001)")
            for kind, frame in (("Pressed", 1010), ("Moved", 1030), ("Moved", 1045), ("Released", 1045)):
                await page.mouse(kind, *await page.value(ON_TRACK % frame))
            assert await page.value("vehsim.viewer.frame") == 1045

            (x, y), early = await page.value(ON_TRACK % 1073), await page.value(ON_TRACK % 1011)
            for kind, at in (("Pressed", (x - 1, y)), ("Moved", early), ("Released", early)):
                await page.mouse(kind, *at)
            await page.until("Boolean(document.querySelector('#problems .fix'))")
            assert await page.value("vehsim.viewer.ticks.map((one) => one.frame)") == [1001, 1011]
            assert re.search(r"(earliest|use) \d+", await page.value("document.getElementById('problems').textContent"))
            await page.value("document.querySelector('#problems .fix').click()")
            await page.until(f"{SOLVED} && vehsim.viewer.last > 1011 && vehsim.viewer.last < 1073")

            await page.value("document.getElementById('do-save').click()")
            await page.until("document.getElementById('do-save').disabled")
            await page.value("document.getElementById('do-export').click()")
            await page.until("document.getElementById('notice').textContent.startsWith('exported')")

    asyncio.run(play())
    assert "frame = 1073" not in path.read_text()
    command = [sys.executable, "-m", "vehsim", "export", path, "--out", tmp_path / "cli", "--to", "usd,html"]
    subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)
    ours, theirs = (content(tmp_path / name / "drive") for name in ("out", "cli"))
    assert "drive.html" in ours and ours == theirs


def test_marks_on_terrain_are_drawn_on_the_ground(tmp_path):
    """Also after a drag; their height in the file, which the ground overrides, stays."""
    there = SHOT.replace("position = [0, 0, 0]", "position = [40, 40, 0]").replace("[8, 1, 0]", "[48, 41, 0]")
    path = written(tmp_path, there.replace("[[vehicle]]", '[world]\nterrain = "hills"\n[[vehicle]]', 1))
    end = "vehsim.viewer.lines.get('car').geometry.attributes.position.array.at(-1)"
    ring = "vehsim.viewer.rings[1].position.z"

    async def play():
        async with opened(path) as page:
            ground = await page.value(end)
            assert abs(ground) > 0.1 and await page.value(ring) == pytest.approx(ground, abs=0.01)
            x, y = await page.value(PLACE)
            await page.mouse("Pressed", x, y)
            for k in range(1, 6):
                await page.mouse("Moved", x + 8 * k, y)
            await page.until("document.getElementById('status').textContent.startsWith('dragging')")
            await page.mouse("Released", x + 40, y)
            await page.until(f"!document.getElementById('do-undo').disabled && {SOLVED}")
            moved = await page.value(end)
            assert moved != ground and await page.value(ring) == pytest.approx(moved, abs=0.01)
            await page.value("document.getElementById('do-save').click()")
            await page.until("document.getElementById('do-save').disabled")

    asyncio.run(play())
    place = tomllib.loads(path.read_text())["vehicle"][0]["motion"]["mark"][1]["position"]
    assert place[:2] != [48, 41] and place[2] == 0


GATE = "gate = { direction = [5, 0, 0], size = [4, 3] } # the arch\n"


def test_a_gate_is_turned_and_tilted_by_its_arrow(tmp_path):
    """Its border and the motion follow; its mark stays where it is."""
    first, last = SHOT.rindex("[[vehicle.motion.mark]]"), "position = [8, 1, 0]"
    mark = "[[vehicle.motion.mark]]\nframe = 1043\nposition = [5, 0.6, 0]\n"
    path = written(tmp_path, SHOT[:first] + mark + GATE + SHOT[first:])
    arrow = "vehsim.live.grips.find((grip) => grip.handle.key.endsWith('gate.direction'))"
    tip = PLACE.replace(
        "v.rings[1].position.clone()",
        f"new THREE.Vector3({arrow}.ring.userData.tip, 0, 0).applyMatrix4({arrow}.ring.matrixWorld)",
    )

    async def turn(page, to, shift=0):
        await page.value("vehsim.viewer.draw()")  # else the arrow is where it will be drawn only with the next picture
        (x, y), (u, v) = await page.value(tip), to
        await page.mouse("Moved", x, y)
        await page.until("document.getElementById('view').title.endsWith('gate.direction')")
        await page.mouse("Pressed", x, y)
        for k in range(1, 6):
            await page.mouse("Moved", x + u * k / 5, y + v * k / 5, shift)
        await page.until("document.getElementById('status').textContent.startsWith('dragging')")
        border = "vehsim.viewer.rings[1].userData.carries.rotation"
        assert await page.value(f"{border}.equals({arrow}.ring.rotation)")
        await page.mouse("Released", x + u, y + v, shift)
        await page.until(f"!document.getElementById('do-undo').disabled && {SOLVED}")

    async def saved(page):
        await page.value("document.getElementById('do-save').click()")
        await page.until("document.getElementById('do-save').disabled")
        marks = tomllib.loads(path.read_text())["vehicle"][0]["motion"]["mark"]
        assert marks[1]["position"] == [5, 0.6, 0] and "heading" not in marks[1] and "# the arch" in path.read_text()
        return marks[1]["gate"]["direction"]

    async def play():
        async with opened(path) as page:
            await page.value("vehsim.viewer.orbit.target.set(5, 1, 0); vehsim.viewer.camera.position.set(3, -12, 8)")
            await page.value("vehsim.viewer.orbit.update(); vehsim.viewer.draw()")
            await turn(page, (-15, -25))
            x, y, z = await saved(page)
            assert x > 0 < y and z == 0 and math.hypot(x, y) == pytest.approx(5, abs=1e-3)
            heading = f"{arrow}.ring.rotation.z"
            assert await page.value(heading) == pytest.approx(math.atan2(y, x), abs=1e-3)

            await turn(page, (0, -20), shift=8)
            u, v, w = await saved(page)
            assert w > 0.5 and math.atan2(v, u) == pytest.approx(math.atan2(y, x), abs=1e-3)
            assert math.hypot(u, v, w) == pytest.approx(5, abs=1e-3)
            for left in (True, False):
                await page.value("document.getElementById('do-undo').click()")
                await page.until(f"{SOLVED} && document.getElementById('do-undo').disabled !== {str(left).lower()}")
            assert await page.value(heading) == 0
            assert await saved(page) == [5, 0, 0]

    asyncio.run(play())
    assert last in path.read_text()


BOX = """
[[world.obstacle]]
shape = "box"
centre = [4, 9, 0]
size = [1, 1, 1]
"""
GRIP = "vehsim.live.grips.find((grip) => grip.handle.obstacle === 'box_0')"
MESH = "vehsim.viewer.scene.getObjectsByProperty('isMesh', true).find((one) => one.name.includes('box_0'))"


CHOSEN = "[...['speed', 'follow', 'curve'].map((id) => document.getElementById(id).value), vehsim.viewer.loop]"


def test_an_obstacle_is_dragged_with_its_mesh(tmp_path):
    """The new scene keeps what was chosen below the timeline."""
    path = written(tmp_path, SHOT + BOX)

    async def play():
        async with opened(path) as page:
            await page.value("vehsim.viewer.orbit.target.set(5, 5, 0); vehsim.viewer.camera.position.set(4, -8, 20)")
            await page.value("vehsim.viewer.orbit.update(); vehsim.viewer.draw()")
            for name, value in (("speed", 0.5), ("follow", ""), ("curve", 2)):
                choose = f"{{ const list = document.getElementById('{name}'); list.value = '{value}';"
                await page.value(f"{choose} list.dispatchEvent(new Event('change')); }}")
            await page.key("l", "KeyL")
            x, y = await page.value(PLACE.replace("v.rings[1]", f"{GRIP}.ring"))
            await page.mouse("Moved", x, y)
            await page.mouse("Pressed", x, y)
            for k in range(1, 6):
                await page.mouse("Moved", x + 4 * k, y)
            await page.until("document.getElementById('status').textContent.startsWith('dragging')")
            shift = await page.value(f"{MESH}.position.x")
            assert shift == pytest.approx(await page.value(f"{GRIP}.ring.position.x") - 4) and shift > 0.2
            await page.mouse("Released", x + 20, y)
            await page.until(f"!document.getElementById('do-undo').disabled && {SOLVED}")
            await page.until(f"{MESH}.position.x === 0")  # the new scene has it in its place
            assert await page.value(CHOSEN) == ["0.5", "", "2", False]
            assert await page.value("[vehsim.viewer.speed, vehsim.viewer.follow, vehsim.viewer.curve]") == [0.5, "", 2]
            await page.value("document.getElementById('do-undo').click()")
            await page.until(f"document.getElementById('do-undo').disabled && {SOLVED}")
            await page.until(f"String({GRIP}.ring.position.toArray()) === '4,9,0' && {MESH}.position.x === 0")

    asyncio.run(play())


def test_a_mark_that_cannot_be_met_is_dragged_to_where_it_can(tmp_path):
    """An added mark too far away: the motion on the screen stays the last one, and the new mark is a handle."""
    path = written(tmp_path, SHOT)
    mark = "vehsim.live.grips.find((grip) => grip.handle.key === 'vehicle[0].motion.mark[1].position')"

    def pixel(point):
        return PLACE.replace("v.rings[1].position.clone()", f"({point})")

    async def play():
        async with opened(path) as page:
            await page.value("vehsim.live.send({ kind: 'add_mark', vehicle: 'car', frame: 1037 })")
            await page.until(f"vehsim.viewer.rings.length === 3 && {SOLVED}")
            place = await page.value("vehsim.viewer.rings[1].position.toArray()")
            far = [place[0], place[1] + 15, 0]
            await page.value(f"vehsim.live.send({{ kind: 'place', key: {mark}.handle.key, position: {far} }})")
            await page.until(UNSOLVED)
            await page.value("vehsim.live.send({ kind: 'add_mark', vehicle: 'car', frame: 1055 })")
            await page.until("vehsim.live.grips.length === 4")
            assert await page.value("vehsim.viewer.rings.every((ring) => !ring.visible)")
            frames = "vehsim.viewer.ticks.map((one) => one.frame)"  # the timeline has the file's marks
            assert await page.value(frames) == [1001, 1037, 1055, 1073]
            for frame, left in ((1060, 4), (1055, 3)):
                await page.value(f"vehsim.viewer.seek({frame}); document.getElementById('do-delete').click()")
                await page.until(f"{frames}.length === {left}")
            assert await page.value(frames) == [1001, 1037, 1073]
            await page.value("document.getElementById('do-undo').click()")
            await page.until("vehsim.live.grips.length === 4")
            await page.value("document.getElementById('do-undo').click()")
            await page.until("vehsim.live.grips.length === 3")
            await page.value("vehsim.viewer.orbit.target.set(5, 8, 0); vehsim.viewer.camera.position.set(5, 7, 40)")
            await page.value("vehsim.viewer.orbit.update(); vehsim.viewer.draw()")
            x, y = await page.value(pixel(f"{mark}.ring.position.clone()"))
            u, v = await page.value(pixel(f"new THREE.Vector3(...{place})"))
            await page.mouse("Moved", x, y)
            await page.mouse("Pressed", x, y)
            for k in range(1, 7):
                await page.mouse("Moved", x + (u - x) * k / 6, y + (v - y) * k / 6)
            await page.mouse("Released", u, v)
            await page.until(SOLVED)
            met = await page.value("vehsim.viewer.rings[1].position.toArray()")
            assert met == pytest.approx(place, abs=0.2)

    asyncio.run(play())


def test_a_mark_without_a_place_has_a_tick_too(tmp_path):
    """Of a heading only: it is retimed on the timeline and deleted as others are, although it is no handle."""
    last = SHOT.rindex("[[vehicle.motion.mark]]")
    path = written(tmp_path, f"{SHOT[:last]}[[vehicle.motion.mark]]\nframe = 1037\nheading = 5\n{SHOT[last:]}")
    frames = "vehsim.viewer.ticks.map((one) => one.frame).toSorted()"

    async def play():
        async with opened(path) as page:
            assert await page.value(frames) == [1001, 1037, 1073]
            assert await page.value("vehsim.viewer.motion.unplaced.map((one) => one.frame)") == [
                1037
            ]  # as in --to html
            tick, there = await page.value(ON_TRACK % 1037), await page.value(ON_TRACK % 1041)
            for kind, place in (("Pressed", tick), ("Moved", there), ("Released", there)):
                await page.mouse(kind, *place)
            await page.until(f"!document.getElementById('do-undo').disabled && {SOLVED}")
            frame = await page.value("vehsim.viewer.ticks.at(-1).frame")
            assert 1039 <= frame <= 1043
            await page.value(f"vehsim.viewer.seek({frame}); document.getElementById('do-delete').click()")
            await page.until(f"vehsim.viewer.ticks.length === 2 && {SOLVED}")
            await page.value("document.getElementById('do-save').click()")
            await page.until("document.getElementById('do-save').disabled")
            assert path.read_text() == SHOT

    asyncio.run(play())


def test_marks_of_an_artists_prim_are_shown_beside_marks_that_are_dragged(tmp_path):
    """They have rings and ticks as in --to html, but are no handles, and a press on their ticks scrubs."""
    stage_with(tmp_path / "blocking.usda", "Y", 0.01)
    heli = """[[vehicle]]
name = "heli"
asset = "helicopter"
[vehicle.motion]
method = "plan"
segments = 16
marks = { usd = "blocking.usda", prim = "/World/heli" }
"""
    path = written(tmp_path, SHOT.replace("[[vehicle]]", f"{heli}[[vehicle]]", 1))

    async def play():
        async with opened(path) as page:
            assert await page.value("vehsim.live.grips.map((grip) => grip.handle.vehicle)") == ["car", "car"]
            frames = await page.value("vehsim.viewer.ticks.map((one) => one.frame)")
            assert sorted(frames) == [1001, 1001, 1050, 1073, 1100]
            shown = await page.value(
                "vehsim.viewer.rings.filter((ring) => ring.visible).map((r) => r.position.toArray())"
            )
            wanted = [place for place, _ in KEYS.values()] + [(0, 0, 0), (8, 1, 0)]
            assert np.array(sorted(shown)) == pytest.approx(np.array(sorted(wanted)), abs=1e-3)
            for kind, frame in (("Pressed", 1050), ("Moved", 1060), ("Released", 1060)):
                await page.mouse(kind, *await page.value(ON_TRACK % frame))
            assert await page.value("vehsim.viewer.frame") == 1060
            assert await page.value("document.getElementById('do-undo').disabled")

    asyncio.run(play())


def test_a_note_is_written_pinned_and_deleted(tmp_path):
    path = written(tmp_path, SHOT)

    async def play():
        async with opened(path) as page:
            await page.value("vehsim.viewer.seek(1030); document.getElementById('do-note').click()")
            await page.until("document.activeElement.value === 'note'")  # selected, to be written over
            await page.until(SOLVED)
            await page.value("document.activeElement.value = 'brake <b>'; document.activeElement.blur()")
            await page.value("document.querySelector('#notes textarea').dispatchEvent(new Event('change'))")
            await page.until("document.getElementById('note').textContent === 'brake <b>'")
            await page.until(f"!document.getElementById('note').hidden && {SOLVED}")
            await page.value("vehsim.viewer.seek(1029)")
            await page.until("document.getElementById('note').hidden")
            await page.key(".", "Period")
            await page.until("vehsim.viewer.frame === 1030")
            await page.value("document.querySelector('#notes .pin').click()")
            await page.until("document.getElementById('note').className === 'at'")
            await page.until("vehsim.live.grips.some((grip) => grip.handle.key === 'note[0].position')")
            await page.value("document.querySelector('#notes .drop').click()")
            await page.until("!document.querySelector('#track .note') && document.getElementById('note').hidden")

    asyncio.run(play())


def test_a_car_is_driven_with_keys_held_down(tmp_path):
    """The playhead and the other vehicles move with it."""
    moving = "position = [0, 6, 0]\nvelocity = [3, 0, 0]\n"
    other = '[[vehicle]]\nname = "other"\nasset = "car"\n[vehicle.motion]\nmethod = "simulate"\nduration = 3\n'
    path = written(tmp_path, f"{SHOT}{other}[vehicle.motion.start]\n{moving}")

    async def play():
        async with opened(path) as page:
            await page.until("!document.getElementById('do-drive').disabled")
            await page.value("document.getElementById('do-drive').click()")
            await page.until("Boolean(vehsim.viewer.trail)")
            assert await page.value("document.querySelectorAll('.pad').length") == 1
            before = await page.value("vehsim.viewer.camera.position.x")
            await page.hold("w", "KeyW", True)
            await page.until("vehsim.drive.values[0] === 1 && vehsim.viewer.orbit.target.x > 0.5")
            await page.until(f"vehsim.viewer.camera.position.x > {before}")
            head = "parseFloat(document.querySelector('#track .head').style.left)"
            assert await page.value(f"{head} > 0 && Number(document.getElementById('frame').value) > 1001")
            group = "vehsim.viewer.motion.groups.findIndex((one) => one.vehicle === 'other')"
            assert await page.value(f"vehsim.viewer.groups[{group}].matrix.elements[12]") > 0.1
            await page.hold("w", "KeyW", False)
            await page.hold("a", "KeyA", True)
            await page.until("vehsim.drive.values[0] === 0 && vehsim.drive.values[1] === 1")
            await page.hold("a", "KeyA", False)
            await page.key("Escape", "Escape")
            await page.until("!vehsim.drive.driven")
            await page.until(f"{SOLVED} && !document.getElementById('do-drive-on').disabled")
            assert await page.value("document.getElementById('pads').hidden && !vehsim.viewer.trail")
            assert await page.value("vehsim.viewer.orbit.target.distanceTo(vehsim.viewer.subject()) < 1e-6")

    asyncio.run(play())
    rows = (tmp_path / "drive.car.001.csv").read_text().splitlines()
    torque = [float(row.split(",")[1]) for row in rows[1:]]
    assert max(torque) == 2500 and torque[0] == 0  # the car's bound


async def _some_frames_later(page):
    """Wait until what the sticks say has been simulated."""
    frame = "parseInt(document.getElementById('status').textContent.split('frame ')[1])"
    await page.until(f"{frame} > {await page.value(frame)} + 5")


def test_a_car_is_driven_with_a_gamepad(tmp_path):
    """The browser's report of a gamepad is replaced, since none is there: forward is negative, and left too."""
    path = written(tmp_path, SHOT.replace("schema = 1", "schema = 1\nend_frame = 2600", 1))
    pad = "navigator.getGamepads = () => [null, { axes: [%s, %s, 0, 0] }]"

    async def play():
        async with opened(path) as page:
            await page.until("!document.getElementById('do-drive').disabled")
            await page.value(pad % (0, -0.8))
            await page.value("document.getElementById('do-drive').click()")
            await page.until("vehsim.drive.values[0] === 0.8 && Boolean(vehsim.viewer.trail)")
            await _some_frames_later(page)
            await page.value(pad % (-0.25, 0.03))  # the middle of a worn stick is not zero
            await page.until("vehsim.drive.values[0] === 0 && vehsim.drive.values[1] === 0.25")
            await _some_frames_later(page)
            await page.key("Escape", "Escape")
            await page.until(f"!vehsim.drive.driven && {SOLVED}")

    asyncio.run(play())
    rows = [row.split(",") for row in (tmp_path / "drive.car.001.csv").read_text().splitlines()[1:]]
    assert max(float(row[1]) for row in rows) == 0.8 * 2500 and max(float(row[2]) for row in rows) > 0


def test_two_recordings_are_drawn_side_by_side(tmp_path):
    """Each in its colour, at its place in the present frame, with its curve; and one of them is used."""
    path = written(tmp_path, SHOT)
    rows = "[...document.querySelectorAll('#recordings div')]"
    nose = "(one) => { const { poses } = one.parts[0], at = 7 * (poses.length / 7 - 1); return poses[at]; }"

    async def play():
        async with opened(path) as page:
            for k, keys in enumerate((["w"], ["w", "a"])):
                await page.until("!document.getElementById('do-drive').disabled")
                await page.value("document.getElementById('do-drive').click()")
                await page.until("Boolean(vehsim.viewer.trail)")
                for key in keys:
                    await page.hold(key, f"Key{key.upper()}", True)
                await page.until("vehsim.viewer.orbit.target.x > 0.3")
                for key in keys:
                    await page.hold(key, f"Key{key.upper()}", False)
                await page.key("Escape", "Escape")
                await page.until(f"!vehsim.drive.driven && {rows}.length === {k + 1}")
            for k in range(2):
                await page.value(f"{rows}[{k}].querySelector('input').click()")
                await page.until(f"vehsim.viewer.compared.length === {k + 1}")
            await page.value("vehsim.viewer.seek(vehsim.viewer.last)")
            await page.until(f"{rows}.every((row) => row.querySelector('i').style.background)")
            assert len(set(await page.value("vehsim.viewer.compared.map((one) => one.color)"))) == 2
            ends = await page.value(f"vehsim.viewer.compared.map({nose})")
            drawn = await page.value("vehsim.viewer.compared.map((one) => one.parts[0].copy.matrix.elements[12])")
            assert drawn == pytest.approx(ends) and ends[0] != ends[1]
            assert await page.value("vehsim.viewer.compared.every((one) => one.curves.length > 2)")
            assert await page.value(f"{rows}.map((row) => row.querySelector('button').textContent)") == [
                "use",
                "in use",
            ]
            await page.value(f"{rows}[0].querySelector('button').click()")
            await page.until(f"{rows}[0].querySelector('button').textContent === 'in use' && {SOLVED}")
            await page.until("vehsim.viewer.compared.length === 2")

    asyncio.run(play())
