#!/usr/bin/env bash
# Installs, updates or rolls back bikeped on a pole's Jetson (JetPack 6, Ubuntu 22.04).
# Safe to run again: an existing configuration is never touched, and a release that fails to
# install or refuses the configuration never becomes the current one.
set -euo pipefail

readonly KEEP_RELEASES=3
readonly SERVICE=bikeped

usage() {
  cat <<'USAGE'
usage: install.sh [--dry-run] [--prefix DIR] [--source DIR] [--python PROGRAM] [--no-start]
       install.sh --rollback [--dry-run] [--prefix DIR]

  --dry-run         say what would be done, change nothing
  --prefix DIR      install the files below DIR and leave users, services and devices alone;
                    needs no root
  --source DIR      the source tree to install (default: the one this script lies in)
  --python PROGRAM  the Python that the virtual environment is made from (default: python3)
  --no-start        install, but do not start or restart the service
  --rollback        go back to the release before the current one
USAGE
}

say() { printf '%s\n' "$*"; }
fail() {
  printf 'install.sh: %s\n' "$*" >&2
  exit 2
}

dry_run=no
prefix=""
source_dir="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
python=python3
start=yes
rollback=no

while (($# > 0)); do
  case "$1" in
    --dry-run) dry_run=yes ;;
    --prefix | --source | --python)
      (($# > 1)) || fail "$1 needs a value"
      case "$1" in
        --prefix) prefix="$2" ;;
        --source) source_dir="$2" ;;
        --python) python="$2" ;;
      esac
      shift
      ;;
    --no-start) start=no ;;
    --rollback) rollback=yes ;;
    -h | --help)
      usage
      exit 0
      ;;
    *)
      usage >&2
      fail "unknown argument: $1"
      ;;
  esac
  shift
done

