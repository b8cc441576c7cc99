"""The integrators compared with their peers: LIE Figs. 3, 4 and 5, long runs, and speed against MuJoCo.

``python -m benchmarks.integrators [PART ...] [--quick] [--fresh]`` writes ``RESULTS.md`` and figures beside this file.
Parts are ``bodies``, ``cars``, ``orbits``, ``long``, ``speed``. Finished parts are stored in
``build/bench-integrators``, so that an interrupted run continues where it stopped; a named part is measured again.
``--quick`` takes a tenth of everything, ``--fresh`` ignores stored parts.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import bodies, cars, speed
from benchmarks._figures import loglog
from benchmarks.machine import heading

HERE = Path(__file__).parent
QUICK = "--quick" in sys.argv
KEPT = HERE.parent / "build" / ("bench-integrators-quick" if QUICK else "bench-integrators")
PARTS: dict[str, Callable[[], dict[str, Any]]] = {
    "bodies": lambda: bodies.free_bodies(*((0.4, 3) if QUICK else (4.0, 20))),
    "cars": lambda: cars.cars(5 if QUICK else 50),
    "orbits": lambda: bodies.orbits(0.4 if QUICK else 4.0),
    "long": lambda: bodies.long_runs(100_000 if QUICK else 1_000_000),
    "speed": lambda: speed.speed(),
}


DROPPED = """## Tried and dropped

