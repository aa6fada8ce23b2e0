"""The paper, arXiv:1504.02570, number by number and figure by figure."""

from cgemit.study.paper.results import COS_THETA, DETECTORS, MOMENTA, THIN_GAP, Reproduction, Row
from cgemit.study.paper.run import reproduce

__all__ = ["COS_THETA", "DETECTORS", "MOMENTA", "THIN_GAP", "Reproduction", "Row", "reproduce"]
