"""How hulls move in waves, against Capytaine on panels of other shape: largest error over the larger of 10 % and 0.02.

``python -m benchmarks.seakeeping`` reads the stored responses and coefficients of ``tests/world`` (written by
``tools/capytaine/responses.py``); ``--again`` computes the coefficients again, which needs ``pip install
'vehsim[hydro]'`` and a minute of CPU time per hull. Waves of 0.25 to 8 lengths, in head, bow and beam seas, with the
same viscous damping of roll.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "world"))


def main() -> None:
    import test_hydro as stored

    from vehsim.world.water.boundary_elements import coefficients

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hulls", nargs="*", help=f"default: all of {', '.join(stored.STORED['hulls'])}")
    parser.add_argument("--again", action="store_true", help="compute the coefficients again")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    lengths, headings = np.array(stored.STORED["lengths"]), stored.STORED["headings"]
    known = {name: stored.coefficients(name) for name in stored.HULLS}
    stored.coefficients = known.__getitem__
    print("| hull | seas | heave | roll | pitch |\n|---|---|---|---|---|")
    for name in arguments.hulls or (stored.STORED["hulls"] if arguments.again else stored.HULLS):
        if arguments.again:
            hull = stored.STORED["hulls"][name]
            body = stored.floating(stored.surface(hull), hull["mass"], hull["inertia"])
            afloat = stored.Afloat(body, stored.World(water=0.0))
            known[name] = coefficients(afloat.hull, afloat.floating()[0])
        for heading, wanted in zip(headings, stored.STORED["hulls"][name]["damped"], strict=True):
            found = np.array([stored.motions(name, heading, k) for k in range(len(lengths))])
            ratios = np.abs(found - wanted) / np.maximum(0.1 * np.array(wanted), 0.02)
            worst = zip(ratios.max(axis=0), lengths[ratios.argmax(axis=0)], strict=True)
            print(f"| {name} | {heading:.0f} | " + " | ".join(f"{r:.2f} at {x:g}" for r, x in worst) + " |", flush=True)


if __name__ == "__main__":
    main()
