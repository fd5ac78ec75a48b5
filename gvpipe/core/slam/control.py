"""Known ground points: what they add to the adjustment, and the first placement by them."""

from dataclasses import dataclass

import numpy as np

from gvpipe.core.slam.rig import Rig, State, camera_from_map, centres, turning
from gvpipe.core.types import Float, Index

SIGMA_PX = 1.0
"""How well a known point is pointed at in a picture, pixels: a careful click."""

MIN_POINTS = 2
"""Known points that fix position, heading and scale."""

MIN_APART = 1e-6
"""Known points nearer to each other than this are one, metres."""


@dataclass(frozen=True)
class Control:
    """Known ground points seen by cameras of a rig.

    Attributes
    ----------
    camera : (C,) int64
        Camera of each observation.
    pixel : (C, 2) float64
        Undistorted pixels.
    position : (C, 2) float64
        In the site frame, metres.
    """

    camera: Index
    pixel: Float
    position: Float

    @property
    def fixes_the_map(self) -> bool:
        """Whether there are two different points, at least."""
        return len(self.position) >= MIN_POINTS and bool(
            np.ptp(self.position, axis=0).max() > MIN_APART
        )

    def errors_px(self, rig: Rig, cameras: Float) -> Float:
        """Reprojection errors (C, 2), pixels; not finite behind a camera."""
        return self._project(rig, cameras)[0] - self.pixel

    def cost(self, rig: Rig, cameras: Float) -> float:
        """Sum the squared errors in units of their variance."""
        error = self.errors_px(rig, cameras)
        return float((error**2).sum()) / SIGMA_PX**2 if np.isfinite(error).all() else np.inf

    def normal(self, rig: Rig, cameras: Float) -> tuple[Float, Float]:
        """Return blocks (N, 6, 6) of the normal matrix and gradient (N, 6) of half the cost."""
        seen, jacobian = self._project(rig, cameras)
        jacobian, error = jacobian / SIGMA_PX, (seen - self.pixel) / SIGMA_PX
        blocks, gradient = np.zeros((len(cameras), 6, 6)), np.zeros((len(cameras), 6))
        np.add.at(blocks, self.camera, np.einsum("cki,ckj->cij", jacobian, jacobian))
        np.add.at(gradient, self.camera, np.einsum("cki,ck->ci", jacobian, error))
        return blocks, gradient

    def _project(self, rig: Rig, cameras: Float) -> tuple[Float, Float]:
        """Pixels (C, 2) of the known points and their derivatives (C, 2, 6)."""
        matrix, turned = rig.matrix[self.camera], turning(rig, cameras)
        projection = matrix @ camera_from_map(rig, cameras)[self.camera]
        centre = centres(rig, cameras)[self.camera]
        ray = np.column_stack([self.position - centre[:, :2], -centre[:, 2]])
        image = np.einsum("cij,cj->ci", projection, ray)
        depth = np.where(image[:, 2] > 0, image[:, 2], np.nan)[:, None]
        pixel = image[:, :2] / depth
        change = np.empty((len(pixel), 3, 6))
        change[:, :, :2] = -projection[:, :, :2]
        change[:, :, 2:5] = np.einsum(
            "cij,cqjk,ck->ciq", matrix, turned[self.camera], ray, optimize=True
        )
        change[:, :, 5] = -projection[:, :, 2] * centre[:, 2:]
        derivative = (change[:, :2] - pixel[:, :, None] * change[:, 2:]) / depth[:, :, None]
        return pixel, derivative


def placed_by(control: Control, rig: Rig, state: State) -> State:
    """Move, turn and scale a whole map so that the known points lie best where they should.

    Parameters
    ----------
    control : Control
        Two different points at least.
    rig : Rig
        The cameras.
    state : State
        The map in a frame of its own.

    Returns
    -------
    state : State
        In the site frame; the matches fit as well as before.
    """
    here = _on_the_ground(control, rig, state.cameras)
    z, w = here @ [1.0, 1.0j], control.position @ [1.0, 1.0j]
    weight = np.isfinite(z).astype(np.float64)
    z = np.where(weight > 0, z, 0.0)
    middle_z, middle_w = (weight @ z) / weight.sum(), (weight @ w) / weight.sum()
    off = (z - middle_z) * weight
    factor = (off.conj() @ (w - middle_w)) / np.vdot(off, off)
    shift = middle_w - factor * middle_z
    turn = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    cameras, means = state.cameras.copy(), state.means.copy()
    cameras[:, :2] = cameras[:, :2] @ turn.T + [shift.real, shift.imag]
    cameras[:, 2] += np.angle(factor)
    cameras[:, 5] += np.log(np.abs(factor))
    means[:, 2] += np.log(np.abs(factor))
    return State(cameras, means, state.points @ turn.T + [shift.real, shift.imag])


def _on_the_ground(control: Control, rig: Rig, cameras: Float) -> Float:
    """Where the pixels meet the ground, (C, 2) metres; NaN above the horizon."""
    projection = rig.matrix[control.camera] @ camera_from_map(rig, cameras)[control.camera]
    centre = centres(rig, cameras)[control.camera]
    pixel = np.column_stack([control.pixel, np.ones(len(control.pixel))])
    ray = np.linalg.solve(projection, pixel[:, :, None])[:, :, 0]
    down = np.where(ray[:, 2] < 0, -ray[:, 2], np.nan)
    return np.asarray(centre[:, :2] + ray[:, :2] * (centre[:, 2] / down)[:, None])
