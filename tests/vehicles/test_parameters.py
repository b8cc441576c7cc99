"""Parameters: every number of a vehicle has a unit and a range, and a shot can replace it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import casadi as ca
import numpy as np
import pytest
from annotated_types import Ge

import vehsim
from tests.shots import driven
from vehsim.batch import export_batch, load_shots
from vehsim.clip.clip import Clip
from vehsim.errors import InputError, ShotError
from vehsim.shot import Shot
from vehsim.vehicles import State, Vehicle, available, load_vehicle
from vehsim.vehicles.definition.holonomic import Holonomic
from vehsim.vehicles.definition.mechanics import symbols
from vehsim.vehicles.definition.quantities import Unit
from vehsim.vehicles.definition.scales import usual_scales
from vehsim.vehicles.library.library import MODELS, parameters_of
from vehsim.vehicles.library.parameters import check_physics, physics_table


def shot(folder: Path, parameters: str) -> Path:
    path = folder / "drive.toml"
    path.write_text(driven(keys=f"parameters = {parameters}\n"))
    return path


@pytest.mark.parametrize("model", sorted(MODELS))
def test_every_parameter_of_a_shipped_model_has_a_unit(model: str) -> None:
    for key, field in physics_table(MODELS[model]).model_fields.items():
        assert "SI units" not in str(field.description), key


@pytest.mark.parametrize("name", available())
def test_every_number_of_a_shipped_vehicle_has_a_unit_and_a_range(name: str) -> None:
    """Nonsense is refused by key, unit and range, and a slightly different number is taken."""
    for key, value, words in parameters_of(name):
        if isinstance(value, str):
            continue
        assert "SI units" not in words, key
        for wrong in (math.nan, 1e200, "much", True):
            with pytest.raises(InputError) as raised:
                load_vehicle(name, nested(key, with_all(value, lambda _, wrong=wrong: wrong)))
            for problem in raised.value.problems:
                assert problem.key.startswith(f"parameters.{key}") and "SI units" not in problem.remedy, problem
        if "no effect without" in words and name.endswith("_lie"):
            continue
        other = load_vehicle(name, nested(key, with_all(value, lambda x: x if x in (0, 1) else 0.99 * x)))
        assert other.parameters == nested(key, with_all(value, lambda x: x if x in (0, 1) else 0.99 * x))


@pytest.mark.parametrize(
    "name", [name for name in available() if name not in ("boat_lie", "snakeboard_lie", "car_lie")]
)
def test_every_number_changes_the_vehicle(name: str) -> None:
    """Each alone changes the equations, the channels, the hull, the limits or the springs; or it is refused because
    of another number, with or without which it has no effect."""
    own = everything(load_vehicle(name))
    for key, value, words in parameters_of(name):
        for changed in [] if isinstance(value, str) else changes(value):
            if key == "locked":
                changed = [one if one in (0, 1) else int(one < 0.5) for one in changed]
            try:
                other = load_vehicle(name, nested(key, changed))
            except InputError as error:
                said = str(error)
                assert (
                    ("changes nothing while" in said and "no effect with" in words)
                    or (key == "inertia" and "as of no body" in said)
                    or (key == "outboard" and "neither 0 nor 1" in said)
                ), said
            else:
                assert not same(own, everything(other)), key


def changes(value: Any) -> Iterator[Any]:
    """A number, or nested lists of numbers, with one of the numbers a fifth smaller; 0.1 in place of 0 and infinity."""
    if isinstance(value, list | tuple):
        yield from ([*value[:k], one, *value[k + 1 :]] for k, entry in enumerate(value) for one in changes(entry))
    else:
        yield 0.8 * value if value and math.isfinite(value) else 0.1


def everything(vehicle: Vehicle) -> list[Any]:
    """The values of all laws of a vehicle at one state, and all its other numbers."""
    found: list[Any] = [] if vehicle.planar is None else everything(vehicle.planar)
    g, r, u, xi, c, wind = symbols(vehicle)
    t, height, flow = ca.SX.sym("t"), ca.SX.sym("height"), ca.SX.sym("flow", 6)
    laws = [vehicle.reduced_lagrangian(r, u, xi), vehicle.basis(r), vehicle.connection(r), vehicle.potential(g, r)]
    laws += [*vehicle.force(g, r, u, xi, c, wind), vehicle.dissipation(g, r, u, xi, wind)]
    laws += [(channel.value or channel.rate)(t, r, u, xi, c) for channel in vehicle.channels.values()]  # type: ignore[misc]
    if isinstance(vehicle, Holonomic) and vehicle.power is not None:
        laws.append(vehicle.power(xi, c, height))
    if vehicle.rolling is not None:
        laws.append(vehicle.rolling(r, xi))
    if vehicle.hull is not None:
        immersion = ca.DM.ones(len(vehicle.hull.propulsor_points)) * 0.7
        laws += [vehicle.hull.propulsion(c, flow, immersion), vehicle.hull.windage(flow)]
    given = [g, r, u, xi, c, wind, t, height, flow]
    state = np.random.default_rng(1)
    values = ca.Function("laws", given, laws)(*(state.uniform(0.1, 0.9, one.shape) for one in given))
    settings = (vehicle.controls, vehicle.joint_limits, vehicle.top_speed, vehicle.top_turn_rate, vehicle.hull)
    springs = None if vehicle.rig is None else (vehicle.rig.suspension, vehicle.rig.origin)
    return [*found, *(np.asarray(value) for value in values), *numbers((settings, springs))]


def numbers(value: Any) -> Iterator[Any]:
    """All numbers and names in nested data."""
    if is_dataclass(value):
        yield from numbers([getattr(value, each.name) for each in fields(value)])
    elif isinstance(value, dict | list | tuple | np.ndarray):
        for one in value.values() if isinstance(value, dict) else value:
            yield from numbers(one)
    elif isinstance(value, float | int | str):
        yield value


def same(one: list[Any], other: list[Any]) -> bool:
    return len(one) == len(other) and all(
        a == b if isinstance(a, str) else np.allclose(a, b, rtol=1e-9, atol=1e-13)
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize(
    ("name", "parameters", "keys"),
    [
        ("helicopter_lie", {"solidity": 0.05}, ["solidity"]),
        ("helicopter", {"stabiliser_angle": 0.1, "stabiliser_behind": 5.0}, ["stabiliser_angle", "stabiliser_behind"]),
        ("helicopter", {"stabiliser_angle": 0.1, "stabiliser_area": 1.0}, []),
        ("rally_car", {"camber_gains": [0.1, 0.1]}, ["camber_gains"]),
        ("boat", {"rudder_area": 0.0, "rudder_slope": 3.0}, ["rudder_slope"]),
        ("boat", {"planing": 0.3}, ["planing"]),
    ],
)
def test_a_number_that_changes_nothing_is_refused(name: str, parameters: dict[str, Any], keys: list[str]) -> None:
    if not keys:
        assert load_vehicle(name, parameters).parameters == parameters
        return
    with pytest.raises(InputError) as raised:
        load_vehicle(name, parameters)
    assert [problem.key for problem in raised.value.problems] == [f"parameters.{key}" for key in keys]
    assert "changes nothing while" in str(raised.value) and "leave it out" in str(raised.value)


def test_an_outboard_is_there_or_not() -> None:
    with pytest.raises(InputError, match=r"parameters.outboard = 0.5: neither 0 nor 1; give 1"):
        load_vehicle("boat", {"outboard": 0.5})


def with_all(value: Any, change: Any) -> Any:
    """A number, or each number of nested lists, changed."""
    return [with_all(one, change) for one in value] if isinstance(value, list | tuple) else change(value)


def nested(key: str, value: Any) -> dict[str, Any]:
    """The parameters with a ``value`` at a dotted key."""
    for name in reversed(key.split(".")):
        value = {name: value}
    return dict(value)


@pytest.mark.parametrize("name", available())
def test_parameters_equal_to_the_file_change_nothing(name: str) -> None:
    """The listed values, given back as parameters, give the same vehicle."""
    given: dict[str, Any] = {}
    for key, value, _ in parameters_of(name):
        node = given
        *tables, last = key.split(".")
        for table in tables:
            node = node.setdefault(table, {})
        node[last] = value
    own, again = load_vehicle(name), load_vehicle(name, given)
    assert again.controls == own.controls and again.joint_limits == own.joint_limits
    assert again.top_speed == own.top_speed
    state = State(twist=np.linspace(0.1, 0.6, own.group.dim), joints=[0.1] * len(own.joints))
    assert again.energy(state) == own.energy(state)


@pytest.mark.parametrize(
    ("name", "key", "power"),
    [("car", "mass", 1), ("helicopter", "mass", 1), ("boat", "mass", 1), ("hopper", "mass", 1)],
)
def test_twice_the_mass_has_twice_the_kinetic_energy(name: str, key: str, power: int) -> None:
    """In pure translation, where moments of inertia have no effect; a hopper's foot adds its own mass."""
    own = load_vehicle(name)
    value = next(value for this, value, _ in parameters_of(name) if this == key)
    heavy = load_vehicle(name, {key: 2 * value})
    twist = np.zeros(own.group.dim)
    twist[own.group.dim // 2 if own.group.dim == 6 else 1] = 3.0
    state = State(twist=twist)
    assert heavy.energy(state)[0] - own.energy(state)[0] == pytest.approx(value * 3.0**2 / 2, rel=1e-9)


def test_parameters_come_as_numpy_arrays_too() -> None:
    inertia = np.array([1000.0, 2000.0, 3000.0])
    heli = load_vehicle("helicopter", {"mass": np.float64(1500), "inertia": inertia})
    assert heli.parameters == {"mass": 1500.0, "inertia": inertia.tolist()}


@pytest.mark.parametrize(
    ("parameters", "key", "message", "remedy"),
    [
        ({"mass": -1}, "mass", "greater than 0", "in kg"),
        ({"mas": 3}, "mas", "unknown key", "'mass'"),
        ({"mass": "1500 kg"}, "mass", "not a number", "in kg"),
        ({"mass": True}, "mass", "not a number", "in kg"),
        ({"mass": math.nan}, "mass", "not a finite number", "in kg"),
        ({"mass": math.inf}, "mass", "not a finite number", "in kg"),
        ({"mass": 1e14}, "mass", "beyond 1e", "in kg"),
        ({"slope": [0.1]}, "slope", "at least 2", "two numbers"),
        ({"rolling_damping": -2}, "rolling_damping", "at least 0", "N m s/rad"),
        ({"controls": {"torque": {"lower": 1e5}}}, "controls.torque.lower", "above upper", "swap"),
        ({"controls": {"thrust": {}}}, "controls.thrust", "unknown key", "torque"),
        ({"controls": {"torque": {"lower": "full"}}}, "controls.torque.lower", "not a number", "in N m"),
        ({"controls": {"torque": {"upper": 1e13}}}, "controls.torque.upper", "beyond 1e+12", "in N m"),
        ({"joints": {"sigma": {"upper": -1e300}}}, "joints.sigma.upper", "beyond 1e+12", "without a unit"),
        ({"actuators": {"torque": {"rate": 1e200}}}, "actuators.torque.rate", "beyond 1e+12", "per second"),
        ({"top_speed": 1e300}, "top_speed", "beyond 1e+12", "m/s"),
        ({"joints": {"sigma": {"lower": 3}}}, "joints.sigma.lower", "not below upper", "swap"),
        ({"suspension": {"frequency": -1}}, "suspension.frequency", "greater than 0", "Hz"),
        ({"top_speed": -4}, "top_speed", "greater than 0", "m/s"),
    ],
)
def test_a_wrong_parameter_is_named_with_its_unit(
    parameters: dict[str, Any], key: str, message: str, remedy: str
) -> None:
    with pytest.raises(InputError) as raised:
        load_vehicle("car", parameters)
    (problem,) = raised.value.problems
    assert problem.key == f"parameters.{key}" and not problem.file
    assert message in problem.message and remedy in problem.remedy


def test_a_vehicle_without_joints_says_that_it_has_none() -> None:
    with pytest.raises(InputError, match=r"parameters.joints.psi = .*: unknown key; known keys: \(none\)"):
        load_vehicle("tumbler", {"joints": {"psi": {"lower": 0}}})


@pytest.mark.parametrize("name", ["helicopter", "boat", "hopper", "tumbler"])
def test_an_inertia_that_no_body_has_is_refused(name: str) -> None:
    """About each axis at most the sum of those about the others; a plate has exactly that sum."""
    assert load_vehicle(name, {"inertia": [1.0, 2.0, 3.0]}).parameters["inertia"] == [1.0, 2.0, 3.0]
    with pytest.raises(
        InputError, match=r"parameters.inertia = .*: one moment is larger than the sum of the other two"
    ):
        load_vehicle(name, {"inertia": [1.0, 2.0, 3.01]})


def test_everything_that_is_wrong_is_listed_at_once() -> None:
    with pytest.raises(InputError) as raised:
        load_vehicle("car", {"mass": -1, "wheelbase": "long", "color": 3})
    assert sorted(problem.key for problem in raised.value.problems) == [
        "parameters.color",
        "parameters.mass",
        "parameters.wheelbase",
    ]


def test_a_model_of_another_package_may_use_its_own_units_or_none() -> None:
    def kite(name: str = "kite", *, pull: Annotated[float, Unit("N"), Ge(0)], drag: float = 0.0) -> None: ...

    kite.__annotations__ = {
        "pull": Annotated[float, Unit("N"), Ge(0)],
        "drag": float,
    }  # in a local function, annotations are strings
    words = {key: field.description for key, field in physics_table(kite).model_fields.items()}
    assert words == {"pull": "a number of at least zero, in N", "drag": "a number, in SI units"}
    check_physics(kite, {"pull": 3})
    with pytest.raises(InputError, match=r"physics.pull = -3: .* in N"):
        check_physics(kite, {"pull": -3})


def test_a_clip_remembers_its_vehicle(tmp_path: Path) -> None:
    car = load_vehicle("car", {"mass": 2000.0})
    clip = vehsim.simulate(car, None, [500.0, 0.0], State(), duration=0.25)
    again = Clip.load(clip.save(tmp_path / "drive.npz"))
    assert again.vehicle.parameters == {"mass": 2000.0}
    assert np.array_equal(again.positions, clip.positions)


def test_a_shot_drives_a_heavier_car_less_far(tmp_path: Path) -> None:
    """At the same torque the acceleration is F / (m + I / r^2), from rest."""
    reached = {}
    for mass in (1350.0, 2700.0):
        take = Shot.load(shot(tmp_path, f"{{ mass = {mass} }}")).solve()
        reached[mass] = float(take.clips["car"].positions[-1, 0])
    car = {key: value for key, value, _ in parameters_of("car")}
    spin = car["wheel_inertia"] / car["wheel_radius"] ** 2
    assert reached[1350.0] / reached[2700.0] == pytest.approx((2700.0 + spin) / (1350.0 + spin), rel=1e-6)


def test_a_shot_names_its_wrong_parameters_with_their_line(tmp_path: Path) -> None:
    with pytest.raises(ShotError) as raised:
        Shot.load(shot(tmp_path, "{ mass = -1, gravity = 3 }")).solve()
    assert [problem.key for problem in raised.value.problems] == [
        "vehicle[0].parameters.mass",
        "vehicle[0].parameters.gravity",
    ]
    assert {problem.line for problem in raised.value.problems} == {8}


def test_a_parameter_that_contradicts_the_asset_is_reported(tmp_path: Path) -> None:
    (problem,) = Shot.load(shot(tmp_path, "{ wheel_radius = 0.5 }")).check()
    assert problem.key == "vehicle[0].parameters.wheel_radius" and "its wheels have a radius" in problem.message


def test_a_sweep_over_a_parameter_is_in_its_reports(tmp_path: Path) -> None:
    path = shot(tmp_path, "{ top_speed = 40 }")
    path.write_text(path.read_text() + '[sweep]\n"vehicle.car.parameters.mass" = [1200, 1600]\n')
    outcomes = export_batch(load_shots(path), tmp_path / "out", ["usd"])
    assert [outcome.state for outcome in outcomes] == ["done", "done"], outcomes
    reports = [json.loads(path.read_text()) for path in sorted((tmp_path / "out").glob("*/report.json"))]
    found = [report["vehicles"]["car"]["parameters"] for report in reports]
    assert found == [{"mass": 1200, "top_speed": 40}, {"mass": 1600, "top_speed": 40}]


def test_every_number_of_a_character_can_be_replaced_on_its_own() -> None:
    """In the table of ``vehicle.toml``, with what it does not give as before."""
    car, kinds = load_vehicle("car").character, ("costs", "limits", "control_rates", "review")
    numbers = [("response", ""), *((each, name) for each in kinds for name in getattr(car, each))]
    for kind, name in numbers:
        trait = getattr(car, kind)[name] if name else car.response
        for driven_as in ("calm", "normal", "brisk"):
            row = {driven_as: 0.9 * trait.of(driven_as)}
            other = load_vehicle("car", {"character": {kind: {name: row} if name else row}}).character
            after = getattr(other, kind)[name] if name else other.response
            assert after == dataclasses.replace(trait, **row, source="given as a parameter")
            same = {each: getattr(other, each) for each in ("response", *kinds) if each != kind}
            assert same == {each: getattr(car, each) for each in same}


@pytest.mark.parametrize(
    ("character", "key", "remedy"),
    [
        ({"limits": {"bank": {"normal": 0.1}}}, "parameters.character.limits.bank", "give calm, brisk too"),
        ({"control_rates": {"torqe": {"normal": 9.0}}}, "character.control_rates.torqe", "torque"),
        ({"response": {"normal": -1.0}}, "parameters.character.response.normal", "normally"),
        ({"stunt_controls": ["torq"]}, "character.stunt_controls.torq", "torque"),
        ({"review": {"jrk": {"normal": 4.0}}}, "parameters.character.review.jrk", "jerk"),
    ],
)
def test_wrong_numbers_of_a_character_are_named(character: Any, key: str, remedy: str) -> None:
    with pytest.raises(InputError) as raised:
        load_vehicle("car", {"character": character})
    (problem,) = raised.value.problems
    assert key in problem.key and remedy in problem.remedy


def test_a_plan_keeps_the_numbers_of_a_character_that_a_shot_replaces(tmp_path: Path) -> None:
    rest = (0.0, 0.0, 0.0)
    marks = [vehsim.Mark(1, position=rest, velocity=rest), vehsim.Mark(289, position=(30, 0, 0), velocity=rest)]

    def rate(parameters: Any) -> float:
        car = load_vehicle("car", parameters)
        clip = vehsim.plan(car, None, marks, segments=24, refine=False).clip
        return float(np.abs(np.diff(clip.controls[:, 0]) / np.diff(clip.times)).max())

    most = 0.8 * rate({})
    assert rate({"character": {"control_rates": {"torque": {"normal": most}}}}) < 1.05 * most


@pytest.mark.parametrize("name", ["car", "simple_car", "truck", "snakeboard", "two_wheeled"])
def test_usual_scales_are_of_the_size_of_chosen_ones(name: str) -> None:
    vehicle = load_vehicle(name)
    usual, chosen = usual_scales(vehicle), {control.name: control.scale for control in vehicle.controls}
    assert set(usual) == set(chosen) - set(vehicle.rate_controls)
    for control, scale in usual.items():
        assert 1 / 4 < scale / chosen[control] < 4, control


@pytest.mark.parametrize(
    ("more", "thrust"),
    [("", 1500.0), ("[controls.thrust]\nupper = 9000.0\n", 1500.0), ("[controls.thrust]\nscale = 70.0\n", 70.0)],
)
def test_a_scale_that_a_file_lacks_follows_from_the_mass(tmp_path: Path, more: str, thrust: float) -> None:
    """Of a sleigh of 1,500 kg: 1,500 N, and the torque with the same energy norm."""
    text = 'schema = 1\nname = "sleigh"\nmodel = "chaplygin_sleigh"\n[physics]\n'
    text += "mass = 1500.0\nyaw_inertia = 600.0\nahead = 0.0\n"
    (tmp_path / "vehicle.toml").write_text(text + more)
    scales = [control.scale for control in load_vehicle(tmp_path / "vehicle.toml").controls]
    assert scales == pytest.approx([thrust, math.sqrt(1500.0 * 600.0)], rel=0.01)
