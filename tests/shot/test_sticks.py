"""``method = "sticks"``: recorded controls give the same motion again."""

import csv

import numpy as np
import pytest

from vehsim import Shot
from vehsim.errors import ShotError


def shot(tmp_path, method, **more):
    """A car in empty space, whose motion is ``method`` with its keys; ``end_frame`` is that of the shot."""
    header = {key: more.pop(key) for key in ("end_frame",) if key in more}
    return Shot.from_dict(
        {
            "shot": {"schema": 1, "name": "drive", "start_frame": 1001, **header},
            "vehicle": [{"name": "car", "asset": "car", "motion": {"method": method, **more}}],
        },
        folder=tmp_path,
    )


def write(path, header, *rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


COLUMNS = ["frame", "control.torque [N m]"]


def test_a_table_drives_as_the_same_commands_do(tmp_path):
    write(tmp_path / "a.csv", COLUMNS, [1001, 0.0], [1007, 900.0], [1013, 100.0])
    commands = [{"frame": 1001, "torque": 0.0}, {"frame": 1007, "torque": 900.0}, {"frame": 1013, "torque": 100.0}]
    ours = shot(tmp_path, "sticks", file="a.csv").solve().clips["car"]
    other = shot(tmp_path, "simulate", commands=commands, duration=0.5).solve().clips["car"]
    assert ours.end_frame == 1013 and ours.positions[-1, 0] > 0.08
    for name in ("positions", "orientations", "twists", "controls"):
        assert np.array_equal(getattr(ours, name), getattr(other, name))


def test_a_delivered_table_gives_the_same_bytes_again(tmp_path):
    """The rows of the csv exporter are on frames; so are the knots of this drive."""
    write(tmp_path / "a.csv", COLUMNS, [1001, 0.0], [1004, 300.0], [1009, 800.0])
    first = shot(tmp_path, "sticks", file="a.csv").solve().export(tmp_path / "one", to=("csv", "npz"))
    again = shot(tmp_path, "sticks", file="one/drive/car.csv").solve().export(tmp_path / "two", to=("npz",))
    once_more = shot(tmp_path, "sticks", file="two.csv")
    write(tmp_path / "two.csv", COLUMNS, [1001, 0.0], [1004, 300.0], [1009, 800.0])
    assert (once_more.solve().export(tmp_path / "three", to=("npz",)) / "car.npz").read_bytes() == (
        first / "car.npz"
    ).read_bytes()
    with np.load(first / "car.npz") as a, np.load(again / "car.npz") as b:
        assert np.abs(a["positions"] - b["positions"]).max() < 1e-9


def test_a_recording_continues_seamlessly(tmp_path):
    """New input from frame 1005 on leaves pose and velocity before it as they were."""
    write(tmp_path / "a.csv", COLUMNS, [1001, 500.0], [1005, 500.0], [1013, 500.0])
    write(tmp_path / "b.csv", COLUMNS, [1001, 500.0], [1005, 500.0], [1006, -900.0], [1013, -900.0])
    a, b = (shot(tmp_path, "sticks", file=f"{name}.csv").solve().clips["car"] for name in "ab")
    before = a.frames <= 1005
    assert np.array_equal(a.positions[before], b.positions[before])
    assert np.array_equal(a.twists[before], b.twists[before])
    assert abs(a.twists[-1, 1] - b.twists[-1, 1]) > 0.5


def test_the_end_frame_cuts_it_short(tmp_path):
    write(tmp_path / "a.csv", COLUMNS, [1001, 500.0], [1101, 500.0])
    assert shot(tmp_path, "sticks", file="a.csv", end_frame=1006).solve().frames == (1001, 1006)


@pytest.mark.parametrize(
    "rows, message",
    [
        ([["frame", "control.torque [N m]"], [1001, 0], [1001, 1]], "row 2: frame 1001 is not after"),
        ([["frame", "control.torqe"], [1001, 0], [1009, 0]], "'control.torqe': no such control"),
        ([["frame", "control.torque [lbf ft]"], [1001, 0], [1009, 0]], "the unit is not that of car"),
        ([["frame", "control.torque"], [1001, 0], [1009, 1e9]], "row 2, column 'control.torque': 1e+09 is beyond"),
        ([["frame", "control.torque"], [1001, 0], [1009, "fast"]], "row 2, column 'control.torque': not a number"),
        ([["frame", "control.torque"], [1001, 0], [1009]], "row 2 has 1 of 2 values"),
        ([["frame", "control.torque"]], "no rows"),
        ([["time", "control.torque"], [0, 0]], "no column 'frame'"),
        ([["frame", "frame"], [0, 0]], "used twice"),
        ([["frame", "speed"], [1001, 0], [1009, 0]], "no column of a control"),
        ([["frame", "control.torque"], [900, 0], [990, 0]], "ends at frame 990, where the shot starts"),
        ([], "missing or used twice"),
    ],
)
def test_wrong_tables_are_refused(tmp_path, rows, message):
    write(tmp_path / "a.csv", *(rows or [[]]))
    with pytest.raises(ShotError) as caught:
        shot(tmp_path, "sticks", file="a.csv").solve()
    assert any(message in str(problem) for problem in caught.value.problems)
    assert {problem.key for problem in caught.value.problems} == {"vehicle[0].motion.file"}


def test_a_missing_table_is_named(tmp_path):
    with pytest.raises(ShotError, match=r"vehicle\[0\].motion.file .*no such file"):
        shot(tmp_path, "sticks", file="none.csv").solve()


def test_a_changed_table_is_solved_again(tmp_path, monkeypatch):
    monkeypatch.setenv("VEHSIM_CACHE_GB", "0.1")
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    ends = []
    for torque in (200.0, 200.0, 400.0):
        write(tmp_path / "a.csv", COLUMNS, [1001, torque], [1007, torque])
        take = shot(tmp_path, "sticks", file="a.csv").solve()
        ends.append((take.recalled, take.clips["car"].positions[-1, 0]))
    assert [recalled for recalled, _ in ends] == [False, True, False]
    assert ends[2][1] == pytest.approx(2 * ends[0][1], rel=1e-3)


def test_a_motion_that_is_cut_off_is_said_to_need_grip_once(tmp_path, recwarn):
    """2.3 g in its bend; that it stands still after its last row is no braking."""
    write(tmp_path / "a.csv", COLUMNS, [1001, 0.0], [1013, 0.0])
    start = {"velocity": [15.0, 0.0, 0.0], "spin": [0.0, 0.0, np.degrees(1.5)], "joints": {"sigma": 0.26}}
    longer = {"name": "other", "asset": "car", "motion": {"method": "simulate", "duration": 4.0}}
    vehicle = {"name": "car", "asset": "car", "motion": {"method": "sticks", "file": "a.csv", "start": start}}
    data = {"shot": {"schema": 1, "name": "drive"}, "world": {"terrain": "flat"}, "vehicle": [vehicle, longer]}
    Shot.from_dict(data, folder=tmp_path).solve()
    texts = [str(warning.message) for warning in recwarn]
    assert [text[:12] for text in texts if "grip of tyres" in text] == ["car: 2.3 g a"]
    assert any("cut off while it moves" in text for text in texts)
