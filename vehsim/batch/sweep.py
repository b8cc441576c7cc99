"""``[sweep]``: one shot file, many clips, each with its own name.

This module turns a table of keys and values into shots: listed, evenly spaced or random values, independent of their
meaning.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from vehsim.errors import Problem, ShotError
from vehsim.intake.toml import line_of, lines_of, read_toml
from vehsim.shot import Shot
from vehsim.shot.overrides import apply_overrides, assign

MAX_CLIPS = 100_000
SPECIAL = {"seeds", "combine"}
_DISTRIBUTIONS: dict[str, Callable[[Any, float, float], float]] = {
    "uniform": lambda generator, low, high: low + (high - low) * generator.random(),
    "normal": lambda generator, mean, deviation: mean + deviation * generator.normal(),
}
"""Name -> a random number from a generator of NumPy and the two numbers that a sweep gives."""
_FORMS = "a list of values, { from = 0, to = 1, count = 5 }, { uniform = [0, 1] } or { normal = [mean, deviation] }"


def load_shots(path: str | Path, overrides: Sequence[str] = ()) -> list[Shot]:
    """The shots of a shot file: one, or one for every combination of its ``[sweep]``.

    ``overrides`` are applied before the sweep. Raises ``ShotError`` with all errors of the first invalid shot.
    """
    path = Path(path)
    data, text = read_toml(path)
    lines = lines_of(text)
    apply_overrides(data, overrides)
    sweep = data.pop("sweep", None)
    folder, source = path.parent, str(path)
    if sweep is None:
        return [Shot.from_dict(data, folder, source, lines=lines)]
    try:
        _refuse_swept(sweep, overrides)
        variants = expand(sweep)
        return [Shot.from_dict(_vary(data, *variant), folder, source, lines=lines) for variant in variants]
    except ShotError as error:
        raise ShotError([_place(problem, source, lines) for problem in error.problems]) from None


def expand(sweep: Any) -> list[tuple[str, dict[str, Any]]]:
    """Every clip of a sweep: the end of its name (``wind1_seed7``), and key -> value. Raises ``ShotError``."""
    if not isinstance(sweep, Mapping) or not (set(sweep) - {"combine"}):
        raise _wrong("sweep", "nothing to sweep", f"give keys of the shot file, each with {_FORMS}", sweep)
    axes, drawn = _axes(sweep), {key: given for key, given in sweep.items() if _is_drawn(given)}
    seeds = _seeds(sweep, bool(drawn))
    combine = sweep.get("combine", "grid")
    lengths = {len(values) for values in axes.values()} | ({len(seeds)} if seeds else set())
    if combine not in ("grid", "zip"):
        raise _wrong(
            "sweep.combine", "unknown combination", 'give "grid" (every combination) or "zip" (side by side)', combine
        )
    if combine == "zip" and len(lengths) > 1:
        raise _wrong("sweep.combine", f"lists of {sorted(lengths)} values", "give lists of one length", combine)
    count = max(lengths) if combine == "zip" else math.prod(map(len, axes.values())) * len(seeds or [0])
    if count > MAX_CLIPS:
        raise _wrong("sweep", f"{count} clips", f"a sweep has at most {MAX_CLIPS}")
    labels = _labels(axes)
    columns = [[(_numbered(labels[key], i), {key: value}) for i, value in enumerate(axes[key])] for key in axes]
    columns += [[(f"seed{seed}", _draw(drawn, seed)) for seed in seeds]] if seeds else []
    rows = zip(*columns, strict=True) if combine == "zip" else product(*columns)
    return [("_".join(name for name, _ in row), {k: v for _, values in row for k, v in values.items()}) for row in rows]


def _vary(data: Mapping[str, Any], suffix: str, values: Mapping[str, Any]) -> dict[str, Any]:
    varied = copy.deepcopy(dict(data))
    for key, value in values.items():
        assign(varied, key, copy.deepcopy(value))
    header = varied.get("shot")
    if isinstance(header, dict) and isinstance(header.get("name"), str):
        header["name"] = f"{header['name']}_{suffix}"
    return varied


def _axes(sweep: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Key -> its values, for keys with listed or spaced values."""
    axes: dict[str, list[Any]] = {}
    for key, given in sweep.items():
        if key in SPECIAL or _is_drawn(given):
            continue
        values = given if isinstance(given, list) else list(_spaced(given))
        if not values:
            raise _wrong(f"sweep.{key}", "not values to sweep", f"give {_FORMS}", given)
        axes[key] = values
    return axes


