#!/bin/sh
# Run the tests on other Pythons: the whole suite on 3.11 and 3.13, the core on 3.12 and 3.14.
#
# An interpreter is taken from PATH, from pyenv, or by uv from the network. An unavailable one is reported
# and skipped; STRICT=1 makes this an error. Each gets its own environment in .pythons/, from the locked dependencies.
# To run only some versions: tools/test_pythons.sh 3.13
set -eu
cd "$(dirname "$0")/.."

SUITE="3.11 3.13"
CORE="3.12 3.14"
CORE_TESTS="tests/lie tests/vehicles tests/integrators tests/clip tests/simulation tests/test_layers.py"

say() { printf 'pythons: %s\n' "$*"; }

is_version() { "$1" -c "import sys, venv, ensurepip; sys.exit('%d.%d' % sys.version_info[:2] != '$2')" 2>/dev/null; }

find_python() {
    for found in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/"$1".*/bin/python; do
        if is_version "$found" "$1"; then
            command -v "$found"
            return
        fi
    done
    uv=.pythons/uv/bin/uv
    if [ ! -x $uv ]; then
        .venv/bin/python -m venv .pythons/uv && $uv --version >/dev/null 2>&1 ||
            .pythons/uv/bin/pip install --quiet --disable-pip-version-check uv 2>/dev/null
    fi
    timeout 300 $uv python install --quiet --install-dir .pythons/interpreters "$1" 2>/dev/null || true
    for found in "$PWD"/.pythons/interpreters/*/bin/"python$1"; do
        if is_version "$found" "$1"; then
            printf '%s\n' "$found"
            return
        fi
    done
}

# An environment with the locked dependencies, made again when they or the interpreter change.
make_environment() {
    stamp=$(cat requirements.lock pyproject.toml | cksum)" $2 $PWD"
    [ "$(cat "$1/.stamp" 2>/dev/null || true)" = "$stamp" ] && return
    say "$2: installing the locked dependencies in $1"
    "$2" -m venv --clear "$1"
    "$1/bin/python" -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock &&
        "$1/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable . &&
        printf '%s' "$stamp" >"$1/.stamp"
}

passed= failed= missing=
for version in ${*:-$SUITE $CORE}; do
    python=$(find_python "$version")
    if [ -z "$python" ]; then
        say "$version: no such interpreter on PATH, in pyenv or to be fetched by uv; install python$version to test it"
        missing="$missing $version"
        continue
    fi
    tests=
    case " $CORE " in *" $version "*) tests=$CORE_TESTS ;; esac
    say "$version: ${tests:-the whole suite}"
    # shellcheck disable=SC2086 # the tests are several words
    if make_environment ".pythons/$version" "$python" && ".pythons/$version/bin/python" -m pytest -q -rs -n 2 \
        --dist worksteal -o cache_dir=".pythons/$version/.pytest_cache" $tests; then
        passed="$passed $version"
    else
        failed="$failed $version"
    fi
done
say "passed:${passed:- none}; failed:${failed:- none}; not tested, no interpreter:${missing:- none}"
[ -z "$failed" ] && [ -n "$passed" ] && { [ -z "$missing" ] || [ -z "${STRICT:-}" ]; }
