"""`python -m vehsim.assets.generate [NAME...]` regenerates the named vehicles' assets; default: all.

The same scripts with the same libraries write the same bytes on every CPU.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

from vehsim.assets.generate._usd import PLAIN, WHOLE, triangles, write_asset

HERE = Path(__file__).parent


def main(names: list[str]) -> None:
    for name in names or vehicles():
        script = import_module(f"vehsim.assets.generate.{name}")
        out = HERE.parent / "vehicles" / name / f"{name}.usdc"
        parts = script.build()
        variants = getattr(script, "LIVERIES", PLAIN), getattr(script, "ABSENT", WHOLE)
        write_asset(out, parts, script.MATERIALS, script.DOC, *variants)
        print(f"{out.name}: {triangles(parts)} triangles, {out.stat().st_size / 1e6:.2f} MB")


def vehicles() -> list[str]:
    """Names of the scripts that build a vehicle; those of terrains write their own files."""
    scripts = sorted(path.stem for path in HERE.glob("*.py") if not path.stem.startswith("_"))
    return [name for name in scripts if hasattr(import_module(f"vehsim.assets.generate.{name}"), "build")]


if __name__ == "__main__":
    main(sys.argv[1:])
