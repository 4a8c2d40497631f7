"""Cramer-Rao bounds of positioning and their gradients."""

from rhs_isac_ros.bounds.average_crlb import AverageCrlb, average_crlb
from rhs_isac_ros.bounds.fisher import Factors, crlb, factor, fisher_information
from rhs_isac_ros.bounds.pairwise_error import PairwiseErrorCost

__all__ = [
    'AverageCrlb', 'Factors', 'PairwiseErrorCost', 'average_crlb', 'crlb', 'factor',
    'fisher_information',
]
