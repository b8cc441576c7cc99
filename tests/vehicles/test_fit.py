"""A vehicle.toml whose numbers do not match its asset is refused, or warns, with both numbers."""

import re
from pathlib import Path

import pytest

import vehsim
from vehsim.assets import shipped
from vehsim.shot.shot import Shot
from vehsim.vehicles.library.fit import backwards, misfits

ELSEWHERE = sorted(path.parent for path in (Path(__file__).parents[1] / "assets_elsewhere").glob("*/vehicle.toml"))
CARS = [shipped("vehicle")["car"].parent, *(path for path in ELSEWHERE if path.name in ("kart", "crawler", "pickup"))]


def copied(source, folder, **physics):
    """A folder with a vehicle's asset and other numbers in its vehicle.toml."""
    folder.mkdir()
    toml = folder / "vehicle.toml"
    text = (source / "vehicle.toml").read_text(encoding="utf-8")
    text = re.sub(r'(?m)^asset = "(.*?)"', lambda m: f'asset = "{(source / m[1]).resolve()}"', text)
    for key, value in physics.items():
        text, count = re.subn(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
        assert count == 1
    toml.write_text(text, encoding="utf-8")
    return folder


def problems(folder):
    data = {
        "shot": {"schema": 1, "name": "s", "fps": 24},
        "vehicle": [{"name": "v", "asset": str(folder), "motion": {"method": "simulate", "duration": 1.0}}],
    }
    return [p for p in Shot.from_dict(data).check() if "vehicle.0" not in p.key and p.key == "vehicle[0].asset"]


@pytest.mark.parametrize("source", [*shipped("vehicle"), *ELSEWHERE], ids=lambda source: Path(source).name)
def test_matching_numbers_do_not_warn(source):
    rig = vehsim.load_vehicle(source).rig
    assert misfits(rig) == [] and backwards(rig) is None


@pytest.mark.parametrize("source", CARS, ids=lambda path: path.name)
@pytest.mark.parametrize(("key", "times", "severity"), [("wheelbase", 100, "error"), ("wheelbase", 1.25, "warning"),
    ("wheel_radius", 100, "error"), ("wheel_radius", 0.7, "warning"), ("wheelbase", 1.08, None)])  # fmt: skip
def test_lengths_are_those_of_the_asset(source, key, times, severity, tmp_path):
    (given,) = re.findall(rf"(?m)^{key} = ([\d.]+)", (source / "vehicle.toml").read_text(encoding="utf-8"))
    wrong = problems(copied(source, tmp_path / "own", **{key: round(float(given) * times, 4)}))
    if severity is None:
        assert not wrong
        return
    (problem,) = wrong
    assert problem.severity == severity and f"physics.{key} = " in problem.message
    measured = float(re.findall(r"(?:by|of) ([\d.]+) m", problem.message)[0])
    assert measured == pytest.approx(float(given), rel=0.1)
    assert ("as in cm" in problem.message) == (times == 100)


@pytest.mark.parametrize(("mass", "severity"), [(0.9, "error"), (1.35, "error"), (100.0, "warning"), (1350e3, "error")])
def test_implausible_masses_are_reported(mass, severity, tmp_path):
    (problem,) = problems(copied(CARS[0], tmp_path / "own", mass=mass))
    assert problem.severity == severity and f"physics.mass = {mass}" in problem.message
    assert "kg/m^3" in problem.message and "physics.density" in problem.remedy


def test_a_rotor_away_from_its_physics_position_is_named(tmp_path):
    (problem,) = problems(copied(shipped("vehicle")["helicopter"].parent, tmp_path / "own", d_r=63.5))
    assert problem.severity == "error" and "tail rotor" in problem.message


@pytest.mark.parametrize("source", CARS, ids=lambda path: path.name)
def test_a_nose_that_points_backwards_is_refused(source, tmp_path):
    folder = copied(source, tmp_path / "own")
    toml = folder / "vehicle.toml"
    text = toml.read_text(encoding="utf-8")
    turned = {"-Y": "+Y", "+Y": "-Y", "-Z": "+Z", "+Z": "-Z", "-X": "+X", "+X": "-X"}
    given = re.findall(r'(?m)^forward = "(..)"', text)
    if given:
        text = text.replace(f'forward = "{given[0]}"', f'forward = "{turned[given[0]]}"')
    else:
        text = text.replace("[physics]", 'forward = "-X"\n[physics]', 1)
    toml.write_text(text, encoding="utf-8")
    (problem,) = problems(folder)
    assert problem.severity == "error" and "it points backwards" in problem.message and "forward" in problem.remedy


@pytest.mark.parametrize("name", ["helicopter", "boat"])
def test_aircraft_and_boats_that_point_backwards_are_refused(name, tmp_path):
    folder = copied(shipped("vehicle")[name].parent, tmp_path / "own")
    toml = folder / "vehicle.toml"
    text = toml.read_text(encoding="utf-8")
    toml.write_text(text.replace("[physics]", 'forward = "-X"\n[physics]', 1), encoding="utf-8")
    assert any("it points backwards" in problem.message for problem in problems(folder))
