"""Retouch: a solved motion drawn to curves that an animator edited."""

from pathlib import Path

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.lie.quaternions import matrices, tilt_of
from vehsim.planning import retouch as retouching
from vehsim.planning.retouch import KEPT, _clear, retouch
from vehsim.world.ground.placing import place_on_terrain
from vehsim.world.obstacles.obstacles import box

CAR, HELI = vehsim.load_vehicle("car"), vehsim.load_vehicle("helicopter")


@pytest.fixture(scope="module")
def drive():
    """A car that drives a gentle bend for five seconds."""
    start = vehsim.State(position=(0, 0, 0), twist=(0.0, 8.0, 0.0))
    return vehsim.simulate(CAR, None, lambda t, state: (100.0, 0.05 * np.sin(2 * t)), start, 5.0, step=1 / 96)


@pytest.fixture(scope="module")
def flight():
    """A helicopter that flies 30 m in four seconds."""
    marks = [
        Mark(frame=1001, position=(0, 0, 30), heading=0, velocity=(0, 0, 0)),
        Mark(frame=1097, position=(30, 5, 32), velocity=(0, 0, 0)),
    ]
    return vehsim.plan(HELI, None, marks, fps=24, segments=32, character="stunt").clip


@pytest.fixture(scope="module")
def voyage():
    """A boat that speeds up, turns and stops."""
    marks = [
        Mark(frame=1001, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        Mark(frame=1241, position=(40, 3, 0)),
        Mark(frame=1481, position=(70, 40, 0), velocity=(0, 0, 0)),
    ]
    return vehsim.plan(vehsim.load_vehicle("boat"), vehsim.World(water=0.0), marks).clip


def bumped(clip, first, last, by):
    """The clip's frames and poses, moved by up to ``by`` (3,) m halfway between two frames, with smooth ends."""
    whole = clip.resample()
    share = np.clip((whole.frames - first) / (last - first), 0.0, 1.0)
    bump = (16 * share**2 * (1 - share) ** 2) ** 1.5
    return whole.frames, whole.positions + bump[:, None] * np.array(by), matrices(whole.orientations)


def executed(clip):
    """Where the controls of a clip lead from its first state: a simulation that knows nothing of plans."""
    fine = vehsim.simulate(
        clip.vehicle,
        None,
        lambda t, state: clip.at(min(t, clip.times[-1])).controls[0],
        clip.state(0),
        clip.duration,
        fps=clip.fps,
        actuators=False,
    )
    return fine.positions[-1]


def test_shorter_segments_are_tried_where_untouched_frames_would_move(drive, monkeypatch):
    """Segments of a second can show neither the driver's steering nor the edit."""
    frames, positions, rotations = bumped(drive, 1045, 1075, (0.0, 0.4, 0.0))
    monkeypatch.setattr("vehsim.planning.retouch.TRIES", ((1.0, 1.0),))
    coarse = retouch(drive, None, frames, positions, rotations)
    monkeypatch.setattr("vehsim.planning.retouch.TRIES", ((1.0, 1.0), (1.0, 1 / 12)))
    fine = retouch(drive, None, frames, positions, rotations)
    assert coarse.kept > KEPT >= fine.kept


@pytest.mark.parametrize(("surface", "room"), [("asphalt", 24), ("gravel", 33)])
def test_sliding_cars_have_short_segments_and_more_time_on_loose_ground(surface, room, monkeypatch):
    """Gravel has 0.54 of asphalt's friction, so that a correction takes 1 / sqrt(0.54) = 1.36 times as long."""
    car = vehsim.load_vehicle("drift_car", {"surface": surface})
    start = vehsim.State(position=(0, 0, 0), twist=(0.0, 8.0, 0.0), joint_rates=(8.0 / 0.31, 0.0, 8.0 / 0.31))
    clip = vehsim.simulate(car, None, lambda t, state: (100.0, 0.0, 0.0, 0.05 * np.sin(2 * t)), start, 4.5)
    tried = []
    attempt = retouching._attempt
    monkeypatch.setattr(retouching, "_attempt", lambda *given: tried.append(given[3:5]) or attempt(*given))
    made = retouch(clip, None, *bumped(clip, 1045, 1065, (0.0, 0.05, 0.0)))
    ((window, count),) = tried
    ((first, last),) = made.touched
    assert made.kept < KEPT and window == (first - room, last + room)
    assert count == window[1] - window[0]  # of a frame each


def test_a_car_follows_an_edit_that_it_can_drive(drive):
    frames, positions, rotations = bumped(drive, 1030, 1090, (0.0, 0.4, 0.0))
    made = retouch(drive, None, frames, positions, rotations)
    ((first, last),) = made.touched
    assert 1030 <= first < last <= 1090
    assert made.metres.max() < 0.03 and not made.misses(0.03)
    assert made.kept < KEPT
    (window,) = made.windows
    assert np.linalg.norm(executed(made.clip) - made.clip.positions[-1]) < 0.02  # it is a motion of this car
    far = frames[(frames < window[0]) | (frames > window[1])]
    before, after = (clip.at((far - 1001) / 24).positions for clip in (drive, made.clip))
    assert after == pytest.approx(before, abs=1e-6)


def test_wheels_roll_as_far_as_the_car_drives(drive):
    made = retouch(drive, None, *bumped(drive, 1030, 1090, (0.0, 0.4, 0.0)))
    for clip in (drive, made.clip):
        whole = clip.at(np.linspace(0, clip.duration, 2000))
        path = np.linalg.norm(np.diff(whole.positions, axis=0), axis=1).sum()
        mean = np.mean([whole.channels[name][-1] - whole.channels[name][0] for name in ("roll_rl", "roll_rr")])
        assert 0.32 * mean == pytest.approx(path, rel=2e-3)
        assert np.abs(np.diff(whole.channels["roll_rl"])).max() < 0.2  # no jump where the motions meet


def test_a_helicopter_stays_within_a_centimetre_where_nothing_was_touched(flight):
    frames, positions, rotations = bumped(flight, 1035, 1075, (0.0, 0.6, 0.3))
    made = retouch(flight, None, frames, positions, rotations, stops=(1001, 1097))
    untouched = np.linalg.norm(positions - flight.resample().positions, axis=1) < 1e-3
    moved = np.linalg.norm(made.clip.resample().positions - flight.resample().positions, axis=1)
    assert moved[untouched].max() < KEPT
    assert made.metres.max() < 0.35  # it leans into the bump, as fast as its actuators tilt the disc
    assert np.linalg.norm(executed(made.clip) - made.clip.positions[-1]) < 0.1


@pytest.mark.parametrize(("name", "span", "by", "most"), [
    ("flight", (1035, 1062), (0.0, 0.6, 0.3), 8.0),
    ("voyage", (1200, 1280), (0.0, 0.4, 0.0), 0.6),
])  # fmt: skip
def test_motion_enters_and_leaves_a_window_without_a_jolt(name, span, by, most, request):
    """The jerk, m/s^3, that a retouch adds within three frames of the ends: it was 16 and 1.1."""
    clip = request.getfixturevalue(name)
    world = vehsim.World(water=0.0) if name == "voyage" else None
    made = retouch(clip, world, *bumped(clip, *span, by))
    frames = np.arange(1001, clip.end_frame + 1)
    before, after = (each.at((frames - 1001) / 24).positions for each in (clip, made.clip))
    added = np.linalg.norm(np.diff(after - before, 3, axis=0), axis=1) * 24**3
    ((first, last),) = made.windows
    middles = frames[:-3] + 1.5
    ends = (np.abs(middles - first) < 3) | (np.abs(middles - last) < 3)
    assert added[ends].max() < most < added.max() / 3
    assert made.kept < KEPT


def test_a_disc_tilts_after_an_edit_as_before(flight):
    made = retouch(flight, None, *bumped(flight, 1035, 1062, (0.0, 0.0, 0.3)))
    (window,) = made.windows
    later = np.arange(window[1] + 5, 1098)  # a curve through samples differs beside the first of them
    assert len(later) > 5
    for name in ("disc_pitch", "disc_roll"):
        before, after = (clip.at((later - 1001) / 24).channels[name] for clip in (flight, made.clip))
        assert after == pytest.approx(before, abs=1e-9), name


def test_what_cannot_be_met_is_named_with_its_frame_and_amount(flight):
    frames, positions, rotations = bumped(flight, 1035, 1075, (0.0, 0.0, 0.0))
    positions[frames == 1055] += (0.0, 3.0, 0.0)  # there and back in two frames
    made = retouch(flight, None, frames, positions, rotations)
    worst = max(made.misses(), key=lambda miss: miss["metres"])
    assert worst["frame"] == 1055 and 2.0 < worst["metres"] < 3.1
    assert made.kept < KEPT


def test_an_edit_that_changes_nothing_changes_nothing(drive):
    made = retouch(drive, None, *bumped(drive, 1030, 1090, (0.0, 0.0, 0.0)))
    assert made.clip is drive and not made.touched and not made.misses()


def test_the_first_frame_can_be_edited(flight):
    frames, positions, rotations = bumped(flight, 1035, 1075, (0.0, 0.0, 0.0))
    share = np.clip((frames - 1001) / 40, 0.0, 1.0)
    positions[:, 1] += 0.5 * (1 - share) ** 3 * (1 + 3 * share + 6 * share**2)
    made = retouch(flight, None, frames, positions, rotations)
    assert made.clip.positions[0] == pytest.approx([0.0, 0.5, 30.0], abs=0.05)
    assert np.abs(made.clip.twists[0]).max() < 1e-6  # it rests there, as before


def test_marks_that_were_not_touched_are_kept_exactly(flight):
    edit = bumped(flight, 1035, 1075, (0.0, 0.6, 0.3))
    made = retouch(flight, None, *edit, stops=(1030,))
    at = (1030 - 1001) / 24
    assert made.clip.at(at).positions[0] == pytest.approx(flight.at(at).positions[0], abs=1e-6)
    assert made.windows[0][0] == 1030


@pytest.mark.parametrize("name, drifts", [("hopper", True), ("tumbler", True), ("snakeboard", False), ("car", False)])
def test_a_vehicle_that_nothing_pushes_is_refused(name, drifts):
    """In free fall, no motion but one leads from a state; a snakeboard is pushed by its wheels."""
    from vehsim.errors import InputError
    from vehsim.planning.retouch import check_pushed

    if drifts:
        with pytest.raises(InputError, match="no control pushes it"):
            check_pushed(vehsim.load_vehicle(name))
    else:
        check_pushed(vehsim.load_vehicle(name))


def test_an_edited_height_of_a_car_is_named(drive):
    frames, positions, rotations = bumped(drive, 1030, 1090, (0.0, 0.0, 0.3))
    made = retouch(drive, None, frames, positions, rotations)
    ((first, last),) = made.lifted
    assert 1030 <= first < last <= 1090 and not made.touched and made.clip is drive


def test_an_edit_on_the_ground_is_refused(flight):
    """The flight, 30 m lower: it starts on the ground."""
    from dataclasses import replace

    from vehsim.errors import SolveError

    low = replace(flight, positions=flight.positions - (0, 0, 30))
    world = vehsim.World(terrain="flat")
    standing = world.clearance(HELI, low.positions[:1], low.orientations[:1])[0]
    assert abs(standing) < 0.05
    with pytest.raises(SolveError, match="stands on the ground"):
        retouch(low, world, *bumped(low, 991, 1041, (0.0, 0.5, 0.0)))


@pytest.mark.parametrize(("aside", "least", "most"), [(3.0, 0.5, 0.5), (1.4, 0.15, 0.45), (0.5, 0.0, 0.0)])
def test_an_edit_on_the_ground_keeps_clear_of_obstacles(drive, aside, least, most):
    """The ground below its wheels is none: the clearance was 0 on every terrain."""
    world = vehsim.World("flat", obstacles=[box("post", (0, aside, 0), (0.2, 0.2, 2))])
    assert least <= _clear(drive, world, drive, 0, 0.5) <= most


@pytest.fixture(scope="module")
def slide():
    """A car that slides with its handbrake into a bay, at the limit of its grip."""
    marks = [
        Mark(frame=1001, position=(-2, 24, 0), heading=-90, velocity=(0, 0, 0), joints={"sigma": 0}),
        Mark(frame=1097, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
    ]
    car = vehsim.load_vehicle("drift_car")
    return vehsim.plan(car, None, marks, fps=24, segments=124, character="stunt").clip


def test_an_edit_near_the_end_of_a_slide_is_followed(slide):
    """On the knots of the slide, which are not on whole frames, its controls can be repeated where it is not edited."""
    frames, positions, rotations = bumped(slide, 1056, 1094, (0.0, 0.15, 0.0))
    made = retouch(slide, None, frames, positions, rotations)
    assert made.kept <= KEPT and made.metres.max() < 0.04


def test_knots_are_those_between_which_controls_are_linear(slide, drive):
    knots = retouching._knots(slide)
    assert knots == pytest.approx(np.linspace(1001, 1097, 125), abs=1e-6)
    assert retouching._knots(drive) is None  # every sample of a simulated motion is one


def test_bodies_and_trailers_stay_on_their_springs_around_an_edit():
    """Springs remember for a second: a lorry leans on after the edit, and its trailer too, without a jump."""
    lorry, world = vehsim.load_vehicle("truck"), vehsim.World(terrain="flat")
    start = vehsim.State(position=(0, 0, 0), twist=(0.0, 6.0, 0.0))
    clip = vehsim.simulate(lorry, world, lambda t, state: (300.0, 0.02 * np.sin(2 * t)), start, 12.0, step=1 / 96)
    clip = place_on_terrain(clip, world)
    made = retouch(clip, world, *bumped(clip, 1045, 1085, (0.0, 0.2, 0.0))).clip
    far = made.times < 1.0 / 24
    for name in ("roll", "pitch", "heave", "hitch_roll_1", "travel_t1_l", "travel_fl"):
        bends = np.abs(np.diff(made.channels[name], 2))
        assert bends.max() < 5e-4, name
        assert made.channels[name][far] == pytest.approx(clip.channels[name][far], abs=1e-9)
        assert made.channels[name][-1] == pytest.approx(clip.channels[name][-1], abs=1e-4)


def test_an_edit_near_obstacles_is_solved_where_the_solved_motion_is_as_near():
    """Between parked cars: the simplified outline of the car is nearer to them than the car, also at the fixed ends."""
    take = vehsim.Shot.load(Path(__file__).parents[2] / "examples" / "parallel_park.toml").solve()
    clip = take.clips["car"]
    made = retouch(clip, take.world, *bumped(clip, 1363, 1403, (0.0, 0.15, 0.0)))
    assert made.kept < KEPT and made.misses(), "so slow a car cannot move sideways: named"
    before, after = (
        take.world.clearance(each.vehicle, each.positions, each.orientations) for each in (clip, made.clip)
    )
    assert after.min() > before.min() - 0.03


@pytest.mark.parametrize(("first", "last", "aside"), [(1050, 1150, 0.4), (1080, 1130, 0.2)])
def test_a_boat_that_runs_with_its_bow_up_is_drawn_to_an_edit(voyage, first, last, aside):
    """Its height changes with its speed, and the ends of the window were refused as marks of two heights."""
    clip, world = voyage, vehsim.World(water=0.0)
    frames, positions, rotations = bumped(clip, first, last, (0.0, aside, 0.0))
    made = retouch(clip, world, frames, positions, rotations).clip.resample()
    pitch, before = (tilt_of(each.orientations)[1] for each in (made, clip.resample()))
    assert np.abs(made.positions[:, :2] - positions[:, :2]).max() < 0.2
    assert np.degrees(pitch.min()) < -5 and np.degrees(np.abs(pitch - before).max()) < 2
    assert np.abs(np.diff(made.positions[:, 2])).max() < 0.02
    assert np.degrees(np.abs(np.diff(pitch, 2)).max()) < 1.5 * np.degrees(np.abs(np.diff(before, 2)).max())


def test_a_far_edit_is_followed_as_far_as_the_iterations_reach():
    """A boat at rest, moved aside, must come from farther behind: the motion nearest to that is found slowly."""
    marks = [
        Mark(frame=1, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        Mark(frame=569, position=(26.3, -5.2, 0), velocity=(0, 0, 0), hold=48),
        Mark(frame=1087, position=(52, -12.8, 0), heading=11, velocity=(0, 0, 0)),
    ]
    boat = vehsim.load_vehicle("boat")
    clip = vehsim.plan(boat, None, marks, fps=24).clip
    frames, positions, rotations = bumped(clip, 290, 580, (0.3, 0.75, 0.0))
    made = retouch(clip, None, frames, positions, rotations, stops=[1, 569, 1087])
    asked = np.linalg.norm(positions - clip.resample().positions, axis=1).max()
    assert made.metres.max() < 0.6 * asked and made.kept < KEPT
    assert np.linalg.norm(executed(made.clip) - clip.positions[-1]) < 0.03


def test_an_edit_of_a_truck_leaves_room_for_its_trailer():
    """Its trailer must follow the solved motion again: in a second, only with a swerve that missed most of the edit."""
    ends = [(1001, (0, 0, 0)), (1501, (50, 10, 0))]
    marks = [Mark(frame, position=place, heading=0, velocity=(0, 0, 0)) for frame, place in ends]
    clip = vehsim.plan(vehsim.load_vehicle("truck"), None, marks, fps=24).clip
    frames, positions, rotations = bumped(clip, 1090, 1210, (0.0, 0.5, 0.0))
    made = retouch(clip, None, frames, positions, rotations, stops=[1001, 1501])
    assert made.metres.max() < 0.03 and made.kept < KEPT


def test_a_robot_at_its_speed_limit_is_drawn_to_an_edit():
    """Between its knots, where windows begin and end, the solved motion is faster than its limit by 0.05 mm/s."""
    ends = [(1001, (-6, 0, 0)), (1241, (6, 0, 0))]
    marks = [Mark(frame, position=place, heading=0, velocity=(0, 0, 0)) for frame, place in ends]
    plan = vehsim.plan(vehsim.load_vehicle("two_wheeled"), None, marks, fps=25, limits={"speed": 1.5})
    frames, positions, rotations = bumped(plan.clip, 1080, 1150, (0.0, 0.5, 0.0))
    made = retouch(plan.clip, None, frames, positions, rotations, limits={"speed": 1.5})
    assert made.touched and made.kept < KEPT
    assert np.abs(made.clip.twists[:, 1]).max() < 1.5 * 1.001


def test_what_exceeds_the_character_is_named():
    """A calm car that is moved aside in two seconds accelerates harder than its driver would."""
    marks = [
        Mark(1001, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        Mark(1301, position=(40, 0, 0), heading=0, velocity=(0, 0, 0)),
    ]
    plan = vehsim.plan(CAR, None, marks, fps=24, character="calm")
    assert "beyond" not in plan.message
    little, much = (
        retouch(plan.clip, None, *bumped(plan.clip, 1100, 1150, (0.0, by, 0.0)), asks=plan.asks) for by in (0.003, 1.5)
    )
    assert not little.beyond
    assert any(row.startswith("character.acceleration: ") for row in much.beyond)


@pytest.fixture(scope="module")
def lap():
    """The lap of a car that does not stop."""
    marks = [
        Mark(1001, position=(0, 0, 0), heading=0),
        Mark(1151, position=(25, 15, 0)),
        Mark(1301),
    ]
    return vehsim.plan(CAR, None, marks, loop=True, character="brisk")


@pytest.mark.parametrize(
    ("edited", "moves"),
    [((1001, 1301), 0.5), ((1001,), 0.0), ((1301,), 0.0), (None, 0.5)],
    ids=["both ends", "the first", "the last", "all frames"],
)
def test_an_edited_loop_stays_closed(lap, edited, moves):
    """Its ends were drawn to the edit one by one, and missed each other by 2 mm and 0.2 degrees."""
    whole = lap.clip.resample()
    near = (
        1.0
        if edited is None
        else sum(np.cos(np.clip((whole.frames - end) / 40, -1, 1) * np.pi / 2) ** 2 for end in edited)
    )
    aside = 0.5 * np.broadcast_to(near, len(whole.frames))[:, None] * [0.0, 1.0, 0.0]
    made = retouch(lap.clip, None, whole.frames, whole.positions + aside, matrices(whole.orientations), asks=lap.asks)
    assert made.kept <= KEPT
    ends = made.clip.at(made.clip.times[[0, -1]])
    turns = matrices(ends.orientations)
    assert np.ptp(ends.positions, axis=0).max() < 1e-4 and np.abs(turns[1] - turns[0]).max() < 1e-4
    assert np.ptp(ends.twists, axis=0).max() < 1e-4 and np.ptp(ends.controls, axis=0).max() < 1e-2
    assert ends.positions[0, 1] == pytest.approx(moves, abs=0.02)
