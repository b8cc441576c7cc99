"""The document of a live session: what is not edited stays as it was written, and nothing is lost."""

import errno
import tomllib

import pytest

from vehsim.errors import InputError
from vehsim.live import document as live_document
from vehsim.live.document import Document
from vehsim.live.settings import handles

TEXT = """\
# a drive
[shot]
name = "drive"     # its name
schema = 1

[[vehicle]]
asset = "car"
name = "car"
  [vehicle.motion]
  method = "plan"
  mark = [
    { frame = 1001, position = [0, 0, 0], heading = 0 },
    { frame = 1073, position = [10.50, 2.0, 0] },  # the garage
  ]
[[vehicle]]
name = "other"
asset = "car"
[vehicle.motion]
method = "plan"
[[vehicle.motion.mark]]
frame = 1001
position = [
  5.0,   # east
  1e1,   # north
  0,
]
"""


def place(document, vehicle, mark, position, heading=None):
    key = f"vehicle[{vehicle}].motion.mark[{mark}].position"
    handle = next(handle for handle in handles(document.data) if handle.key == key)
    document.change(handle.moved(position, heading))


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "drive.toml"
    path.write_bytes(TEXT.encode())
    return path


def test_only_what_was_moved_is_rewritten(path):
    document = Document(path)
    place(document, 0, 1, [10.5, 3.25, 0.0])
    place(document, 1, 0, [5.0, 11.0, 0.0], 30.0)
    document.save()
    expected = TEXT.replace("[10.50, 2.0, 0]", "[10.50, 3.25, 0]").replace("  1e1,   # north", "  11.0,   # north")
    assert path.read_text() == expected.replace("  0,\n]\n", "  0,\n]\nheading = 30.0\n")
    assert document.data == tomllib.loads(path.read_text())


APART = """\
[[vehicle]]
name = "boat"

[vehicle.motion]
method = "simulate"
commands = [{ frame = 1001, thrust = 9 }]

[vehicle.motion.start]   # in the bay
position = [0, 0.10, 0]  # m

[camera]
rig = "chase"
"""


def test_a_table_that_is_replaced_keeps_what_stays(path):
    path.write_text(APART)
    document = Document(path)
    document.put("vehicle[0].motion", {"method": "sticks", "start": {"position": [0.0, 0.1, 0.0]}, "file": "a.csv"})
    old = 'method = "simulate"\ncommands = [{ frame = 1001, thrust = 9 }]\n'
    assert document.text == APART.replace(old, 'method = "sticks"\nfile = "a.csv"\n')


def test_added_tables_are_apart_where_the_others_are(path):
    note = '[[note]]\nframe = 1\ntext = "a"\n'
    for text, between in ((TEXT, ""), (APART, "\n")):
        path.write_text(text)
        document = Document(path)
        document.insert("note", 0, {"frame": 1, "text": "a"})
        assert document.text == text + between + note
        document.save()
    document.put("vehicle[0].motion.limits.speed", 9)
    camera = '[camera]\nrig = "chase"\n'
    assert document.text == APART.replace(camera, f"[vehicle.motion.limits]\nspeed = 9\n\n{camera}\n{note}")


@pytest.mark.parametrize(
    ("given", "heading", "tilt", "kept"),
    [
        ("3, 4, 0", 90.0, None, "0.0, 5.0, 0"),  # of the same length
        ("0, 4, 3", 0.0, None, "4.0, 0.0, 3"),  # and the same slope
        ("4, 0, 3", None, -30.0, "4.33, 0, -2.5"),
        ("0, 0.1, 0", 180.0, 45.0, "-0.707, 0.0, 0.707"),  # long enough for its decimals
    ],
)
def test_a_gate_is_turned_at_its_mark(path, given, heading, tilt, kept):
    """It does not move, and the mark's heading is its own."""
    text = TEXT + f"heading = 10\ngate = {{ direction = [{given}], size = [6, 4] }} # the arch\n"
    path.write_text(text)
    document = Document(path)
    gate = next(handle for handle in handles(document.data) if handle.key.endswith("gate.direction"))
    mark = next(handle for handle in handles(document.data) if handle.key == gate.on)
    assert gate.place == mark.place and gate.key.startswith(mark.key.removesuffix("position")) and gate.mark is None
    document.change(gate.moved([1.0, 2.0, 3.0], heading, tilt=tilt))
    assert document.text == text.replace(given, kept)
    document.undo()
    assert document.text == text
    document.change(mark.moved(mark.place, 20.0))
    assert document.text == text.replace("heading = 10\n", "heading = 20.0\n")


