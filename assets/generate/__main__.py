"""`python -m vehsim.assets.generate [NAME...]` writes the vehicles' assets again, all of them unless named.

The same scripts on the same libraries write the same bytes.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

from vehsim.assets.generate._usd import PLAIN, triangles, write_asset

VEHICLES = ("boat", "car", "helicopter")


def main(names: list[str]) -> None:
    for name in names or VEHICLES:
        script = import_module(f"vehsim.assets.generate.{name}")
        out = Path(__file__).parents[1] / "vehicles" / name / f"{name}.usdc"
        parts = script.build()
        write_asset(out, parts, script.MATERIALS, script.DOC, getattr(script, "LIVERIES", PLAIN))
        print(f"{out.name}: {triangles(parts)} triangles, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(sys.argv[1:])
