"""Each measure on motions known in closed form, and a spoiled motion for each kind of ask."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim.audit import MEASURES, Scene, Track, WorldScene, audit, missed, track_of_clip, track_of_poses
from vehsim.audit.scene import rolling_wheels
from vehsim.clip.clip import Clip
from vehsim.lie.quaternions import from_vectors, matrices, product
from vehsim.requests import Ask, mark_asks
from vehsim.world.world import World

RADIUS, RATE, HEIGHT = 20.0, 2 * math.pi / 12.5, 30.0
SPEED, ACCELERATION = RADIUS * RATE, RADIUS * RATE**2
HELICOPTER, CAR = vehsim.load_vehicle("helicopter"), vehsim.load_vehicle("car")


def flight(end: float = 12.5) -> Clip:
    """A level circle, nose first: every measured value follows from its radius and rate; it closes after 12.5 s."""
    fps = 24
    t = np.arange(round(end * fps) + 1) / fps
    angle, zero, one = RATE * t, np.zeros_like(t), np.ones_like(t)
    yaw = angle + math.pi / 2
    return Clip(
        HELICOPTER,
        times=t,
        positions=np.column_stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), HEIGHT * one]),
        orientations=np.column_stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)]),
        twists=np.column_stack([zero, zero, RATE * one, SPEED * one, zero, zero]),
        joints=np.zeros((len(t), len(HELICOPTER.joints))),
        joint_rates=np.zeros((len(t), len(HELICOPTER.joints))),
        controls=np.zeros((len(t), len(HELICOPTER.controls))),
        fps=Fraction(fps),
        start_frame=1,
    )


def standing(position: tuple[float, float, float] = (0.0, 0.0, HEIGHT)) -> Clip:
    clip = flight(2.0)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(clip), 1))
    return replace(clip, positions=np.tile(position, (len(clip), 1)), orientations=level, twists=0 * clip.twists)


def steered() -> Clip:
    """A car that stands and turns its wheels: tan(angle) = t / 10."""
    t = np.arange(49) / 24
    one, zero = np.ones_like(t), np.zeros_like(t)
    joints, rates = np.zeros((2, len(t), len(CAR.joints)))
    column = CAR.joints.index("sigma")
    joints[:, column], rates[:, column] = t / 10, 0.1
    return Clip(
        CAR,
        times=t,
        positions=np.zeros((len(t), 3)),
        orientations=np.column_stack([one, zero, zero, zero]),
        twists=np.zeros((len(t), 3)),
        joints=joints,
        joint_rates=rates,
        controls=np.zeros((len(t), len(CAR.controls))),
        start_frame=1,
    )


def pulled() -> Clip:
    """A car that stands still while its first control rises by 0.1 per second."""
    clip = steered()
    controls = clip.controls.copy()
    controls[:, 0] = clip.times / 10
    return replace(clip, controls=controls)


def rolling() -> Clip:
    """A car in two seconds on a circle of 10 m to the left, its wheels as far as their hubs come."""
    clip, radius, speed = steered(), 10.0, 3.0
    t, zero, one = clip.times, 0 * clip.times, 0 * clip.times + 1
    yaw, origin = speed / radius * t, CAR.rig.origin[0]
    channels, to_centre = {}, {"fl": (2.6, 0.77), "fr": (2.6, -0.77), "rl": (0.0, 0.77), "rr": (0.0, -0.77)}
    for wheel, (ahead, left) in to_centre.items():
        channels[f"roll_{wheel}"] = yaw * math.hypot(radius - left, ahead) / 0.32
        if ahead:
            channels[f"steer_{wheel}"] = one * math.atan2(ahead, radius - left)
    rear = np.column_stack([radius * np.sin(yaw), radius * (1 - np.cos(yaw)), zero])
    return replace(
        clip,
        positions=rear - origin * np.column_stack([np.cos(yaw), np.sin(yaw), zero]),
        orientations=np.column_stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)]),
        twists=np.column_stack([speed / radius * one, speed * one, -origin * speed / radius * one]),
        channels=channels,
    )


def hovering() -> Clip:
    """A helicopter that stands in the air while its rotors turn."""
    clip = standing()
    rates = {"main_rotor": HELICOPTER.channels["main_rotor"], "tail_rotor": HELICOPTER.channels["tail_rotor"]}
    laws = {
        name: float(channel.rate(0, *[np.zeros(0)] * 2, np.zeros(6), np.zeros(4))) for name, channel in rates.items()
    }
    return replace(clip, channels={name: rate * clip.times for name, rate in laws.items()})


def turning(clip: Clip, channel: str, by: float) -> Clip:
    """The clip in whose second half a channel turns by so many rad more."""
    extra = np.linspace(0, 2 * by, len(clip)) - by
    return replace(clip, channels={**clip.channels, channel: clip.channels[channel] + np.maximum(extra, 0)})


def moved(clip: Clip, by: Any, sample: int | slice = slice(None)) -> Clip:
    positions = clip.positions.copy()
    positions[sample] += by
    return replace(clip, positions=positions)


def turned(clip: Clip, by: Any, sample: int | slice = slice(None)) -> Clip:
    orientations = clip.orientations.copy()
    rows = orientations[sample].reshape(-1, 4)
    orientations[sample] = product(rows, from_vectors(np.tile(by, (len(rows), 1)))).reshape(orientations[sample].shape)
    return replace(clip, orientations=orientations)


def sped_up(clip: Clip, by: float, columns: slice = slice(3, 6)) -> Clip:
    """Velocities that are larger by a share at every knot, without a change of the poses."""
    twists = clip.twists.copy()
    twists[:, columns] *= 1 + by
    return replace(clip, twists=twists)


def bumped(clip: Clip, column: int = 5) -> Clip:
    """A jolt of 0.5 m/s at one knot in the middle, upwards by default."""
    twists = clip.twists.copy()
    twists[len(clip) // 2, column] += 0.5
    return replace(clip, twists=twists)


@dataclass(frozen=True)
class Case:
    """A motion that meets an ask exactly, and the same motion spoiled."""

    ask: Ask
    clip: Callable[[], Clip]
    spoil: Callable[[Clip], Clip]
    scene: Callable[[], Scene] = Scene


def ask(measure: str, first: float = 1, last: float = 301, wanted: Any = None, **bounds: Any) -> Ask:
    return Ask(measure, measure, first, last, wanted or {}, **bounds)


def own_law() -> str:
    """A law: the distance of the root from the circle's axis, as its second component."""
    sizes = (3, 9, 3, 3, 3, len(HELICOPTER.joints), len(HELICOPTER.joints), len(HELICOPTER.controls), 1)
    given = [ca.SX.sym("x", size) for size in sizes]
    law: str = ca.Function("law", given, [ca.vertcat(given[-1], ca.norm_2(given[0][:2]))]).serialize()
    return law


