"""Expressions that are built once give what building them again would give."""

import casadi as ca
import numpy as np

from vehsim.lie import SE2, SO3
from vehsim.lie.once import built_once


class Law:
    built = 0

    @built_once
    def __call__(self, x, y):
        self.built += 1
        return x * y[0], ca.sumsqr(y)


def test_arguments_are_inserted_into_what_the_first_call_built():
    law, a, b = Law(), ca.SX.sym("a"), ca.SX.sym("b", 2)
    first, second = law(ca.vertcat(a, 1), b), law(np.array([3.0, 4.0]), ca.vertcat(a, 5))
    values = ca.Function("values", [a, b], [*first, *second])(2, [7, 8])
    assert [value.full().ravel().tolist() for value in values] == [[14, 7], [113], [6, 8], [29]]
    assert law.built == 1
    law(a, b)
    assert law.built == 2 and ca.SX(law(a, [5, 6])[1]).is_constant()


def test_constants_and_structural_zeros_remain():
    twist = ca.SX.sym("x", 3)
    assert SE2.hat(twist).nnz() == 6
    assert SO3.compose(ca.SX([1, 0, 0, 0]), ca.vertcat(1, twist)).nnz() == 4
    assert SO3.compose(ca.SX([1, 0, 0, 0]), ca.SX([0, 1, 0, 0])).is_constant()
