# Sourced by the other scripts: goes to the project's root and makes `.venv` with what is asked for.
# shellcheck shell=bash
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf '%s\n' "$*" >&2; }

# A Python that the project supports: the one named in $PYTHON, or the first that fits.
find_python() {
  local candidate
  for candidate in ${PYTHON:-} python3 python3.12 python3.11 python3.10 python; do
    if "$candidate" -c 'import sys; raise SystemExit(not (3, 10) <= sys.version_info < (3, 13))' \
      >/dev/null 2>&1; then
      printf '%s\n' "$candidate"
      return
    fi
  done
  say "bikeped needs Python 3.10, 3.11 or 3.12; install one, or name it: PYTHON=/path/to/python $0"
  exit 2
}

# ensure_venv FOLDER: a virtual environment with a current pip.
ensure_venv() {
  if [ ! -x "$1/bin/python" ] || ! "$1/bin/python" -c '' >/dev/null 2>&1; then
    say "making $1 with $(find_python)"
    "$(find_python)" -m venv --clear "$1"
    "$1/bin/python" -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=23.1'
  fi
}

# ensure_env [EXTRAS [FOLDER]]: the virtual environment (.venv) with bikeped and extras of it, installed
# anew only when what it is made from has changed.
ensure_env() {
  local extras=${1:-} venv=${2:-.venv} wanted stamp
  ensure_venv "$venv"
  wanted="$extras $(cat pyproject.toml scripts/constraints.txt | cksum) $("$venv/bin/python" -V)"
  stamp=$venv/.bikeped-${extras:-base}
  if [ ! -f "$stamp" ] || [ "$(cat "$stamp")" != "$wanted" ]; then
    say "installing bikeped${extras:+[$extras]} into $venv"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
      --constraint scripts/constraints.txt --editable ".${extras:+[$extras]}"
    printf '%s' "$wanted" >"$stamp"
  fi
}

# ensure_cpu_torch FOLDER: PyTorch's CPU build there. On x86-64 the plain package brings gigabytes of CUDA.
ensure_cpu_torch() {
  local pin
  ensure_venv "$1"
  "$1/bin/python" -c 'import torch' >/dev/null 2>&1 && return
  pin=$(grep '^torch==' scripts/constraints.txt)
  [ "$(uname -m)" != x86_64 ] || pin="$pin+cpu"
  say "installing $pin into $1"
  "$1/bin/python" -m pip install --quiet --disable-pip-version-check \
    --constraint scripts/constraints.txt "$pin" && return
  say "pip finds no $pin: name PyTorch's index of CPU builds in PIP_EXTRA_INDEX_URL, or a folder that"
  say "has the wheel in PIP_FIND_LINKS; or install any PyTorch with $1/bin/python -m pip"
  exit 2
}

# ensure_tool COMMAND PACKAGE: a system tool that a test needs, from the distribution's packages.
ensure_tool() {
  local command=$1 package=$2 sudo=""
  PATH="$PATH:/usr/sbin:/usr/local/sbin"
  command -v "$command" >/dev/null 2>&1 && return
  if command -v apt-get >/dev/null 2>&1; then
    [ "$(id -u)" = 0 ] || sudo="sudo -n"
    say "installing $package"
    $sudo apt-get update -qq >/dev/null &&
      DEBIAN_FRONTEND=noninteractive $sudo apt-get install -y -qq "$package" >/dev/null || true
  fi
  command -v "$command" >/dev/null 2>&1 ||
    say "could not install $package: the tests that need $command will be skipped, saying so"
}