MM, ANGLE = 1.01e-3, math.radians(0.0505)
GATE = {"gate": np.eye(3)[[1, 0, 2]].tolist(), "half": [1.0, 1.0], "round": True, "planar": False}
START = {"position": [RADIUS, 0.0, HEIGHT]}
CASES = {
    "frame": Case(ask("frame", 301, 301, lower=301, upper=301), flight, lambda c: c.at(c.times[:-1])),
    "off_frame": Case(ask("off_frame", 1, 1, upper=1e-3), flight, lambda c: c),
    "position": Case(
        ask("position", 1, 1, START | {"axes": [0, 1, 2]}, upper=1e-3), flight, lambda c: moved(c, [0, 0, MM])
    ),
    "distance": Case(
        ask("distance", 301, 301, {"position": [RADIUS, 3.0, HEIGHT - 4.0], "axes": [1, 2]}, upper=5.0),
        flight,
        lambda c: moved(c, [0, 0, MM]),
    ),
    "off_path": Case(
        ask("off_path", 1, 49, {"points": [[-5, 1, 0], [5, 1, 0]], "offset": [0, 0.6, 0]}, upper=0.4),
        standing,
        lambda c: moved(c, [0, -MM, 0], 24),
    ),
    "swing": Case(
        ask("swing", 1, 49, {"joint": "sigma"}, lower=0.095, upper=0.105),
        steered,
        lambda c: replace(c, joints=0.9 * c.joints),
    ),
    "heading": Case(
        ask("heading", 1, 1, {"heading": math.pi / 2}, upper=math.radians(0.05)),
        flight,
        lambda c: turned(c, [0, 0, ANGLE]),
    ),
    "orientation": Case(
        ask("orientation", 1, 1, {"orientation": [1, 0, 0, 1]}, upper=math.radians(0.05)),
        flight,
        lambda c: turned(c, [ANGLE, 0, 0]),
    ),
    "velocity": Case(
        ask("velocity", 1, 1, {"velocity": [0, SPEED, 0], "axes": [0, 1, 2]}, upper=1e-3),
        flight,
        lambda c: sped_up(c, 1.01e-4),
    ),
    "speed_error": Case(ask("speed_error", 1, 1, {"speed": SPEED}, upper=1e-3), flight, lambda c: sped_up(c, -1.01e-4)),
    "joint_error": Case(
        ask("joint_error", 25, 25, {"joint": "sigma", "value": 0.1}, upper=1e-3),
        steered,
        lambda c: replace(c, joints=c.joints + 2e-3),
    ),
    "drift": Case(ask("drift", 1, 49, upper=1e-3), standing, lambda c: moved(c, [0, 0, -MM], slice(20, None))),
    "turned": Case(
        ask("turned", 1, 49, upper=math.radians(0.05)), standing, lambda c: turned(c, [0, ANGLE, 0], slice(20, None))
    ),
    "closure": Case(ask("closure", upper=1e-3), flight, lambda c: moved(c, [MM, 0, 0], -1)),
    "closure_angle": Case(
        ask("closure_angle", upper=math.radians(0.05)), flight, lambda c: turned(c, [ANGLE, 0, 0], -1)
    ),
    "closure_velocity": Case(
        ask("closure_velocity", upper=1e-3),
        flight,
        lambda c: replace(c, twists=c.twists + np.eye(len(c))[-1][:, None] * [0, 0, 0, 0, 0, 2e-3]),
    ),
    "gate_plane": Case(
        ask("gate_plane", 1, 1, START | GATE, lower=-1e-3, upper=1e-3), flight, lambda c: moved(c, [0, MM, 0])
    ),
    "gate_opening": Case(
        ask("gate_opening", 1, 1, {"position": [RADIUS - 0.6, 0, HEIGHT - 0.8]} | GATE, upper=1.0),
        flight,
        lambda c: moved(c, [0, 0, 2e-3]),
    ),
    "gate_direction": Case(
        ask("gate_direction", 1, 1, START | GATE, lower=0), flight, lambda c: replace(c, twists=-c.twists)
    ),
    "speed": Case(ask("speed", upper=SPEED), flight, lambda c: sped_up(c, 0.002)),
    "ceiling": Case(ask("ceiling", upper=HEIGHT), flight, bumped),
    "climb": Case(ask("climb", upper=0.01), flight, bumped),
    "turn_rate": Case(ask("turn_rate", upper=RATE), flight, lambda c: sped_up(c, 0.002, slice(0, 3))),
    "bank": Case(ask("bank", upper=math.radians(1)), flight, lambda c: turned(c, [math.radians(1.01), 0, 0], 40)),
    "acceleration": Case(ask("acceleration", upper=ACCELERATION), flight, bumped),
    "g_load": Case(ask("g_load", upper=math.hypot(1, ACCELERATION / 9.81)), flight, bumped),
    "grip": Case(ask("grip", upper=ACCELERATION / 9.81), flight, lambda c: bumped(c, 4)),
    "steering": Case(
        ask("steering", 1, 49, upper=math.atan(0.2)), steered, lambda c: replace(c, joints=c.joints * 1.01)
    ),
    "steering_rate": Case(
        ask("steering_rate", 1, 49, upper=0.1), steered, lambda c: replace(c, joint_rates=c.joint_rates * 1.01)
    ),
    "joint": Case(
        ask("joint", 1, 49, {"joint": "sigma"}, lower=0, upper=0.2), steered, lambda c: replace(c, joints=-c.joints)
    ),
    "joint_rate": Case(
        ask("joint_rate", 1, 49, {"joint": "sigma"}, lower=0.099, upper=0.101),
        steered,
        lambda c: replace(c, joint_rates=1.05 * c.joint_rates),
    ),
    "control_rate": Case(
        ask("control_rate", 1, 49, {"control": 0}, upper=0.101),
        pulled,
        lambda c: replace(c, controls=1.05 * c.controls),
    ),
    "command": Case(
        ask("command", 1, 49, {"control": 0, "lag": 0.5}, upper=0.251),
        pulled,
        lambda c: replace(c, controls=1.05 * c.controls),
    ),
    "look": Case(
        ask("look", wanted={"at": [0, 0, HEIGHT], "axis": 1, "sign": 1.0, "level": True}, upper=math.radians(0.05)),
        flight,
        lambda c: turned(c, [0, 0, ANGLE], 100),
    ),
    "law": Case(
        ask("law", wanted={"law": own_law(), "component": 1, "planar": False, "start": 1}, upper=RADIUS + 1e-3),
        flight,
        lambda c: moved(c, [MM, MM, 0], 40),
    ),
    "outside": Case(
        ask("outside", wanted={"box": [[-RADIUS, -RADIUS, 0], [RADIUS, None, HEIGHT]]}, upper=1e-3),
        flight,
        lambda c: moved(c, [0, 0, MM], 100),
    ),
    "descent": Case(
        ask("descent", wanted={"place": [0, 0, HEIGHT], "sink": 0.0}, upper=0.01),
        flight,
        lambda c: replace(c, twists=c.twists - [0, 0, 0, 0, 0, 0.02]),
    ),
    "stands": Case(
        ask("stands", 1, 49, lower=-5e-3, upper=5e-3),
        lambda: standing(landed()),
        lambda c: moved(c, [0, 0, 6e-3], 24),
        lambda: WorldScene(World("flat"), HELICOPTER),
    ),
    "wheels": Case(
        ask("wheels", 1, 49, {"prims": ["wheel"]}, lower=-5e-3, upper=5e-3),
        standing,
        lambda c: moved(c, [0, 0, 6e-3], 24),
        lambda: OnWheels(),
    ),
    "rolling": Case(
        ask("rolling", 1, 49, {"wheels": rolling_wheels(CAR.rig), "share": 0.0}, upper=1e-3),
        rolling,
        lambda c: turning(c, "roll_fr", -2e-3),
        lambda: WorldScene(None, CAR),
    ),
    "spinning": Case(
        ask("spinning", 1, 49, {"channel": "tail_rotor", "share": 0.0}, upper=1e-3),
        hovering,
        lambda c: turning(c, "tail_rotor", 2e-3),
        lambda: WorldScene(None, HELICOPTER),
    ),
    "clearance": Case(
        ask("clearance", 1, 49, {"clearance": 1.0, "obstacles_only": False, "slope": 0.35}, lower=1.0 - 1e-4),
        lambda: moved(standing(landed()), [0, 0, 1.0]),
        lambda c: moved(c, [0, 0, -2e-3], 24),
        lambda: WorldScene(World("flat"), HELICOPTER),
    ),
}


