"""Sea states: spectra of wind waves, and random waves with such a spectrum."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.world.water.shelter import Shelter
from vehsim.world.water.water import Array, Waves

LOWEST, HIGHEST = 0.6, 4.0
"""Range of the frequencies of a sea, relative to that of its peak."""
COMPONENTS = 96


def spectrum(omega: Array, height: float, period: float, peakedness: float = 3.3) -> Array:
    """JONSWAP's variance density (n,) m^2 s at ``omega`` (n,) rad/s; ``peakedness`` 1 gives that of Pierson and
    Moskowitz.

    ``height`` m is the significant wave height, four standard deviations of the surface; ``period`` s that of the peak.
    Scaled so that the used part of the spectrum has the whole variance.
    """
    peak = 2 * np.pi / period

    def shape(w: Array) -> Array:
        ratio = w / peak
        width = np.where(ratio > 1, 0.09, 0.07)
        bump = peakedness ** np.exp(-((ratio - 1) ** 2) / (2 * width**2))
        return np.asarray(ratio**-5 * np.exp(-1.25 * ratio**-4) * bump)

    w = peak * np.geomspace(LOWEST, HIGHEST, 4001)
    density = shape(w)
    total = float(np.sum(np.diff(w) * (density[1:] + density[:-1]) / 2))
    used = (omega >= w[0]) & (omega <= w[-1])
    return np.where(used, shape(np.clip(omega, w[0], w[-1])), 0.0) * (height / 4) ** 2 / total


def sea_state(
    height: float,
    period: float | None = None,
    seed: int = 0,
    *,
    heading: float = 0.0,
    peakedness: float = 3.3,
    spread: float = 0.5,
    choppiness: float = 0.0,
    components: int = COMPONENTS,
) -> Waves:
    """The waves of a sea: the same seed gives the same sea.

    ``height`` m significant; ``period`` s of the peak (None: of a fully developed sea, ``5.1 sqrt(height)``);
    ``heading`` rad from X, the direction of travel; ``spread`` rad, the standard deviation of its directions (cos^2s
    law, about 0.5 for a wind sea, 0.15 for swell, 0: long-crested). Frequencies are evenly spaced in their logarithm,
    with a random offset within their bin, so that the sea does not repeat; each has one direction (no standing
    patterns).
    """
    period = 5.1 * np.sqrt(max(height, 0.0)) if period is None else period
    good = np.isfinite([height, period, heading, peakedness, spread]).all()
    if not good or not (0 < height < 40 and 0.2 < period < 60):
        remedy = "give a significant height and a peak period, such as 0.6 m and 4 s"
        raise InputError("not a sea", remedy, key="sea", value=(height, period))
    if not (1 <= peakedness <= 20 and 0 <= spread <= 1.2 and 8 <= components <= 2048):
        remedy = "peakedness is 1 to 20, spread 0 to 1.2 rad, components 8 to 2048"
        raise InputError("out of bounds", remedy, key="sea", value=(peakedness, spread, components))
    random = np.random.default_rng(seed)
    peak = 2 * np.pi / period
    edges = peak * np.geomspace(LOWEST, HIGHEST, components + 1)
    omega = edges[:-1] + random.uniform(0.25, 0.75, components) * np.diff(edges)
    fine = np.linspace(0, 1, 17)[:, None] * np.diff(edges) + edges[:-1]
    density = spectrum(fine, height, period, peakedness)
    variance = (density[1:] + density[:-1]).sum(axis=0) / 32 * np.diff(edges)
    amplitude = np.sqrt(2 * variance)
    amplitude *= height / 4 / np.sqrt((amplitude**2).sum() / 2)
    angle = heading + _directions(components, spread, random)
    number = (omega**2 / GRAVITY)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return Waves(amplitude, number, random.uniform(0, 2 * np.pi, components), choppiness, wind_of(height, period))


def wind_of(height: float, period: float) -> float:
    """Wind (m/s, at 10 m) that raises a sea of significant ``height`` m and peak ``period`` s.

    A fully developed sea has ``H = 0.0246 U^2`` (Pierson and Moskowitz) and, in `sea_state`, ``T = 5.1 sqrt(H)``. For
    other periods, Toba's law: ``H^2 / T^3`` is proportional to the wind. So a swell needs hardly any.
    """
    return float(np.sqrt(height / 0.0246) * (5.1 * np.sqrt(height) / period) ** 3)


def _directions(count: int, spread: float, random: np.random.Generator) -> Array:
    """Angles (n,) around zero with density cos^2s(angle / 2), spread evenly over its distribution and shuffled."""
    if spread == 0:
        return np.zeros(count)
    s = max(2 / spread**2 - 1, 0.5)
    angle = np.linspace(-np.pi, np.pi, 4001)
    share = np.cumsum(np.cos(angle / 2) ** (2 * s))
    even = (np.arange(count) + random.uniform(0, 1, count)) / count
    return np.interp(random.permutation(even), share / share[-1], angle)


def together(*waves: Waves, choppiness: float, moles: Sequence[Array] = ()) -> Waves:
    """The sum of several seas or waves, sheltered by ``moles`` along lines (n, 2) m."""
    amplitude, number, phase = (
        np.concatenate([getattr(w, name) for w in waves]) for name in ("amplitude", "number", "phase")
    )
    shelter = Shelter(moles, amplitude, number) if moles else None
    return Waves(amplitude, number, phase, choppiness, max(w.wind for w in waves), shelter)
