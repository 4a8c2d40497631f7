#!/usr/bin/env bash
# joblib 1.6.0 with its copy of loky 3.6.0: if `shutdown(kill_workers=True)` follows directly on `submit`, the thread of
# the executor may end with a KeyError, whose traceback appears on stderr. The thread first removes calls without a
# result, and then looks up a call whose number is still in its queue. Whether it happens depends on which thread runs.
# loky 3.7.0 empties that queue first.
#
# Expected from the documentation: the call ends with a ShutdownExecutorError or its result, and nothing is printed.
# The script fails unless one of 200 calls shows the KeyError.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'joblib==1.6.0'
cat > "$folder/observe.py" <<'PYTHON'
import threading

import joblib
from joblib.externals import loky

if __name__ == '__main__':
    failures = []
    threading.excepthook = lambda failure: failures.append(failure.exc_type.__name__)
    for _ in range(200):
        executor = loky.ProcessPoolExecutor(1)
        # The second call finds the thread and the process waiting.
        executor.submit(abs, -1).result()
        executor.submit(abs, -2)
        executor.shutdown(kill_workers=True)
        if failures:
            break
    print('joblib', joblib.__version__, 'with loky', loky.__version__)
    print('the thread of the executor ends with', *failures)
PYTHON
found=$(timeout 240 "$folder/venv/bin/python" "$folder/observe.py")
"$folder/venv/bin/python" -c 'import platform; print(platform.python_version())'
echo "$found"
[[ $found == $'joblib 1.6.0 with loky 3.6.0\nthe thread of the executor ends with KeyError' ]]