class OnWheels(Scene):
    """Wheels that stand on the ground at the height of `standing`."""

    def wheel_gap(self, track: Track, prims: Sequence[str]) -> Any:
        return track.positions[:, 2] - HEIGHT


def landed() -> tuple[float, float, float]:
    from vehsim.world.ground.touchdown import put_down

    return tuple(put_down(World("flat"), HELICOPTER, (0.0, 0.0, 3.0), (1.0, 0.0, 0.0, 0.0)).tolist())


def test_every_measure_has_a_case() -> None:
    assert set(CASES) == set(MEASURES)


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_motion_that_meets_an_ask_passes(name: str) -> None:
    case = CASES[name]
    (row,) = audit(track_of_clip(case.clip()), [case.ask], case.scene())
    assert row.met, row


@pytest.mark.parametrize("name", sorted(set(CASES) - {"off_frame"}))
def test_a_spoiled_motion_is_refused(name: str) -> None:
    case = CASES[name]
    rows = audit(track_of_clip(case.spoil(case.clip())), [case.ask], case.scene())
    assert missed(rows), rows[0]
    assert name in str(rows[0])


def test_a_mark_between_frames_is_refused() -> None:
    rows = audit(track_of_clip(flight()), [Ask("frame", "off_frame", 7.5, 7.5, upper=1e-3)])
    assert missed(rows)


