"""Cramer-Rao bounds of positioning and their gradients."""

from rhs_isac_ros.bounds.average_crlb import AverageCrlb, average_crlb
from rhs_isac_ros.bounds.fisher import crlb, crlb_of, fisher_information, fisher_information_of
from rhs_isac_ros.bounds.pairwise_error import PairwiseErrorCost

__all__ = [
    'AverageCrlb', 'PairwiseErrorCost', 'average_crlb', 'crlb', 'crlb_of', 'fisher_information',
    'fisher_information_of',
]