def _spaced(given: Any) -> Iterator[float]:
    """``{ from, to, count }``: evenly spaced, both ends included."""
    if not isinstance(given, Mapping) or set(given) != {"from", "to", "count"}:
        return
    first, last, count = given["from"], given["to"], given["count"]
    if _is_number(first) and _is_number(last) and isinstance(count, int) and 1 <= count <= MAX_CLIPS:
        for i in range(count):
            yield first + (last - first) * i / max(count - 1, 1)


def _is_drawn(given: Any) -> bool:
    if not isinstance(given, Mapping) or len(given) != 1:
        return False
    name, pair = next(iter(given.items()))
    return name in _DISTRIBUTIONS and isinstance(pair, list) and len(pair) == 2 and all(map(_is_number, pair))


def _seeds(sweep: Mapping[str, Any], needed: bool) -> list[int]:
    """``seeds = 3`` is 0, 1, 2; or a list of them."""
    given = sweep.get("seeds", [] if not needed else None)
    seeds = list(range(given)) if isinstance(given, int) and 0 < given <= MAX_CLIPS else given
    whole = isinstance(seeds, list) and all(isinstance(s, int) and not isinstance(s, bool) and s >= 0 for s in seeds)
    if not whole or len(set(seeds)) < len(seeds) or ("seeds" in sweep and not (seeds and needed)):
        what = "missing" if given is None else "not seeds" if needed else "no key is random"
        remedy = "give the number of clips, or a list of whole numbers, and a key such as { uniform = [0, 1] }"
        raise _wrong("sweep.seeds", what, remedy, given)
    return seeds


def _draw(drawn: Mapping[str, Any], seed: int) -> dict[str, float]:
    """Random values that depend only on their key and seed, so that other keys and seeds never change them."""
    import numpy as np

    values = {}
    for key, given in drawn.items():
        name, pair = next(iter(given.items()))
        stream = int.from_bytes(hashlib.sha256(key.encode()).digest()[:8])
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, stream])))
        values[key] = float(_DISTRIBUTIONS[name](generator, *pair))
    return values


def _labels(keys: Mapping[str, Any]) -> dict[str, str]:
    """A short name for every key: its last part, or as many parts as distinguish it from the others."""
    parts = {key: ["".join(c for c in part if c.isalnum() or c == "_") for part in key.split(".")] for key in keys}

    def ending(key: str, length: int) -> str:
        return "_".join(parts[key][-length:])

    labels = {}
    for key in keys:
        length = 1
        while length < len(parts[key]) and any(ending(key, length) == ending(k, length) for k in keys if k != key):
            length += 1
        labels[key] = ending(key, length)
    return labels


def _numbered(label: str, i: int) -> str:
    return f"{label}_{i}" if label[-1:].isdigit() else f"{label}{i}"


def _refuse_swept(sweep: Any, overrides: Sequence[str]) -> None:
    for override in overrides:
        key = override.partition("=")[0].strip()
        if isinstance(sweep, Mapping) and key in sweep:
            raise _wrong(f"sweep.{key}", "both the sweep and --set give it", "keep one of them", override)


def _place(problem: Problem, source: str, lines: Mapping[str, int]) -> Problem:
    from dataclasses import replace

    return problem if problem.file else replace(problem, file=source, line=line_of(problem.key, lines))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _wrong(key: str, message: str, remedy: str, value: object = None) -> ShotError:
    return ShotError([Problem(key, message, remedy, value)])
