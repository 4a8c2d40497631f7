"""Reports with intervals from few replicates."""

import pytest

from rhs_isac_ros.experiments import resampling


@pytest.fixture(scope='package', autouse=True)
def few_replicates():
    """Resample a tenth as often: the tests compare statistics, and intervals far from a limit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resampling, '_RESAMPLES', 200)
        resampling._case_weights.cache_clear()
        yield
    resampling._case_weights.cache_clear()
