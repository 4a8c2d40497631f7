#!/usr/bin/env bash
# CPython 3.10 to 3.13: inspect.getclosurevars raises ValueError for a function with a free variable that has no value yet,
# although its result has a set of names that cannot be resolved.
#
# Guess before the run: the name is in the set `unbound` of the result, as a global name without a value is. The script
# fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/observe.py" <<'PYTHON'
import inspect


def outer():
    def free():
        return later

    def open():
        return nowhere
    for function in (open, free):
        try:
            print(function.__name__, inspect.getclosurevars(function).unbound)
        except ValueError as error:
            print(function.__name__, 'ValueError:', error)
    later = 1
    print('then', inspect.getclosurevars(free).nonlocals)


outer()
PYTHON
python3 --version
found=$(timeout 120 python3 "$folder/observe.py")
echo "$found"
[[ $found == $'open {\'nowhere\'}\nfree ValueError: Cell is empty\nthen {\'later\': 1}' ]]