def test_a_warning_does_not_fail_a_motion() -> None:
    spoiled = replace(CASES["speed"].ask, severity="warning", upper=1.0)
    (row,) = audit(track_of_clip(flight()), [spoiled])
    assert row.met is False and not missed([row])


def test_joints_that_a_stage_does_not_show_are_neither_met_nor_missed() -> None:
    clip = flight()
    track = track_of_poses(*on_eighths(clip))
    (row,) = audit(track, [CASES["joint"].ask])
    assert row.met is None and not missed([row])


def test_a_law_of_controls_is_not_shown_by_a_stage() -> None:
    (row,) = audit(track_of_poses(*on_eighths(flight())), [CASES["law"].ask])
    assert row.met is None


def on_eighths(clip: Clip) -> tuple[Any, Fraction, Any]:
    """The clip as a stage shows it: on whole frames, linear in between."""
    baked = clip.resample()
    frames = clip.start_frame + np.arange(8 * (clip.end_frame - clip.start_frame) + 1) / 8
    share = np.interp(frames, baked.frames, np.arange(len(baked)))
    k = np.minimum(share.astype(int), len(baked) - 2)
    s = (share - k)[:, None]
    T_wr = np.tile(np.eye(4), (len(frames), 1, 1))
    T_wr[:, :3, 3] = (1 - s) * baked.positions[k] + s * baked.positions[k + 1]
    q = (1 - s) * baked.orientations[k] + s * baked.orientations[k + 1]  # as good as slerp over so small a turn
    T_wr[:, :3, :3] = matrices(q / np.linalg.norm(q, axis=1, keepdims=True))
    return frames, clip.fps, T_wr


