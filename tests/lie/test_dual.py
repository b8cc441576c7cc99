"""The duals, computed without a matrix, equal the matrix's transpose, for every map on every group."""

import numpy as np
import pytest

from vehsim.lie import GROUPS, difference_map
from vehsim.lie.maps import MAPS


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("group", GROUPS.values(), ids=str)
def test_duals_are_transposes(name, group):
    tau, rng = difference_map(name, group), np.random.default_rng(4)
    for scale in (1e-9, 0.1, 2.0):
        x, covector = scale * rng.standard_normal((5, group.dim)), rng.standard_normal((5, group.dim))
        for dual, matrix in ((tau.dual, tau.C), (tau.dual_end, tau.C_end)):
            expected = np.einsum("nji,nj->ni", matrix(x), covector)
            np.testing.assert_allclose(dual(x, covector), expected, atol=1e-12)


@pytest.mark.parametrize("name", MAPS)
def test_the_map_used_for_derivatives_agrees_to_second_order(name):
    group, direction = GROUPS["SE3"], np.array([0.3, -0.5, 0.4, 1.0, 0.2, -0.7])
    tau = difference_map(name, group)
    apart = [np.abs(tau.C(s * direction) - tau.near.C(s * direction)).max() for s in (0.1, 0.05)]
    assert apart[0] < 0.01 and apart[1] <= apart[0] / 3.5
