"""Settings, remedies and marks: what the page offers to change, and what each change does to the file."""

import asyncio
import re
import tomllib
from itertools import groupby

import pytest

pytest.importorskip("websockets", reason='needs the extra: pip install "vehsim[live]"')

from tests.live.test_server import SHOT, browser, served, texts
from vehsim import Shot
from vehsim.errors import InputError
from vehsim.live.document import Document
from vehsim.live.messages import Fix
from vehsim.live.session import Session
from vehsim.live.settings import named, settings
from vehsim.shot.cache import motion_key
from vehsim.shot.schema.shot_file import parse


def listed(text, variants=()):
    return {one.key: one for one in settings(tomllib.loads(text), variants)}


def segments_of(state):
    return next(one["value"] for one in state["settings"] if one["key"].endswith("segments"))


def test_settings_come_from_the_models():
    found = listed(
        SHOT + "limits = { speed = 5 }\n[camera]\nlens_mm = 50\n[[world.water.wave]]\nheight = 1\nlength = 9\n"
    )
    clearance = found["vehicle[0].motion.clearance"]
    assert (clearance.kind, clearance.value, clearance.default, clearance.low) == ("number", None, 1.0, 0)
    assert clearance.about.startswith("the least distance from obstacles")
    assert found["vehicle[0].motion.segments"].value == 8 and found["vehicle[0].motion.segments"].kind == "integer"
    assert "energy" in found["vehicle[0].motion.cost"].choices
    assert "vehicle[0].motion.limits.bank" in found  # a table that is not given, all of whose keys may be left out
    assert found["vehicle[0].motion.mark[1].frame"].value == 1073
    assert found["world.water.wave[0].height"].value == 1 and found["camera.rig"].default == "chase"
    assert found["camera.lens_mm"].value == 50
    assert not any(one.endswith(("file", "path", "name")) for one in found)  # no texts


@pytest.mark.parametrize("method", ["plan", "sinusoid"])
def test_a_table_is_listed_once_and_before_those_in_it(method):
    """Each is a group of the panel, and a motion's own settings come before those of its marks."""
    found = listed(SHOT.replace('"plan"\nsegments = 8', f'"{method}"'))
    groups = [name for name, _ in groupby(one.table for one in found.values())]
    assert len(groups) == len(set(groups)) > 5
    assert groups.index("vehicle car, motion") < groups.index("vehicle car, motion, mark 1 at 1001")


def test_weights_of_a_cost_and_liveries_are_settings():
    text = SHOT.replace("segments = 8", "segments = 8\ncost = { effort = 1 }")
    found = listed(text, [{"livery": ["red", "blue"]}])
    assert found["vehicle[0].motion.cost.effort"].value == 1 and found["vehicle[0].motion.cost.time"].value is None
    assert found["vehicle[0].variants.livery"].choices == ("red", "blue")


@pytest.mark.parametrize("text", ["vehicle = 3", "[[vehicle]]\nmotion = 5", "[camera]\nlens_mm = []", "world = [1]"])
def test_a_broken_file_has_settings_too(text):
    assert "render.every" in listed(text)


def test_each_change_leaves_the_rest_of_the_file(tmp_path):
    path = tmp_path / "drive.toml"
    path.write_text(SHOT + "[camera]\nlens_mm = 50 # long\n")
    document = Document(path)
    document.put("vehicle[0].motion.clearance", 0.5)
    document.put("vehicle[0].motion.limits.speed", 4.0)
    document.put("camera.lens_mm", 85)
    document.put("vehicle[0].variants.livery", "red")
    document.put("vehicle[0].motion.segments", None)
    document.put("vehicle[0].motion.loop", None)  # it is not there
    data = document.data
    motion = data["vehicle"][0]["motion"]
    assert motion["clearance"] == 0.5 and motion["limits"] == {"speed": 4.0} and "segments" not in motion
    assert data["camera"] == {"lens_mm": 85} and data["vehicle"][0]["variants"] == {"livery": "red"}
    assert "# the garage" in document.text and "# long" in document.text
    document.put("camera[0].lens_mm", 20)  # as a problem names it
    assert document.data["camera"] == {"lens_mm": 20}
    for wrong in ("vehicle[7].motion.loop", "shot.name.first", "vehicle[0].motion.mark.frame"):
        before = document.text
        with pytest.raises(InputError, match="no such place"):
            document.put(wrong, 1)
        assert document.text == before
    for _ in range(6):
        document.undo()
    assert document.text == SHOT + "[camera]\nlens_mm = 50 # long\n"


