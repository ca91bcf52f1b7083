"""The closed-form classifier: codes, exact statistics, readouts computed from them, and their calibration."""

from scroll_tactile.ridge.codes import BITS, to_codes
from scroll_tactile.ridge.readouts import Readout, fit_readout
from scroll_tactile.ridge.statistics import FOLDS, Statistics, fold_of

__all__ = ["BITS", "FOLDS", "Readout", "Statistics", "fit_readout", "fold_of", "to_codes"]
