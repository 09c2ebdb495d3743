"""Mismatch between a nominal model and recordings: located, named, modelled, and tested on records not used."""

from bayes_nlsid.mismatch.case import Case, read_case
from bayes_nlsid.mismatch.diagnose import diagnose
from bayes_nlsid.mismatch.diagnosis import Diagnosis, write_diagnosis

__all__ = ["Case", "Diagnosis", "diagnose", "read_case", "write_diagnosis"]