def test_marks_are_added_and_deleted_in_their_place(tmp_path):
    path = tmp_path / "drive.toml"
    path.write_text(SHOT)
    document = Document(path)
    document.insert("vehicle[0].motion.mark", 1, {"frame": 1040, "position": [4.0, 0.5, 0.0]})
    assert [mark["frame"] for mark in document.data["vehicle"][0]["motion"]["mark"]] == [1001, 1040, 1073]
    assert "# the garage" in document.text
    document.put("vehicle[0].motion.mark[1]", None)
    assert document.data == tomllib.loads(SHOT)


def test_notes_are_added_edited_and_deleted(tmp_path):
    path = tmp_path / "drive.toml"
    path.write_text(SHOT)

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            before = page.last.get("motion", page.last["scene"])  # a slow machine draws straight guesses first
            for frame, text in ((1030, "brake here"), (1010, "slow")):
                await page.send(kind="add_note", frame=frame, text=text)
                motion = await page.until("motion")
                state = await page.until("state", lambda message: message["solved"])
            assert [(one["frame"], one["text"]) for one in state["notes"]] == [(1010, "slow"), (1030, "brake here")]
            assert motion.header["notes"] == [{"frame": 1010, "text": "slow"}, {"frame": 1030, "text": "brake here"}]
            lines = [block.array(block.header["paths"][0]["points"]).tolist() for block in (before, motion)]
            assert lines[0] == lines[1]

            await page.send(kind="edit_note", note=1, text='brake "now"', position=[4.0, 0.50001, 0.0])
            await page.until("state", lambda message: message["notes"][1]["position"] == [4, 0.5, 0])
            await page.send(kind="place", key="note[1].position", position=[5.0, 0.5, 0.0])
            await page.until("state", lambda message: message["notes"][1]["position"] == [5, 0.5, 0])
            for wrong in (
                {"kind": "edit_note", "note": 2, "text": "x"}, {"kind": "delete_note", "note": 2},
                {"kind": "add_note", "frame": 1010, "text": ""}, {"kind": "edit_note", "note": 0, "text": "x" * 1001},
            ):  # fmt: skip
                await page.send(**wrong)
                assert (await page.until("refused"))["text"]
            await page.send(kind="delete_note", note=0)
            await page.until("state", lambda message: len(message["notes"]) == 1)
            await page.send(kind="save")
            await page.until("said")
            data = tomllib.loads(path.read_text())
            assert data.pop("note") == [{"frame": 1030, "text": 'brake "now"', "position": [5, 0.5, 0]}]
            assert data == tomllib.loads(SHOT) and "# the garage" in path.read_text()
            await page.send(kind="delete_note", note=0)
            state = await page.until("state", lambda message: not message["notes"])
            for _ in range(6):
                await page.send(kind="undo")
            await page.until("state", lambda message: message["solved"] and not message["undo"])
        assert path.with_name("drive.toml.autosave").read_text() == SHOT

    asyncio.run(play())


def test_notes_change_no_motion():
    shots = [Shot.from_dict(tomllib.loads(SHOT + more)) for more in ("", '[[note]]\nframe = 1010\ntext = "slow"\n')]
    keys = [motion_key(shot.file, shot.motion_files(), shot.world.content_hash) for shot in shots]
    assert keys[0] == keys[1] is not None and shots[1].file.note[0].text == "slow"


def test_a_bound_comes_with_its_problem():
    data = tomllib.loads(SHOT.replace("segments = 8", "segments = 1\nclearance = 2000"))
    _, problems = parse(data)
    fixes = dict(fix for problem in problems for fix in problem.fixes)
    motion = "vehicle[0].motion"
    assert fixes == {f"{motion}.segments": 2, f"{motion}.clearance": 1000}


LAST = """\
[[vehicle.motion.mark]]
frame = 1080
position = [12, 2, 0]
"""


def too_hurried(folder, text):
    """The fixes of a session on a shot whose marks leave too little time, after they were applied: key -> frame."""
    path = folder / "drive.toml"
    path.write_text(text)
    session = Session(path, folder, lambda *_: None)
    session.solve()
    (problem,) = [one for one in session.problems if "fixes" in one]
    assert (
        re.search(r"(earliest|use) \d+", problem["text"]) and str(folder) not in problem["text"] and not session.solved
    )
    session.fix(Fix(kind="fix", fixes=[list(fix) for fix in problem["fixes"]]))
    marks = session.document.data["vehicle"][0]["motion"]["mark"]
    for key, frame in problem["fixes"]:
        assert marks[int(key.removesuffix("].frame")[-1])]["frame"] == frame
    return session, dict(problem["fixes"])


def test_later_marks_move_with_one_that_is_too_early(tmp_path):
    """All is one step to undo."""
    session, fixes = too_hurried(tmp_path, SHOT.replace("frame = 1073", "frame = 1019") + LAST)
    assert list(fixes) == [f"vehicle[0].motion.mark[{k}].frame" for k in (1, 2)]
    assert fixes["vehicle[0].motion.mark[2].frame"] - 1080 == fixes["vehicle[0].motion.mark[1].frame"] - 1019 > 0
    assert session.solved
    session.document.undo()
    assert session.document.text == session.document.path.read_text()