def test_undo_and_redo_restore_every_byte(path):
    document = Document(path)
    texts = [document.text]
    for k in range(30):
        place(document, 0, 1, [10.5, 2.0 + k / 10, 0.0], 5.0 * k)
        texts.append(document.text)
    assert len(set(texts)) == 31
    for text in reversed(texts[:-1]):
        document.undo()
        assert document.text == text
    assert not document.undoable and not document.changed
    document.undo()
    for text in texts[1:]:
        document.redo()
        assert document.text == text
    document.redo()
    document.undo()
    place(document, 0, 0, [1.0, 0.0, 0.0])
    assert not document.redoable and document.undoable


def test_a_session_that_ended_without_saving_goes_on(path):
    document = Document(path)
    place(document, 0, 1, [1.0, 2.0, 3.0])
    assert path.read_text() == TEXT
    again = Document(path)
    assert again.recovered and again.text == document.text
    again.undo()
    assert again.text == TEXT and not again.autosave.exists()
    again.redo()
    again.save()
    assert not again.autosave.exists() and not Document(path).recovered
    assert tomllib.loads(path.read_text())["vehicle"][0]["motion"]["mark"][1]["position"] == [1.0, 2.0, 3.0]


def test_changes_of_others_are_not_overwritten(path):
    document = Document(path)
    place(document, 0, 1, [1.0, 2.0, 3.0])
    path.write_text(TEXT + "# of somebody else\n")
    with pytest.raises(InputError, match="changed by another program"):
        document.save()
    assert path.read_text().endswith("somebody else\n") and document.autosave.exists()
    path.write_text("[[broken")
    with pytest.raises(InputError, match="changed by another program"):
        document.save()
    path.unlink()  # as the message advises
    document.save()
    assert path.read_text() == document.text and not document.autosave.exists()


def test_an_autosave_that_cannot_be_written_ends_nothing(path, monkeypatch):
    """Such as in a folder that is read-only; the next one that can be is written."""
    document, real = Document(path), live_document._write

    def full(path, text):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(live_document, "_write", full)
    place(document, 0, 1, [1.0, 2.0, 3.0])
    assert document.changed and document.unkept == "No space left on device" and not document.autosave.exists()
    monkeypatch.setattr(live_document, "_write", real)
    place(document, 0, 1, [1.0, 2.0, 4.0])
    assert not document.unkept and document.autosave.read_text() == document.text


def test_a_change_is_retracted_for_good_and_files_are_named(path):
    document, odd = Document(path), 'a "b" ö.npz'
    document.put("vehicle[0].motion.guess", odd)
    assert document.names(odd) and not document.names("b")
    document.retract()
    assert not document.names(odd) and not document.redoable and document.text == TEXT
    document.put("vehicle[0].motion.guess", odd)
    document.save()
    document.undo()
    document.save()
    assert document.names(odd)  # a copy of the file may have been made
    path.write_text('[x]\nguess = "c.npz"\n')
    assert document.names("c.npz")


def test_tables_are_counted_when_their_indices_change(path):
    """Not when a table moves, gets a key or a table of its own; adding one and deleting another is two changes."""
    document = Document(path)
    place(document, 0, 1, (4.0, 1.0, 0.0), 30.0)
    document.put("vehicle[0].motion.limits.speed", 5.0)
    assert document.tables == 0
    document.insert("vehicle[1].motion.mark", 1, {"frame": 1050, "position": [1.0, 2.0, 0.0]})
    document.put("vehicle[0].motion.mark[0]", None)
    assert document.tables == 2
    document.undo()
    document.undo()
    document.undo()
    document.redo()
    assert document.tables == 4
