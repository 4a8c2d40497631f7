"""A surface of many elements, without computing one."""

import pytest

from rhs_isac_ros.model import multipath


@pytest.fixture
def by_convolution(monkeypatch):
    """Multiply by V as for a surface of many elements, with few plane waves."""
    caches = (multipath.spatial_covariance, multipath.declared_covariance, multipath._stretches,
              multipath.multipath_factors)
    for cache in caches:
        cache.cache_clear()
    monkeypatch.setattr(multipath, '_MAX_MATRIX', 1)
    yield
    for cache in (*caches, multipath._lattice):
        cache.cache_clear()
