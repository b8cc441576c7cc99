#!/bin/sh
# Make .venv with the locked dependencies and vehsim itself, and check that pictures can be rendered off-screen (EGL).
# It is safe to run again, and does nothing if nothing has changed. Needs only Python 3.11+ and the network.
set -eu
cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$*"; }
fail() {
    printf 'setup: %s\n' "$*" >&2
    exit 1
}

# Install Debian packages with permission to do so; otherwise say what to install, and stop.
need_packages() {
    why=$1
    shift
    if [ "$(id -u)" = 0 ]; then
        root=env
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        root="sudo env"
    else
        root=
    fi
    if [ -z "$root" ] || ! command -v apt-get >/dev/null; then
        fail "$why. Install it and run make again; on Debian and Ubuntu: sudo apt-get install $*"
    fi
    say "$why: installing $*"
    $root DEBIAN_FRONTEND=noninteractive apt-get update -qq &&
        $root DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null ||
        fail "apt-get could not install them. Fix that and run make again: sudo apt-get install $*"
}

find_python() {
    for python in "${PYTHON:-python3}" python3.11 python3.12 python3.13 python3.14; do
        if "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$python"
            return
        fi
    done
    fail "Python 3.11 or newer was not found. Install it, or name it: make PYTHON=/path/to/python3 ..."
}

make_venv() {
    python=$(find_python)
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        need_packages "Python's venv module is missing" \
            "$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"
    fi
    say "making .venv with $python"
    "$python" -m venv --clear .venv
}

install_locked() {
    say "installing the locked dependencies (about 1.6 GB on disk; a minute or two the first time)"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
}

# The stamp names everything an installed environment depends on; its last word is this folder, for scripts hold its path.
stamp=$(cat requirements.lock pyproject.toml tools/setup.sh | cksum)" $PWD"
made=$(cat .venv/.stamp 2>/dev/null || true)
if [ "$made" != "$stamp" ]; then
    case "$made" in
        *" $PWD") ;;
        *) make_venv ;;
    esac
    install_locked
    printf '%s' "$stamp" >.venv/.stamp
fi

# As pip does with what it installs: an environment may forbid Python to, and every process would compile them again.
.venv/bin/python -m compileall -q vehsim exporters assets

if ! .venv/bin/python -m vehsim.cli.doctor --egl; then
    need_packages "No EGL library that can render was found" libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri
    .venv/bin/python -m vehsim.cli.doctor --egl ||
        fail "EGL is installed but offers no device. 'vehsim doctor' says more."
fi
