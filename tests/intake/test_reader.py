"""A file can crash or block only the reader process, never the process that requested it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from vehsim.errors import InputError
from vehsim.intake import reader
from vehsim.intake.foreign import LIMITS
from vehsim.intake.reader import read_cached, read_in_process

sys.path.insert(0, str(Path(__file__).parent))
import deadly

from tools.hostile_files.writers import CUBE, FACES, usda

pytestmark = pytest.mark.broken_stages


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "a.bin").write_bytes(b"content")
    return tmp_path / "a.bin"


def process_of(file: Path) -> int:
    return int(read_in_process(deadly.prints, file, "key")[0]["process"])


@pytest.mark.parametrize(
    ("read", "says"),
    [
        (deadly.crashes, r"cannot be read \(the library that reads it crashed: SIGSEGV\); export the file again"),
        (deadly.aborts, r"cannot be read \(broken, or takes more than 8 GB\); export the file again"),
        (deadly.takes_memory, r"takes more than 8 GB to read; .*VEHSIM_READ_GB=32"),
    ],
)
def test_a_file_that_crashes_the_reader_is_refused(file: Path, read: reader.Read, says: str) -> None:
    for _ in range(2):
        with pytest.raises(InputError, match=rf"a.bin: key: {says}"):
            read_in_process(read, file, "key")
    assert process_of(file) == process_of(file) != os.getpid()


@pytest.mark.parametrize(("read", "patience"), [(deadly.never_ends, 100.0), (deadly.sleeps, 0.5)])
def test_a_file_that_takes_forever_is_refused(
    file: Path, read: reader.Read, patience: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VEHSIM_READ_SECONDS", "1")
    monkeypatch.setattr(reader, "PATIENCE", patience)
    with pytest.raises(InputError, match=r"takes more than 1 s to read; .*raise the limit: VEHSIM_READ_SECONDS=4"):
        read_in_process(read, file, "key")
    requests: list[object] = []
    monkeypatch.setattr(reader, "_ask", requests.append)
    with pytest.raises(InputError, match="takes more than 1 s"):  # without waiting again
        read_in_process(read, file, "key")
    file.write_bytes(b"other")
    read_in_process(read, file, "key")
    assert len(requests) == 1


def test_answers_are_plain_and_complete(file: Path) -> None:
    facts, (empty, text, matrix) = read_in_process(deadly.prints, file, "key")
    assert facts["size"] == 7 and empty.shape == (0, 3) and text == "text" and np.array_equal(matrix, np.eye(2))


def test_an_interrupt_does_not_mix_up_answers(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, unpack = process_of(file), reader._unpacked

    def interrupted(answers: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(reader, "_unpacked", interrupted)
    with pytest.raises(KeyboardInterrupt):
        read_in_process(deadly.prints, file, "key")
    monkeypatch.setattr(reader, "_unpacked", unpack)
    assert process_of(file) != before


def test_threads_and_forks_get_their_own_answers(file: Path, tmp_path: Path) -> None:
    for k in range(8):
        (tmp_path / str(k)).write_bytes(bytes(k))
    sizes: dict[int, int] = {}
    threads = [
        threading.Thread(
            target=lambda k=k: sizes.update({k: read_in_process(deadly.prints, tmp_path / str(k), "")[0]["size"]})
        )
        for k in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sizes == {k: k for k in range(8)}
    mine = process_of(file)
    if not os.fork():  # a copy of this process must not read from the same pipe
        os._exit(process_of(file) == mine)
    assert os.waitstatus_to_exitcode(os.wait()[1]) == 0
    assert process_of(file) == mine


def test_a_file_is_read_once_for_its_content(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    first = read_cached(deadly.prints, file, "key")
    monkeypatch.setattr(reader, "_ask", lambda request: pytest.fail("read again"))
    (tmp_path / "other.bin").write_bytes(file.read_bytes())
    again = read_cached(deadly.prints, tmp_path / "other.bin", "key")
    assert again[0] == first[0] and all(map(np.array_equal, again[1], first[1]))
    file.write_bytes(b"changed")
    with pytest.raises(pytest.fail.Exception):
        read_cached(deadly.prints, file, "key")


def test_the_reader_ends_with_its_parent(file: Path) -> None:
    program = (
        f"import os, sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import deadly; from pathlib import Path; "
        "from vehsim.intake.reader import read_in_process; "
        f"p = read_in_process(deadly.prints, Path({str(file)!r}), 'k')[0]['process']; "
        "print(p, flush=True); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    wait_for_the_end_of(int(done.stdout))


def wait_for_the_end_of(process: int) -> None:
    for _ in range(500):
        state = Path(f"/proc/{process}/stat")
        if not state.exists() or ") Z" in state.read_text():
            return
        threading.Event().wait(0.02)
    pytest.fail("it is still there")


FORK = "if os.fork(): os.wait(); sys.exit(not os.path.isdir(answer['folder']))"


@pytest.mark.parametrize("end", ["sys.exit()", "os.kill(os.getpid(), 9)", FORK])
def test_temporary_files_of_libraries_are_removed(file: Path, tmp_path: Path, end: str) -> None:
    """After a crash at once, and when the process ends, is killed, or has a fork that reads."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    program = (
        f"import os, sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import deadly; from pathlib import Path\n"
        "from vehsim.errors import InputError; from vehsim.intake.reader import read_in_process\n"
        "def read(crash): return read_in_process(deadly.leaves_a_trace, Path(sys.argv[1]), 'key', crash)\n"
        "try: read(True)\n"
        "except InputError: left = os.listdir(os.environ['TMPDIR'])\n"
        f"answer = read(False)[0]; print(*left, answer['process'], flush=True)\n{end}\nread(False)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(file)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"TMPDIR": str(temporary)},
    )
    wait_for_the_end_of(int(done.stdout))
    assert not list(temporary.iterdir()) and done.returncode in (0, -9), done.stderr