case "$prefix" in
  "" | /*) ;;
  *) prefix="$PWD/$prefix" ;;
esac
prefix="${prefix%/}"

readonly opt="$prefix/opt/bikeped"
readonly releases="$opt/releases"
readonly current="$opt/venv"
readonly previous="$opt/previous"
readonly etc="$prefix/etc/bikeped"
readonly state="$prefix/var/lib/bikeped"
readonly config="$etc/config.yaml"

# Whether this run may touch the machine itself, or only files below the prefix.
system=yes
[[ -z "$prefix" ]] || system=no

run() {
  if [[ "$dry_run" == yes ]]; then
    say "would run: $*"
  else
    "$@"
  fi
}

on_system() {
  if [[ "$system" == yes ]]; then
    run "$@"
  else
    say "left alone (--prefix): $*"
  fi
}

need_root() {
  if [[ "$system" == yes && "$dry_run" == no && "$(id -u)" -ne 0 ]]; then
    fail "needs root: run it with sudo, or try --dry-run or --prefix DIR"
  fi
}

check_source() {
  [[ -f "$source_dir/pyproject.toml" && -f "$source_dir/deploy/bikeped.service" ]] ||
    fail "--source $source_dir: no bikeped source tree; name the folder that has pyproject.toml"
  command -v "$python" >/dev/null || fail "--python $python: no such program"
  "$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 13))' ||
    fail "--python $python: bikeped needs Python 3.10 to 3.12"
}

# Puts $2 in place of the link $1 in one step, so that no moment is without a release.
point() {
  run ln -sfn "$2" "$1.new"
  run mv -T "$1.new" "$1"
}

install_packages() {
  # libusb-1.0-0: USB lights; alsa-utils: aplay; v4l-utils, gpiod: for the installer's checks.
  on_system apt-get install -y --no-install-recommends \
    python3-venv libusb-1.0-0 alsa-utils v4l-utils gpiod
}

make_user() {
  local group
  for group in video render gpio audio plugdev; do
    on_system groupadd --system --force "$group"
  done
  if [[ "$system" == yes ]] && id "$SERVICE" >/dev/null 2>&1; then
    say "user $SERVICE exists"
  else
    on_system useradd --system --user-group --home-dir "$state" --no-create-home \
      --shell /usr/sbin/nologin "$SERVICE"
  fi
  on_system usermod --append --groups video,render,gpio,audio,plugdev "$SERVICE"
}

make_release() {
  release="$releases/$(date -u +%Y%m%d-%H%M%S-%N)"
  run mkdir -p "$releases"
  # --system-site-packages: JetPack's tensorrt is a package of the system's Python.
  run "$python" -m venv --system-site-packages "$release"
  if ! run "$release/bin/python" -m pip install --upgrade "${source_dir}[gpio,usb]"; then
    rm -rf -- "$release"
    fail "the package could not be installed; the current release stays as it was"
  fi
}

install_config() {
  run mkdir -p "$etc" "$state"
  local file
  for file in config.yaml camera_calibration.json; do
    if [[ -e "$etc/$file" ]]; then
      say "kept: $etc/$file"
    elif [[ -f "$source_dir/$file" ]]; then
      run install -m 0640 "$source_dir/$file" "$etc/$file"
    fi
  done
  on_system chown -R "root:$SERVICE" "$etc"
  on_system chown "$SERVICE:$SERVICE" "$state"
}

install_files() {
  run mkdir -p "$opt/share" "$prefix/etc/systemd/system" "$prefix/etc/udev/rules.d"
  run install -m 0644 "$source_dir/deploy/bikeped.service" \
    "$source_dir/deploy/bikeped-lamp.service" "$prefix/etc/systemd/system/"
  run install -m 0644 "$source_dir/deploy/99-bikeped.rules" "$prefix/etc/udev/rules.d/"
  if [[ -f "$source_dir/docs/install-on-a-pole.md" ]]; then
    run install -m 0644 "$source_dir/docs/install-on-a-pole.md" "$opt/share/"
  fi
}

check_config() {
  if ! run "$release/bin/bikeped" config check -c "$config"; then
    rm -rf -- "$release"
    fail "the new release refuses $config (see above); the current release stays as it was"
  fi
}

switch_release() {
  if [[ -L "$current" ]]; then
    point "$previous" "$(readlink "$current")"
  elif [[ -e "$current" ]]; then
    fail "$current exists and is no link; move it away first"
  fi
  point "$current" "$release"
}

drop_old_releases() {
  local old keep_current keep_previous
  [[ -d "$releases" ]] || return 0
  keep_current="$(readlink "$current" || true)"
  keep_previous="$(readlink "$previous" || true)"
  # Names sort by time: the newest come last.
  find "$releases" -mindepth 1 -maxdepth 1 -type d | sort | head -n "-$KEEP_RELEASES" |
    while IFS= read -r old; do
      if [[ "$old" != "$keep_current" && "$old" != "$keep_previous" ]]; then
        run rm -rf -- "$old"
      fi
    done
}

restart_service() {
  on_system systemctl daemon-reload
  on_system udevadm control --reload-rules
  on_system udevadm trigger
  on_system systemctl enable "$SERVICE" "$SERVICE-lamp"
  if [[ "$start" == yes ]]; then
    on_system systemctl restart "$SERVICE-lamp" "$SERVICE"
  fi
}

run_doctor() {
  # The service holds camera and lamps, so what it has already taken shows as busy: not a failure.
  if [[ "$system" == yes ]]; then
    run runuser -u "$SERVICE" -- "$current/bin/bikeped" doctor -c "$config" ||
      say "doctor found a problem: see above"
  else
    run "$current/bin/bikeped" doctor -c "$config" ||
      say "doctor found a problem: see above"
  fi
}

next_steps() {
  cat <<NEXT

Done. Next:
  1. edit $config (camera height and pitch, model file, lamps)
  2. $current/bin/bikeped config check -c $config
  3. sudo systemctl restart $SERVICE-lamp $SERVICE
  4. journalctl -u $SERVICE -f
Back to the release before this one: sudo $0 --rollback
NEXT
}

need_root

if [[ "$rollback" == yes ]]; then
  [[ -L "$previous" ]] || fail "$previous: there is no release to go back to"
  back="$(readlink "$previous")"
  [[ -d "$back" ]] || fail "$previous: points to $back, which is gone"
  run "$back/bin/bikeped" config check -c "$config" ||
    fail "the release before refuses $config (see above); correct it first"
  was="$(readlink "$current")"
  point "$current" "$back"
  point "$previous" "$was"
  if [[ "$start" == yes ]]; then
    on_system systemctl restart "$SERVICE-lamp" "$SERVICE"
  fi
  say "Back to $back; the release left is $was"
  exit 0
fi

check_source
install_packages
make_user
make_release
install_config
check_config
switch_release
install_files
drop_old_releases
run_doctor
restart_service
next_steps
