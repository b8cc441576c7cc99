"""CPU time of edits that come back: ``python -m benchmarks.retouch [EXAMPLE...]`` writes ``RESULTS.retouch.md``.

Every example whose vehicle can be retouched is exported with curves. In a stage over the delivery, the last
vehicle's path is moved aside by 15 cm and more within 40 frames; `vehsim retouch` then reads the edit, solves, and
exports. The process has already retouched the same shot once; the median of three more edits counts, and nothing is
taken from a cache of solved motion.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.machine import headed
from vehsim.cli import commands as cli

EXAMPLES = Path(__file__).parents[1] / "examples"
SHOTS = (
    "boat_docking",
    "canyon_flight",
    "car_commands",
    "car_obstacles",
    "car_over_hills",
    "car_winding",
    "drift_park",
    "landing_on_mark",
    "parallel_park",
    "robot_worlds",
    "simple_car_worlds",
    "slalom_on_gravel",
    "snakeboard_to_mark",
    "snakeboard_twist",
)
"""Those whose motion follows from controls alone: not from waves or contact."""
CURVES = "export.curves={tolerance=0.001}"
SWEPT = ("robot_worlds", "simple_car_worlds")
"""Those that make ten worlds, of which the first is enough."""
EDITS, ASIDE, MORE, WIDTH = 4, 0.15, 0.03, 40
"""Number of edits; by how many m the first moves the path aside, and each one more; for how many frames."""


def main() -> None:
    rows = []
    with TemporaryDirectory(prefix="retouch-") as folder:
        os.environ["VEHSIM_CACHE"] = str(Path(folder) / "cache")  # no edit was ever solved before
        for name in sys.argv[1:] or SHOTS:
            rows.append(measured(name, Path(folder)))
            print(rows[-1], flush=True)
    table = ["| shot | duration, s | CPU time of a retouch, s | per ten seconds, s |", "|---|---|---|---|", *rows]
    about = "Every example" + (__doc__ or "").partition("Every example")[2]
    page = headed(f"# Edits back, measured\n\n{about}\n" + "\n".join([*table, ""]))
    if not sys.argv[1:]:
        Path(__file__).with_name("RESULTS.retouch.md").write_text(page, encoding="utf-8")


def measured(name: str, folder: Path) -> str:
    """The row of an example."""
    os.chdir(EXAMPLES)
    out = folder / "out" / name
    sets = ["--set", CURVES, *(("--set", "sweep.seeds=1") if name in SWEPT else ())]
    if cli.run(["export", f"{name}.toml", "--out", str(out), "--quiet", *sets]) != 0:
        return f"| {name} | not exported | | |"
    delivery = min(report.parent for report in out.glob("*/report.json"))  # the first of a sweep
    spent, duration = [], 0.0
    for k in range(EDITS):
        edit = folder / f"{name}_{k}.usda"
        duration = write_edit(delivery / f"{delivery.name}.usda", delivery.name, edit, ASIDE + k * MORE)
        start = time.process_time()
        if cli.run(["retouch", str(delivery), "--edit", str(edit), "--out", str(folder / "new"), "--quiet"]) != 0:
            return f"| {name} | {duration:.1f} | refused | |"
        spent.append(time.process_time() - start)
    cost = median(spent[1:])
    return f"| {name} | {duration:.1f} | {cost:.2f} | {10 * cost / duration:.2f} |"


def write_edit(stage: Path, shot: str, edit: Path, aside: float) -> float:
    """Write a layer over ``stage`` in which its last vehicle's path is moved to world Y by ``aside`` m around the
    middle; returns the shot's duration in s."""
    from pxr import Gf, Sdf, Usd

    layer = Sdf.Layer.CreateNew(str(edit))
    layer.subLayerPaths = [str(stage)]
    over = Usd.Stage.Open(layer)
    vehicle = over.GetPrimAtPath(f"/{shot}/vehicles").GetChildren()[-1]
    whole = Sdf.Layer.FindOrOpen(str(stage))
    first, last, rate = whole.startTimeCode, whole.endTimeCode, whole.timeCodesPerSecond
    layer.timeCodesPerSecond = layer.framesPerSecond = rate
    vehicle.GetVariantSets().SetSelection("motion", "exact")
    track = vehicle.GetAttribute("xformOp:translate")
    places = {frame: track.Get(frame) for frame in np.arange(first, last + 1)}
    for frame, place in places.items():
        share = np.clip((frame - (first + last) / 2) / WIDTH + 0.5, 0, 1)
        track.Set(place + Gf.Vec3d(0, aside * float(16 * share**2 * (1 - share) ** 2) ** 1.5, 0), frame)
    layer.Save()
    return float((last - first) / rate)


if __name__ == "__main__":
    main()
