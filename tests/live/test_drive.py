"""A vehicle that is driven: a recording gives the same motion again, and continues without a seam."""

import asyncio
import json
from fractions import Fraction

import numpy as np
import pytest

pytest.importorskip("websockets", reason='needs the extra: pip install "vehsim[live]"')

import vehsim
from tests.live.test_server import browser, served
from vehsim import Shot
from vehsim.errors import InputError
from vehsim.live.drive import Clock, Sticks, affordable_step, record
from vehsim.shot.motions.sticks import write_sticks

STILL = {"method": "simulate", "duration": 0.25}
FLY = STILL | {"start": {"position": [0, 0, 30]}}
SWELL = {"water": {"wave": [{"height": 0.4, "length": 9, "heading": 160}]}}


class Hand:
    """Moves the sticks at given knots, and stops after ``last``; the clock is its own, and never late."""

    def __init__(self, moves, last):
        self.moves, self.last, self.knot, self.time = moves, last, -1, 0.0
        self.sticks = None

    def ended(self):
        self.knot += 1
        if self.knot in self.moves:
            self.sticks.move(self.moves[self.knot])
        return self.knot > self.last

    def sleep(self, seconds):
        self.time += seconds

    def drive(self, shot, clips, since=None, clock=None):
        """The recording, and the clips that were shown."""
        shown, world = [], shot.world
        self.sticks = Sticks(shot.vehicle(shot.file.vehicle[0]), world.wind)
        show = lambda clip, behind: shown.append((clip, behind))
        clock = clock or Clock(lambda: self.time, self.sleep)
        return record(shot, "v", clips, show, self.ended, self.sticks, since, clock), shown


def shot_of(folder, asset, motion, world=None):
    table = {"name": "v", "asset": asset, "motion": motion}
    return Shot.from_dict({"shot": {"schema": 1, "name": "s"}, "world": world or {}, "vehicle": [table]}, folder)


def kept(folder, shot, made):
    """The shot with a recording as its motion."""
    table = shot.file.vehicle[0]
    write_sticks(folder / "made.csv", shot.vehicle(table), made.frames, made.controls)
    world = shot.file.world.model_dump(mode="json", exclude_unset=True)
    return shot_of(folder, table.asset, made.motion | {"file": "made.csv"}, world)


@pytest.mark.parametrize(
    "asset, motion, world",
    [
        ("car", STILL, {}), ("helicopter", FLY, {"wind": [3, 0, 0]}), ("boat", STILL, SWELL),
        ("two_wheeled", STILL, {}), ("hopper", FLY, {}),
    ],
)  # fmt: skip
def test_what_was_seen_is_what_was_recorded(tmp_path, asset, motion, world):
    """The recording has a row per knot; simulated again, poses equal those that were shown."""
    shot = shot_of(tmp_path, asset, motion, world)
    count = len(shot.vehicle(shot.file.vehicle[0]).controls)
    moves = {8: [1.0] * count, 29: [0.3] * count, 30: [-0.4] * count, 44: [0.0] * count}
    made, shown = Hand(moves, 66).drive(shot, shot.solve().clips)
    assert made.problem is None and made.frames[0] == 1001 and made.frames[-1] == 1007
    again = kept(tmp_path, shot, made).solve(cached=False).clips["v"]
    assert again.end_frame == 1007
    commands = np.column_stack([*again.commands.values()])
    assert np.array_equal(commands, made.controls) and np.ptp(made.controls[:, 0]) > 0
    knot = again.times[1]
    seen = [clip.at(clip.times[-1:]) for clip, _ in shown if knot <= clip.times[-1] <= again.times[-1]]
    assert len(seen) > 8
    for one in seen:  # the state that was shown is predicted, or that of the knot before
        there = again.at([one.times[0] - knot, one.times[0]])
        assert np.linalg.norm(there.positions - one.positions, axis=1).min() < 1e-3
        for name, values in one.channels.items():
            assert np.abs(there.channels[name] - values).min() < 1.0, name  # a propeller turns by up to 200 rad/s
    once_more = kept(tmp_path, shot, made).solve(cached=False).clips["v"]
    assert once_more.to_bytes() == again.to_bytes()


