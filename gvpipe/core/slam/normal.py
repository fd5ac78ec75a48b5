"""Normal equations of cameras and robot means: damped solution and covariances."""

from dataclasses import replace

import numpy as np

from gvpipe.core.slam.fronts import Blocks, Dissection, Factor
from gvpipe.core.slam.tracks import Index
from gvpipe.core.types import Float


class Normal:
    """Normal matrix of all cameras, with the robots' means as its border.

    Parameters
    ----------
    plan : Dissection
        Which cameras share a block.
    blocks : Blocks
        The matrix; taken over.
    held : (H,) int64
        Unknowns of cameras that are held fixed: they get zero steps and zero covariances.
    """

    def __init__(self, plan: Dissection, blocks: Blocks, held: Index) -> None:
        self.plan, self.blocks, self.held = plan, blocks, held
        camera, unknown = np.divmod(held, plan.size)
        for c, u in zip(camera.tolist(), unknown.tolist(), strict=True):
            blocks.diagonal[c, u], blocks.diagonal[c, :, u] = 0.0, 0.0
            blocks.diagonal[c, u, u] = 1.0
            blocks.between[plan.i == c, u] = 0.0
            blocks.between[plan.j == c, :, u] = 0.0
            blocks.border[c, u] = 0.0

    def factor(self, damping: float = 0.0) -> Factor:
        """Cholesky factors with the diagonal raised by the share `damping`.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is not positive definite.
        """
        raised = 1.0 + damping * np.eye(self.plan.size)
        corner = self.blocks.corner * (1.0 + damping * np.eye(self.plan.border))
        return Factor(
            self.plan, replace(self.blocks, diagonal=self.blocks.diagonal * raised, corner=corner)
        )

    def step(self, gradient: Float, damping: float) -> Float:
        """Step (S,) over all unknowns against a gradient.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is not positive definite.
        """
        right = -gradient
        right[self.held] = 0.0
        return self.factor(damping).solve(right)


def marginal_covariances(normal: Normal, beside: Index) -> tuple[Float, Float]:
    """Covariance blocks of the inverse normal matrix.

    Parameters
    ----------
    normal : Normal
        Of N cameras.
    beside : (C,) int64
        Further unknowns whose covariance with all is wanted; none of them held.

    Returns
    -------
    own : (N, 6, 6) float64
        Covariance of each camera's unknowns; zero where they are held fixed.
    cross : (S, C) float64
        Covariance of all unknowns with those in `beside`.
    """
    plan = normal.plan
    factor = normal.factor()
    own = factor.marginals()
    camera, unknown = np.divmod(normal.held, plan.size)
    own[camera, unknown, unknown] = 0.0
    columns = np.zeros((plan.size * plan.count + plan.border, len(beside)))
    columns[beside, np.arange(len(beside))] = 1.0
    return own, factor.solve(columns)
