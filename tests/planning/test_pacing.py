"""Paces along paths, among moving obstacles too, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from vehsim.planning.guesses.pacing import FINER, MEETING, STEPS, changes_of_gear, paced, smoothest, stations, stopping

LENGTH, SECONDS = 24.0, 12.0


def straight(reverses_after: float = 1.0):
    """Poses along a straight path, of which the last part is driven back."""
    there = np.array([[0.0, 0, 0, 0], [LENGTH * reverses_after, 0, 0, 0]])
    back = [[LENGTH * (2 * reverses_after - 1), 0, 0, 0]] if reverses_after < 1 else []
    return stations(np.vstack([there, *back]) if back else there)


def free():
    return np.zeros((STEPS + 1, STEPS * FINER + 1), bool)


@pytest.mark.parametrize("rests, merit", [((True, True), 12.0), ((True, False), 3.0), ((False, False), 0.0)])
def test_without_obstacles_the_least_squared_acceleration_is_found(rests, merit):
    """From rest to rest 12 d^2/t^3, from rest 3 d^2/t^3, between free ends a constant speed; speeds are whole cells."""
    found, at = smoothest(free(), straight(), SECONDS, rests)
    exact = merit * LENGTH**2 / SECONDS**3
    assert exact <= found <= 1.5 * exact
    assert at[0] == 0 and at[-1] == STEPS * FINER and (np.diff(at) >= 0).all()


@pytest.mark.parametrize("first, last", [(0.3, 0.75), (0.6, 1.0), (0.0, 0.4)])
def test_a_place_that_is_taken_for_a_while_is_passed_before_or_after(first, last):
    """The middle of the path is taken in these shares of the time."""
    taken, middle = free(), STEPS * FINER // 2
    taken[int(first * STEPS) : int(last * STEPS) + 1, middle - 20 : middle + 20] = True
    merit, at = smoothest(taken, straight(), SECONDS, (True, True))
    assert not taken[np.arange(STEPS + 1), at].any()
    easy, _ = smoothest(free(), straight(), SECONDS, (True, True))
    assert easy <= merit < MEETING


def test_a_wall_on_the_way_costs_as_long_as_it_is_met():
    taken = free()
    taken[:, 100:200] = True
    assert smoothest(taken, straight(), SECONDS, (True, True))[0] > MEETING


def test_a_vehicle_stops_where_it_changes_its_direction():
    poses = straight(reverses_after=0.75)
    turn = int(np.argmax(poses[:, 0]))
    merit, at = smoothest(free(), poses, SECONDS, (True, True))
    assert merit < MEETING
    here = int(np.searchsorted(at, turn))
    assert at[here + 1] - at[here - 1] <= 6


def test_a_paced_path_holds_the_pose_at_every_step():
    poses = straight()
    path = paced(poses, np.arange(0, STEPS * FINER + 1, FINER))
    assert path.shape == (STEPS + 1, 5)
    assert path[:, 0] == pytest.approx(LENGTH * path[:, 4])


def test_changes_of_direction_are_counted_where_the_vehicle_moves():
    x = np.array([0.0, 0.0, 1.0, 2.0, 3.0, 3.0, 3.0, 2.0, 1.0, 1.0, 2.0, 2.0])
    poses = np.column_stack([x, np.zeros((len(x), 3))])
    assert changes_of_gear(poses)[-1] == 2 and changes_of_gear(poses[:5])[-1] == 0
    assert changes_of_gear(np.add(poses, [0, 0, 0, np.pi]))[-1] == 2  # tail first, then the same
    sideways = np.column_stack([0.01 * (-1.0) ** np.arange(12), np.arange(12.0), np.zeros((12, 2))])
    assert not changes_of_gear(sideways).any()
    assert not changes_of_gear(poses[:, :3]).any() and not changes_of_gear(poses[:1]).any()


def test_guesses_stop_where_they_change_their_direction():
    """Four metres ahead and one back, from rest to rest: the turning point comes after two thirds of the time."""
    x = np.concatenate([np.linspace(0, 4, 401), np.linspace(3.99, 3, 100)])
    path = np.column_stack([x, np.zeros((len(x), 3))])
    paced = stopping(path, (True, True))
    share, turn = paced[:, 4], int(x.argmax())
    assert share[0] == 0 and share[-1] == 1 and (np.diff(share) > 0).all()
    assert share[turn] == pytest.approx(2 / 3, abs=0.01)
    speed = np.abs(np.diff(x)) / np.diff(share)
    assert max(speed[0], speed[turn - 1], speed[turn], speed[-1]) < 0.15 * speed.max()
    straight = path[: turn + 1]
    assert stopping(straight, (True, True)) is straight
    moving = stopping(path, (False, True))
    assert np.diff(x)[0] / np.diff(moving[:, 4])[0] > 0.5 * speed.max()
    sideways = np.column_stack([x[: turn + 1], np.zeros((turn + 1, 2)), np.linspace(0, 1.75, turn + 1)])
    assert stopping(sideways, (True, True)) is sideways