@pytest.mark.parametrize("variable", LIMITS)
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "much"])
def test_limits_are_numbers_above_zero(file: Path, variable: str, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from vehsim.intake.foreign import limit

    monkeypatch.setenv(variable, value)
    with pytest.raises(InputError, match=rf"{variable} = '{value}': not a number above zero; give one, such as"):
        limit(variable)


def test_a_stage_of_many_prims_is_refused_with_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if they are in nested instances, or in a variant that is not selected."""
    from vehsim.intake.usd import open_stage

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    deep = 'class "c0"\n{\n    def Xform "leaf"\n    {\n    }\n}\n'
    for k in range(1, 30):
        arcs = "".join(
            f'    def "i{j}" (\n        instanceable = true\n        inherits = </c{k - 1}>\n    )\n    {{\n    }}\n'
            for j in range(4)
        )
        deep += f'class "c{k}"\n{{\n{arcs}}}\n'
    files = {
        "plain": "".join(f'def "p{k}"\n{{\n}}\n' for k in range(400)),
        "instances": f'{deep}def "all" (\n    inherits = </c29>\n)\n{{\n}}\n',
        "variants": 'def "v" (\n    prepend variantSets = "s"\n)\n{\n    variantSet "s" = {\n        "one" {\n'
        + "".join(f'            def "p{k}"\n            {{\n            }}\n' for k in range(400))
        + "        }\n    }\n}\n",
    }
    for name, text in files.items():
        path = tmp_path / f"{name}.usda"
        path.write_text(f"#usda 1.0\n{text}")
        monkeypatch.setenv("VEHSIM_READ_PRIMS", "300")
        with pytest.raises(InputError, match=rf"{name}.usda: asset: more than 300 prims; .*VEHSIM_READ_PRIMS=1200"):
            open_stage(path)
        if name != "instances":
            monkeypatch.setenv("VEHSIM_READ_PRIMS", "1200")
            assert open_stage(path)
            monkeypatch.setenv("VEHSIM_READ_PRIMS", "300")
            with pytest.raises(InputError, match="more than 300 prims"):
                open_stage(path)


def test_a_stage_is_read_again_when_a_referenced_file_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vehsim.intake.usd import dependencies

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    (tmp_path / "part.usda").write_bytes(usda())
    whole = tmp_path / "whole.usda"
    whole.write_text('#usda 1.0\ndef "a" (\n    references = @./part.usda@\n)\n{\n}\n')
    assert dependencies(whole) == ((tmp_path / "part.usda", whole), ())
    (tmp_path / "part.usda").write_bytes(usda(CUBE, FACES)[:-9])
    with pytest.raises(InputError, match=r"whole.usda: asset: cannot be read"):
        dependencies(whole)


@pytest.mark.parametrize("known_here", [True, False])
def test_references_that_did_not_resolve_are_found_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_here: bool
) -> None:
    """In the process that missed them, and in another one, which has the cached answer."""
    from vehsim.intake import usd as stages

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    whole = tmp_path / "whole.usda"
    refers, texture = "references = @./part.usda@", "asset inputs:file = @./t.<UDIM>.png@"
    whole.write_text(f'#usda 1.0\ndef Shader "a" (\n    {refers}\n)\n{{\n    {texture}\n}}\n')
    for name, left in {"part.usda": ["t.<UDIM>.png"], "t.1002.png": []}.items():
        assert name not in [file.name for file in stages.dependencies(whole)[0]]
        (tmp_path / name).write_bytes(usda() if name == "part.usda" else b"")
        if not known_here:
            stages._known.clear()
        files, missing = stages.dependencies(whole)
        assert tmp_path / name in files and [Path(each).name for each in missing] == left


def test_a_stage_nested_very_deeply_is_refused(tmp_path: Path) -> None:
    from vehsim.intake.usd import dependencies

    for depth in (400, 600):
        (tmp_path / "deep.usda").write_text("#usda 1.0\n" + 'def "a"\n{\n' * depth + "}\n" * depth)
        if depth == 400:
            dependencies(tmp_path / "deep.usda")
    with pytest.raises(InputError, match=r"deep.usda: asset: prims nested deeper than 500; group its prims"):
        dependencies(tmp_path / "deep.usda")
