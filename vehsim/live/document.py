"""A shot file that is edited: its text with comments and order, undo and redo, saving and autosaving.

Every state is a whole text, so that undo restores it to the byte. The autosave is a file beside the shot; it is removed
when the shot is saved, and continues an interrupted session when the shot is opened again.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehsim.errors import InputError
from vehsim.intake.toml import read_toml
from vehsim.live.settings import KEY
from vehsim.runtime.files import replacing_file

AUTOSAVE = ".autosave"
"""Suffix of the autosave of ``shot.toml``: ``shot.toml.autosave``."""

GLUED = re.compile(r"^([ \t]*[^#\[\s].*\n)(?=[ \t]*\[{1,2}[^\[\],\n]+\]{1,2}[ \t]*(#.*)?\r?$)", re.MULTILINE)
"""A line of a table that the header of the next table follows without an empty line."""


class Document:
    """The text of a shot file and its history. Raises ``InputError`` if the file cannot be read as TOML."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._saved = [read_toml(path)[1]]
        """The text of the file when it was opened, then those that were saved."""
        self._texts = list(self._saved)
        self._at = 0
        self.tables = 0
        """It grows when tables are added to a list or removed, because keys with an index then name others."""
        self.recovered = False
        """Whether it continues an interrupted session."""
        self.unkept = ""
        """Why the present text is not in the autosave, such as a full disk; empty if it is."""
        if self.autosave.is_file():
            _, text = read_toml(self.autosave)
            self.recovered = text != self._saved[-1]
            self._texts += [text] * self.recovered
            self._at = len(self._texts) - 1

    @property
    def autosave(self) -> Path:
        return self.path.with_name(self.path.name + AUTOSAVE)

    @property
    def text(self) -> str:
        return self._texts[self._at]

    @property
    def data(self) -> dict[str, Any]:
        """The text as plain data."""
        return tomllib.loads(self.text)

    @property
    def changed(self) -> bool:
        """Whether it differs from the file."""
        return self.text != self._saved[-1]

    @property
    def undoable(self) -> bool:
        return self._at > 0

    @property
    def redoable(self) -> bool:
        return self._at + 1 < len(self._texts)

    def put(self, key: str, value: Any) -> None:
        """Set what a dotted key such as ``vehicle[0].motion.mark[1].frame`` names; None removes it.

        Tables that are missing are added. Raises ``InputError`` if the file has no such place.
        """
        self.change([(key, value)])

    def change(self, changes: Iterable[tuple[str, Any]]) -> None:
        """`put` several keys in one step."""
        import tomlkit

        document: Any = tomlkit.parse(self.text)
        for key, value in changes:
            write(document, key, value, tomlkit.table)
        self._push(tomlkit.dumps(document))

    def insert(self, key: str, index: int, values: dict[str, Any]) -> None:
        """Insert a table before that at ``index`` of a list of tables, such as ``vehicle[0].motion.mark``."""
        import tomlkit

        document: Any = tomlkit.parse(self.text)
        *path, last = (int(at) if at else name for name, at in KEY.findall(key))
        tables = document
        for part in path:
            tables = tables[part]
        table = tomlkit.table()
        table.update(values)
        tables.setdefault(last, tomlkit.aot()).insert(index, table)
        self._push(tomlkit.dumps(document))

    def undo(self) -> None:
        self._go(max(self._at - 1, 0))

    def retract(self) -> None:
        """Undo the last change for good."""
        self.undo()
        del self._texts[self._at + 1 :]

    def redo(self) -> None:
        self._go(min(self._at + 1, len(self._texts) - 1))

    def save(self) -> None:
        """Write the file. Raises ``InputError`` if another program changed it since it was read; not if it is gone."""
        if self.path.exists() and not self._is_there():
            remedy = f"your changes are in {self.autosave.name}: compare, then delete one of them"
            raise InputError("was changed by another program since it was opened", remedy, file=self.path)
        _write(self.path, self.text)
        self._saved.append(self.text)
        self._keep()

    def names(self, file: str) -> bool:
        """Whether a value of the present text is ``file``, or of any that was saved, or of what is in the file now."""
        texts = {self.text, *self._saved}
        with suppress(InputError):
            texts.add(read_toml(self.path)[1])
        return any(file in _values(tomllib.loads(text)) for text in texts)

    def _is_there(self) -> bool:
        """Whether the file has the text that was read or saved last."""
        with suppress(InputError):  # which another program broke
            return read_toml(self.path)[1] == self._saved[-1]
        return False

    def _push(self, text: str) -> None:
        if text != self.text:
            apart = GLUED.sub(r"\1\n", text)  # added tables are apart from others, as those in the file are
            if not GLUED.search(self.text) and tomllib.loads(apart) == tomllib.loads(text):
                text = apart
            self._texts[self._at + 1 :] = [text]
            self._go(self._at + 1)

    def _go(self, at: int) -> None:
        """Make another state the present one."""
        before, self._at = self.data, at
        self.tables += list(_lengths(before)) != list(_lengths(self.data))
        self._keep()

    def _keep(self) -> None:
        """Write the autosave, or remove it if there is nothing to save. The session goes on if that fails."""
        try:
            if self.changed:
                _write(self.autosave, self.text)
            else:
                self.autosave.unlink(missing_ok=True)
            self.unkept = ""
        except OSError as error:
            self.unkept = error.strerror or str(error)


def _lengths(data: Any) -> Iterator[int]:
    """The lengths of all lists of tables, in the order of the file."""
    values = data.values() if isinstance(data, dict) else data
    for value in values:
        if isinstance(value, list) and any(isinstance(one, dict) for one in value):
            yield len(value)
        if isinstance(value, dict | list):
            yield from _lengths(value)


def _values(data: Any) -> Iterator[Any]:
    """All values that are no tables or lists."""
    if isinstance(data, dict | list):
        for value in data.values() if isinstance(data, dict) else data:
            yield from _values(value)
    else:
        yield data


def write(data: Any, key: str, value: Any, table: Callable[[], Any] = dict) -> None:
    """Set what a dotted key names in the data of a shot file; None removes it. ``table`` makes missing tables.

    Numbers that are equal stay as they were written. Raises ``InputError`` if there is no such place.
    """
    *path, last = (int(index) if index else name for name, index in KEY.findall(key))
    try:
        for part in path:
            if isinstance(data, dict) and part == 0:  # a single [camera] table
                continue
            if isinstance(data, dict) and part not in data:
                data[part] = table()
            data = data[part]
        if value is not None:
            _assign(data, last, value)
        elif isinstance(data, list) or last in data:
            del data[last]
    except (LookupError, TypeError, ValueError) as error:
        raise InputError("no such place in the file", "change it there", key=key) from error


def _assign(data: Any, key: Any, value: Any) -> None:
    """Set a value, of lists and tables only what differs."""
    there = data.get(key) if isinstance(data, dict) else data[key]
    if isinstance(value, dict) and isinstance(there, dict):
        for name in [name for name in there if name not in value]:
            del there[name]
        for name, item in value.items():
            _assign(there, name, item)
        return
    if isinstance(value, list) and isinstance(there, list) and len(value) == len(there):
        for k, item in enumerate(value):
            _assign(there, k, item)
        return
    if type(there) is bool or type(value) is bool or there != value:
        data[key] = value


def _write(path: Path, text: str) -> None:
    with replacing_file(path) as beside:
        beside.write_bytes(text.encode())