- `cay` as the default map: the least accurate of the symmetric ones in rotations (the tables above).
- SE(3) for flight: its steps couple rotation and translation, and cost two to four times those of SO(3)xR3.
- Composition as the way to fourth order of a free body: five stages where `tln4` and `tln6` have one, and an explicit
  splitting beats RK4 (`RESULTS.order.md`).""".splitlines()


def main() -> None:
    requested = [word for word in sys.argv[1:] if not word.startswith("--")]
    KEPT.mkdir(parents=True, exist_ok=True)
    results = {}
    for name, measure in PARTS.items():
        file = KEPT / f"{name}.json"
        if name in requested or "--fresh" in sys.argv or not file.is_file():
            loads, begin = [os.getloadavg()[0]], time.perf_counter()
            result = measure()
            loads.append(os.getloadavg()[0])
            took = {"seconds": time.perf_counter() - begin, "loads": loads, "cores": os.cpu_count(), "on": heading()}
            file.with_suffix(".tmp").write_text(json.dumps({"result": result, "took": took}), encoding="utf-8")
            file.with_suffix(".tmp").replace(file)
        results[name] = json.loads(file.read_text(encoding="utf-8"))
    figures(results["bodies"]["result"], results["cars"]["result"])
    path = HERE / ("RESULTS.quick.md" if QUICK else "RESULTS.md")
    path.write_text("\n".join(report(results)) + "\n", encoding="utf-8")
    print(f"wrote {path}")


def report(results: dict[str, Any]) -> list[str]:
    body, car, orbit, long, fast = (results[name]["result"] for name in PARTS)
    lines = ["# Integrators, measured", ""]
    lines += [
        "`make bench-integrators`. Run times are CPU times of one thread; the load is that of the whole machine.",
        "",
    ]
    took = [
        [name, f"{r['took']['seconds']:.0f} s", *(f"{x:.1f}" for x in r["took"]["loads"])]
        for name, r in results.items()
    ]
    lines += [*results["speed"]["took"].get("on", []), "## The claims of LIE 3.3", ""]
    lines += table(["claim", "held", "measured"], claims(body, car))
    lines += ["", "## When the parts were measured", ""]
    lines += table(["part", "took", "load before", "load after"], took)
    lines += ["", "## Speed compared with MuJoCo, and the targets", "", *_speed(fast, results["speed"]["took"])]
    lines += ["", f"## Free rigid body, {body['minutes']:g} minutes, {body['count']} random bodies (LIE Fig. 4)"]
    for i, (what, unit) in enumerate((("position error", "m"), ("rotation error", "rad"))):
        lines += ["", f"### {what} [{unit}], mean; in brackets blow-ups of {body['count']}", ""]
        rows = [[name, *(_cell(v[i], v[3]) for v in row.values())] for name, row in body["table"].items()]
        lines += table(["method", *(f"h = {h}" for h in bodies.STEPS)], rows)
    lines += ["", "### Microseconds per step at h = 1/64", ""]
    rows = [[name, *(f"{t * 1e6:.2f}" for t in times)] for name, times in body["steps"].items()]
    lines += table(["method", "interpreted", "machine code"], rows)
    lines += ["", "![](figures/body_position.svg) ![](figures/body_rotation.svg)"]
    lines += ["![](figures/body_position_cost.svg) ![](figures/body_rotation_cost.svg)", ""]
    lines += [f"## Car, one minute, {car['runs']} random runs (LIE Fig. 5)", ""]
    lines += ["Position error [m]; microseconds per step interpreted / as machine code.", ""]
    rows = [
        [name, *(f"{e:.1e}; {t * 1e6:.2f} / {b * 1e6:.2f}" for e, t, b in row.values())]
        for name, row in car["table"].items()
    ]
    lines += table(["method", *(f"h = {h}" for h in cars.STEPS)], rows)
    lines += ["", "![](figures/car_position.svg) ![](figures/car_position_cost.svg)", "", "## Orbits (LIE Fig. 3)", ""]
    lines += [
        f"One body at h = 0.5 s for {orbit['minutes']:g} minutes: rotational energy and spin angular momentum "
        "|J omega| at the end, divided by those at the start.",
        "On SE(3), the conserved quantity is the total angular momentum about the world's origin, which includes that "
        "of the translation (below).",
        "",
    ]
    ends = [[n, *(f"{x:.3f}" for x in v)] if v else [n, "blow-up", "blow-up"] for n, v in orbit["ends"].items()]
    lines += table(["method", "energy", "angular momentum"], ends)
    lines += ["", f"## {long['steps']:,} steps of 0.02 s", "", "Relative; momentum at the knots.", ""]
    rows = [[name, *(f"{x:.1e}" for x in row)] for name, row in long["rows"].items()]
    lines += table(
        ["method", "energy oscillation (peak to peak)", "energy drift (linear fit)", "angular momentum drift"], rows
    )
    return [*lines, "", *DROPPED]


def claims(body: dict[str, Any], car: dict[str, Any]) -> list[list[str]]:
    """Every claim of LIE 3.3: whether it holds, and the measurement."""
    rows, times, coarse = body["table"], body["steps"], str(bodies.STEPS[0])
    lost = {name: sum(v[3] for v in row.values()) for name, row in rows.items()}
    newmark, ours = rows["Lie-Newmark"]["0.125"][0], rows["TLN"]["0.125"][0]
    fine = str(cars.STEPS[-1])
    errors = {name: row[fine][0] for name, row in car["table"].items()}
    per_step = {name: row[fine][1:] for name, row in car["table"].items()}
    turned = [rows[name][coarse][1] for name in ("TLN", "RK4")]
    made = [
        (
            "no blow-up where RK methods fail",
            lost["TLN"] == lost["exp"] == lost["cay"] == 0 < lost["RK4"],
            f"runs that blew up, all step sizes together: exp, cay, TLN {lost['exp']}, {lost['cay']}, {lost['TLN']}; "
            f"RK4 {lost['RK4']}, RK2 {lost['RK2']}, Lie-Newmark {lost['Lie-Newmark']}. "
            "RK4 does not fail here: it loses energy instead",
        ),
        (
            "at a large step, rotations stay near the true ones where those of RK4 do not",
            turned[0] < turned[1],
            f"h = {coarse}: TLN {turned[0]:.2g} rad, RK4 {turned[1]:.2g} rad",
        ),
        *_efficiency(times),
        (
            "one Newton iteration at small steps",
            body["newton"]["0.0010"] < 1e-6,
            "relative residual after one: "
            + ", ".join(f"h = {h} s: {worst:.0e}" for h, worst in body["newton"].items()),
        ),
        (
            "Newmark's position error is larger",
            newmark > ours,
            f"h = 0.125: Lie-Newmark {newmark:.2g} m, TLN {ours:.2g} m",
        ),
        (
            "the car at RK2's accuracy",
            min(errors["TLN"], errors["exp"]) <= 1.2 * errors["RK2"],
            f"h = {fine}: exp {errors['exp']:.2g} m, TLN {errors['TLN']:.2g} m, RK2 {errors['RK2']:.2g} m",
        ),
        *(
            (
                f"... for half its time, {how}",
                per_step["TLN"][i] <= 0.6 * per_step["RK2"][i],
                f"TLN {per_step['TLN'][i] * 1e6:.2f}, exp {per_step['exp'][i] * 1e6:.2f}, "
                f"RK2 {per_step['RK2'][i] * 1e6:.2f} us per step",
            )
            for i, how in enumerate(("interpreted", "machine code"))
        ),
        *_order_four(body),
    ]
    return [[claim, "yes" if held else "no", measured] for claim, held, measured in made]


def _efficiency(times: dict[str, list[float]]) -> list[tuple[str, bool, str]]:
    return [
        (
            f"about twice RK4's efficiency: a step's time at h = 1/64, {how}",
            times["TLN"][i] * 1.5 < times["RK4"][i],
            ", ".join(f"{name} {times[name][i] * 1e6:.2f}" for name in ("exp", "cay", "TLN", "RK4")) + " us",
        )
        for i, how in enumerate(("interpreted", "machine code"))
    ]


def _order_four(body: dict[str, Any]) -> list[tuple[str, bool, str]]:
    """Run times at an error of 1e-3, interpolated on the log-log lines, interpreted."""
    made = []
    for i, what in enumerate(("a position error of 1e-3 m", "a rotation error of 1e-3 rad")):
        ours = {n: _time_at_error(body, n, i) for n in ("order 4", "order 4 TLN", "SO(3)xR3 order 4")}
        rk4 = _time_at_error(body, "RK4", i)
        words = ", ".join(f"{name} {t * 1e3:.1f} ms" for name, t in ours.items())
        made.append(
            (
                f"(ours) order 4 reaches {what} in less time than RK4",
                min(ours.values()) < rk4,
                f"{words}; RK4 {rk4 * 1e3:.1f} ms",
            )
        )
    return made


def _time_at_error(body: dict[str, Any], name: str, i: int, error: float = 1e-3) -> float:
    """Run time s at which a method reaches an error; its smallest run time if all errors are smaller."""
    seconds = body["minutes"] * 60
    points = [(v[i], v[2] * seconds / float(h)) for h, v in body["table"][name].items() if v[i] is not None]
    return float(np.exp(np.interp(np.log(error), *np.log(np.array(sorted(points)).T)))) if points else np.inf


def _speed(fast: dict[str, Any], took: dict[str, Any]) -> list[str]:
    rows, euler, rk4 = fast["rows"], fast["rows"]["MuJoCo Euler"], fast["rows"]["MuJoCo RK4"]
    cells = [[name, *("" if t is None else f"{t * 1e6:.2f}" for t in row)] for name, row in rows.items()]
    lines = ["Microseconds per step, best of 15.", ""]
    lines += table(
        [
            "",
            "step in place (`Stepper.step`, `mj_step`)",
            "step from state to state (`Integrator.step`)",
            "rollout of 10,000 steps, with its clip",
            "its stepping loop alone",
        ],
        cells,
    )
    targets = [
        (f"a call of `step` at most {most} times `mj_step` ({name})", rows[name][1] / euler[0], most)
        for name, most in (("helicopter", 4), ("car", 2))
    ]
    targets += [
        (f"rollout at most MuJoCo's RK4 rollout ({name})", rows[name][2] / rk4[3], 1) for name in ("helicopter", "car")
    ]
    targets += [
        (f"with a compiler at most its Euler rollout ({name})", rows[f"{name}, machine code"][2] / euler[3], 1)
        for name in fast["gains"]
    ]
    lines += [
        "",
        *table(["target", "held", "ratio"], [[w, "yes" if x <= most else "no", f"{x:.2f}"] for w, x, most in targets]),
    ]
    for name, (one, two) in fast["gains"].items():
        held = "yes" if one / two >= 1.7 else "no"
        lines += [
            "",
            f"1,000 vehicles in parallel ({name}, machine code, wall time): {one * 1e6:.3f} us per step on one ",
        ]
        lines[-1] += f"thread, {two * 1e6:.3f} on two: gain {one / two:.2f} (target 1.7: {held})."
        if took["loads"][0] > 0.5:
            lines[-1] += (
                f" The machine was busy (load {took['loads'][0]:.1f} on {took['cores']} cores), so this proves nothing."
            )
    return lines


def figures(body: dict[str, Any], car: dict[str, Any]) -> None:
    folder, seconds = HERE / "figures", body["minutes"] * 60
    for i, (what, unit) in enumerate((("position", "m"), ("rotation", "rad"))):
        rows = {n: [(float(h), v) for h, v in row.items() if v[i] is not None] for n, row in body["table"].items()}
        title = f"Free body, {body['minutes']:g} min: {what} error"
        lines = {n: [(h, v[i]) for h, v in row] for n, row in rows.items()}
        loglog(folder / f"body_{what}.svg", title, "step [s]", unit, lines)
        lines = {n: [(v[2] * seconds / h * 1e3, v[i]) for h, v in row] for n, row in rows.items()}
        loglog(folder / f"body_{what}_cost.svg", f"{title} against run time", "run time [ms], interpreted", unit, lines)
    lines = {n: [(float(h), v[0]) for h, v in row.items()] for n, row in car["table"].items()}
    loglog(folder / "car_position.svg", "Car, one minute: position error", "step [s]", "m", lines)
    lines = {n: [(v[1] * 60 / float(h) * 1e3, v[0]) for h, v in row.items()] for n, row in car["table"].items()}
    loglog(
        folder / "car_position_cost.svg",
        "Car: position error against run time",
        "run time [ms], interpreted",
        "m",
        lines,
    )


def _cell(value: float | None, lost: int) -> str:
    words = "-" if value is None else f"{value:.1e}"
    return f"{words} ({lost})" if lost else words


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines]


if __name__ == "__main__":
    main()
