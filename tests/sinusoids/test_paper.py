"""The paper's figures: one net motion from several inputs (Fig. 6), Lissajous figures stage by stage (Fig. 4)."""

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from PIL import Image
from scipy.integrate import solve_ivp

from vehsim.errors import SolveError
from vehsim.sinusoids import models
from vehsim.sinusoids.algebra.feedback import car_triangular, hopper_chained
from vehsim.sinusoids.canonical.fourier import steer_triangular
from vehsim.sinusoids.canonical.optimal import extremal
from vehsim.sinusoids.manoeuvres.families import bodies, boxes, choose, clearance, discs, family, outline
from vehsim.sinusoids.manoeuvres.picture import paint, portraits

FIG_4 = [-5.0, 1.0, 0.05, 1.0], [0.0, 0.5, 0.0, 0.0]
"""x, y, theta, phi; wheelbase 4, because the paper's constant first stage leaves the chart below 3.24."""


def turns(line):
    """Turning number of a closed curve (k, 2): the total rotation of its tangent divided by 2 pi."""
    tangent = np.diff(line, axis=0)
    angle = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return (angle[-1] - angle[0]) / (2 * np.pi)


@pytest.fixture(scope="module")
def stages():
    steering = steer_triangular(car_triangular(4.0), *FIG_4)
    cuts = np.searchsorted(steering.times, steering.knots - 1e-12)
    return steering, [steering.states[a : b + 1] for a, b in pairwise(cuts)]


def test_fig_4_has_three_stages_each_moving_what_the_paper_says(stages):
    """A: x and phi to their goals; B: theta alone; C: y alone."""
    steering, (a, b, c) = stages
    x, y, theta, phi = range(4)
    assert [s.label for s in steering.stages] == ["straight", "alpha", "y"]
    assert a[-1][[x, phi]] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert b[-1][[x, theta, phi]] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9) and abs(b[0][theta]) > 0.01
    assert c[-1] == pytest.approx(FIG_4[1], abs=1e-9) and abs(c[0][y] - c[-1][y]) > 0.05


def test_fig_4_lissajous_figures(stages):
    """Over x, the steering makes one loop in B and in C an eight of equal lobes that turn opposite ways; theta a loop
    there."""
    _, (_, b, c) = stages
    x, _, theta, phi = range(4)
    assert abs(turns(b[:, [x, phi]])) == pytest.approx(1.0, abs=0.05)
    assert turns(c[:, [x, phi]]) == pytest.approx(0.0, abs=0.05)
    middle, step = (c[1:] + c[:-1]) / 2, np.diff(c[:, x])
    far = middle[:, x] > c[:, x].mean()
    lobes = [np.sum((middle[:, phi] * step)[side]) for side in (far, ~far)]
    assert abs(lobes[0]) > 0.01 and lobes[0] == pytest.approx(-lobes[1], rel=0.02)
    assert abs(turns(c[:, [x, theta]])) == pytest.approx(0.5, abs=0.05)  # one loop, pointed where it begins


