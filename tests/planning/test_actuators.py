"""Plans within what actuators can follow: rates, and commands within the bounds of the controls."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.audit import audit, track_of_clip
from vehsim.planning.constraints.actuation import Actuation, excess
from vehsim.vehicles.definition.commands import Actuated


def hop(name="helicopter", character="stunt", last=1145, **options):
    marks = [
        Mark(frame=1001, position=(0, 0, 30), heading=0, velocity=(0, 0, 0)),
        Mark(frame=last, position=(20, 5, 30), heading=0, velocity=(0, 0, 0)),
    ]
    return vehsim.plan(vehsim.load_vehicle(name), None, marks, character=character, segments=32, **options)


def slopes(clip):
    return np.diff(clip.controls, axis=0) / np.diff(clip.times)[:, None]


@pytest.fixture(scope="module")
def stunt():
    return hop()


def test_a_stunt_is_as_fast_as_its_actuators_and_no_faster(stunt):
    bare, rates = hop("helicopter_lie"), [c.actuator.rate for c in stunt.clip.vehicle.controls]
    assert stunt.success and bare.success
    share, more = (np.abs(slopes(plan.clip)).max(axis=0) / rates for plan in (stunt, bare))
    assert share.max() == pytest.approx(1, abs=1e-4) and more.max() > 1.5


def test_the_commands_of_a_plan_stay_within_bounds_and_lead_to_its_controls(stunt):
    """Independent of the planner: filter the commands that follow from the plan."""
    clip, vehicle = stunt.clip, stunt.clip.vehicle
    lag = np.array([c.actuator.lag for c in vehicle.controls])
    slope, position = slopes(clip), clip.controls[0]
    for k, h in enumerate(np.diff(clip.times)):
        commands = clip.controls[k : k + 2] + lag * slope[k]  # at both ends of a segment
        for control, column in zip(vehicle.controls, commands.T, strict=True):
            slack = 1e-5 * control.scale
            assert (control.lower - slack <= column).all() and (column <= control.upper + slack).all()
        law = iter([*commands])
        actuated = Actuated(vehicle, lambda t, state, law=law: next(law))
        actuated(0.0, vehsim.State())
        actuated._controls = position
        position = actuated(h, vehsim.State())
        scale = np.array([c.scale for c in vehicle.controls])
        assert np.allclose(position / scale, clip.controls[k + 1] / scale, atol=1e-5)


def test_the_audit_measures_rates_and_commands(stunt):
    asks = [ask for ask in stunt.asks if ask.key.startswith("actuators.")]
    assert {ask.key for ask in asks} == {
        f"actuators.{c.name}.{what}" for c in stunt.clip.vehicle.controls for what in ("rate", "command")
    }
    assert all(row.met for row in audit(track_of_clip(stunt.clip), asks))
    k = len(stunt.clip) // 2
    jumped = stunt.clip.controls.copy()
    jumped[k, 0] += 20000.0
    missed = {row.key for row in audit(track_of_clip(replace(stunt.clip, controls=jumped)), asks) if not row.met}
    assert missed == {"actuators.collective.rate", "actuators.collective.command"}
    late = [replace(ask, wanted={**ask.wanted, "lag": 5.0}) for ask in asks if ask.measure == "command"]
    assert not all(row.met for row in audit(track_of_clip(stunt.clip), late))


def test_a_careful_motion_needs_no_rows_and_is_that_of_the_bare_controls():
    """ "normal" is far within what the machine can do: the same problem, hence the same motion."""
    marks = [
        Mark(frame=1001, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        Mark(frame="free", position=(40, 5, 0), heading=0, velocity=(0, 0, 0)),
    ]
    plans = [vehsim.plan(vehsim.load_vehicle(name), None, marks, segments=32) for name in ("car", "car_lie")]
    assert np.array_equal(plans[0].clip.positions, plans[1].clip.positions)
    block = plans[0]._iterate.block(Actuation)
    assert not block.active and excess(plans[0]._iterate) <= 0


def test_a_lag_keeps_commands_within_bounds_where_controls_alone_would_be():
    """A slow engine from rest: the distance at full command in 2 s, in closed form, is reached, and hardly any more."""
    lag, time = 1.5, 2.0
    car = vehsim.load_vehicle("car", {"actuators": {"torque": {"lag": lag}}})
    most = 2500 / 0.32 / (1350 + 2.4 / 0.32**2) * (time**2 / 2 - lag * time + lag**2 * (1 - np.exp(-time / lag)))

    def drive(distance):
        start = Mark(frame=1001, position=(0, 0, 0), heading=0, velocity=(0, 0, 0), hold=12)
        marks = [start, Mark(frame=1061, position=(distance, 0, 0), heading=0)]
        return vehsim.plan(car, None, marks, character="stunt", segments=40)

    near = drive(0.97 * most)
    assert near.success
    commands = near.clip.controls[1:, 0] + lag * slopes(near.clip)[:, 0]
    assert commands.max() == pytest.approx(2500, rel=1e-4) and near.clip.controls[:, 0].max() < 2000
    with pytest.warns(vehsim.errors.FailedPlan):
        assert not drive(1.02 * most).success


def test_a_mark_that_is_too_early_for_an_actuator_gets_the_frame_that_would_do():
    slow = vehsim.load_vehicle("car", {"actuators": {"torque": {"rate": 300.0}}})

    def drive(last):
        marks = [Mark(frame=f, position=(x, 0, 0), heading=0, velocity=(0, 0, 0)) for f, x in ((1001, 0), (last, 6))]
        return vehsim.plan(slow, None, marks, character="stunt", segments=16)

    with pytest.warns(vehsim.errors.FailedPlan, match="too early; use") as caught:
        failed = drive(1049)
    frame = int(re.search(r"use (\d+)", str(caught[0].message))[1])
    assert not failed.success and drive(frame).success
