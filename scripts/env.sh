# Makes ROS 2, the messages and rhs_isac_ros available in the current bash or zsh, from any directory:
#   . scripts/env.sh
# shellcheck shell=bash

_rhs_prepend() { # NAME directory: prepends the directory to the path variable unless it is included
  eval "case :\${$1-}: in (*:\"\$2\":*) ;; (*) export $1=\"\$2\${$1:+:\$$1}\" ;; esac"
}

_rhs_load() { # root shell
  local mode='' libraries
  if [ -f "$1/install/.setup" ]; then read -r mode _ <"$1/install/.setup"; fi
  case $mode:${ROS_DISTRO:-} in
    wheels:)
      # First in PATH, even if another environment was activated in between.
      case $PATH: in ("$1/.venv/bin:"*) ;; (*) PATH=$1/.venv/bin:$PATH ;; esac
      export PATH VIRTUAL_ENV="$1/.venv"
      # Without these, the wheels restart every Python process to set them.
      export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
      libraries=$(find "$1/.venv/lib" -maxdepth 3 -name 'ros_*.libs' | sort | tr '\n' ':')
      _rhs_prepend LD_LIBRARY_PATH "$libraries$1/.venv/lib"
      _rhs_prepend AMENT_PREFIX_PATH "$1/.venv"
      # shellcheck source=/dev/null
      . "$1/install/local_setup.$2"
      ;;
    system: | system:jazzy)
      # shellcheck source=/dev/null
      . "$1/install/setup.$2"
      ;;
    wheels:*)
      echo "env.sh: this clone was built with the wheels, but ROS 2 $ROS_DISTRO is sourced: use a shell without ROS" >&2
      return 1
      ;;
    system:*)
      echo "env.sh: this clone was built on ROS 2 Jazzy, but ROS 2 $ROS_DISTRO is sourced: source Jazzy" >&2
      return 1
      ;;
    *)
      echo 'env.sh: the packages have not been built: run scripts/setup' >&2
      return 1
      ;;
  esac
}

_rhs_env() {
  local shell=bash file=${BASH_SOURCE[0]:-} nounset='' code=0
  # bash cannot parse the zsh counterpart of BASH_SOURCE.
  if [ -n "${ZSH_VERSION:-}" ]; then shell=zsh && eval 'file=${(%):-%x}'; fi
  # colcon's scripts read unset variables.
  case $- in (*u*) nounset=1 && set +u ;; esac
  _rhs_load "$(CDPATH='' builtin cd -- "$(dirname -- "$file")/.." && pwd -P)" "$shell" || code=1
  if [ -n "$nounset" ]; then set -u; fi
  return "$code"
}

# Before `||`, a failing command does not end a shell that has `set -e`.
_rhs_env || {
  unset -f _rhs_prepend _rhs_load _rhs_env
  return 1
}
unset -f _rhs_prepend _rhs_load _rhs_env
