#!/usr/bin/env bash
# Installs what Marsyard needs: system libraries for off-screen rendering, and the environment in .venv.
# If nothing has changed, it returns immediately.
#
#   PYTHON=/path/to/python   the interpreter to build .venv with; otherwise the first Python >= 3.11 on the PATH
#   tools/setup.sh --demo        installs what campaigns need, without the tools for tests and documentation
#   tools/setup.sh --slow-tests  installs only the programs for the slow tests (`make validate`)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=.venv
stamp=$venv/.setup-done             # what the environment was made from, written last
unfinished=$venv/.setup-unfinished # exists while pip runs; if it is left over, the environment is created again
extras=dask,dev,docs,geo,spice
[ "${1:-}" != --demo ] || extras=dask,geo,spice

# Debian packages of each GL backend. Those that are not of Mesa are for pyrender, which imports its viewer.
osmesa=(libosmesa6 libgl1 libxrender1)
egl=(libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libxrender1)
either="install ${osmesa[*]}, or else ${egl[*]} (sudo apt-get install ...)"

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

# --- existing software ----------------------------------------------------------------------------------------------------

is_python() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

find_python() {
    local candidate
    for candidate in ${PYTHON:+"$PYTHON"} python3 python3.11 python3.12 python3.13 python3.14; do
        if is_python "$candidate"; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    fail "Python 3.11 or newer not found: install it (sudo apt-get install python3 python3-venv), or set PYTHON=/path/to/python"
}

# Interpreter and folder of the environment; if they change, it is created again.
foundation() { printf '%s %s' "$PWD" "$("$venv/bin/python" -c 'import sys; print(sys.version.split()[0])')"; }

contents() { cat pyproject.toml constraints.txt tools/setup.sh | sha256sum | cut -d ' ' -f 1; }

up_to_date() {
    [ -f "$stamp" ] && [ ! -e "$unfinished" ] && [ -x "$venv/bin/python" ] && is_python "$venv/bin/python" &&
        case "$(cat "$stamp")" in "$(foundation) $(contents) $extras" | "$(foundation) $(contents) "*dev*) ;; *) return 1 ;; esac
}

usable_venv() {
    [ ! -e "$unfinished" ] && [ -x "$venv/bin/python" ] && is_python "$venv/bin/python" || return 1
    if [ -f "$stamp" ]; then
        case "$(cat "$stamp")" in "$(foundation) "*) ;; *) return 1 ;; esac
    fi
    "$venv/bin/pip" --version >/dev/null 2>&1
}

# --- system packages --------------------------------------------------------------------------------------------------

as_root=
apt_refreshed=
can_install() {
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" -eq 0 ]; then
        return 0
    fi
    as_root=sudo
    command -v sudo >/dev/null && sudo -n true >/dev/null 2>&1
}

apt_install() {
    local options=(-qq -y --no-install-recommends -o DPkg::Lock::Timeout=300)
    if [ -z "$apt_refreshed" ]; then
        $as_root apt-get -qq -o DPkg::Lock::Timeout=300 update >/dev/null 2>&1 || say "apt-get update failed; the existing package lists are used"
        apt_refreshed=yes
    fi
    say "installing $*"
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install "${options[@]}" "$@" >/dev/null 2>&1 </dev/null
}

# Installs a group of packages, or prints in one line what to install.
need() {
    if can_install && apt_install "$@"; then
        return 0
    fi
    say "could not install $*; to install it by hand: sudo apt-get install $*"
    return 1
}

# Each backend is a group of its own: recent versions of Mesa have EGL, but not OSMesa.
install_gl_libraries() {
    local loadable
    loadable=" $("$1" tools/gl_backends.py) "
    case "$loadable" in *" osmesa "*) ;; *) need "${osmesa[@]}" || true ;; esac
    case "$loadable" in *" egl "*) ;; *) need "${egl[@]}" || true ;; esac
    if [ -z "$("$1" tools/gl_backends.py)" ]; then
        fail "nothing to render with: $either"
    fi
}

# The tests build an example in C.
install_compiler() { command -v cc >/dev/null || need gcc libc6-dev || true; }

# The slow tests of pages use Debian's browser, no other browser is downloaded; those of the sandbox use bubblewrap.
install_test_programs() {
    command -v chromium >/dev/null || need chromium || true
    command -v bwrap >/dev/null || need bubblewrap || true
}

# --- the environment --------------------------------------------------------------------------------------------------

make_venv() {
    if ! "$1" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        local version
        version=$("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        need python3-venv || need "python$version-venv" || fail "$1 cannot make environments: its venv module is missing"
    fi
    say "making $venv with $("$1" -c 'import sys; print(sys.executable, sys.version.split()[0])')"
    rm -rf "$venv"
    mkdir "$venv"
    : >"$unfinished"
    "$1" -m venv "$venv"
}

install_packages() {
    say "installing the packages pinned in constraints.txt (about a minute)"
    local install=("$venv/bin/python" -m pip install -qq --no-input --disable-pip-version-check --progress-bar off --no-compile -c constraints.txt)
    : >"$unfinished"
    # setuptools first, with its pinned version: an isolated build would download another version
    "${install[@]}" pip setuptools
    "${install[@]}" --no-build-isolation -e ".[$extras]"
    # on all cores; pip would use one
    "$venv/bin/python" -m compileall -q -j 0 "$venv/lib" >/dev/null || true
}

check_rendering() {
    local backend works=
    for backend in $("$venv/bin/python" tools/gl_backends.py); do
        if "$venv/bin/python" -P marsyard/gl_probe.py "$backend" >/dev/null 2>&1 </dev/null; then
            works=yes
        else
            say "pyrender renders nothing with $backend; 'marsyard doctor' shows the cause"
        fi
    done
    [ -n "$works" ] || fail "no GL backend renders an image: $either"
}

if [ "${1:-}" = --slow-tests ]; then
    install_test_programs
    exit 0
fi

# One set-up at a time in one folder.
if command -v flock >/dev/null; then
    exec 9<"$PWD"
    flock -n 9 || { say "waiting for another set-up in this folder"; flock 9; }
fi

if up_to_date && [ -n "$("$venv/bin/python" tools/gl_backends.py)" ]; then
    exit 0
fi
if usable_venv; then
    python=$venv/bin/python
    install_gl_libraries "$python"
else
    python=$(find_python)
    install_gl_libraries "$python"
    make_venv "$python"
fi
case $extras in *dev*) install_compiler ;; esac
install_packages
check_rendering
rm -f "$unfinished"
printf '%s %s %s' "$(foundation)" "$(contents)" "$extras" >"$stamp"
say "done"
