"""The asks of a pilot's targets: see `vehsim.pilots` for the content of a target."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from vehsim.requests.asks import Ask

Target = Mapping[str, Any]


def target_asks(targets: Iterable[Target], first: float, last: float, fps: float) -> list[Ask]:
    """Asks of severity ``warning`` for a clip from frame ``first`` to ``last``: a pilot may miss its targets."""

    def frame(seconds: float) -> float:
        return min(first + seconds * fps, last)

    return [_ASKS[target["kind"]](target, frame, last) for target in targets]


def _reach(target: Target, frame: Callable[[float], float], last: float) -> Ask:
    axes = [k for k, x in enumerate(target["position"]) if x is not None]
    wanted = {"position": [0.0 if x is None else x for x in target["position"]], "axes": axes}
    needs = target.get("needs")
    longer = needs is not None and frame(needs) >= last
    remedy = f"give it {needs:.1f} s" if longer else "give it more time, or less wind or speed"
    return _ask(target, "distance", last, last, wanted, upper=target["tolerance"], unit="m", remedy=remedy)


def _heading(target: Target, frame: Callable[[float], float], last: float) -> Ask:
    wanted = {"heading": target["heading"]}
    return _ask(
        target, "heading", last, last, wanted, upper=target["tolerance"], unit="rad", remedy="give it more time"
    )


def _speed(target: Target, frame: Callable[[float], float], last: float) -> Ask:
    return _ask(target, "speed", frame(target["from"]), last, {}, upper=target["upper"], unit="m/s")


def _path(target: Target, frame: Callable[[float], float], last: float) -> Ask:
    wanted = {"points": target["points"], "offset": target["offset"]}
    remedy = "drive slower, or give it wider bends"
    begin = frame(target["from"])
    return _ask(target, "off_path", begin, last, wanted, upper=target["tolerance"], unit="m", remedy=remedy)


def _amplitude(target: Target, frame: Callable[[float], float], last: float) -> Ask:
    wanted = {"joint": target["joint"]}
    period = target.get("needs_period")
    remedy = f"use a period of {period:.2f} s" if period else ""
    bounds = [target["amplitude"] * (1 + sign * target["tolerance"]) for sign in (-1, 1)]
    ends = frame(target["from"]), frame(target["until"])
    named = {**target, "key": f"{target['key']}.{target['joint']}"}
    return _ask(named, "swing", *ends, wanted, lower=bounds[0], upper=bounds[1], unit="rad", remedy=remedy)


def _ask(target: Target, measure: str, first: float, last: float, wanted: dict[str, Any], **rest: Any) -> Ask:
    return Ask(target["key"], measure, first, last, wanted, severity="warning", **rest)


_ASKS: dict[str, Callable[[Target, Callable[[float], float], float], Ask]] = {
    "reach": _reach,
    "heading": _heading,
    "speed": _speed,
    "path": _path,
    "amplitude": _amplitude,
}
"""Kind of target -> its ask."""
