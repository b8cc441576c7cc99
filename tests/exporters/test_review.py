"""The review of a motion: closed forms of every quantity, the envelope, the page and the command."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vehsim
from vehsim.cli import commands as cli
from vehsim.clip.clip import Clip
from vehsim.exporters.checks.review import outside, review, shown
from vehsim.exporters.checks.review_page import write_page
from vehsim.pilots.controllers import FollowPath
from vehsim.vehicles.definition.character import REVIEW_UNITS, REVIEWED
from vehsim.world.ground import touchdown
from vehsim.world.obstacles.obstacles import box

BOAT, CAR = vehsim.load_vehicle("boat").planar, vehsim.load_vehicle("car")
RALLY, HELICOPTER = vehsim.load_vehicle("rally_car"), vehsim.load_vehicle("helicopter")


def along_x(vehicle: Any, x: Any, v: Any, controls: Any, seconds: float = 6.0, slip: float = 0.0) -> Clip:
    """A clip with the root at x(t) along world X, the nose turned aside by ``slip``, and given controls, at 240 samples
    per second."""
    t = np.linspace(0.0, seconds, round(240 * seconds) + 1)
    n, z = len(t), np.zeros(len(t))
    positions, speed = np.column_stack([x(t), z, z]), v(t)
    q = np.tile([math.cos(slip / 2), 0, 0, math.sin(slip / 2)], (n, 1))
    twists = np.column_stack([z, speed * math.cos(slip), -speed * math.sin(slip)])
    joints = np.zeros((n, len(vehicle.joints)))
    given = np.column_stack([np.broadcast_to(control(t), n) for control in controls])
    return Clip(vehicle, t, positions, q, twists, joints, joints, given, {}, Fraction(24))


def row(clip: Clip, name: str) -> dict[str, Any]:
    (found,) = (row for row in review(clip) if row["name"] == name)
    return found


def still(t: Any) -> Any:
    return 0.0 * t


def test_jerk_is_that_of_a_sine_averaged_over_half_a_second() -> None:
    a, w = 3.0, 1.5
    clip = along_x(BOAT, lambda t: a * np.sin(w * t), lambda t: a * w * np.cos(w * t), (still, still), 9.0)
    # the mean of the jerk's mean: two moving averages over a quarter of a second each
    mean = (math.sin(w / 8) / (w / 8)) ** 2
    assert row(clip, "jerk")["worst"] == pytest.approx(a * w**3 * mean, rel=2e-3)
    assert row(clip, "jerk")["inside"] is False


@pytest.mark.parametrize(("stop", "vain"), [(0.0, 0.3), (0.2, 0.0)], ids=["turns back", "stops"])
def test_passing_a_mark_and_returning_is_motion_in_vain(stop: float, vain: float) -> None:
    """Ahead by 2 m, back by 0.3 m, then rest; where it stops between, the way back is a leg of its own."""

    def x(t: Any) -> Any:
        ahead = 1 - np.cos(np.pi * np.clip(t - 1, 0, 2) / 2)
        return ahead - 0.15 * (1 - np.cos(np.pi * np.clip(t - 3 - stop, 0, 1)))

    def there_and_back(v: Any) -> float:
        clip = along_x(BOAT, x, lambda t: v * np.gradient(x(t), t), (still, still))
        return float(row(replace(clip, positions=v * clip.positions), "settling")["worst"])

    assert there_and_back(1) == pytest.approx(vain, abs=0.002)
    assert there_and_back(-1) == pytest.approx(vain, abs=0.002)


def moved(places: Any, rotations: Any = None, seconds: float = 6.0) -> Clip:
    """A flight whose centre of mass is at places(t) (n, 3), rolled by ``rotations(t)`` (n,) rad."""
    clip = along_x(HELICOPTER, still, still, (still,) * 4, seconds)
    t, centre = clip.times, places(clip.times)
    roll = np.zeros(len(t)) if rotations is None else rotations(t)
    sides = np.column_stack([0 * t, -np.sin(roll), np.cos(roll)])  # the body's Z axis
    roots = centre - HELICOPTER.origin[2] * sides
    speeds = np.gradient(roots, t, axis=0)
    across, up = np.cos(roll), np.sin(roll)
    velocities = [speeds[:, 0], across * speeds[:, 1] + up * speeds[:, 2], across * speeds[:, 2] - up * speeds[:, 1]]
    twists = np.column_stack([np.gradient(roll, t), 0 * t, 0 * t, *velocities])
    quaternions = np.column_stack([np.cos(roll / 2), np.sin(roll / 2), 0 * t, 0 * t])
    return replace(clip, positions=roots, orientations=quaternions, twists=twists)


def eased(t: Any, power: int) -> Any:
    """From rest at 1 s to rest at 5 s, m, nearer to its mark the higher the ``power``."""
    return 6 * (1 - (1 - np.clip((t - 1) / 4, 0, 1) ** 2) ** power)


def test_a_curved_climb_to_a_mark_is_not_in_vain() -> None:
    curved = moved(lambda t: np.column_stack([eased(t, 6), -eased(t, 4), eased(t, 2)]))
    assert row(curved, "settling")["worst"] == pytest.approx(0.0, abs=1e-6)
    last = curved.positions[(curved.times > 3) & (curved.times < 5)]
    detour = np.linalg.norm(np.diff(last, axis=0), axis=1).sum() - np.linalg.norm(last[-1] - last[0])
    assert detour > 0.15  # it is bent


def test_passing_a_mark_below_it_and_up_and_down_are_in_vain() -> None:
    def swing(t: Any) -> Any:  # 0.3 m within the last second
        return 0.15 * (1 - np.cos(2 * np.pi * np.clip(t - 4, 0, 1)))

    for centre in (
        lambda t: np.column_stack([eased(t, 6) + swing(t), 0 * t, eased(t, 2)]),
        lambda t: np.column_stack([eased(t, 2), 0 * t, eased(t, 6) + swing(t)]),
    ):
        assert row(moved(centre), "settling")["worst"] == pytest.approx(0.3, abs=0.02)


def test_skids_that_swing_below_a_steady_centre_are_not_in_vain() -> None:
    def roll(t: Any) -> Any:  # levels out where it comes to rest, as after a flare
        return 0.25 * (1 + np.cos(np.pi * np.clip((t - 4.2) / 0.8, 0, 1))) * (t > 1.5)

    flight = moved(lambda t: np.column_stack([0 * t, eased(t, 4), 0 * t]), roll)
    assert np.max(flight.positions[:, 1]) > flight.positions[-1, 1] + 0.1  # the root passes its mark
    assert row(flight, "settling")["worst"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("turn", "vain"), [(math.pi, 0.0), (4 * math.pi, 2.0)], ids=["half", "two"])
def test_circles_back_to_a_mark_are_in_vain_and_half_of_one_is_not(turn: float, vain: float) -> None:
    clip = along_x(BOAT, still, still, (still, still))
    t = clip.times
    angle = turn * np.clip(t - 3, 0, 2) ** 2 / 2 * (3 - np.clip(t - 3, 0, 2)) / 2
    circle = np.column_stack([np.cos(angle), np.sin(angle), 0 * t])
    rate = np.gradient(angle, t)
    twists = np.column_stack([0 * t, -rate * np.sin(angle), rate * np.cos(angle)])
    assert row(replace(clip, positions=circle, twists=twists), "settling")["worst"] == pytest.approx(vain, abs=0.01)


def test_slip_is_the_angle_to_the_velocity_above_walking_speed() -> None:
    fast = along_x(CAR, lambda t: 5 * t, lambda t: 5 + 0 * t, (still, still), slip=0.2)
    assert row(fast, "slip")["worst"] == pytest.approx(0.2, abs=1e-4)
    assert row(fast, "slip")["inside"] is False
    slow = along_x(CAR, lambda t: 0.5 * t, lambda t: 0.5 + 0 * t, (still, still), slip=0.2)
    assert "slip" not in {row["name"] for row in review(slow)}


def test_saturation_is_a_share_of_time_and_reversals_are_counted() -> None:
    top, w = BOAT.controls[0].upper, 2 * math.pi / 2

    def steered(t: Any) -> Any:
        return 0.2 * np.sin(w * t)  # of 1.05 rad: three turns of a tenth of the range and more every 3 s

    clip = along_x(BOAT, still, still, (lambda t: np.where(t < 1.5, top, 0.0), steered))
    assert row(clip, "saturation")["worst"] == pytest.approx(0.25, abs=0.01)
    assert row(clip, "reversals")["worst"] == pytest.approx(6 / 6 * 60, rel=0.1)
    small = along_x(BOAT, still, still, (still, lambda t: 0.04 * np.sin(w * t)))
    assert row(small, "reversals")["worst"] == 0


def test_a_released_brake_is_not_saturated_and_a_rotor_without_thrust_is() -> None:
    driven = [lambda t, k=k: 0 * t + k for k in (500.0, 0.0, 0.0, 0.1)]  # drive, brake, handbrake, steering_rate
    assert row(along_x(RALLY, lambda t: 5 * t, lambda t: 5 + 0 * t, driven), "saturation")["worst"] == 0
    driven[1] = lambda t: np.where(t < 1.5, RALLY.controls[1].upper, 0.0)  # a quarter of the time
    assert row(along_x(RALLY, still, still, driven), "saturation")["worst"] == pytest.approx(0.25, abs=0.01)
    falling = vehsim.simulate(HELICOPTER, vehsim.World(), np.zeros((25, 4)), duration=0.1, step=1 / 240)
    assert row(falling, "saturation")["worst"] == 1


def test_a_control_without_bounds_is_never_saturated() -> None:
    free = replace(BOAT, controls=(replace(BOAT.controls[0], upper=math.inf), *BOAT.controls[1:]))
    turned = BOAT.controls[1].upper / 2
    with np.errstate(all="raise"):
        clip = along_x(free, still, still, (lambda t: 1e9 + 0 * t, lambda t: turned + 0 * t))
        assert row(clip, "saturation")["worst"] == 0


def test_ease_is_measured_where_the_motion_rests() -> None:
    rate = BOAT.character.control_rates["thrust"].normal

    def pushed(t: Any) -> Any:
        return 0.3 * rate * np.maximum(t - 5, 0)

    resting, moving = (along_x(BOAT, lambda t, s=s: s * t, lambda t, s=s: s + 0 * t, (pushed, still)) for s in (0, 2))
    assert row(resting, "ease")["worst"] == pytest.approx(0.3, rel=0.01)
    assert "ease" not in {row["name"] for row in review(moving)}


def test_everything_reviewed_has_a_unit() -> None:
    assert REVIEWED.keys() <= REVIEW_UNITS.keys()
    assert shown(math.pi, "rad/s") == "180 deg/s" and shown(0.25, "share") == "25 %" and shown(2, "m") == "2 m"


def test_a_page_is_whole_and_red_where_outside(tmp_path: Path) -> None:
    clip = along_x(CAR, lambda t: np.sin(3 * t), lambda t: 3 * np.cos(3 * t), (still, still))
    rows = review(clip)
    page = write_page({"shot": "a<b", "fps": "24", "vehicles": {"x&y": rows}}, "normal", tmp_path / "p.html")
    text = page.read_text(encoding="utf-8")
    body = text[text.index("<h1>") : text.index("</html>")]
    tree = ET.fromstring(f"<page>{body}</page>")
    assert "a<b" in str(tree.findtext("h1")) and "x&y" in str(tree.findtext("h2"))
    marked = [line for line in tree.iter("tr") if line.get("class") == "out"]
    assert len(marked) == len(outside(rows)) > 0
    assert len(list(tree.iter("svg"))) == len(rows)
    red = [line for line in tree.iter("tr") if "#ff6b5e" in ET.tostring(line, "unicode")]
    assert {ET.tostring(line) for line in marked} >= {ET.tostring(line) for line in red}


def test_the_command_reviews_deliveries_and_shots_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = tmp_path / "drive.toml"
    shot.write_text(
        '[shot]\nschema = 1\nname = "drive"\n[[vehicle]]\nname = "car"\nasset = "car"\n'
        '[vehicle.motion]\nmethod = "simulate"\nduration = 2\ncommands = [{ frame = 1001, torque = 2500 }]\n'
    )
    assert cli.run(["export", str(shot), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    capsys.readouterr()
    assert cli.run(["review", str(tmp_path / "out" / "drive"), "--out", str(tmp_path / "a")]) == 0
    said = capsys.readouterr().out
    assert "drive: car: outside: saturation: 100 %, 5 % in the envelope" in said
    assert cli.run(["review", str(shot), "--out", str(tmp_path / "b"), "--quiet"]) == 0
    pages = [(tmp_path / folder / "drive.review.html").read_text(encoding="utf-8") for folder in "ab"]
    assert pages[0] == pages[1]


def test_a_folder_without_a_review_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["review", str(tmp_path), "--out", str(tmp_path / "a")]) == 2
    (tmp_path / "report.json").write_text('{"shot": "x", "fps": "24", "vehicles": {"car": {}}}')
    assert cli.run(["review", str(tmp_path), "--out", str(tmp_path / "a")]) == 2
    assert not (tmp_path / "a").exists()


ROW = {"name": "jerk", "unit": "m/s^3", "worst": 1.0, "frame": 1001.0, "envelope": 2.0, "source": "", "inside": True}


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("curve", [[1001.0, 1002.0], [1.0]], "a curve has frames, and as many values"),
        ("curve", [[1001.0], ["much"]], "valid number"),
        ("worst", float("nan"), "finite"),
        ("envelope", {}, "valid number"),
        ("inside", None, ""),
        ("unit", 3, "valid string"),
        ("shot", "../../escape", "not a name: letters"),
        ("fps", [], "frame rate"),
    ],
)
def test_a_report_that_was_changed_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str, value: Any, says: str
) -> None:
    row: dict[str, Any] = ROW | {"curve": [[1001.0], [1.0]]}
    report = {"shot": "x", "fps": "24", "vehicles": {"car": {"review": [row]}}}
    (report if key in report else row)[key] = value
    (tmp_path / "report.json").write_text(json.dumps(report))
    code = cli.run(["review", str(tmp_path), "--out", str(tmp_path / "a" / "b")])
    assert code == (2 if says else 0), capsys.readouterr().err
    if says:
        said = capsys.readouterr().err
        assert says in said and key in said and str(tmp_path) in said
        assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def test_power_is_that_of_the_rotors_in_the_air_that_they_meet() -> None:
    """Hover by momentum theory; the same motion through the air has the same power, with any heading and wind."""
    heli = vehsim.load_vehicle("helicopter")
    n = 3
    thrust, tail = 1900 * 9.81, 1105.0

    def worst(speed: float, wind: Any, heading: float = 0.0) -> float:
        t, z = np.linspace(0.0, 1.0, n), np.zeros(n)
        turn = np.tile([math.cos(heading / 2), 0, 0, math.sin(heading / 2)], (n, 1))
        positions = np.column_stack([speed * math.cos(heading) * t, speed * math.sin(heading) * t, z])
        controls = np.tile([thrust, tail, 0.0, 0.0], (n, 1))
        twists, none = np.tile([0.0, 0, 0, speed, 0, 0], (n, 1)), np.zeros((n, 0))
        clip = Clip(heli, t, positions, turn, twists, none, none, controls, {}, Fraction(24))
        (found,) = (row for row in review(clip, vehsim.World(wind=wind)) if row["name"] == "power")
        assert shown(found["worst"], found["unit"]).endswith(" kW") and found["inside"] is True
        return float(found["worst"])

    def hover(force: float, radius: float, speed: float, solidity: float) -> float:
        disc, air = math.pi * radius**2, 1.225
        return 1.15 * force**1.5 / math.sqrt(2 * air * disc) + 0.01 * solidity / 8 * air * disc * (speed * radius) ** 3

    still = hover(thrust, 5.35, 40.8, 0.0625) + hover(tail, 0.93, 218.0, 0.13)
    assert worst(0.0, (0, 0, 0)) == pytest.approx(still, rel=2e-3)
    assert worst(10.0, (0, 10, 0), math.pi / 2) == pytest.approx(still, rel=2e-3)
    assert worst(10.0, (0, 0, 0), 1.0) == pytest.approx(worst(0.0, (-10, 0, 0)), rel=1e-4)
    assert worst(10.0, (0, 0, 0)) < 0.95 * still


def test_a_hover_near_the_ground_needs_less_power() -> None:
    """Skids on ground, pad or water: Hayden's share of the induced power of the main rotor, 3.06 m above them."""
    heli, n = vehsim.load_vehicle("helicopter"), 3
    thrust, none = 1900 * 9.81, np.zeros((n, 0))

    def power(height: float, world: vehsim.World | None) -> float:
        upright, still = np.tile([1.0, 0, 0, 0], (n, 1)), np.zeros((n, 6))
        positions, controls = np.tile([0.0, 0, height], (n, 1)), np.tile([thrust, 0.0, 0, 0], (n, 1))
        t = np.linspace(0.0, 1.0, n)
        clip = Clip(heli, t, positions, upright, still, none, none, controls, {}, Fraction(24))
        (found,) = (row for row in review(clip, world) if row["name"] == "power")
        return float(found["worst"])

    free, flat = power(0.0, None), vehsim.World("flat")
    induced = 1.15 * thrust**1.5 / math.sqrt(2 * 1.225 * math.pi * 5.35**2)
    saved = induced * (1 - 1 / (0.9926 + 0.0379 * (2 * 5.35 / 3.06) ** 2))
    pad = box("pad", (0, 0, 10.0), (20, 20, 2.0))
    for world, height in (
        (flat, 0.0),
        (vehsim.World("flat", obstacles=[pad]), 12.0),
        (vehsim.World(water=4.0), 4.0),
    ):
        assert free - power(height, world) == pytest.approx(saved, rel=5e-3)
    assert power(40.0, flat) == pytest.approx(free)


