"""Elements evaluated at all their occurrences: by machine code as by CasADi's interpreter."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim.integrators.fast import kernel
from vehsim.integrators.fast.kernel import Kernel
from vehsim.planning.problem import elements
from vehsim.planning.problem.repeated import LEAST, Repeated, long
from vehsim.world.obstacles.obstacles import box

Mark = vehsim.Mark
CASES = {
    "boat": {  # curves of its hull are looked up
        "world": vehsim.World(wind=(3.0, 4.0, 0.0)),
        "marks": [
            Mark(frame=1, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
            Mark(frame=577, position=(40, 12, 0), heading=40, velocity=(0, 0, 0)),
        ],
    },
    "helicopter": {  # the ground below its rotors is looked up
        "world": vehsim.World("hills"),
        "marks": [
            Mark(frame=1, position=(0, 0, 40), heading=0, velocity=(0, 0, 0)),
            Mark(frame=385, position=(70, 10, 45), heading=0, velocity=(0, 0, 0)),
        ],
    },
    "two_wheeled": {
        "world": vehsim.World(obstacles=[box("crate", (3.0, 0.2, 0.0), (0.5, 0.5, 1.0))]),
        "marks": [
            Mark(frame=1, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
            Mark(frame=385, position=(6, 0, 0), heading=0, velocity=(0, 0, 0)),
        ],
    },
}


@pytest.mark.parametrize("name", CASES)
def test_plans_are_the_same_to_the_last_bit(name, monkeypatch):
    """Interpreted, by machine code from the second evaluation on, and with one that is built under way."""
    plans = []
    for worth in (10**9, 1, 700):
        monkeypatch.setattr(kernel, "WORTH", worth)
        plans.append(vehsim.plan(replace(vehsim.load_vehicle(name)), **CASES[name]))
    first, *others = plans
    assert first.success
    for other in others:
        assert other.iterations == first.iterations
        for field in ("positions", "orientations", "twists", "controls"):
            np.testing.assert_array_equal(getattr(other.clip, field), getattr(first.clip, field))


def test_a_function_at_many_columns_is_that_of_casadi():
    """Also where the solver asks for one result only, and with an input that has no rows."""
    x, y, none = ca.SX.sym("x", 2), ca.SX.sym("y"), ca.SX.sym("none", 0)
    function = ca.Function("f", [x, y, none], [x * y, ca.sin(y)])
    both = Repeated(Kernel(function), 7)
    given = [ca.MX.sym("x", 2, 7), ca.MX.sym("y", 1, 7), ca.MX.sym("none", 0, 7)]
    rng = np.random.default_rng(0)
    numbers = [rng.normal(size=(2, 7)), rng.normal(size=(1, 7)), np.zeros((0, 7))]
    expected = function.map(7)(*numbers)
    for i, values in enumerate(both(*given)):
        one = ca.Function("one", given, [values])
        np.testing.assert_array_equal(one(*numbers), expected[i])
    many = 1 + LEAST // function.n_instructions()
    assert long(function, many) and not long(function, 7)
    assert not long(ca.Function("g", given, [ca.sin(given[0])]), many)


def test_two_threads_share_one_repeated_function(monkeypatch):
    """Only that one is kept: solvers cannot evaluate one that Python has deleted. The second thread asks while the
    first one builds."""
    y = ca.SX.sym("y", 2)
    element, asked = elements.Element("e", y, f=ca.sin(y[0]) * y[1]), []

    class Slow(Repeated):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            if not asked:
                asked.append(None)
                asked[0] = element.repeated(element.value, LEAST)

    monkeypatch.setattr(elements, "Repeated", Slow)
    assert element.repeated(element.value, LEAST) is asked[0]