def test_the_page_names_marks_as_its_groups_do(tmp_path):
    """Also the button that sets the frames."""
    path = tmp_path / "drive.toml"
    path.write_text(SHOT.replace("frame = 1073", "frame = 1019") + LAST)
    session = Session(path, tmp_path, lambda *_: None)
    session.solve()
    (problem,) = [one for one in session.problems if "fixes" in one]
    table = "vehicle car, motion, mark 2 at 1019"
    assert table in {setting.table for setting in session.settings}
    assert problem["text"].startswith(f"{table}: frame = 1019: ")
    assert problem["offer"] == f"{table}: frame = {problem['fixes'][0][1]}, and 1 more"
    for odd in ("shot.fps", "[0].a", "vehicle[7].motion.b", "--host"):
        assert named(odd, session.document.data).endswith(odd.rpartition(".")[2])


def test_the_frame_that_the_planner_found_is_offered(tmp_path):
    """The check's bounds do not refuse this flight, but its actuators are too slow for it."""
    text = SHOT.replace('"car"', '"helicopter"').replace("segments = 8", "segments = 16").replace("1073", "1113")
    text = text.replace("[0, 0, 0]\nheading", "[0, 0, 30]\nheading").replace("[8, 1, 0]", "[60, 10, 30]")
    _, fixes = too_hurried(tmp_path, text)
    assert 1113 < fixes["vehicle[0].motion.mark[1].frame"] < 1145 and len(fixes) == 1


def fixed(folder, text):
    """A session on a shot, after each fix that it offered was applied until none was, and the first problem."""
    path = folder / "drive.toml"
    path.write_text(text)
    session, first = Session(path, folder, lambda *_: None), None
    session.solve()
    for _ in range(4):
        offered = [one for one in session.problems if "fixes" in one]
        if not offered:
            break
        first = first or offered[0]
        session.fix(Fix(kind="fix", fixes=[list(fix) for fix in offered[0]["fixes"]]))
    return session, first


def test_a_mark_that_was_retimed_past_the_next_one_moves_the_later_ones(tmp_path):
    session, first = fixed(tmp_path, SHOT.replace("frame = 1073", "frame = 1090") + LAST)
    assert "not after frame 1090" in first["text"] and session.solved
    frames = [mark["frame"] for mark in session.document.data["vehicle"][0]["motion"]["mark"]]
    assert frames[:2] == [1001, 1090] and frames[2] >= 1091


HOUSE = '[[world.obstacle]]\nshape = "box"\ncentre = [8, 3, 0]\nsize = [6, 6, 4]\n'


@pytest.mark.parametrize("asset, z, terrain", [("car", 0, ""), ("helicopter", 2, ""), ("helicopter", -9, "hills")])
def test_a_mark_in_an_obstacle_or_rock_is_moved_to_the_nearest_free_place(tmp_path, asset, z, terrain):
    text = SHOT.replace('asset = "car"', f'asset = "{asset}"').replace("segments = 8", "segments = 32\nclearance = 0.5")
    text = text.replace("frame = 1073", "frame = 1241").replace(
        "[0, 0, 0]\nheading", f"[-40, 0, {30 * (z != 0)}]\nheading"
    )
    world = f'[world]\nterrain = "{terrain}"\n' if terrain else ""
    text = text.replace("[[vehicle]]", world + "[[vehicle]]").replace("[8, 1, 0]", f"[8, 1, {z}]")
    session, first = fixed(tmp_path, text + ("" if terrain else HOUSE))
    assert ("rock" if terrain else "in obstacle 'box_0'") in first["text"]
    ((key, place),) = first["fixes"]
    assert key == "vehicle[0].motion.mark[1].position" and session.solved
    found = session.document.data["vehicle"][0]["motion"]["mark"][1]["position"]
    assert found == place
    if asset == "car":  # out through the side that is nearest to [8, 1]: y = 0, half a car away
        assert place == pytest.approx([8, -0.5 - 0.25 - 1.8 / 2, 0], abs=0.25)
    else:
        assert place[:2] == [8, 1] and place[2] > z


