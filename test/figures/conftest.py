"""The scripts that reproduce the paper's figures, as modules."""

import importlib.util
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / 'scripts' / 'figures'


@pytest.fixture(scope='session')
def load_figure():
    """Callable that imports a script by name."""
    # As when Python runs a script, so that the script finds its parts.
    sys.path.insert(0, str(FOLDER))

    def load(name):
        spec = importlib.util.spec_from_file_location(f'figures_{name}', FOLDER / f'{name}.py')
        module = importlib.util.module_from_spec(spec)
        # Jobs are pickled with the name of the module of their function.
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        return module
    return load
