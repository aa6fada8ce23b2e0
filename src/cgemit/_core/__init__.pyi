# Types of the compiled module, whose submodules are named as the folders of the core (src/cpp);
# tests/quality/test_stubs.py compares them with it.
# Arrays go in C-contiguous and are converted to the dtype named here; they come out as new arrays that own the
# memory of the core. Dicts hold one array per column of the tables in docs/data_model.md.
from cgemit._core import _testing as _testing
from cgemit._core import calibration as calibration
from cgemit._core import common as common
from cgemit._core import covariance as covariance
from cgemit._core import detector as detector
from cgemit._core import kalman as kalman
from cgemit._core import kernels as kernels
from cgemit._core import matter as matter
from cgemit._core import readout as readout
from cgemit._core import reconstruction as reconstruction
from cgemit._core import simulation as simulation
from cgemit._core import truth as truth