def test_the_page_fixes_changes_adds_and_deletes(tmp_path):
    path = tmp_path / "drive.toml"
    path.write_text(SHOT.replace("frame = 1073", "frame = 1010"))

    async def play():
        async with served(path) as address, browser(address) as page:
            state = await page.until("state", lambda message: message["problems"])
            (problem,) = [one for one in state["problems"] if "fixes" in one]
            ((key, frame),) = problem["fixes"]
            assert key == "vehicle[0].motion.mark[1].frame" and frame > 1010
            await page.send(kind="fix", fixes=[[key, frame + 1]])
            assert "not offered" in (await page.until("refused"))["text"]
            await page.send(kind="fix", fixes=problem["fixes"])
            await page.until("scene")
            state = await page.until("state", lambda message: message["solved"])
            assert state["changed"] and state["handles"][1]["mark"] == 1

            await page.send(kind="change", key="vehicle[0].motion.segments", value=10)
            await page.until("state", lambda message: message["solved"] and segments_of(message) == 10)

            for key, value in (("shot.name", "x"), ("vehicle[0].asset", "/etc/passwd"), ("sweep", 1)):
                await page.send(kind="change", key=key, value=value)
                assert (await page.until("refused"))["text"]

            middle = (1001 + frame) // 2
            await page.send(kind="add_mark", vehicle="car", frame=middle)
            await page.until("state", lambda message: message["solved"] and len(message["handles"]) == 3)
            for vehicle, frame in (("car", middle), ("boat", middle), ("car", 900)):
                await page.send(kind="add_mark", vehicle=vehicle, frame=frame)
                assert (await page.until("refused"))["text"]
            await page.send(kind="delete_mark", vehicle="car", mark=3)
            assert "no such mark" in (await page.until("refused"))["text"]
            await page.send(kind="delete_mark", vehicle="car", mark=1)
            await page.until("state", lambda message: message["solved"] and len(message["handles"]) == 2)
            await page.send(kind="delete_mark", vehicle="car", mark=1)
            assert "needs two marks" in (await page.until("refused"))["text"] and page.last["state"]["solved"]
            await page.send(kind="change", key="vehicle[0].motion.segments", value=1)
            await page.until("state", lambda message: "at least 2" in texts(message) and not message["solved"])

    asyncio.run(play())


def test_a_mark_is_added_before_one_whose_frame_is_free(tmp_path):
    """The motion on the screen passes it, so the plan exists."""
    from vehsim.live.messages import AddMark
    from vehsim.live.session import Session

    path = tmp_path / "drive.toml"
    path.write_text(SHOT.replace("frame = 1073", 'frame = "free"'))
    session = Session(path, tmp_path, lambda *_: None)
    session.solve()
    last = session.take.clips["car"].end_frame
    session.add_mark(AddMark(kind="add_mark", vehicle="car", frame=(1001 + last) // 2))
    marks = session.document.data["vehicle"][0]["motion"]["mark"]
    assert [mark["frame"] for mark in marks] == [1001, (1001 + last) // 2, "free"]
    assert session.solved, session.problems


REST = "velocity = [0, 0, 0]"
DRAGGED = {
    "joints by name": ("snakeboard", "", (5, 1.5, 0), f"joints = {{ psi = 0, phi = 0 }}\n{REST}"),
    "a speed": ("car", "", (14, 3, 0), "speed = 3"),
    "no heading": ("helicopter", "", (20, 8, 12), REST),
    "a tolerance": ("car", "", (14, 3, 0), f"heading = 0\ntolerance = 0.5\n{REST}"),
    "on terrain": ("car", 'terrain = "hills"', (14, 3, 0), f"heading = 0\n{REST}"),
    "a hold": ("helicopter", "", (20, 8, 12), f"heading = 0\nhold = 12\n{REST}"),
    "an orientation": ("helicopter", "", (20, 8, 12), f"orientation = [1, 0, 0, 0]\n{REST}"),
}


@pytest.mark.parametrize("kind", DRAGGED)
def test_marks_of_every_kind_are_dragged(kind, tmp_path):
    from vehsim.live.messages import Drag
    from vehsim.live.session import Session

    asset, world, (x, y, z), mark = DRAGGED[kind]
    path = tmp_path / "shot.toml"
    path.write_text(
        f'[shot]\nschema = 1\nname = "shot"\n[world]\n{world}\n[[vehicle]]\nname = "one"\nasset = "{asset}"\n'
        f'[vehicle.motion]\nmethod = "plan"\nsegments = 32\n'
        f"[[vehicle.motion.mark]]\nframe = 1001\nposition = [0, 0, {z}]\nheading = 0\n{REST}\n"
        f"[[vehicle.motion.mark]]\nframe = 1193\nposition = [{x}, {y}, {z}]\n{mark}\n"
    )
    session = Session(path, tmp_path, lambda *_: None)
    session.solve()
    assert session.solved, session.problems
    session.prepare()
    place = (x + 0.5, y - 0.5, z)
    session.drag(Drag(key="vehicle[0].motion.mark[1].position", position=place))
    reached = session._drafts["one"].draft.clip().positions[-1, :2]
    assert abs(reached - place[:2]).max() <= (0.5 if "tolerance" in mark else 0.01)  # the next event goes on from there