@pytest.mark.parametrize("name", ["position", "heading", "orientation", "velocity", "speed_error", "speed", "turn_rate",
                                  "acceleration", "g_load", "look", "outside", "bank", "ceiling", "climb"])  # fmt: skip
def test_a_stage_of_a_good_motion_passes_too(name: str) -> None:
    """The part of a motion that linear interpolation hides does not fail it."""
    (row,) = audit(track_of_poses(*on_eighths(flight())), [CASES[name].ask])
    assert row.met, row


@pytest.mark.parametrize("name", ["position", "heading", "orientation", "drift", "turned", "bank"])
def test_a_stage_of_a_spoiled_motion_is_refused(name: str) -> None:
    case = CASES[name]
    assert missed(audit(track_of_poses(*on_eighths(case.spoil(case.clip()))), [case.ask]))


def test_a_hold_that_falls_is_refused() -> None:
    """The motion that led to this module: 11 m below its mark, and reported as a success."""
    clip = standing()
    fall = moved(clip, np.column_stack([0 * clip.times, 0 * clip.times, -0.5 * 9.81 * clip.times**2]))
    asks = list(mark_asks("mark[1]", 1, hold=48, position=(0, 0, HEIGHT), velocity=(0, 0, 0)))
    assert not missed(audit(track_of_clip(clip), asks))
    keys = {row.key for row in missed(audit(track_of_clip(fall), asks))}
    assert {"mark[1].position", "mark[1].velocity", "mark[1].hold"} <= keys