@pytest.mark.parametrize("asset, world", [("car", {"terrain": "hills"}), ("boat", SWELL)])
def test_a_recording_continues_without_a_seam(tmp_path, asset, world):
    shot = shot_of(tmp_path, asset, STILL, world)
    made, _ = Hand({0: [1.0, 0.0], 20: [1.0, 0.5]}, 70).drive(shot, shot.solve().clips)
    first = kept(tmp_path, shot, made)
    clip = first.solve(cached=False).clips["v"]
    hand = Hand({0: [-1.0, -1.0]}, 90)
    longer, _ = hand.drive(first, {"v": clip}, since=1004)
    second = kept(tmp_path, first, longer).solve(cached=False).clips["v"]
    before, after = second.frames <= 1004, second.frames > 1005
    count = int(before.sum()) - 2  # the body's lean follows from the acceleration, measured between neighbours
    assert count > 20 and after.sum() > 20
    assert np.array_equal(second.controls[:count], clip.controls[:count])
    for name in ("positions", "orientations", "twists"):
        assert np.array_equal(getattr(second, name)[:count], getattr(clip, name)[:count]), name
    changes = np.linalg.norm(np.diff(second.twists, axis=0), axis=1)
    assert changes[count - 1 : count + 4].max() < 1.5 * changes[: count - 1].max()  # of the velocity: no jump
    ahead = -3 if second.twists.shape[1] == 6 else -2
    assert abs(second.twists[-1, ahead] - clip.twists[-1, ahead]) > 0.05  # a boat's engine follows late


def test_a_recording_is_not_cut_short_by_a_continuation_that_ends_before_it_begins(tmp_path):
    """On a slow machine, it takes a while to play it up to the frame where one drives on."""
    shot = shot_of(tmp_path, "car", STILL)
    made, _ = Hand({8: [1.0, 0.0]}, 66).drive(shot, shot.solve().clips)
    again = kept(tmp_path, shot, made)
    with pytest.raises(InputError, match=r"nothing was recorded; wait until .* frame 1006"):
        Hand({}, 30).drive(again, again.solve().clips, since=1006)


def test_a_slow_simulation_sets_the_clock_back(tmp_path):
    shot = shot_of(tmp_path, "car", STILL)
    hand = Hand({}, 66)
    hand.ended_before = hand.ended

    def slow():
        hand.time += 0.02
        return hand.ended_before()

    hand.ended = slow
    made, shown = hand.drive(shot, shot.solve().clips)
    assert made.frames[-1] == 1007 and shown[-1][1] == pytest.approx(66 * 0.02 - 66 / 240, abs=0.2)


@pytest.mark.parametrize(
    ("seconds", "fps", "step"),
    [
        (0.0024, 24, None),  # 240 steps fit
        (0.004, 24, 1 / 120),
        (0.004, 25, 1 / 125),
        (0.006, 24, 1 / 72),
        (0.1, 30, 1 / 60),  # too slow for any
    ],
)
def test_a_slow_machine_takes_fewer_steps_but_at_least_sixty(seconds, fps, step):
    assert affordable_step(seconds, Fraction(fps)).get("step") == step


def test_a_drive_whose_steps_are_slow_records_its_step(tmp_path):
    """The clock goes 6 ms further whenever it is read, once in each step of the trial; the recording plays alike."""
    shot = shot_of(tmp_path, "car", {"method": "simulate", "duration": 1.0})
    hand = Hand({10: [0.5, 0.2]}, 60)

    class Slow(Clock):
        def __init__(self):
            super().__init__(self.read, hand.sleep)

        def read(self):
            hand.time += 0.006
            return hand.time

    made, shown = hand.drive(shot, shot.solve().clips, clock=Slow())
    assert made.motion["step"] == 1 / 72 and np.diff(made.frames) == pytest.approx(24 / 72)
    again = kept(tmp_path, shot, made).solve().clips["v"]
    assert np.diff(again.times) == pytest.approx(1 / 72)
    for clip, _ in shown[:-1]:  # the state that was shown is predicted
        assert np.abs(again.at(clip.times[-1:]).positions - clip.positions[-1:]).max() < 1e-3


