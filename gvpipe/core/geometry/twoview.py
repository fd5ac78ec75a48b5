"""Two cameras over one ground plane, as eight meaningful parameters of their homography."""

from dataclasses import dataclass, replace

import numpy as np

from gvpipe.core.geometry.homography import normalise
from gvpipe.core.kernels.twoview import fit_pair, pair_homography
from gvpipe.core.types import Camera, Float, Mount, View

SETTLED = 1e-7
"""Share of the cost gained in a step after which a fit ends."""


@dataclass(frozen=True)
class PairPrior:
    """What is known of a pair before it is matched, one standard deviation each.

    Attributes
    ----------
    tilt_i, tilt_j, roll : float
        Error of the configured tilts and of both rolls, radians.
    log_scale : float
        Error of the ratio of the configured heights, as a natural logarithm.
    limit : float
        Largest error of a known tilt and of a roll, radians: beyond, the plane is another one.
    """

    tilt_i: float
    tilt_j: float
    roll: float
    log_scale: float
    limit: float = np.inf

    @property
    def weights(self) -> Float:
        """(8,) inverse standard deviations of :attr:`TwoView.parameters`; 0 = unknown."""
        known = (self.log_scale, self.tilt_i, self.roll, self.tilt_j, self.roll)
        return np.array([0.0, 0.0, 0.0, *(1.0 / s for s in known)])


@dataclass(frozen=True)
class TwoView:
    """The geometry of a pair.

    Attributes
    ----------
    camera_i, camera_j : Camera
        Intrinsics.
    mount_i, mount_j : Mount
        Tilts and rolls as estimated, heights as configured.
    yaw, x, y : float
        Pose of robot i in the ground frame of robot j: radians, metres.
    log_scale : float
        Logarithm of the scale of ``ground_j_from_ground_i``; 0 when both configured heights hold.
    """

    camera_i: Camera
    camera_j: Camera
    mount_i: Mount
    mount_j: Mount
    yaw: float = 0.0
    x: float = 0.0
    y: float = 0.0
    log_scale: float = 0.0

    @property
    def parameters(self) -> Float:
        """(8,) yaw, x, y, log scale, tilt and roll of i, tilt and roll of j."""
        i, j = self.mount_i, self.mount_j
        return np.array([self.yaw, self.x, self.y, self.log_scale, i.tilt, i.roll, j.tilt, j.roll])

    def with_parameters(self, parameters: Float) -> "TwoView":
        """Return the same cameras with other :attr:`parameters`."""
        yaw, x, y, log_scale, tilt_i, roll_i, tilt_j, roll_j = (float(v) for v in parameters)
        return replace(
            self,
            yaw=float(np.arctan2(np.sin(yaw), np.cos(yaw))),
            x=x,
            y=y,
            log_scale=log_scale,
            mount_i=replace(self.mount_i, tilt=tilt_i, roll=roll_i),
            mount_j=replace(self.mount_j, tilt=tilt_j, roll=roll_j),
        )

    @property
    def ground_j_from_ground_i(self) -> Float:
        """(3, 3) similarity between the two robots' ground frames, metres."""
        s = np.exp(self.log_scale)
        c, n = s * np.cos(self.yaw), s * np.sin(self.yaw)
        return np.array([[c, -n, self.x], [n, c, self.y], [0.0, 0.0, 1.0]])

    @property
    def projection(self) -> Float:
        """(3, 3) pixel_j_from_pixel_i; third component positive in front of camera j."""
        return np.asarray(
            pair_homography(
                self.parameters,
                self.camera_i.inverse,
                self.camera_j.matrix,
                self.mount_i.height,
                self.mount_j.height,
            )
        )

    @property
    def homography(self) -> Float:
        """(3, 3) pixel_j_from_pixel_i for ground points, normalised (thesis eq. 3.4.1)."""
        return normalise(self.projection)

    def drift(self, expected: "TwoView") -> float:
        """Largest difference of a roll or a known tilt from the expected one, radians."""
        off = np.abs(self.parameters[4:] - expected.parameters[4:])
        i, j = expected.mount_i.tilt_known, expected.mount_j.tilt_known
        return float((off * np.array([i, True, j, True])).max())


def two_views(view_i: View, view_j: View) -> TwoView:
    """Geometry of a pair as configured, the robots standing in one place."""
    return TwoView(view_i.camera, view_j.camera, view_i.mount, view_j.mount)


@dataclass(frozen=True)
class PairFit:
    """A :class:`TwoView` at its optimum.

    Attributes
    ----------
    geometry : TwoView
        The estimate.
    cost : float
        Half the robust sum of squares, prior included.
    information : (8, 8) float64
        Inverse covariance of the parameters.
    """

    geometry: TwoView
    cost: float
    information: Float

    @property
    def homography_covariance(self) -> Float:
        """(9, 9) covariance of the row-major entries of the normalised homography."""
        theta = self.geometry.parameters
        step = 1e-6
        columns = []
        for k in range(len(theta)):
            moved = step * (np.arange(len(theta)) == k)
            up = self.geometry.with_parameters(theta + moved).homography
            down = self.geometry.with_parameters(theta - moved).homography
            columns.append((up - down).ravel() / (2 * step))
        chain = np.column_stack(columns)
        return np.asarray(chain @ np.linalg.pinv(self.information, hermitian=True) @ chain.T)


def _limits(expected: TwoView, limit: float) -> Float:
    """(8,) largest departures of the parameters from their expected values."""
    tilts = [limit if m.tilt_known else np.inf for m in (expected.mount_i, expected.mount_j)]
    return np.array([np.inf, np.inf, np.inf, np.inf, tilts[0], limit, tilts[1], limit])


def fit_two_views(
    start: TwoView,
    expected: TwoView,
    prior: PairPrior,
    points_i: Float,
    points_j: Float,
    whiten: Float | None = None,
    loss: float = 3.0,
    iterations: int = 30,
) -> PairFit:
    """Robust maximum a posteriori geometry of matched ground pixels.

    Parameters
    ----------
    start : TwoView
        Where the descent begins.
    expected : TwoView
        As configured; its mounts and scale are the prior's centre.
    prior : PairPrior
        How far the configuration may be off.
    points_i, points_j : (N, 2) float64
        Matched pixels; wrong ones are allowed.
    whiten : (N, 2, 2) float64, optional
        Takes residuals in image j, pixels, to unit standard deviation; default one pixel.
    loss : float
        Residuals beyond this many standard deviations lose their weight (Geman-McClure).
    iterations : int
        Most Levenberg-Marquardt steps.

    Returns
    -------
    fit : PairFit
    """
    n = len(points_i)
    if whiten is None:
        whiten = np.broadcast_to(np.eye(2), (n, 2, 2))
    theta, cost, information = fit_pair(
        start.parameters,
        expected.parameters,
        prior.weights,
        _limits(expected, prior.limit),
        start.camera_i.inverse,
        start.camera_j.matrix,
        start.mount_i.height,
        start.mount_j.height,
        np.ascontiguousarray(points_i, dtype=np.float64),
        np.ascontiguousarray(points_j, dtype=np.float64),
        np.ascontiguousarray(whiten, dtype=np.float64),
        loss,
        iterations,
        SETTLED,
    )
    return PairFit(start.with_parameters(theta), float(cost), np.asarray(information))
