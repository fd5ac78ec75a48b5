"""The three plain motions of a front, in any number of dimensions (thesis, section 5.3).

Here phi is negative inside, as in that section; :mod:`gvpipe.core.reconstruct.levelset` works
with the opposite sign, as the thesis' section 5.6 does. These functions take one explicit time step
on a whole array; they serve to understand and to test, not to be fast.
"""

import numpy as np

from gvpipe.core.types import Float

TINY = 1e-12
"""Keeps divisions by a squared slope finite where phi is flat."""


def _shifted(phi: Float, axis: int, by: int) -> Float:
    """Value of the neighbour `by` (-1, 1) along an axis; borders repeat the outermost."""
    index = np.clip(np.arange(phi.shape[axis]) + by, 0, phi.shape[axis] - 1)
    return np.take(phi, index, axis=axis)


def one_sided(phi: Float, axis: int, spacing: float) -> tuple[Float, Float]:
    """Backward and forward difference along an axis (thesis eq. 5.3.11).

    Parameters
    ----------
    phi : (n, ...) float64
    axis : int
    spacing : float
        Grid spacing along it.

    Returns
    -------
    backward, forward : (n, ...) float64
        0 at the border that has no neighbour on that side.
    """
    backward = (phi - _shifted(phi, axis, -1)) / spacing
    forward = (_shifted(phi, axis, 1) - phi) / spacing
    return backward, forward


def _central(phi: Float, axis: int, spacing: float) -> Float:
    """Central difference along an axis."""
    return (_shifted(phi, axis, 1) - _shifted(phi, axis, -1)) / (2.0 * spacing)


def upwind_slopes(phi: Float, spacing: float) -> tuple[Float, Float]:
    """Slopes D+ for fronts that grow and D- for fronts that shrink.

    Parameters
    ----------
    phi : (n, ...) float64
        Negative inside; two, three or any number of dimensions.
    spacing : float
        Grid spacing, the same along all axes.

    Returns
    -------
    growing, shrinking : (n, ...) float64
        Entropy-satisfying |grad phi| (thesis eq. 5.3.10, whose D- repeats D+ in print).
    """
    growing, shrinking = np.zeros_like(phi), np.zeros_like(phi)
    for axis in range(phi.ndim):
        backward, forward = one_sided(phi, axis, spacing)
        growing += np.maximum(backward, 0.0) ** 2 + np.minimum(forward, 0.0) ** 2
        shrinking += np.minimum(backward, 0.0) ** 2 + np.maximum(forward, 0.0) ** 2
    return np.sqrt(growing), np.sqrt(shrinking)


def curvature(phi: Float, spacing: float) -> Float:
    """Sum of the principal curvatures, ``div(grad phi / |grad phi|)`` (thesis eq. 5.3.5).

    Parameters
    ----------
    phi : (n, ...) float64
        Negative inside.
    spacing : float
        Grid spacing.

    Returns
    -------
    curvature : (n, ...) float64
        1 / r for a circle, 2 / r for a sphere; no larger than one over the spacing, the sharpest
        bend a grid can show.
    """
    slopes = [_central(phi, axis, spacing) for axis in range(phi.ndim)]
    square = sum((s**2 for s in slopes), np.full_like(phi, TINY))
    bend = np.zeros_like(phi)
    for a in range(phi.ndim):
        second = (_shifted(phi, a, 1) - 2.0 * phi + _shifted(phi, a, -1)) / spacing**2
        bend += second * (square - slopes[a] ** 2)
        for b in range(a):
            bend -= 2.0 * slopes[a] * slopes[b] * _central(slopes[a], b, spacing)
    limit = 1.0 / spacing
    return np.clip(bend / square**1.5, -limit, limit)


def step_by_curvature(phi: Float, speed: float, spacing: float, time_step: float) -> Float:
    """Move the front by its curvature: convex parts inward for a positive `speed`.

    Parameters
    ----------
    phi : (n, ...) float64
        Negative inside.
    speed : float
        b > 0 of ``phi_t = b kappa |grad phi|``, squared length per time.
    spacing, time_step : float
        Stable up to ``spacing**2 / (2 ndim b)``.

    Returns
    -------
    phi : (n, ...) float64
        One step later (thesis eq. 5.3.6 with the sign of its last term corrected).

    Raises
    ------
    ValueError
        If the speed is negative: the flow would be backward diffusion.
    """
    if speed < 0:
        raise ValueError("curvature flow with a negative speed is ill-posed")
    slopes = [_central(phi, axis, spacing) for axis in range(phi.ndim)]
    slope = np.sqrt(sum((s**2 for s in slopes), np.zeros_like(phi)))
    return phi + time_step * speed * curvature(phi, spacing) * slope


def step_along_normal(phi: Float, speed: Float | float, spacing: float, time_step: float) -> Float:
    """Move the front along its normal: outward where `speed` is positive.

    Parameters
    ----------
    phi : (n, ...) float64
        Negative inside.
    speed : float or (n, ...) float64
        a of ``phi_t + a |grad phi| = 0``, length per time.
    spacing, time_step : float
        Stable up to ``spacing / (ndim |a|)``.

    Returns
    -------
    phi : (n, ...) float64
        One step later (thesis eq. 5.3.9).
    """
    growing, shrinking = upwind_slopes(phi, spacing)
    a = np.asarray(speed, dtype=np.float64)
    return phi - time_step * (np.maximum(a, 0.0) * growing + np.minimum(a, 0.0) * shrinking)


def step_by_velocity(phi: Float, velocity: Float, spacing: float, time_step: float) -> Float:
    """Carry the front along with an outside velocity field.

    Parameters
    ----------
    phi : (n, ...) float64
        Negative inside, `ndim` dimensions.
    velocity : (ndim, n, ...) float64
        Component along each axis, length per time.
    spacing, time_step : float
        Stable up to ``spacing / sum of |components|``.

    Returns
    -------
    phi : (n, ...) float64
        One step later, upwind (thesis eq. 5.3.13).
    """
    change = np.zeros_like(phi)
    for axis, component in enumerate(velocity):
        backward, forward = one_sided(phi, axis, spacing)
        change += np.maximum(component, 0.0) * backward + np.minimum(component, 0.0) * forward
    return phi - time_step * change