def test_a_stick_gives_balance_in_the_middle_and_bounds_at_the_ends(tmp_path):
    from vehsim import load_vehicle
    from vehsim.planning.trim import steady
    from vehsim.vehicles import State

    helicopter = load_vehicle("helicopter")
    sticks, balance = Sticks(helicopter, np.zeros(3)), steady(helicopter, (0.0, 0.0, 0.0)).controls
    assert sticks.controls(State()) == pytest.approx(balance)
    assert balance[0] == pytest.approx(1900 * 9.81, rel=2e-3)
    sticks.move([1, -1, 0.5, 0])
    assert sticks.controls(State()) == pytest.approx([33000, -1000, 0.1, balance[3]], abs=1e-6)
    car = Sticks(load_vehicle("car"), np.zeros(3))
    car.move([0, 1])
    assert car.controls(State(joints=[0, 0.69]))[1] == pytest.approx((0.7 - 0.69) / 0.15)
    car.move([0, 0])
    assert car.controls(State(joints=[0, 0.5]))[1] == -0.8  # the wheel returns, as fast as it can
    with pytest.raises(InputError, match="3 sticks"):
        car.move([0, 0, 0])


@pytest.mark.parametrize("asset", ["car", "drift_car", "rally_car", "truck", "boat", "snakeboard"])
def test_sticks_in_the_middle_neither_push_nor_brake(asset):
    sticks = Sticks(vehsim.load_vehicle(asset), np.zeros(3))
    assert not sticks.controls(vehsim.State()).any()


def test_nothing_is_recorded_in_less_than_a_frame(tmp_path):
    shot = shot_of(tmp_path, "car", STILL)
    with pytest.raises(InputError, match="nothing was recorded"):
        Hand({}, 5).drive(shot, shot.solve().clips)


SHOT = """\
[shot]
schema = 1
name = "drive"
[[vehicle]]
name = "car" # mine
asset = "car"
[vehicle.motion]
method = "simulate"
duration = 0.2
"""


def test_a_drive_is_recorded_saved_continued_and_undone(tmp_path):
    path = tmp_path / "drive.toml"
    path.write_text(SHOT)

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("scene")
            state = await page.until("state", lambda message: message["solved"])
            assert state["drives"] == [{"vehicle": "car", "controls": ["torque", "steering_rate"], "continues": False}]
            for wrong in ({"vehicle": "boat"}, {"vehicle": "car", "frame": 1003}):
                await page.send(kind="drive", **wrong)
                assert (await page.until("refused"))["text"]
            await page.send(kind="sticks", values=[0.5, 0.5])  # no drive has begun: it has no effect
            await page.send(kind="drive", vehicle="car")
            assert (await page.until("driving"))["vehicle"] == "car"
            first = await page.until("live")
            await page.send(kind="sticks", values=[1.0, 0.5])
            await page.send(kind="sticks", values=[1.0, 0.5, 3.0])
            assert "less than or equal to 1" in (await page.until("refused"))["text"]
            await page.send(kind="sticks", values=[0.0] * 5)  # not this vehicle's
            moved = await page.until("live", lambda live: live.header["place"][0] > 0.5)
            assert moved.header["frame"] > first.header["frame"] and len(moved.header["groups"]) > 3
            await page.send(kind="stop")
            await page.until("driven")
            state = await page.until("state", lambda message: message["solved"])
            assert state["changed"] and state["undo"] and state["drives"][0]["continues"]

            await page.send(kind="save")
            await page.until("said")
            assert "# mine" in path.read_text() and 'file = "drive.car.001.csv"' in path.read_text()
            clip = Shot.load(path).solve(cached=False).clips["car"]
            assert (tmp_path / "drive.car.001.npz").read_bytes() == clip.to_bytes(ending=True)
            assert clip.positions[-1, 0] > 0.2  # it ends on a whole frame

            await page.send(kind="drive", vehicle="car", frame=1003)
            await page.until("live", lambda live: live.header["frame"] > 1004)
            await page.send(kind="undo")  # any other request ends it, and the recording is kept
            await page.until("driven")
            await page.until("state", lambda message: message["solved"])
            assert (tmp_path / "drive.car.002.csv").is_file()
            both = [np.loadtxt(tmp_path / f"drive.car.00{k}.csv", delimiter=",", skiprows=1) for k in (1, 2)]
            early = [rows[rows[:, 0] <= 1002.5] for rows in both]
            assert json.dumps(early[0].tolist()) == json.dumps(early[1].tolist())

    asyncio.run(play())


