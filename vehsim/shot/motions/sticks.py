"""``method = "sticks"``: a vehicle simulated under recorded controls, such as those of a person at the sticks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from vehsim.errors import InputError, Problem
from vehsim.intake.columns import read_columns
from vehsim.runtime.files import write_file
from vehsim.shot.checks import Context, did_you_mean
from vehsim.shot.motions.simulate import ForwardMotion, Values, linear
from vehsim.shot.schema.tables import Text

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle

FRAME, CONTROL, COMMAND = "frame", "control.", "command."
"""The column of frames, and the prefixes of a control's column: as the csv exporter writes them. If a table has both
columns, as that of a simulated motion has, the command is read."""
SLACK = 1e-9
"""By how much a recorded value may exceed a control's bounds: that of a rounded decimal."""


class SticksMotion(ForwardMotion):
    """``method = "sticks"``: forward simulation under recorded controls."""

    everywhere: ClassVar[bool] = True
    method: Literal["sticks"]
    """plan, simulate, sticks, integrate, sinusoid or clip"""
    file: Text
    """a CSV table, relative to the shot file, with a column frame and columns such as control.throttle [N]"""

    def seconds(self, context: Context) -> float:
        if context.last is not None:
            return context.seconds(context.last)
        try:
            return max(context.seconds(float(self._table(context)[FRAME][-1])), 0.0)
        except InputError:  # `check_controls` reports it
            return 0.0

    def check_controls(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        try:
            table = self._table(context)
        except InputError as error:
            yield error.problem.seen_from("file", self.file)
            return
        frames = table[FRAME]
        late = np.flatnonzero(np.diff(frames) <= 0)
        if len(late):
            message = f"row {late[0] + 2}: frame {frames[late[0] + 1]:g} is not after the one before it"
            yield Problem("file", message, "put the rows in order", self.file)
        elif context.last is None and frames[-1] <= context.first:
            message = f"ends at frame {frames[-1]:g}, where the shot starts"
            yield Problem("file", message, "give later frames, or shot.start_frame", self.file)
        units = {control.name: control.unit for control in vehicle.controls}
        for column, (name, unit) in _controls_of(table).items():
            if name not in units:
                yield Problem("file", f"column {column!r}: no such control", did_you_mean(name, units), self.file)
                continue
            if unit is not None and unit != units[name]:
                remedy = f"give {units[name] or 'a number without a unit'}"
                yield Problem("file", f"column {column!r}: the unit is not that of {vehicle.name}", remedy, self.file)
            control = vehicle.controls[vehicle.control_names.index(name)]
            slack = SLACK * max(1.0, control.upper - control.lower) if np.isfinite(control.upper - control.lower) else 0
            values = table[column]
            beyond = np.flatnonzero((values < control.lower - slack) | (values > control.upper + slack))
            if len(beyond):
                message = (
                    f"row {beyond[0] + 1}, column {column!r}: {values[beyond[0]]:g} is beyond the vehicle's bounds"
                )
                remedy = f"this vehicle takes {control.lower:g} to {control.upper:g} {control.unit}".rstrip()
                yield Problem("file", message, remedy, self.file)
        if not _controls_of(table) and vehicle.controls:
            remedy = f"add columns such as {CONTROL}{vehicle.control_names[0]}"
            yield Problem("file", "no column of a control", remedy, self.file)

    def controls(self, vehicle: Vehicle, context: Context) -> Any:
        table = self._table(context)
        times = (table[FRAME] - context.first) / float(context.fps)
        columns = {name: table[column] for column, (name, _) in _controls_of(table).items()}
        rest = np.zeros(len(times))
        bounds = [(control.name, control.lower, control.upper) for control in vehicle.controls]
        return linear(
            [(times, np.clip(columns[name], low, high) if name in columns else rest) for name, low, high in bounds]
        )

    def _table(self, context: Context) -> dict[str, Values]:
        """The columns by their names. Raises ``InputError``."""
        return read_columns(context.folder / self.file, "file", FRAME)


def write_sticks(path: Path, vehicle: Vehicle, frames: Values, controls: Values) -> None:
    """Write the table of controls (n, c) at ``frames`` (n,), which reads back to the last bit.

    Rows between equal rows are left out: values are linear between rows.
    """
    kept = np.ones(len(frames), bool)
    same = (controls[1:] == controls[:-1]).all(axis=1)
    kept[1:-1] = ~(same[:-1] & same[1:])
    columns = [f"{CONTROL}{c.name}{f' [{c.unit}]' if c.unit else ''}" for c in vehicle.controls]
    rows = np.column_stack([frames, controls])[kept].tolist()
    lines = [",".join([FRAME, *columns]), *(",".join(map(repr, row)) for row in rows)]
    write_file(path, "\n".join([*lines, ""]))


def _controls_of(table: dict[str, Values]) -> dict[str, tuple[str, str | None]]:
    """Column -> its control, and the unit in its name; other columns, such as poses, are results and not read."""
    found = {}
    for prefix in (CONTROL, COMMAND):
        for column in table:
            if match := re.fullmatch(rf"{re.escape(prefix)}(.*?)(?: \[(.*)\])?", column):
                found[match[1]] = (column, match[2])
    return {column: (name, unit) for name, (column, unit) in found.items()}
