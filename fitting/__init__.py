"""Fit control meshes of `jaxsubdiv` surfaces to scanned point clouds."""

from ._align import Alignment as Alignment
from ._align import align as align
from ._correspondence import closest_points as closest_points
from ._example import example as example
from ._fit import Sweep as Sweep
from ._fit import fit as fit
from ._free import Free as Free
from ._landmarks import Landmarks as Landmarks
from ._landmarks import match_landmarks as match_landmarks
from ._landmarks import read_landmarks as read_landmarks
from ._picture import draw_fit as draw_fit
from ._report import Report as Report
from ._residuals import Priors as Priors
from ._result import FitResult as FitResult
from ._robust import AbstractLoss as AbstractLoss
from ._robust import Barron as Barron
from ._robust import Huber as Huber
from ._robust import LeastSquares as LeastSquares
from ._robust import Tukey as Tukey
from ._robust import cauchy as cauchy
from ._robust import geman_mcclure as geman_mcclure
from ._scan import Scan as Scan
from ._scan import ScanError as ScanError
from ._scan import read_scan as read_scan