def test_a_motion_that_a_recording_replaced_is_offered_again(tmp_path):
    """Also after other edits, with its comments' values; until then the page says what happened."""
    path = tmp_path / "drive.toml"
    path.write_text(SHOT)

    async def play():
        async with served(path) as address, browser(address) as page:
            state = await page.until("state", lambda message: message["solved"])
            assert not state["problems"]
            await page.send(kind="restore", vehicle="car")
            assert "was not driven" in (await page.until("refused"))["text"]
            await page.send(kind="drive", vehicle="car")
            await page.until("live", lambda live: live.header["frame"] > 1002)
            await page.send(kind="stop")
            await page.until("driven")
            await page.send(kind="add_note", frame=1001, text="seen")
            state = await page.until("state", lambda message: message["solved"] and message["notes"])
            (said,) = state["problems"]
            assert "drive.car.001.csv now" in said["text"] and "simulate" in said["text"]
            assert said["restores"] == "car"
            await page.send(kind="drive", vehicle="car", frame=1002)
            await page.until("live", lambda live: live.header["frame"] > 1002.5)
            await page.send(kind="stop")
            await page.until("driven")
            now = "drive.car.002.csv now"
            await page.until("state", lambda message: now in json.dumps(message["problems"]) and message["solved"])
            await page.send(kind="restore", vehicle=said["restores"])
            state = await page.until("state", lambda message: not message["problems"])
            assert state["solved"] and state["recordings"] and not state["drives"][0]["continues"]
            await page.send(kind="save")
            await page.until("said")

    asyncio.run(play())
    assert 'method = "simulate"\nduration = 0.2\n' in path.read_text() and "seen" in path.read_text()


def test_sticks_that_do_not_move_again_are_heard(tmp_path):
    """A page sends its sticks once the drive is announced, and then only if they move."""
    path = tmp_path / "drive.toml"
    path.write_text(SHOT.replace("schema = 1", "schema = 1\nend_frame = 1100", 1))

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("state", lambda message: message["solved"])
            await page.send(kind="drive", vehicle="car")
            await page.until("driving")
            await page.send(kind="sticks", values=[0.8, 0.0])
            await page.until("live", lambda live: live.header["frame"] > 1006)
            await page.send(kind="stop")
            await page.until("driven")

    asyncio.run(play())
    rows = [row.split(",") for row in (tmp_path / "drive.car.001.csv").read_text().splitlines()[1:]]
    assert max(float(row[1]) for row in rows) == 0.8 * 2500


def test_a_drive_ends_when_its_browser_closes(tmp_path):
    """Long before the shot does. The one that watches sees it end, and can edit; the recording is kept."""
    path = tmp_path / "drive.toml"
    path.write_text(SHOT.replace("schema = 1", "schema = 1\nend_frame = 2000", 1))

    async def play():
        async with served(path) as address, browser(address) as first:
            await first.until("state", lambda message: message["solved"])
            async with browser(address) as second:
                await second.until("scene")
                await first.send(kind="drive", vehicle="car")
                await second.until("live", lambda live: live.header["frame"] > 1003)
                await first.socket.close()
                await second.until("driven")
                state = await second.until("state", lambda message: message["solved"])
                assert state["recordings"][0]["used"] and second.last["role"]["editor"]

    asyncio.run(play())
    last = (tmp_path / "drive.car.001.csv").read_text().splitlines()[-1]
    assert float(last.split(",")[0]) < 1900


