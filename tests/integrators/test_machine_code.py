"""Every operation as machine code: the same bits as CasADi's interpreter, for all kinds of numbers."""

import gc
import os
import subprocess
import sys
import threading
import weakref

import casadi as ca
import numpy as np
import pytest

from vehsim.runtime import machine_code
from vehsim.runtime.machine_code import MachineCode, code_key

X, Y = ca.SX.sym("x"), ca.SX.sym("y")
ONE = {
    name: getattr(ca, name)(X)
    for name in (
        *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
        *("exp", "log", "expm1", "log1p", "erf", "floor", "ceil", "sqrt", "fabs", "sign", "logic_not"),
    )
} | {"neg": -X, "inv": 1 / X, "sq": X * X, "twice": 2 * X}
TWO = {
    name: getattr(ca, name)(X, Y)
    for name in ("atan2", "fmod", "fmin", "fmax", "hypot", "remainder", "copysign", "logic_and", "logic_or")
} | {
    "add": X + Y,
    "sub": X - Y,
    "mul": X * Y,
    "div": X / Y,
    "pow": X**Y,
    "constpow": X**1.7,
    "lt": X < Y,
    "le": X <= Y,
    "eq": X == Y,
    "ne": X != Y,
    "if_else_zero": ca.if_else(X > 0, Y, 0),
}
OPERATIONS = ONE | TWO
ODD = [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, np.inf, -np.inf, np.nan, 5e-324, 1e-310, 1e300, -3.7, 2.5, 3.0, 1e-9]


def operands():
    rng = np.random.default_rng(0)
    usual = rng.normal(size=(3000, 2)) * np.exp(3 * rng.normal(size=(3000, 2)))
    return np.vstack([[(a, b) for a in ODD for b in ODD], usual])


def interpreted(function, rows):
    out = np.empty((len(rows), function.numel_out(0)))
    buffer, run = function.map(len(rows)).buffer()
    buffer.set_arg(0, memoryview(rows))
    buffer.set_res(0, memoryview(out))
    run()
    return out


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_gives_the_same_bits(name):
    rows = operands()
    function = ca.Function("f", [ca.vertcat(X, Y)], [ca.vertcat(OPERATIONS[name], 3.0)])
    out, expected = np.empty((len(rows), 2)), interpreted(function, rows)
    MachineCode(function).rows([rows[None]], [out[None]])
    same = (out.view(np.uint64) == expected.view(np.uint64)) | (np.isnan(out) & np.isnan(expected))
    assert same.all(), (rows[~same.all(axis=1)][:3], out[~same.all(axis=1)][:3], expected[~same.all(axis=1)][:3])


def test_all_operations_of_casadi_on_numbers_are_known_but_one(monkeypatch):
    """`OPERATIONS` covers those known; erfinv alone stays with the interpreter."""
    assert len(machine_code._CODE) == len(OPERATIONS)
    with pytest.raises(ValueError, match="ERFINV: not known"):
        MachineCode(ca.Function("f", [X], [ca.erfinv(X)]))
    x = ca.MX.sym("x")
    with pytest.raises(ValueError, match="function g: MXFunction"):
        MachineCode(ca.Function("g", [x], [x + 1]))
    monkeypatch.setattr(machine_code, "LONGEST", 3)
    MachineCode(ca.Function("f", [X], [ca.sin(X)]))
    with pytest.raises(ValueError, match="4 operations, at most 3"):
        MachineCode(ca.Function("f", [X], [ca.sin(ca.sin(X))]))


def test_products_and_sums_are_not_fused():
    """A fused sum of products rounds once, and differs in the last bit of about a quarter of random numbers."""
    z = ca.SX.sym("z")
    function = ca.Function("f", [ca.vertcat(X, Y, z)], [X * Y + z])
    rows = np.random.default_rng(1).normal(size=(1000, 3))
    out = np.empty((1000, 1))
    MachineCode(function).rows([rows[None]], [out[None]])
    np.testing.assert_array_equal(out[:, 0], rows[:, 0] * rows[:, 1] + rows[:, 2])


