"""A step composed of symmetric second-order substeps, as one function; this gives orders 4 and 6."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vehsim.integrators.discrete import DiscreteMechanics, keep

_SUZUKI = 1 / (4 - 4 ** (1 / 3))
_YOSHIDA = (0.78451361047755726382, 0.23557321335935813368, -1.17767998417887100695)
COMPOSITIONS: dict[int, tuple[float, ...]] = {
    2: (1.0,),
    4: (_SUZUKI, _SUZUKI, 1 - 4 * _SUZUKI, _SUZUKI, _SUZUKI),
    6: (*_YOSHIDA, 1 - 2 * sum(_YOSHIDA), *_YOSHIDA[::-1]),
}
"""Order -> fractions of a step (Suzuki; Yoshida's solution A): compositions of the symmetric second-order step."""

FAST_TOLERANCE = 1e-12
"""Largest residual of the fast solver, relative to the balanced terms: small enough for exact momentum."""

SOLVES = ("advance_fast", "advance_far", "advance")
"""Solves of a step in `DiscreteMechanics`, cheapest first."""


def whole_step(mechanics: DiscreteMechanics, order: int, solve: str = SOLVES[0]) -> ca.Function:
    """``(x, c0, c1, h, wind) -> (x1, residual)`` with ``x = (g, r, pi, z)``: all substeps of a composed step.

    ``solve``: one of `SOLVES`.
    """

    def build() -> ca.Function:
        part = _part_of_a_step(mechanics, solve)
        # composed steps call the same code again, which a processor's cache holds, rather than write it out each time
        kind: Any = ca.SX if order == 2 else ca.MX
        x, *given = (kind.sym(part.name_in(i), part.size1_in(i)) for i in range(5))
        x1, done, worst, last = x, 0.0, kind(0), COMPOSITIONS[order][-1]
        for fraction in COMPOSITIONS[order]:
            x1, residual = part(x1, *given, done, fraction, fraction / last)
            worst = ca.if_else(residual <= worst, worst, residual)  # NaN wins
            done, last = done + fraction, fraction
        return ca.Function("step", [x, *given], [x1, worst])

    return keep(mechanics, f"step{order}{solve}", build)


def _part_of_a_step(mechanics: DiscreteMechanics, solve: str) -> ca.Function:
    """``(x, c0, c1, h, wind, done, fraction, ratio) -> (x1, residual)``: a fraction of a step, after the fraction
    ``done``.

    ``ratio``: its length relative to the previous fraction, for the warm start.
    """

    def build() -> ca.Function:
        y, sizes = mechanics.symbols, mechanics.sizes[:3]
        x = ca.SX.sym("x", sum(sizes) + sizes[2])
        g, r, pi, z = ca.vertsplit(x, [0, *(int(k) for k in np.cumsum([*sizes, sizes[2]]))])
        c0, c1, h, wind = y["c0"], y["c1"], y["h"], y["wind"]
        done, fraction, ratio = (ca.SX.sym(name) for name in ("done", "fraction", "ratio"))
        a, b = c0 + done * (c1 - c0), c0 + (done + fraction) * (c1 - c0)
        knot = mechanics.knot_velocity_guess(r, pi, a)
        before = knot + ratio * (z - knot)  # half a segment back, if that segment had the length of this one
        *after, residual = getattr(mechanics, solve)(g, r, pi, before, a, b, fraction * h, wind)
        outputs = ca.cse([ca.densify(ca.vertcat(*after)), residual])
        return ca.Function("part", [x, c0, c1, h, wind, done, fraction, ratio], outputs)

    return keep(mechanics, f"part{solve}", build)
