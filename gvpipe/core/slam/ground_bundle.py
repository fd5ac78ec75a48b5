"""Adjustment of cameras over a plane: poses and ground points that explain the matches best."""

from dataclasses import replace

import numpy as np

from gvpipe.core.kernels import bundle as kernels
from gvpipe.core.slam.control import Control
from gvpipe.core.slam.fronts import Dissection
from gvpipe.core.slam.normal import Normal
from gvpipe.core.slam.rig import Rig, Spread, State, centres, orientation, prior_cost, prior_normal
from gvpipe.core.slam.tracks import Index, Tracks
from gvpipe.core.types import Float

FIRST_DAMPING = 1e-7
MAX_DAMPING = 1e8
"""Share by which the diagonal is raised at first, and where the search for a step ends."""


class Problem:
    """One connected set of cameras with their tracks.

    Position and heading of the `reference` camera are held, or nothing is where known ground
    points fix the map instead. Rough positions `where` (N, 2) of what the cameras see save time.
    """

    def __init__(
        self,
        rig: Rig,
        tracks: Tracks,
        reference: int,
        control: Control | None = None,
        where: Float | None = None,
    ) -> None:
        self.rig = rig
        self.tracks = tracks
        self.control = control
        self.where = np.zeros((len(rig.height), 2)) if where is None else where
        self.groups = int(rig.group.max()) + 1
        n = len(rig.height)
        lengths = np.diff(tracks.start)
        first, second = _observation_pairs(tracks.start, lengths)
        keys = tracks.camera[first] * n + tracks.camera[second]
        block_keys, block = np.unique(keys, return_inverse=True)
        self._pair_block = block.ravel().astype(np.int64)
        row, column = block_keys // n, block_keys % n
        self._own = row == column
        self._seen = row[self._own]
        self._plan = Dissection(
            row[~self._own], column[~self._own], self.where, size=6, border=3 * self.groups
        )
        self.held = 6 * reference + np.arange(3 if control is None else 0)

    def initial_points(self, cameras: Float) -> Float:
        """Mean of where the observations of each track meet the ground, (T, 2) metres."""
        rotation, _ = orientation(self.rig, cameras)
        centre = centres(self.rig, cameras)
        back = np.linalg.inv(self.rig.matrix @ rotation)
        seen = np.column_stack([self.tracks.pixel, np.ones(len(self.tracks.pixel))])
        ray = np.einsum("kij,kj->ki", back[self.tracks.camera], seen)
        c = centre[self.tracks.camera]
        down = np.maximum(-ray[:, 2], 1e-3 * np.linalg.norm(ray, axis=1))
        ground = c[:, :2] + ray[:, :2] * (c[:, 2] / down)[:, None]
        # a foreshortened view says little about where the point lies
        weight = (down / np.linalg.norm(ray, axis=1)) ** 2 / c[:, 2]
        total = np.add.reduceat(weight, self.tracks.start[:-1])
        return np.add.reduceat(ground * weight[:, None], self.tracks.start[:-1]) / total[:, None]

    def misfits(self, state: State) -> Float:
        """Sum of the squared reprojection errors of each point, (T,) squared pixels."""
        out = np.empty(len(state.points))
        self._robust_cost(state, 1.0, out)
        return out

    def _robust_cost(self, state: State, loss_px: float, out: Float) -> float:
        rotation, _ = orientation(self.rig, state.cameras)
        return kernels.evaluate(
            self.rig.matrix @ rotation,
            centres(self.rig, state.cameras),
            self.tracks.camera,
            self.tracks.pixel,
            self.tracks.start,
            self.tracks.weight,
            state.points,
            loss_px,
            out,
        )

    def cost(self, state: State, spread: Spread, loss_px: float, noise_px: float) -> float:
        """Robust data cost over the noise variance, plus the priors."""
        data = self._robust_cost(state, loss_px, np.empty(len(state.points))) / noise_px**2
        known = self.control.cost(self.rig, state.cameras) if self.control else 0.0
        return float(data + known + prior_cost(self.rig, state, spread))

    def minimise(
        self,
        state: State,
        spread: Spread,
        loss_px: float,
        noise_px: float,
        steps: int,
        gain: float,
    ) -> State:
        """Levenberg-Marquardt until a step lowers the cost by a share below `gain`."""
        damping = FIRST_DAMPING
        cost = self.cost(state, spread, loss_px, noise_px)
        for _ in range(steps):
            normal, gradient, elimination = self._linearise(state, spread, loss_px, noise_px)
            gained = 0.0
            while damping < MAX_DAMPING:
                try:
                    step = normal.step(gradient, damping)
                except np.linalg.LinAlgError:
                    damping *= 10.0
                    continue
                trial = self._moved(state, step, elimination)
                trial_cost = self.cost(trial, spread, loss_px, noise_px)
                if trial_cost <= cost:
                    gained = cost - trial_cost
                    state, cost = trial, trial_cost
                    damping /= 10.0
                    break
                damping *= 10.0
            if gained <= gain * cost:
                break
        return state

    def normal(self, state: State, spread: Spread, loss_px: float, noise_px: float) -> Normal:
        """Return the normal matrix of the cameras at `state`, the points eliminated."""
        return self._linearise(state, spread, loss_px, noise_px)[0]

    def _moved(self, state: State, step: Float, elimination: tuple[Float, Float, Float]) -> State:
        n = len(state.cameras)
        cameras = step[: 6 * n].reshape(n, 6)
        points = kernels.move_points(
            self.tracks.camera, self.tracks.start, state.points, cameras, *elimination
        )
        return State(state.cameras + cameras, state.means + step[6 * n :].reshape(-1, 3), points)

    def _linearise(
        self, state: State, spread: Spread, loss_px: float, noise_px: float
    ) -> tuple[Normal, Float, tuple[Float, Float, Float]]:
        n, m, t = len(state.cameras), len(self.tracks.camera), len(state.points)
        rotation, turned = orientation(self.rig, state.cameras)
        blocks, gradient = np.zeros((len(self._own), 6, 6)), np.zeros((n, 6))
        coupling, inverse = np.empty((m, 6, 2)), np.empty((t, 2, 2))
        point_gradient = np.empty((t, 2))
        kernels.linearise(
            self.rig.matrix @ rotation,
            self.rig.matrix[:, None] @ turned,
            centres(self.rig, state.cameras),
            self.tracks.camera,
            self.tracks.pixel,
            self.tracks.start,
            self.tracks.weight,
            state.points,
            loss_px,
            self._pair_block,
            blocks,
            gradient,
            coupling,
            inverse,
            point_gradient,
        )
        blocks, gradient = blocks / noise_px**2, gradient / noise_px**2
        matrix, total = prior_normal(self.rig, state, spread)
        matrix.diagonal[self._seen] += blocks[self._own]
        if self.control:
            known, pull = self.control.normal(self.rig, state.cameras)
            matrix.diagonal[:] += known
            gradient += pull
        total[: 6 * n] += gradient.ravel()
        return (
            Normal(self._plan, replace(matrix, between=blocks[~self._own]), self.held),
            total,
            (coupling, inverse, point_gradient),
        )


def _observation_pairs(start: Index, lengths: Index) -> tuple[Index, Index]:
    """All pairs (a <= b) of observations of a track, track by track, a slow and b fast."""
    # observation k of its track pairs with itself and everything after it
    after = np.repeat(start[1:], lengths) - np.arange(start[-1])
    first = np.repeat(np.arange(start[-1]), after)
    offset = np.arange(len(first)) - np.repeat(np.cumsum(after) - after, after)
    return first.astype(np.int64), (first + offset).astype(np.int64)
