"""Normal equations of cameras and robot means: damped solution and covariances."""

from dataclasses import replace

import numpy as np

from gvpipe.core.slam.fronts import Blocks, Dissection, Factor
from gvpipe.core.types import Float, Index


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

    def step(self, factor: Factor, gradient: Float) -> Float:
        """Step (S,) over all unknowns against a gradient, by factors of this matrix or one near."""
        right = -gradient
        right[self.held] = 0.0
        return factor.solve(right)


def marginal_covariances(factor: Factor, held: Index, beside: Index) -> tuple[Float, Float]:
    """Covariance blocks of the inverse normal matrix.

    Parameters
    ----------
    factor : Factor
        Of a :class:`Normal` of N cameras.
    held : (H,) int64
        Unknowns that are held fixed in it.
    beside : (C,) int64
        Further unknowns whose covariance with all is wanted; none of them held.

    Returns
    -------
    own : (N, 6, 6) float64
        Covariance of each camera's unknowns; zero where they are held fixed.
    cross : (S, C) float64
        Covariance of all unknowns with those in `beside`.
    """
    plan = factor.plan
    own = factor.marginals()
    camera, unknown = np.divmod(held, plan.size)
    own[camera, unknown, unknown] = 0.0
    columns = np.zeros((plan.size * plan.count + plan.border, len(beside)))
    columns[beside, np.arange(len(beside))] = 1.0
    return own, factor.solve(columns)