def test_fig_6_three_parks_share_their_net_motion(tmp_path):
    """Wide, narrow with five cycles, and cosines: all three move by (0, -3.37) m; the printed cosine pair does not."""
    change, start, goal = car_triangular(1.0), [0.0, 0.0, 0.0, 0.0], [0.0, -3.368, 0.0, 0.0]
    parks = [
        *family(change, start, goal, amplitudes=(2.5,), cycles=(1,), phases=(0.0,)),
        *family(change, start, goal, amplitudes=(1.1,), cycles=(5,), phases=(0.0,)),
        *family(change, start, goal, amplitudes=(2.4,), cycles=(1,), phases=(np.pi / 2,)),
    ]
    assert len(parks) == 3 and all(p.end_error < 1e-9 for p in parks)
    wide, narrow, cosine = (np.ptp(p.states[:, 0]) for p in parks)
    assert narrow < wide / 2 and cosine != pytest.approx(wide, rel=0.02)
    efforts = [p.effort for p in parks]
    assert len({round(e, 3) for e in efforts}) == 3
    path = paint(parks, tmp_path / "parks.png", footprints=[outline(1.6, 0.8, 0.3)])
    with Image.open(path) as picture:
        assert picture.size == (1920, 400)
    x, y = (corners := outline(1.6, 0.8, 0.3)).T  # in order round it, once: its area by the shoelace formula
    assert (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 == pytest.approx(1.6 * 0.8)
    assert len(np.unique(corners.round(9), axis=0)) == len(corners)
    assert bodies(parks[0])[-1, 0] == pytest.approx([0.0, -3.368, 0.0], abs=1e-9)
    # a kerb in the path of the wide one: of those that clear it, choose the one with the least effort
    kerb, hulls = boxes([(5.5, -1.0, 0.0, 0.5, 6.0)]), [corners]
    rooms = [clearance(park, kerb, hulls) for park in parks]
    assert min(rooms) < 0.0 < max(rooms)
    free = [park for park, room in zip(parks, rooms, strict=True) if room > 0.1]
    assert choose(parks, kerb, hulls) is min(free, key=lambda park: park.effort)
    with pytest.raises(SolveError, match="none of 3 manoeuvres keeps"):
        choose(parks, discs([(0.0, -3.368, 1.0)]), hulls)


def test_the_papers_printed_inputs_integrated_unchanged():
    """The sines move a car of wheelbase 1 by (0, -3.368) and (0, -3.372), the cosines by (1.58, -2.52)."""
    system = models.car(1.0)
    field = ca.Function("f", [system.x, u := ca.SX.sym("u", 2)], [system.G @ u])

    def moved(v1, v2, cycles):
        def rate(t, q):
            return np.ravel(np.asarray(field(q, [v1(t), v2(t)])))

        end = solve_ivp(rate, (0, 2 * np.pi * cycles), np.zeros(4), method="DOP853", rtol=1e-10, atol=1e-12)
        return end.y[:2, -1]

    sin, cos = np.sin, np.cos
    assert moved(lambda t: 2.5 * sin(t), lambda t: -0.75 * cos(2 * t), 1) == pytest.approx([0, -3.368], abs=1e-3)
    assert moved(lambda t: 1.1 * sin(t), lambda t: -0.75 * cos(2 * t), 5) == pytest.approx([0, -3.372], abs=1e-3)
    assert moved(lambda t: 2.4 * cos(t), lambda t: 0.71 * cos(2 * t), 1) == pytest.approx([1.58, -2.52], abs=5e-3)


def test_hopper_turns_by_the_area_its_leg_sweeps(tmp_path):
    """Figs. 1 and 2: leg and length return, and the body has turned by the area that their loop encloses (Stokes)."""
    system = models.hopper()
    steering = steer_triangular(system, [0.0, 0.0, 0.0], [0.0, 0.0, 0.3])
    psi, reach, theta = steering.states.T
    assert np.abs(steering.states[-1] - [0, 0, 0.3]).max() < 1e-9
    share = -0.5 * (1 + reach) ** 2 / (1 + 0.5 * (1 + reach) ** 2)
    assert np.trapezoid(share, psi) == pytest.approx(theta[-1] - theta[0], rel=5e-3)
    assert hopper_chained().check() is not None
    path = portraits(steering, [("psi", "l"), ("psi", "theta")], tmp_path / "hopper.png")
    with Image.open(path) as picture:
        assert picture.size == (960, 720)


def test_brocketts_optimum_is_dido():
    """Net area alone: a circle of circumference sqrt(4 pi A), effort 4 pi A; with two planes the larger turns once."""
    for area in (0.3, 2.0):
        a, u0 = extremal(np.zeros(2), np.array([[0.0, area], [-area, 0.0]]))
        assert u0 @ u0 == pytest.approx(4 * np.pi * area, rel=1e-9)
        assert abs(a[0, 1]) == pytest.approx(2 * np.pi, rel=1e-9)
    areas = np.zeros((4, 4))
    areas[0, 1], areas[2, 3] = 1.0, 0.25
    _, u0 = extremal(np.zeros(4), areas - areas.T)
    assert u0 @ u0 == pytest.approx(4 * np.pi * (1.0 + 2 * 0.25), rel=1e-9)