def test_recordings_are_compared_and_one_is_used(tmp_path):
    """Two drives, gentle and hard: both are drawn beside the present motion, and again after each solve."""
    path = tmp_path / "drive.toml"
    path.write_text(
        SHOT.replace("duration = 0.2", "duration = 1.0").replace("schema = 1", "schema = 1\nend_frame = 1025")
    )

    async def play():
        async with served(path) as address, browser(address) as page:
            await page.until("scene")
            state = await page.until("state", lambda message: message["solved"])
            assert state["recordings"] == []
            await page.send(kind="compare", files=["../drive.car.001.csv"])
            assert "no such recording" in (await page.until("refused"))["text"]
            await page.send(kind="use_recording", file="drive.car.001.csv")
            assert "cannot be used" in (await page.until("refused"))["text"]
            for torque in (0.4, 1.0):
                await page.send(kind="drive", vehicle="car")
                await page.until("live")
                await page.send(kind="sticks", values=[torque, 0.0])
                await page.until("driven")  # at the last frame
                state = await page.until("state", lambda message: message["solved"])
            names = [f"drive.car.00{k}.csv" for k in (1, 2)]
            assert [(one["name"], one["used"], one["compared"]) for one in state["recordings"]] == [
                (names[0], False, False), (names[1], True, False)
            ]  # fmt: skip

            await page.send(kind="compare", files=names)
            block = await page.until("compared")
            ends = []
            for name, one in zip(names, block.header["motions"], strict=True):
                clip = vehsim.Clip.load((tmp_path / name).with_suffix(".npz"))
                places = block.array(one["points"]).reshape(-1, 3)
                np.testing.assert_allclose(
                    places[[0, 12, -1]], clip.positions[np.isin(clip.frames, [1001, 1013, 1025])], atol=1e-5
                )
                assert one["name"] == name and one["vehicle"] == "car" and len(one["groups"]) > 3
                assert {"speed", "torque"} <= {curve["name"] for curve in one["curves"]}
                ends.append(places[-1, 0])
            assert 0.1 < ends[0] < ends[1]
            state = await page.until("state")
            assert [one["compared"] for one in state["recordings"]] == [True, True]

            await page.send(kind="use_recording", file=names[0])
            await page.until("compared")  # after the motion, which has no other recordings in it
            state = await page.until("state", lambda message: message["solved"])
            assert [one["used"] for one in state["recordings"]] == [True, False]
            assert not [one for one in state["problems"] if "restores" not in one]
            (tmp_path / names[1]).with_suffix(".npz").unlink()
            await page.send(kind="undo")
            block = await page.until("compared")
            assert [one["name"] for one in block.header["motions"]] == names[:1]

    asyncio.run(play())


def test_a_planned_vehicle_starts_where_its_plan_does(tmp_path):
    """Also in flight: the start is the pose and velocity of the planned motion, in readable numbers."""
    marks = [
        {"frame": 1001, "position": [0, 0, 30], "heading": 40, "velocity": [3, 0, 0]},
        {"frame": 1049, "position": [6, 1, 30]},
    ]
    shot = shot_of(tmp_path, "helicopter", {"method": "plan", "segments": 8, "mark": marks})
    clips = shot.solve().clips
    made, _ = Hand({}, 30).drive(shot, clips)
    again = kept(tmp_path, shot, made).solve(cached=False).clips["v"]
    for name in ("positions", "orientations", "twists"):
        assert np.abs(getattr(again, name)[0] - getattr(clips["v"], name)[0]).max() < 1e-5, name
    start = made.motion["start"]
    assert max(len(repr(x)) for key in ("position", "velocity", "spin") for x in start[key]) < 12