def test_a_near_miss_between_frames_is_seen() -> None:
    """An obstacle touched between two frames, far from both."""
    from vehsim.world.obstacles.obstacles import box

    clip = flight(1.0)
    n = len(clip)
    straight = replace(
        clip,
        positions=np.column_stack([200.0 * clip.times, np.zeros(n), np.full(n, HEIGHT)]),
        orientations=np.tile([1.0, 0, 0, 0], (n, 1)),
        twists=np.tile([0, 0, 0, 200.0, 0, 0], (n, 1)),
    )
    beam = box("beam", (103.5 + 200 / 48, 0.0, HEIGHT + 3.6), (0.2, 0.2, 1.0))
    scene = WorldScene(World(obstacles=[beam]), HELICOPTER)
    wanted = {"clearance": 1.0, "obstacles_only": False, "slope": 0.35}
    (row,) = audit(track_of_clip(straight), [ask("clearance", 1, 25, wanted, lower=0.99)], scene)
    assert row.met is False and row.frame is not None


class Boom(Scene):
    """A boom of 5 m on a body that drives past posts; its swing is known or, if ``blind``, unknown."""

    reach = 0.0

    def __init__(self, seed: int, blind: bool) -> None:
        rng = np.random.default_rng(seed)
        self.posts = np.column_stack([rng.uniform(0, 60, 6), rng.uniform(-9, 9, 6)])
        self.rate, self.blind, self.measured = rng.uniform(0.5, 4.0), blind, 0
        self.fastest = float(rng.choice([0.0, 3.0]))

    def angles(self, track: Track) -> Any:
        return 1.5 * np.sin(self.rate * (track.seconds - 1 / 24))

    def away(self, track: Track, obstacles_only: bool) -> Any:
        self.measured += len(track.frames)
        angle = self.angles(track)
        tips = track.positions[:, :2] + 5 * np.column_stack([np.cos(angle), np.sin(angle)])
        shift = np.column_stack([0 * track.seconds, self.fastest * np.sin(track.seconds)])
        return np.linalg.norm(tips[:, None] - (self.posts + shift[:, None]), axis=2).min(axis=1)

    def swept(self, track: Track) -> Any:
        steps = 5 * np.abs(np.diff(self.angles(track)))
        return None if self.blind else np.concatenate([[0.0], np.cumsum(steps)])


