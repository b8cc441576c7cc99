"""Planned boats pitch and heave as their hull can: after the trim of their speed, as a damped oscillator."""

from dataclasses import replace

import numpy as np
import pytest
from hulls import box, floating

import vehsim
from vehsim import Mark
from vehsim.clip.interpolant import monotone
from vehsim.constants import GRAVITY, SEA_WATER
from vehsim.lie.quaternions import from_yaw, tilt_of, yaw_of
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.gliding import HEAVE_DAMPING, PITCH_DAMPING, place_on_water
from vehsim.world.world import World

BOAT, WATER = vehsim.load_vehicle("boat"), World(water=0.0)
HEAVE, ROLL, PITCH = 2 * np.pi * Afloat(BOAT, WATER).natural_frequencies


@pytest.fixture(scope="module")
def straight():
    marks = [Mark(96 * k, position=(8.0 * k, 0, 0), heading=0, velocity=(2, 0, 0)) for k in range(4)]
    return vehsim.plan(BOAT, World(), marks=marks, fps=24, character="stunt", segments=12).clip


def moving(clip, speed, step=1 / 192):
    """A clip in the plane with ``speed(t)`` m/s ahead."""
    clip = clip.at(np.arange(int(clip.times[-1] / step) + 1) * step)
    return replace(clip, twists=np.column_stack([0 * clip.times, speed(clip.times), 0 * clip.times]))


def table(speed):
    """The bow's angle upwards at steady speeds, rad."""
    running = BOAT.hull.running
    return monotone(running.speeds, running.trim[:, None], np.atleast_1d(speed))[:, 0]


def bow(clip):
    return -tilt_of(clip.orientations)[1]


def swing(t, omega, zeta):
    """The answer of an oscillator at rest to a unit step."""
    own = omega * np.sqrt(1 - zeta**2)
    decay = np.exp(-zeta * omega * t) * (np.cos(own * t) + zeta * omega / own * np.sin(own * t))
    return np.where(t < 0, 0.0, 1 - decay)


def test_natural_frequencies_of_a_box():
    """Heave by its waterplane; roll and pitch by its metacentric heights, with the centre of mass at the waterline."""
    length, beam, draft = 6.0, 2.0, 0.5
    volume = length * beam * draft
    boat = floating(box(length, beam, 2 * draft), mass=SEA_WATER * volume)
    afloat = Afloat(boat, World(water=0.0))
    below = draft / 2 + afloat.floating()[0]  # the centre of buoyancy
    arms = [width**2 / 12 / draft - below for width in (beam, length)]
    stiffness = SEA_WATER * GRAVITY * np.array([length * beam, *(volume * arm for arm in arms)])
    inertia = (np.diag(boat.inertia) + afloat.added_mass_at_rest)[[5, 0, 1]]
    assert afloat.natural_frequencies == pytest.approx(np.sqrt(stiffness / inertia) / (2 * np.pi), rel=1e-4)


def test_at_a_steady_speed_a_boat_has_the_trim_of_its_table(straight):
    for speed in BOAT.hull.running.speeds[[4, 9, 15, 20]]:
        placed = place_on_water(moving(straight, lambda t, v=speed: v + 0 * t), WATER)
        assert np.abs(bow(placed) - table(speed)).max() < 1e-9 and np.ptp(placed.positions[:, 2]) < 1e-9


def test_after_a_step_in_speed_it_swings_to_its_trim(straight):
    start, end = BOAT.hull.running.speeds[[8, 14]]
    late = 2.0 - 0.5 / 192  # halfway through the step's sample
    placed = place_on_water(moving(straight, lambda t: np.where(t < late, start, end)), WATER)
    share = (bow(placed) - table(start)) / (table(end) - table(start))
    assert share == pytest.approx(swing(placed.times - late, PITCH, PITCH_DAMPING), abs=2e-4)
    assert share.max() > 1.2  # the bow rises too far, and falls back
    x, _, z = BOAT.origin
    centre = placed.positions[:, 2] + x * np.sin(bow(placed)) + z * np.cos(bow(placed))
    share = (centre - centre[0]) / (centre[-1] - centre[0])
    assert share == pytest.approx(swing(placed.times - late, HEAVE, HEAVE_DAMPING), abs=2e-3)


