"""Slip, load and contact on the wheels of a stage, against formulas of the motion that share no code with them."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import vehsim
from vehsim.delivery.take import Take
from vehsim.exporters.usd.exporter import write_usd
from vehsim.world.ground.placing import place_on_terrain
from vehsim.world.terrain.terrain import Terrain

G, MASS, AXLE, HALF, RADIUS, HEIGHT = 9.81, 1350.0, 1.3, 0.77, 0.32, 0.5
LEVEL = vehsim.World(Terrain("level", np.zeros((3, 3)), (-100.0, -100.0), (100.0, 100.0)))
WHEELS = {"fl": "steer_fl/wheel_fl", "fr": "steer_fr/wheel_fr", "rl": "wheel_rl", "rr": "wheel_rr"}


def exported(clip, folder):
    """Arrays by wheel and primvar at the whole frames of a clip on level ground, and the clip there."""
    clip = place_on_terrain(clip, LEVEL)
    take = Take("shot", {"car": clip}, LEVEL, (), Fraction(24), (1001, int(clip.end_frame)))
    write_usd(take, folder, lambda what, done: None)
    stage = Usd.Stage.Open(str(folder / "shot.usda"))
    at = clip.resample()
    found = {}
    for wheel, path in WHEELS.items():
        api = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(f"/shot/vehicles/car/{path}"))
        for name in ("slip_ratio", "slip_angle", "load", "contact"):
            primvar = api.GetPrimvar(f"vehsim:tyre:{name}")
            found[wheel, name] = np.array([primvar.Get(frame) for frame in at.frames.tolist()])
    return found, at


def handbrake_turn(name):
    """A car that turns in at 12 m/s and pulls its handbrake."""
    vehicle = vehsim.load_vehicle(name)
    times = np.linspace(0, 1.5, round(1.5 / vehicle.largest_step) + 1)
    pull = np.interp(times, [0.5, 0.7], [0, 4000])
    rows = np.column_stack([0 * times, 0 * times, pull, np.interp(times, [0, 0.4, 0.41], [0.5, 0.5, 0])])
    return vehsim.simulate(vehicle, None, rows, vehsim.State(twist=(0, 12, 0)), 1.5, step=times[1])


@pytest.mark.parametrize("name", ["drift_car", "rally_car"])
def test_the_primvars_of_sliding_cars_are_those_of_the_motion(name, tmp_path):
    found, clip = exported(handbrake_turn(name), tmp_path)
    column = {joint: k for k, joint in enumerate(clip.vehicle.joints)}
    sigma, (turn, along, across) = clip.joints[:, column["sigma"]], clip.twists.T
    for wheel in WHEELS:
        front, side = wheel[0] == "f", (1.0 if wheel[1] == "l" else -1.0) * HALF * (name == "rally_car")
        rate = {"f": "psi_front", "r": "psi"}[wheel[0]] if name == "drift_car" else f"psi_{wheel if front else 'r'}"
        delta = np.arctan2(sigma, 1 - side * sigma / (2 * AXLE)) if front else 0 * turn
        vx, vy = along - side * turn, across + (AXLE if front else -AXLE) * turn
        ahead, aside = np.cos(delta) * vx + np.sin(delta) * vy, np.cos(delta) * vy - np.sin(delta) * vx
        pace = np.hypot(ahead, 3.0)
        ratio = (RADIUS * clip.joint_rates[:, column[rate]] - ahead) / pace
        assert found[wheel, "slip_ratio"] == pytest.approx(ratio, abs=2e-3)
        assert found[wheel, "slip_angle"] == pytest.approx(np.degrees(np.arctan2(aside, pace)), abs=0.1)
        assert np.all(found[wheel, "contact"] == 1)
    total = sum(found[wheel, "load"] for wheel in WHEELS)
    assert total == pytest.approx(np.full(len(clip), MASS * G), rel=1e-6 if name == "drift_car" else 0.03)  # it heaves
    shift = sum((1 if wheel[0] == "f" else -1) * found[wheel, "load"] for wheel in WHEELS)
    if name == "drift_car":  # moments about the middle of the car
        forward = np.gradient(along, clip.times) - turn * across
        assert shift[2:-2] * AXLE == pytest.approx(-MASS * HEIGHT * forward[2:-2], abs=0.04 * MASS * HEIGHT * G)
    assert found["rl", "slip_ratio"].min() < -0.9 and np.abs(found["rl", "slip_angle"]).max() > 20
    assert np.ptp(shift) > 0.1 * MASS * G


def test_rolling_wheels_carry_what_a_bend_shifts(tmp_path):
    """In a steady bend, the outer wheels carry more by mass, height and lateral acceleration over the track."""
    car = vehsim.load_vehicle("car")
    speed, sigma = 9.0, 0.13
    turn = speed * sigma / 2.6
    start = vehsim.State(twist=(turn, speed, 0), joints=(0, sigma))
    found, _ = exported(vehsim.simulate(car, LEVEL, np.zeros(2), start, 4.0), tmp_path)
    lateral = turn * speed
    for axle in "fr":
        inner, outer = (found[f"{axle}{side}", "load"][-1] for side in "lr")
        assert (outer - inner) * 2 * HALF == pytest.approx(MASS * HEIGHT * lateral, rel=0.02)
    assert sum(found[wheel, "load"][-1] for wheel in WHEELS) == pytest.approx(MASS * G, rel=1e-3)
    for wheel in WHEELS:
        assert not found[wheel, "slip_ratio"].any() and not found[wheel, "slip_angle"].any()
        assert np.all(found[wheel, "contact"] == 1)


@pytest.mark.filterwarnings("ignore:.*(is too fast for steps|leaves its arch)")
def test_a_tyre_in_the_air_has_no_contact(tmp_path):
    """A body that leans by 14 degrees unloads the two wheels on its high side."""
    vehicle = vehsim.load_vehicle("rally_car")
    joints = [0.0] * len(vehicle.joints)
    joints[vehicle.joints.index("roll")] = 0.25
    state = vehsim.State(joints=joints)
    found, _ = exported(vehsim.simulate(vehicle, None, np.zeros(4), state, 0.5, step=1 / 2400), tmp_path)
    spring = MASS * G / 4 - 26000 * HALF * 0.25 - 14000 * 0.25 / (2 * HALF)
    assert spring < 0
    assert [found[wheel, "contact"][0] for wheel in WHEELS] == [0, 1, 0, 1]
    assert found["fl", "load"][0] < 10 and found["fr", "load"][0] > MASS * G / 2
    assert all(found[wheel, "contact"][-1] == 1 for wheel in WHEELS)


def test_wheels_of_trailers_roll_and_their_loads_are_not_guessed(tmp_path):
    truck = vehsim.load_vehicle("truck")
    clip = place_on_terrain(vehsim.simulate(truck, LEVEL, np.zeros(2), vehsim.State(twist=(0, 3, 0)), 0.25), LEVEL)
    assert not [name for name in clip.channels if name.startswith("load_")]
    write_usd(Take("shot", {"it": clip}, LEVEL, (), Fraction(24), (1001, 1007)), tmp_path, lambda what, done: None)
    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    names = [
        str(a.GetName()) for prim in stage.Traverse() for a in prim.GetAttributes() if "vehsim:tyre" in a.GetName()
    ]
    assert names.count("primvars:vehsim:tyre:contact") >= 6 and "primvars:vehsim:tyre:load" not in names