def landed(slide: float, turn: float, ground: float) -> Clip:
    """A helicopter that comes down at 0.5 m/s and stands from 3 s on at the height ``ground``, m; from a second before,
    it slides aside at ``slide`` m/s and turns at ``turn`` rad/s until it stands."""
    t = np.linspace(0.0, 6.0, 1441)
    z = np.zeros(len(t))
    late = (t > 2) & (t < 3)
    yaw = turn * (np.clip(t, 2, 3) - 2)
    positions = np.column_stack([z, slide * (np.clip(t, 2, 3) - 2), ground + 0.5 * np.clip(3 - t, 0, None)])
    body = [slide * late * np.sin(yaw), slide * late * np.cos(yaw)]
    twists = np.column_stack([z, z, turn * late, *body, np.where(t < 3, -0.5, 0.0)])
    turned = np.column_stack([np.cos(yaw / 2), z, z, np.sin(yaw / 2)])
    none, controls = np.zeros((len(t), 0)), np.zeros((len(t), 4))
    return Clip(HELICOPTER, t, positions, turned, twists, none, none, controls, {}, Fraction(24))


@pytest.mark.parametrize("top", [0.0, 2.0], ids=["ground", "pad"])
def test_the_slide_of_a_landing_is_that_of_its_skids(top: float) -> None:
    """Their speed where it slides, the rate times the reach of the skids where it turns; none where it hovers."""
    world = vehsim.World("flat", obstacles=[box("pad", (0, 0, top - 1.0), (20, 20, 2.0))] if top else [])
    stands = float(touchdown.put_down(world, HELICOPTER, (0, 0, top + 3.0), (1, 0, 0, 0))[2])
    reach = float(np.linalg.norm(touchdown.feet(HELICOPTER)[:, :2], axis=1).max())

    def slide(aside: float, turn: float, above: float = 0.0) -> dict[str, Any] | None:
        rows = review(landed(aside, turn, stands + above), world)
        return next((row for row in rows if row["name"] == "slide"), None)

    straight, aside, turned = slide(0, 0), slide(0.7, 0), slide(0, 0.3)
    assert straight is not None and straight["inside"] is True and straight["worst"] == pytest.approx(0.0, abs=1e-6)
    assert aside is not None and aside["inside"] is False and aside["worst"] == pytest.approx(0.7)
    assert aside["frame"] == pytest.approx(1001 + 24 * 3, abs=24)
    assert turned is not None and turned["worst"] == pytest.approx(0.3 * reach, rel=1e-6)
    assert slide(0.7, 0, above=0.1) is None


