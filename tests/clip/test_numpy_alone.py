"""Functions that we wrote in numpy, for a fast start, agree with scipy's."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from vehsim.cameras.path import envelope, smooth
from vehsim.clip.interpolant import monotone
from vehsim.integrators.record import _integrals, _rule

ALONE = """
import sys, vehsim
marks = [vehsim.Mark(1001, position=(0, 0, 0), heading=0), vehsim.Mark(1049, position=(8, 2, 0), heading=0)]
plan = vehsim.plan(vehsim.load_vehicle("car"), None, marks, segments=16)
plan.clip.at([0.1, 0.7])
print(plan.success, [name for name in sys.modules if name.split(".")[0] == "scipy"])
"""


def test_a_plan_needs_no_scipy(tmp_path):
    """Except for the convex hulls of a vehicle, which are cached: the very first plan computes them."""
    environment = {**os.environ, "VEHSIM_CACHE": str(tmp_path)}
    for _ in range(2):
        command = [sys.executable, "-c", ALONE]
        output = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert output.stdout.strip() == "True []", output.stdout + output.stderr


@pytest.mark.parametrize("count", [2, 3, 4, 10, 200])
@pytest.mark.parametrize("shape", [(), (3,)])
@pytest.mark.parametrize("kind", [lambda y: y, lambda y: np.cumsum(np.abs(y), axis=0), np.round])
def test_channels_are_monotone_like_pchip(count, shape, kind):
    rng = np.random.default_rng(count)
    x, y = np.cumsum(rng.uniform(0.1, 1, count)), kind(rng.normal(size=(count, *shape)))
    at = rng.uniform(x[0], x[-1], 100)
    assert np.abs(monotone(x, y, at) - PchipInterpolator(x, y)(at)).max() < 1e-11


@pytest.mark.parametrize("before", [1, 2, 5])
@pytest.mark.parametrize("after", [1, 2, 5])
def test_channels_keep_their_rate_until_a_motion_is_cut_off(before, after):
    x = np.concatenate([np.linspace(0, 1, before + 1), np.linspace(1 + 1e-4, 2, after + 1)])
    y = np.minimum(3 * x, 3.0)
    at = np.linspace(0, 2, 300)
    assert np.abs(monotone(x, y, at) - np.minimum(3 * at, 3.0)).max() < 1e-3


@pytest.mark.parametrize("count", [1, 2, 5, 100])
def test_bells_are_gaussian_filters(count):
    values = np.random.default_rng(count).normal(size=count)
    widened = maximum_filter1d(values, size=2 * int(3 * 9.6 + 0.5) + 1, mode="nearest")
    wanted = gaussian_filter1d(widened, 9.6, mode="nearest", truncate=3.0)
    assert np.abs(envelope(values, 24.0) - wanted).max() < 1e-13
    line = np.arange(count) * 0.3 + 2.0
    assert count < 100 or np.abs(smooth(line, 8.4) - line).max() < 1e-12  # runs straight on beyond its ends
    assert np.abs(smooth(np.stack([values, line], axis=1), 2.0)[:, 0] - smooth(values, 2.0)).max() < 1e-14


@pytest.mark.parametrize("count", [2, 3, 6, 40])
def test_integrals_of_polynomials_are_exact(count):
    rng = np.random.default_rng(count)
    times = np.linspace(1.0, 4.0, count) + rng.uniform(-0.2, 0.2, count) * 3 / count
    laws = [np.poly1d(rng.normal(size=min(6, count))) for _ in range(2)]
    rates = np.column_stack([law(times) for law in laws])
    wanted = np.column_stack([law.integ()(times) - law.integ()(times[0]) for law in laws])
    parts = _integrals(_rule(times, np.zeros(count - 1, bool)), rates[:, None])[:, 0]
    integrals = np.vstack([np.zeros(2), np.cumsum(parts, axis=0)])
    assert np.abs(integrals - wanted).max() < 1e-10 * (1 + np.abs(wanted).max())