def test_its_pitch_has_no_kink_where_it_begins_to_plane(straight):
    placed = place_on_water(moving(straight, lambda t: 1.0 + t), WATER)
    kinked = np.diff(table(placed.twists[::8, 1]), 3) * 24**3
    assert np.abs(kinked).max() > 4 * np.abs(np.diff(bow(placed)[::8], 3)).max() * 24**3


def test_at_rest_marks_it_floats_as_at_rest():
    places = {0: (0, 0, 0), 300: (40, 0, 0), 324: (40, 0, 0), 660: (75, 15, 0)}
    marks = [Mark(frame, position=place, velocity=(0, 0, 0)) for frame, place in places.items()]
    clip = vehsim.plan(BOAT, WATER, marks=marks, fps=24, character="stunt").clip
    assert np.degrees(bow(clip).max()) > 5
    fine = 1 / 1000
    for frame, place in places.items():
        then, before, after = (clip.at(np.clip(frame / 24 + d, 0.0, clip.times[-1])) for d in (0, -fine, fine))
        assert np.abs(bow(then)) < 1e-6
        assert then.positions[0] == pytest.approx((*place[:2], clip.positions[0, 2]), abs=1e-5)
        for near in (before, after):
            assert np.abs(bow(near) - bow(then)) < 2e-3 * fine
            assert np.abs(near.positions[0, 2] - then.positions[0, 2]) < 1e-3 * fine


def lap(still):
    """Speeds (m/s) of a lap of 12 s, which stops once if ``still``."""

    def speed(t):
        fast = 4 + 2 * np.sin(2 * np.pi * t / 12) + np.sin(4 * np.pi * t / 12)
        return fast * (np.clip(np.abs(t - 5) - 0.5, 0.0, 1.0) if still else 1.0)

    return speed


@pytest.mark.parametrize("still", [False, True])
def test_a_loop_ends_as_it_begins(straight, still):
    one = moving(straight, lap(still))
    placed = place_on_water(one, WATER, loop=True)
    two = np.concatenate([bow(placed), bow(placed)[1:]])
    times = np.concatenate([one.times, one.times[1:] + one.times[-1]])
    assert bow(placed)[0] == pytest.approx(bow(placed)[-1], abs=1e-12)
    assert placed.positions[0, 2] == pytest.approx(placed.positions[-1, 2], abs=1e-12)
    bends = np.diff(two, 2) / np.diff(times)[1:] ** 2
    seam = len(one) - 2
    assert np.abs(np.diff(bends)[seam - 3 : seam + 3]).max() < 5 * np.abs(np.diff(bends)).mean()


def test_a_motion_that_continues_a_placed_one_goes_on_with_its_pitch(straight):
    """As in handles and retouched windows."""
    whole = place_on_water(moving(straight, lambda t: 4 + 2 * np.sin(t)), WATER)
    for level in (whole.times > 7.0, whole.times < 5.0, np.abs(whole.times - 6) < 2.0):
        flat = np.where(level[:, None], from_yaw(yaw_of(whole.orientations)), whole.orientations)
        again = place_on_water(replace(whole, orientations=flat), WATER)
        np.testing.assert_array_equal(again.orientations[~level], whole.orientations[~level])
        before, after = (np.diff(bow(each), 2) * 192**2 for each in (whole, again))
        assert np.abs(after).max() < 1.6 * np.abs(before).max()
        assert np.abs(np.diff(again.positions[:, 2])).max() < 1.6 * np.abs(np.diff(whole.positions[:, 2])).max()
