"""Cramer-Rao bounds of positioning and their gradients."""

from rhs_isac_ros.bounds.fisher import Factors, crlb, factor, fisher_information
from rhs_isac_ros.bounds.gradient import AverageCrlb, average_crlb

__all__ = [
    'AverageCrlb', 'Factors', 'average_crlb', 'crlb', 'factor', 'fisher_information',
]