@pytest.mark.parametrize("blind", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_the_least_clearance_is_found_without_measuring_every_frame(seed: int, blind: bool) -> None:
    clip = flight(12.5)
    n = len(clip)
    driving = replace(
        clip,
        positions=np.column_stack([5.0 * clip.times, np.zeros(n), np.zeros(n)]),
        orientations=np.tile([1.0, 0, 0, 0], (n, 1)),
        twists=np.tile([0, 0, 0, 5.0, 0, 0], (n, 1)),
    )
    scene, track = Boom(seed, blind), track_of_clip(driving)
    whole = np.abs(track.frames - np.round(track.frames)) < 1e-6
    truth = scene.away(track, False)
    for least in (0.1, 2.0):
        scene.measured = 0
        found = MEASURES["clearance"](track, {"clearance": least, "obstacles_only": False, "slope": 0.0}, scene)
        known = ~np.isnan(found)
        assert np.array_equal(found[known], truth[known])
        assert np.nanmin(found) <= truth[whole].min()
        if not blind and truth.min() < least:  # and wherever it is missed, between frames too
            assert np.nanmin(found) == truth.min()
        assert blind or least > 1 or scene.measured < whole.sum() / 2


def test_parts_sweep_at_least_as_far_as_they_come_nearer() -> None:
    """A truck's trailer turns while the truck stands beside a box."""
    from vehsim.world.obstacles.obstacles import box

    truck = vehsim.load_vehicle("truck")
    still = replace(standing((0.0, 0.0, 0.0)), vehicle=truck)
    hitch = 0.9 * np.sin(5 * still.times)
    zero = np.zeros((len(hitch), len(truck.joints)))
    clip = replace(still, joints=zero, joint_rates=zero, channels={"hitch_1": hitch})
    world = World(obstacles=[box("shed", (-8.0, 6.0, 1.5), (3.0, 1.0, 3.0))])
    scene, track = WorldScene(world, truck), track_of_clip(clip)
    away, swept = scene.away(track, True), scene.swept(track)
    assert np.ptp(away) > 0.5
    assert (np.abs(np.diff(away)) <= np.diff(swept) + 1e-9).all()


def nodding(yaw_rate: float = 0.0) -> Any:
    """The stage's poses of a car that stands on a slope, nods on its springs, and turns at ``yaw_rate`` rad/s."""
    frames = 1 + np.arange(385) / 8
    t = (frames - 1) / 24
    pitch, roll, yaw = 0.1 + 0.01 * np.sin(9 * t), np.full_like(t, 0.08), yaw_rate * t
    T = np.tile(np.eye(4), (len(t), 1, 1))
    zero = np.zeros_like(t)
    axes = [np.column_stack(columns) for columns in ((zero, zero, yaw), (zero, pitch, zero), (roll, zero, zero))]
    T[:, :3, :3] = matrices(product(product(from_vectors(axes[0]), from_vectors(axes[1])), from_vectors(axes[2])))
    T[:, 2, 3] = 0.02 * np.sin(9 * t)
    return track_of_poses(frames, Fraction(24), T)


@pytest.mark.parametrize(("yaw_rate", "wrong"), [(0.0, set()), (0.01, {"velocity (turning)", "hold (turning)"})])
def test_driving_vehicles_may_nod_on_their_springs_but_not_turn(yaw_rate: float, wrong: set[str]) -> None:
    asks = list(mark_asks("mark", 10, hold=20, position=(0, 0, 0), velocity=(0, 0, 0), planar=True))
    rows = audit(nodding(yaw_rate), [*asks, ask("speed", wanted={"planar": True}, upper=1e-6)])
    assert {row.key.removeprefix("mark.") for row in missed(rows)} == wrong


def test_flying_vehicles_may_not_nod() -> None:
    asks = mark_asks("mark", 10, hold=20, position=(0, 0, 0), velocity=(0, 0, 0))
    assert len(missed(audit(nodding(), asks))) == 5


def test_samples_after_a_range_of_frames_do_not_affect_it() -> None:
    """A motion that is cut off at the end of its limits: from there on it suddenly stands still."""
    clip = flight(8.0)
    still = [replace(clip.at(clip.times[-1:]), times=np.array([k / 24]), start_frame=0) for k in range(1, 25)]
    stopped = replace(
        clip,
        times=np.concatenate([clip.times, clip.times[-1] + np.concatenate([part.times for part in still])]),
        **{
            name: np.concatenate([getattr(clip, name), *(getattr(part, name) for part in still)])
            for name in ("positions", "orientations", "twists", "joints", "joint_rates", "controls")
        },
    )
    track = track_of_poses(*on_eighths(stopped))
    within, beyond = (replace(CASES["acceleration"].ask, first=1, last=last) for last in (193, 195))
    assert not missed(audit(track, [within]))
    assert missed(audit(track, [beyond]))
