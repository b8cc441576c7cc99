"""How fast a car on tyres creeps down a slope, against its simulation; and where it slides."""

import numpy as np
import pytest

import vehsim
from vehsim.integrators.continuous import execute
from vehsim.vehicles.definition.standing import SEEN, creep, peak, steepest
from vehsim.world.ground.slope import on_terrain
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

CARS = ["drift_car", "rally_car"]


def crept(name, slope, heading):
    """Speed, m/s, of a car on ice with all its brakes on, a second after it was set down on a slope."""
    car = vehsim.load_vehicle(name, {"surface": "ice"})
    x = np.arange(-60, 61, 10.0)
    world = World(Terrain("slope", slope * np.tile(x, (13, 1)), (-60.0, -60.0), (10.0, 10.0)))
    brakes = np.tile([0.0, 8000.0, 8000.0, 0.0], (11, 1))
    vehicle, joints = on_terrain(car, world, np.zeros((1, 3))), len(car.joints)
    start = np.array([np.radians(heading), 0.0, 0.0]), np.zeros(joints), np.zeros(3 + joints - 1)
    g, _ = execute(vehicle, *start, brakes, np.full(10, 0.2), np.zeros(3))
    return float(np.linalg.norm(g[-1, 1:] - g[5, 1:]))


@pytest.mark.parametrize("name", CARS)
@pytest.mark.parametrize("slope", [0.1, 0.15, 0.2])
def test_creep_is_that_of_the_simulation(name, slope):
    car = vehsim.load_vehicle(name, {"surface": "ice"})
    along, across = crept(name, slope, 0.0), crept(name, slope, 90.0)
    assert across < along
    assert creep(car, slope) == pytest.approx(along, rel=0.12)


@pytest.mark.parametrize("name", CARS)
def test_car_stands_where_no_creep_is_seen_and_slides_beyond_its_peak(name):
    car = vehsim.load_vehicle(name, {"surface": "ice"})
    assert steepest(car) < peak(car)
    assert creep(car, steepest(car)) == pytest.approx(SEEN, rel=1e-3)
    assert crept(name, 0.3, 0.0) > 50 * SEEN  # 30 %


def test_tyres_that_never_slip_stand_anywhere():
    car = vehsim.load_vehicle("car", {"surface": "ice"})
    assert steepest(car) == peak(car) == np.inf
