"""Sparse normal matrices: damped solution, and the covariances their inverse holds."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_matrix, diags_array
from scipy.sparse.linalg import splu

from gvpipe.core.slam.tracks import Index
from gvpipe.core.types import Float

DENSE_LIMIT = 1500
"""Unknowns up to which a dense factorisation is faster than a sparse one."""


BATCH = 50
"""Cameras whose covariances are solved for at a time: bounds the memory of large maps."""


class Normal:
    """Sparse symmetric normal matrix of all cameras and robot means, some unknowns held fixed."""

    def __init__(self, matrix: csc_matrix, free: Index) -> None:
        self.size = matrix.shape[0]
        self.free = free
        self.matrix = csc_matrix(matrix[free][:, free])

    def factor(self, damping: float = 0.0) -> "Factor":
        """Cholesky or LU factors with the diagonal raised by the share `damping`."""
        return Factor(self, damping)


class Factor:
    """Solver of one damped normal matrix; fixed unknowns get zero steps.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(self, normal: Normal, damping: float) -> None:
        self._normal = normal
        diagonal = normal.matrix.diagonal()
        if not (diagonal > 0).all():
            raise np.linalg.LinAlgError("an unknown has no equation")
        # a unit diagonal: radians, metres and logarithms differ by orders of magnitude
        self._scale = 1.0 / np.sqrt(diagonal)
        scaling = diags_array(self._scale)
        matrix = csc_matrix(scaling @ normal.matrix @ scaling)
        matrix.setdiag(1.0 + damping)
        self._dense = len(normal.free) <= DENSE_LIMIT
        if self._dense:
            self._cholesky = cho_factor(matrix.toarray(), lower=True)
        else:
            self._lu = splu(
                matrix,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )

    def solve(self, right: Float) -> Float:
        """Solve for one (S,) or several (S, C) right sides over all unknowns."""
        free = self._normal.free
        full = np.zeros_like(right)
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        part = np.ascontiguousarray(right[free] * scale)
        solved = cho_solve(self._cholesky, part) if self._dense else self._lu.solve(part)
        full[free] = solved * scale
        return full


def marginal_covariances(normal: Normal, cameras: int, beside: Index) -> tuple[Float, Float]:
    """Covariance blocks of the inverse normal matrix.

    Parameters
    ----------
    normal : Normal
        Its first ``6 * cameras`` unknowns are those of the cameras.
    cameras : int
        N.
    beside : (C,) int64
        Further unknowns whose covariance with every camera is wanted.

    Returns
    -------
    own : (N, 6, 6) float64
        Covariance of each camera's unknowns; zero where they are held fixed.
    cross : (N, 6, C) float64
        Covariance of each camera's unknowns with those in `beside`.
    """
    factor = normal.factor()
    own = np.empty((cameras, 6, 6))
    for begin in range(0, cameras, BATCH):
        count = min(BATCH, cameras - begin)
        solved = factor.solve(_unit_columns(normal.size, np.arange(6 * begin, 6 * (begin + count))))
        part = solved[6 * begin : 6 * (begin + count)].reshape(count, 6, count, 6)
        own[begin : begin + count] = part[np.arange(count), :, np.arange(count)]
    cross = factor.solve(_unit_columns(normal.size, beside))[: 6 * cameras]
    return own, cross.reshape(cameras, 6, len(beside))


def _unit_columns(size: int, which: Index) -> Float:
    """Columns (size, C) of the identity matrix."""
    columns = np.zeros((size, len(which)))
    columns[which, np.arange(len(which))] = 1.0
    return columns