def test_rows_may_be_strided_shared_carried_and_in_threads():
    """A sum that runs along each of three groups, from arrays with gaps and one row for all."""
    step = ca.Function("f", [X, ca.vertcat(Y, Y * 0)[:1], ca.SX.sym("none", 0)], [X + Y])
    code = MachineCode(step)
    state, gains = np.zeros((3, 101, 2)), np.arange(3.0)[:, None, None]
    given = np.broadcast_to(gains, (3, 100, 1))
    x = state[:, :, :1]
    code.rows([x[:, :-1], given, np.empty((3, 100, 0))], [x[:, 1:]])
    np.testing.assert_array_equal(x[:, :, 0], np.outer(np.arange(3), np.arange(101)))
    assert not state[:, :, 1].any()
    outs = [np.zeros((1, 50001, 1)) for _ in range(4)]
    for out in outs:
        out[0, 0] = 1.0
    arguments = (np.broadcast_to(1.0, (1, 50000, 1)), np.empty((1, 50000, 0)))
    threads = [threading.Thread(target=code.rows, args=([o[:, :-1], *arguments], [o[:, 1:]])) for o in outs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(out[0, -1, 0] == 50001.0 for out in outs)


def test_no_rows_and_no_groups_are_nothing():
    code = MachineCode(ca.Function("f", [X], [2 * X]))
    for shape in ((0, 5, 1), (3, 0, 1)):
        code.rows([np.empty(shape)], [np.empty(shape)])


def test_a_bound_call_keeps_its_machine_code():
    """Two threads may build the same function: the second code replaces the first, which others still run."""
    code, given, out = MachineCode(ca.Function("f", [X], [2 * X])), np.array([3.0]), np.zeros(1)
    run, engine = code.bound([given], [out]), weakref.ref(code._engine)
    del code
    gc.collect()
    assert engine() is not None
    run()
    assert out == [6.0]


def evaluated(code, x=3.0):
    out = np.zeros((1, 1, 1))
    code.rows([np.full((1, 1, 1), x)], [out])
    return out.item()


def test_code_is_built_once_for_all_processes(tmp_path, monkeypatch):
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    function, other = ca.Function("f", [X], [2 * X]), ca.Function("f", [X], [3 * X])
    key = code_key(function)
    assert MachineCode.recalled(key) is None and key != code_key(other)
    assert evaluated(MachineCode(function)) == 6.0 and not list(tmp_path.iterdir())
    assert evaluated(MachineCode(function, key)) == evaluated(MachineCode.recalled(key)) == 6.0
    assert MachineCode.recalled(code_key(other)) is None


@pytest.mark.filterwarnings("error")
def test_only_own_code_of_this_very_function_is_executed(tmp_path, monkeypatch):
    """Not that which others can have written, is damaged, or was moved there; and nothing warns."""
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    function, other = ca.Function("f", [X], [2 * X]), ca.Function("g", [X, Y], [3 * X, Y])
    key, before = code_key(function), os.umask(0o002)
    MachineCode(function, key)
    os.umask(before)
    (entry,) = tmp_path.iterdir()
    content = entry.read_bytes()
    assert MachineCode.recalled(key) is not None
    if hasattr(os, "geteuid"):
        entry.chmod(0o664)
        assert MachineCode.recalled(key) is None
        entry.chmod(0o644)
    entry.write_bytes(content[:-100])
    assert MachineCode.recalled(key) is None
    MachineCode(function, key)
    assert MachineCode.recalled(key) is not None
    MachineCode(other, code_key(other))
    (moved,) = (file for file in tmp_path.iterdir() if file != entry)
    moved.replace(entry)
    assert MachineCode.recalled(key) is None
    monkeypatch.setenv("VEHSIM_CACHE", str(entry / "under a file"))
    assert evaluated(MachineCode(function, key)) == 6.0 and MachineCode.recalled(key) is None


def test_long_functions_are_not_looked_for(monkeypatch):
    monkeypatch.setattr(machine_code, "LONGEST", 3)
    assert code_key(ca.Function("f", [X], [ca.sin(X)])) and not code_key(ca.Function("f", [X], [ca.sin(ca.sin(X))]))


REFUSED = """
import ctypes, sys
if not sys.platform.startswith("linux") or ctypes.CDLL(None).prctl(65, 1, 0, 0, 0):  # PR_SET_MDWE, since Linux 6.3
    sys.exit("prctl refuses")
import casadi as ca, numpy as np
from vehsim.integrators.fast.kernel import Kernel
x = ca.SX.sym("x")
kernel, out = Kernel(ca.Function("f", [x], [2 * x])), np.zeros((4000, 1))
for _ in range(2):
    kernel.rows([np.ones((4000, 1))], [out])
print(kernel.compiled, out.sum())
"""


def test_where_memory_may_not_become_executable_the_interpreter_stays():
    """As under SELinux, or systemd's MemoryDenyWriteExecute; LLVM does not notice, and its code crashed there."""
    done = subprocess.run([sys.executable, "-c", REFUSED], capture_output=True, text=True)
    if "prctl refuses" in done.stderr:
        pytest.skip("this system does not forbid executable memory")
    assert (done.returncode, done.stdout) == (0, "False 8000.0\n")


def test_a_function_that_the_process_lacks_is_noticed(monkeypatch):
    """LLVM would end the process when it finds no address."""
    llvm = machine_code._llvm()
    monkeypatch.setattr(llvm, "address_of_symbol", lambda name: None if name == "erf" else 1)
    with pytest.raises(OSError, match="this process has no erf"):
        machine_code._llvm.__wrapped__()
