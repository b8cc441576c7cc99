"""Drafts: motion while marks are dragged, compared with plans for the same marks."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.errors import InputError
from vehsim.lie.quaternions import matrices, yaw_of
from vehsim.planning.certificates import certify, certify_plane
from vehsim.planning.constraints.clearance import Clearance, Dragged
from vehsim.planning.drafts import UNKNOWNS, draft
from vehsim.planning.problem.solver import Patience
from vehsim.planning.problem.solver_cache import common
from vehsim.world.obstacles.obstacles import box

CAR = vehsim.load_vehicle("car")
HELICOPTER = vehsim.load_vehicle("helicopter")


def marks(y, heading=0.0, frame=1085):
    return [
        Mark(frame=1001, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        Mark(frame=frame, position=(15, y, 0), heading=heading, velocity=(0, 0, 0)),
    ]


@pytest.fixture(scope="module")
def first():
    clip = vehsim.plan(CAR, None, marks(3.0), fps=24, segments=32, character="stunt").clip
    return draft(CAR, None, marks(3.0), clip, fps=24, segments=32, character="stunt")


def test_a_draft_begins_as_the_plan(first):
    plan = vehsim.plan(CAR, None, marks(3.0), fps=24, segments=32, character="stunt")
    assert first.success and not first.reason
    clip = first.clip()
    assert np.array_equal(clip.frames, np.arange(1001, 1086))
    assert np.abs(clip.positions - plan.clip.resample().positions).max() < 0.02


def test_a_draft_in_a_character_begins_as_the_plan():
    gentle = marks(3.0, frame=1145)
    plan = vehsim.plan(CAR, None, gentle, segments=48)
    drawn = draft(CAR, None, gentle, plan.clip, fps=24, segments=48)
    assert plan.success and drawn.success and "driven as" not in plan.message
    assert np.abs(drawn.clip().positions - plan.clip.resample().positions).max() < 0.02


def test_a_dragged_draft_follows_its_marks(first):
    now = first
    for y, heading in ((3.1, 0.0), (3.6, 5.0), (4.2, 10.0)):
        now = now.moved(marks(y, heading))
    assert now.success
    clip = now.clip()
    assert clip.positions[-1] == pytest.approx([15.0, 4.2, 0.0], abs=1e-6)
    yaw = 2 * np.arctan2(clip.orientations[-1, 3], clip.orientations[-1, 0])
    assert yaw == pytest.approx(np.radians(10.0), abs=1e-6)
    plan = vehsim.plan(CAR, None, marks(4.2, 10.0), fps=24, segments=32, character="stunt")
    assert np.abs(clip.positions - plan.clip.resample().positions).max() < 0.05


def test_a_draft_whose_patience_ends_goes_on_later(first):
    """Its end is that of a solve without a pause."""
    hurried = first.moved(marks(5.0, 20.0), patience=Patience(1, unfinished=np.inf))
    assert hurried.success and hurried.unfinished
    strict = first.moved(marks(5.0, 20.0), patience=Patience(1, unfinished=1e-4))
    assert strict.success and strict._iterate.solution.iterations > 1
    later, whole = hurried.moved(marks(5.0, 20.0)), first.moved(marks(5.0, 20.0))
    assert later.success and not later.unfinished and not whole.unfinished
    assert np.abs(later.clip().positions - whole.clip().positions).max() < 0.01
    assert np.abs(hurried.clip().positions - whole.clip().positions).max() > 0.01


def test_a_failed_draft_says_why_and_the_last_good_one_goes_on(first):
    beyond = first.moved(marks(3000.0))
    assert not beyond.success and "off by" in beyond.reason
    assert first.moved(marks(3.2)).success


def test_other_quantities_need_a_new_draft(first):
    free = [marks(3.0)[0], Mark(frame=1073, position=(15, 3, 0))]
    with pytest.raises(ValueError, match="make a new draft"):
        first.moved(free)


def test_wheels_stand_on_the_ground_and_segments_are_few():
    world = vehsim.World(terrain="hills")
    clip = vehsim.plan(CAR, world, marks(3.0), fps=24, segments=8, refine=False).clip
    made = draft(CAR, world, marks(3.0), clip, fps=24, segments=400).clip()
    assert len(made) == 85 and UNKNOWNS == 2 * 96
    assert made.positions[:, 2] == pytest.approx(world.height(made.positions[:, :2]), abs=0.3)
    assert np.ptp(made.positions[:, 2]) > 0.05 and "heave" in made.channels


def test_a_draft_beyond_the_grip_of_tyres_warns_of_nothing(first, monkeypatch):
    """Each event of a drag would print it; the solve on release warns."""
    from vehsim.planning import drafts

    drawn = drafts.drawn

    def slipping(*args):
        warnings.warn("more than the grip of tyres", stacklevel=2)
        return drawn(*args)

    monkeypatch.setattr(drafts, "drawn", slipping)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        first.clip()


@pytest.mark.parametrize(("name", "height", "top"), [("car", 0.0, 4.0), ("helicopter", 15.0, 60.0)])
def test_a_draft_follows_an_obstacle_that_moves(name, height, top):
    """A box is dragged across the path in steps: each draft keeps clear of where it is, and costs as a new draft does.

    One that stands elsewhere and is added changes what the problem consists of.
    """
    vehicle = vehsim.load_vehicle(name)
    ends = [
        Mark(1001, position=(0, 0, height), heading=0, velocity=(0, 0, 0)),
        Mark(1241, position=(60, 0, height), heading=0, velocity=(0, 0, 0)),
    ]

    def world(y, *more):
        return vehsim.World(obstacles=[box("tower", (30, y, 0), (8, 8, top)), *more])

    options = {"fps": 24, "segments": 32, "clearance": 1.0}
    plan = vehsim.plan(vehicle, world(8.0), ends, **options, refine=False)
    now = draft(vehicle, world(8.0), ends, plan.clip, **options)
    for y in (6.5, 5.0, 4.0):
        now = now.moved(ends, world(y))
        assert now.success, now.reason
    clip = now.clip()
    assert certify(clip, world(4.0)) > 0.8 if height else certify_plane(clip, parts(world(4.0)))[0] > 0.8
    fresh = draft(vehicle, world(4.0), ends, clip, **options)
    assert fresh.success and np.abs(fresh.clip().positions - clip.positions).max() < 0.05
    again = now.moved(ends, world(4.0, box("far", (30, 60, 0), (4, 4, top))))
    assert again.success and np.abs(again.clip().positions - clip.positions).max() < 0.05
    alone = again.moved(ends, vehsim.World(obstacles=[box("far", (30, 60, 0), (4, 4, top))]))
    assert alone.success and np.abs(alone.clip().positions[:, 1]).max() < 0.5  # the tower has gone
    with pytest.raises(InputError, match="tower"):
        now.moved(ends, vehsim.World(obstacles=[box("tower", (60, 0, 0), (8, 8, top))]))


@pytest.mark.parametrize(("name", "height", "top"), [("car", 0.0, 4.0), ("helicopter", 15.0, 60.0)])
def test_a_dragged_obstacle_changes_only_parameters(name, height, top):
    """The first move builds the problem; then the box is turned and moved, near what is active already."""
    vehicle = vehsim.load_vehicle(name)
    ends = [
        Mark(1001, position=(0, 0, height), heading=0, velocity=(0, 0, 0)),
        Mark(1241, position=(60, 0, height), heading=0, velocity=(0, 0, 0)),
    ]
    other = box("other", (10, 12, 0), (4, 4, top))

    def world(y, heading=0.0):
        return vehsim.World(obstacles=[box("tower", (30, y, 0), (8, 8, top), heading), other])

    options = {"fps": 24, "segments": 32, "clearance": 1.0}
    plan = vehsim.plan(vehicle, world(8.0), ends, **options, refine=False)
    now = draft(vehicle, world(8.0), ends, plan.clip, **options).moved(ends, world(5.0, 45.0))
    built = dict(now._run.solvers._solvers or common()._solvers)
    for y, heading in ((4.9, 40.0), (5.0, 30.0), (5.1, 20.0)):
        now = now.moved(ends, world(y, heading))
        assert now.success, now.reason
    assert dict(now._run.solvers._solvers or common()._solvers) == built
    clip, there = now.clip(), world(5.1, 20.0)
    assert certify(clip, there) > 0.8 if height else certify_plane(clip, parts(there))[0] > 0.8
    fresh = draft(vehicle, there, ends, clip, **options)
    assert fresh.success and np.abs(fresh.clip().positions - clip.positions).max() < 0.05


def test_only_what_is_near_has_rows_while_an_obstacle_is_dragged():
    """Where a motion has come nearer than expected, rows are added."""
    ends = [
        Mark(1001, position=(0, 0, 15), heading=0, velocity=(0, 0, 0)),
        Mark(1241, position=(60, 0, 15), heading=0, velocity=(0, 0, 0)),
    ]

    def world(y):
        return vehsim.World(obstacles=[box("tower", (30, y, 0), (6, 6, 60)), box("far", (0, 90, 0), (4, 4, 60))])

    options = {"fps": 24, "segments": 32, "clearance": 1.0}
    plan = vehsim.plan(HELICOPTER, world(40.0), ends, **options, refine=False)
    now = draft(HELICOPTER, world(40.0), ends, plan.clip, **options).moved(ends, world(39.0))
    assert not now._iterate.block(Clearance).near.any()
    for y in (12.0, 8.0, 5.0):
        now = now.moved(ends, world(y))
        near = now._iterate.block(Clearance).near
        assert now.success and 0.1 < near[1].mean() < 0.9 and not near[0].any(), now.reason
    assert certify(now.clip(), world(5.0)) > 0.8


def test_what_something_lands_on_may_be_dragged():
    """A landing on a roof, which is dragged below it: near the roof no clearance is asked for."""
    ends = [
        Mark(1001, position=(0, 0, 12), heading=0, velocity=(0, 0, 0)),
        Mark(1241, position=(40, 0, 6), heading=0, on_ground=True),
    ]

    def world(x):
        return vehsim.World(obstacles=[box("roof", (x, 0, 0), (14, 14, 6)), box("other", (20, 20, 0), (4, 4, 20))])

    options = {"fps": 24, "segments": 24, "clearance": 1.0}
    plan = vehsim.plan(HELICOPTER, world(40.0), ends, **options, refine=False)
    now = draft(HELICOPTER, world(40.0), ends, plan.clip, **options)
    for x in (40.5, 41.0):
        now = now.moved(ends, world(x))
        assert now.success, now.reason
    assert now.clip().positions[-1] == pytest.approx([40, 0, 6], abs=0.01)


def test_a_moved_and_turned_obstacle_is_recognised():
    one = Dragged(box("tower", (30, 5, 2), (8, 4, 9)))
    moved = one.to(box("tower", (33, 7, 1), (8, 4, 9), 30.0))
    corners = np.vstack(one.obstacle.hulls) @ matrices(moved.orientation[None])[0].T + moved.position
    assert corners == pytest.approx(np.vstack(box("tower", (33, 7, 1), (8, 4, 9), 30.0).hulls), abs=1e-9)
    assert one.to(box("tower", (30, 5, 2), (8, 4, 9.01))) is None


def test_a_draft_faces_as_its_clip_where_a_plan_chose_the_heading():
    """At rest without a heading: the plan turns along its path; the draft keeps that, also when the mark moves."""
    heli = vehsim.load_vehicle("helicopter")
    ends = [
        Mark(1001, position=(0, 0, 20), heading=0, velocity=(0, 0, 0)),
        Mark(1241, position=(40, 40, 20), velocity=(0, 0, 0)),
    ]
    plan = vehsim.plan(heli, None, ends, segments=32)
    drawn = draft(heli, None, ends, plan.clip, fps=24, segments=32)
    moved = drawn.moved([ends[0], replace(ends[1], position=(41, 40, 20))])
    yaw = [np.degrees(yaw_of(one.orientations[-1:]))[0] for one in (plan.clip, drawn.clip(), moved.clip())]
    assert 30 < yaw[0] < 60 and yaw == pytest.approx([yaw[0]] * 3, abs=0.1)


def parts(world):
    return [(obstacle, 0) for obstacle in world.obstacles]


def flight(place, frame):
    return [
        Mark(frame=1001, position=(0, 0, 30), heading=0, velocity=(0, 0, 0)),
        Mark(frame=frame, position=place, heading=0, velocity=(0, 0, 0)),
    ]


def test_a_flight_that_few_segments_cannot_make_is_planned_and_drafted_on_more():
    """At 16 segments, the first possible frame is 1121; controls that may change more often make it by 1120."""
    helicopter = vehsim.load_vehicle("helicopter_lie")  # without actuators
    hurried = flight((60, 10, 30), 1120)
    with pytest.warns(UserWarning, match="with 64 segments, because 16 are too few"):
        plan = vehsim.plan(helicopter, None, hurried, segments=16, character="stunt")
    assert plan.success and plan.clip.frames[-1] == 1120
    first = draft(helicopter, None, hurried, plan.clip, fps=24, segments=16, character="stunt")
    assert first.success and first._iterate.layout.segments == 32
    moved = first.moved(flight((59, 9, 30), 1120))
    assert moved.success and moved.clip().positions[-1] == pytest.approx([59, 9, 30], abs=1e-6)


@pytest.mark.parametrize("price", [1e-3, 1.0, 1e4])
def test_dragging_is_as_exact_whatever_the_magnitude_of_the_cost(price):
    """The barrier of a draft is relative to its cost: the same motion must come of costs in other units."""
    drags = [flight((60 + step, 10 - 2 * step, 30), 1193) for step in range(4)]
    asked = {"fps": 24, "segments": 16, "cost": {"effort": price}, "character": "stunt"}
    now = draft(HELICOPTER, None, drags[0], vehsim.plan(HELICOPTER, None, drags[0], **asked).clip, **asked)
    for to in drags[1:]:
        now = now.moved(to)
        assert now.success, now.reason
    exact = vehsim.plan(HELICOPTER, None, drags[-1], refine=False, guess=now.clip(), **asked).clip
    away = np.linalg.norm(now.clip().positions - exact.resample().positions, axis=1).max()
    assert away < 0.05, away


def test_a_vehicle_without_controls_is_drafted() -> None:
    marks = [Mark(1, position=(0, 0, 0)), Mark(25, position=(1, 0, 0))]
    thrown = draft(vehsim.load_vehicle("tumbler"), None, marks, None, fps=24, segments=32)
    assert thrown.success and np.allclose(thrown.clip().positions[-1], (1, 0, 0), atol=1e-6)
