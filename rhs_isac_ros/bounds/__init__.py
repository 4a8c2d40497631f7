"""Bounds on positioning errors, predicted errors, and gradients for the design of codebooks."""

from rhs_isac_ros.bounds.average import AverageCrlb, average_crlb
from rhs_isac_ros.bounds.fisher import (
    crlb,
    crlb_of,
    fisher_information,
    site_crlb,
    site_information,
)
from rhs_isac_ros.bounds.global_bound import GlobalBound, global_bound
from rhs_isac_ros.bounds.misspecified import Misspecified, misspecified
from rhs_isac_ros.bounds.pairwise_error import PairwiseErrorCost

__all__ = [
    'AverageCrlb', 'GlobalBound', 'Misspecified', 'PairwiseErrorCost', 'average_crlb', 'crlb',
    'crlb_of', 'fisher_information', 'global_bound', 'misspecified', 'site_crlb',
    'site_information',
]