def test_slip_and_power_are_of_the_bodys_origin() -> None:
    """A body that rolls about its rig's root moves aside at its origin above it, whatever its heading."""
    heli = vehsim.load_vehicle("helicopter")
    rate, speed, t = 0.5, 4.0, np.linspace(0.0, 0.01, 3)
    for heading in (0.0, 1.3):
        turn = np.tile([math.cos(heading / 2), 0, 0, math.sin(heading / 2)], (3, 1))
        twists = np.tile([rate, 0, 0, speed, 0, 0], (3, 1))
        none, controls = np.zeros((3, 0)), np.tile([18639.0, 1105.0, 0, 0], (3, 1))
        clip = Clip(heli, t, np.zeros((3, 3)), turn, twists, none, none, controls, {}, Fraction(24))
        assert row(clip, "slip")["worst"] == pytest.approx(math.atan(rate * heli.origin[2] / speed), rel=1e-3)


@pytest.mark.parametrize(
    ("points", "speed"), [([(0, 0), (30, 0), (50, 12), (60, 35)], 12.0), ([(0, 0), (9, 1), (20, 8)], 5.0)]
)
def test_a_car_that_follows_a_path_stays_in_the_envelope(points: list[tuple[float, float]], speed: float) -> None:
    car = vehsim.load_vehicle("car")
    clip = vehsim.simulate(car, None, FollowPath(car, points, speed=speed), duration=20.0)
    assert not outside(review(clip)) and np.linalg.norm(clip.twists[-1]) < 1e-3
