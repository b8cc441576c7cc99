"""What continues a simulated clip, as a text and numbers: plain data, and instances of permitted classes.

Reading makes nothing else, so a file cannot execute code.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

Arrays = Mapping[str, NDArray[Any]]

STRUCTURE, NUMBERS = "structure", "numbers"
"""The text, JSON in UTF-8, and the numbers (m,) of its arrays and floats, in the order of the text."""
SEQUENCES: dict[str, type] = {"list": list, "tuple": tuple}
FLOATS: dict[str, type] = {"float": float, "number": np.float64}
"""Both are kept apart: Python and NumPy may round powers differently."""


def encoded(value: Any, classes: Collection[str]) -> dict[str, NDArray[Any]]:
    """``value`` as arrays: numbers, texts, arrays, None, lists, tuples, dictionaries, and instances of ``classes``,
    each "module:name", by their attributes. `decoded` gives the same bits. Raises ``TypeError`` for anything else."""
    numbers: list[NDArray[np.float64]] = []
    structure = _structure(value, classes, numbers)
    flat = np.concatenate([np.zeros(0), *numbers])
    text = json.dumps(structure, separators=(",", ":")).encode()
    return {STRUCTURE: np.frombuffer(text, np.uint8), NUMBERS: flat}


def _structure(value: Any, classes: Collection[str], numbers: list[NDArray[np.float64]]) -> dict[str, Any]:
    """``value`` without its floats, which are appended to ``numbers``."""
    kind = type(value)
    if value is None or kind in (bool, int, str):
        return {"is": value}
    if isinstance(value, np.bool_ | np.integer):
        return {"is": value.item()}
    for name, floats in FLOATS.items():
        if kind is floats:
            numbers.append(np.array([value]))
            return {"one": name}
    if kind is np.ndarray and value.dtype.kind in "biufc":
        order = "C" if value.flags.c_contiguous or not value.flags.f_contiguous else "F"
        flat = value.ravel(order)
        numbers.append(flat.view(np.float64) if flat.dtype == np.complex128 else flat.astype(np.float64))
        return {"array": list(value.shape), "type": value.dtype.str, "order": order}
    if kind in SEQUENCES.values():
        name = next(name for name, sequence in SEQUENCES.items() if sequence is kind)
        before = len(numbers)
        items = [_structure(item, classes, numbers) for item in value]
        if len(items) > 1 and len(numbers) > before and all(item == items[0] for item in items):
            return {name: items[0], "times": len(items)}
        return {name: items}
    if kind is dict:
        pairs = [[_structure(part, classes, numbers) for part in pair] for pair in value.items()]
        return {"dict": pairs}
    place = f"{kind.__module__}:{kind.__qualname__}"
    if place in classes:
        attributes = {name: _structure(part, classes, numbers) for name, part in vars(value).items()}
        return {"class": place, "with": attributes}
    raise TypeError(f"{place} cannot be stored: attributes named in CARRIED hold plain data only")


def decoded(arrays: Arrays, classes: Collection[str]) -> Any:
    """The value that `encoded` was given. Raises ``InputError`` for arrays that it did not write."""
    try:
        reader = _Reader(np.asarray(arrays[NUMBERS], np.float64), classes)
        value = reader.value(json.loads(arrays[STRUCTURE].tobytes()))
        if reader.at != len(reader.numbers):
            raise ValueError(f"{len(reader.numbers) - reader.at} numbers too many")
    except Exception as error:  # whatever a foreign structure raises
        message = f"what would continue it cannot be read: {error}"
        raise InputError(message, "simulate and save it again", key="clip") from None
    return value


class _Reader:
    """Takes the ``numbers`` (m,) one structure after another; ``at``: how many are taken."""

    def __init__(self, numbers: NDArray[np.float64], classes: Collection[str]) -> None:
        self.numbers, self.at, self._classes = numbers, 0, classes

    def value(self, structure: Any) -> Any:
        if "is" in structure:
            return structure["is"]
        if "one" in structure:
            return FLOATS[structure["one"]](self._take(1)[0])
        if "array" in structure:
            return self._array(structure["array"], np.dtype(structure["type"]), structure["order"])
        for name, sequence in SEQUENCES.items():
            if name in structure:
                return sequence(self._items(structure[name], structure.get("times")))
        if "dict" in structure:
            return {self.value(key): self.value(value) for key, value in structure["dict"]}
        place = structure["class"]
        if place not in self._classes:
            raise ValueError(f"{place} is not permitted")
        module, _, name = place.partition(":")
        kind = getattr(import_module(module), name)
        new = kind.__new__(kind)
        vars(new).update({name: self.value(part) for name, part in structure["with"].items()})
        return new

    def _items(self, structure: Any, times: int | None) -> Iterator[Any]:
        if times is None:
            yield from map(self.value, structure)
            return
        for _ in range(times):
            before = self.at
            yield self.value(structure)
            if self.at == before:  # a short text could otherwise fill the memory
                raise ValueError("repeated without numbers")

    def _array(self, shape: list[int], dtype: np.dtype[Any], order: Any) -> NDArray[Any]:
        if dtype.kind not in "biufc" or min(shape, default=0) < 0:
            raise ValueError(f"an array of {dtype} of the shape {shape}")
        flat = self._take(int(np.prod(shape, dtype=object)) * (2 if dtype == np.complex128 else 1))
        flat = flat.view(dtype) if dtype == np.complex128 else flat.astype(dtype)
        return np.array(flat.reshape(shape, order=order), order=order)

    def _take(self, count: int) -> NDArray[np.float64]:
        part = self.numbers[self.at : self.at + count]
        if len(part) != count:
            raise ValueError("numbers are missing")
        self.at += count
        return part
