#!/usr/bin/env bash
# CPython 3.11.7, 3.12.1 and 3.13.0: argparse takes two options of a mutually exclusive group if one
# has the value of its default, but only if both are one object. With integers, these are the ones
# that CPython caches: a default of 256 is not in conflict, a default of 257 is.
#
# Expected from the documentation: an error whenever two options of a group are on the command line.
# Guess before the run, from the code of argparse: values that are the object of the default do not
# count, so that small integers and large ones differ. The script fails if the behaviour changes.
set -euo pipefail
found=$(timeout 60 python3 - <<'PYTHON'
import argparse
import contextlib
import io


def is_refused(default):
    """Give an option with the value of its default, and another one of its group."""
    parser = argparse.ArgumentParser()
    group = parser.add_mutually_exclusive_group()
    group.add_argument('--processes', type=int, default=default)
    group.add_argument('--cluster')
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            parser.parse_args(['--processes', str(default), '--cluster', 'host'])
    except SystemExit:
        return True
    return False


for number in (1, 256, 257, 1000):
    print(number, 'refused' if is_refused(number) else 'taken')
PYTHON
)
python3 --version
echo "$found"
[[ $found == $'1 taken\n256 taken\n257 refused\n1000 refused' ]]
