"""Adjustment of cameras over a plane: poses and ground points that explain the matches best."""

from dataclasses import replace

import numpy as np

from gvpipe.core.kernels import bundle as kernels
from gvpipe.core.slam.control import Control
from gvpipe.core.slam.fronts import Dissection, Factor
from gvpipe.core.slam.normal import Normal
from gvpipe.core.slam.rig import (
    Rig,
    Spread,
    State,
    camera_from_map,
    centres,
    prior_cost,
    prior_normal,
    turning,
)
from gvpipe.core.slam.tracks import Tracks
from gvpipe.core.types import Float, Index

FIRST_DAMPING = 1e-7
MAX_DAMPING = 1e8
"""Share by which the diagonal is raised at first, and where the search for a step ends."""

PROMISE_KEPT = 0.5
"""Share of what a factor promises of a step that the step must gain for the factor to go on."""


class Problem:
    """One connected set of cameras with their tracks.

    Parameters
    ----------
    rig : Rig
        The N cameras.
    tracks : Tracks
        What they saw.
    reference : int
        Camera whose position and heading are held, unless known points fix the map.
    control : Control, optional
        Known ground points.
    where : (N, 2) float64, optional
        Rough positions of what the cameras see, metres: they save time, and change no result
        but by rounding.
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
        first, second = _observation_pairs(tracks.start, np.diff(tracks.start))
        keys = tracks.camera[first] * n + tracks.camera[second]
        apart = tracks.camera[first] != tracks.camera[second]
        linked, number = np.unique(keys[apart], return_inverse=True)
        # blocks on the diagonal have the numbers of their cameras, the others follow
        self._pair_block = tracks.camera[first].copy()
        self._pair_block[apart] = n + number
        self._plan = Dissection(linked // n, linked % n, self.where, size=6, border=3 * self.groups)
        self.held = 6 * reference + np.arange(3 if control is None else 0)

    def initial_points(self, cameras: Float) -> Float:
        """Mean of where the observations of each track meet the ground, (T, 2) metres."""
        centre = centres(self.rig, cameras)
        back = np.linalg.inv(self.rig.matrix @ camera_from_map(self.rig, cameras))
        seen = np.column_stack([self.tracks.pixel, np.ones(len(self.tracks.pixel))])
        ray = np.einsum("kij,kj->ki", back[self.tracks.camera], seen)
        c = centre[self.tracks.camera]
        # a ray at or above the horizon meets the ground nowhere: its point is put far away
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
        return kernels.evaluate(
            self.rig.matrix @ camera_from_map(self.rig, state.cameras),
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
        factor: Factor | None = None,
    ) -> tuple[State, Factor | None]:
        """Levenberg-Marquardt until a step lowers the cost by a share below `gain`.

        Parameters
        ----------
        state : State
            Where it begins.
        spread : Spread
            Priors.
        loss_px, noise_px : float
            Scale of the robust loss, and deviation of a pixel coordinate, pixels.
        steps : int
            At most.
        gain : float
            Share of the cost.
        factor : Factor, optional
            Of the system at a state nearby.

        Returns
        -------
        state : State
            At the optimum, or after `steps`.
        factor : Factor or None
            Of a system near it; None if it would be damped.

        Notes
        -----
        A factor serves as long as it foretells the gain of its steps: near the optimum systems
        hardly change.
        """
        damping = FIRST_DAMPING
        cost = self.cost(state, spread, loss_px, noise_px)
        for _ in range(steps):
            normal, gradient, elimination = self._linearise(state, spread, loss_px, noise_px)
            gained = 0.0
            while damping < MAX_DAMPING:
                fresh = factor is None
                try:
                    factor = factor or normal.factor(damping)
                except np.linalg.LinAlgError:
                    damping *= 10.0
                    continue
                step = normal.step(factor, gradient)
                trial = self._moved(state, step, elimination)
                trial_cost = self.cost(trial, spread, loss_px, noise_px)
                if trial_cost <= cost:
                    gained = cost - trial_cost
                    state, cost = trial, trial_cost
                    damping /= 10.0 if fresh else 1.0
                    break
                factor = None
                damping *= 10.0 if fresh else 1.0
            if gained <= gain * cost:
                break
            if gained < -PROMISE_KEPT * float(gradient @ step) or damping > FIRST_DAMPING:
                factor = None
        return state, factor if damping <= FIRST_DAMPING else None

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
        blocks, gradient = np.zeros((n + len(self._plan.i), 6, 6)), np.zeros((n, 6))
        elimination = np.empty((m, 6, 2)), np.empty((t, 2, 2)), np.empty((t, 2))
        kernels.linearise(
            self.rig.matrix @ camera_from_map(self.rig, state.cameras),
            self.rig.matrix[:, None] @ turning(self.rig, state.cameras),
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
            *elimination,
        )
        blocks /= noise_px**2
        gradient /= noise_px**2
        matrix, total = prior_normal(self.rig, state, spread)
        matrix.diagonal[:] += blocks[:n] + np.triu(blocks[:n], 1).transpose(0, 2, 1)
        if self.control:
            known, pull = self.control.normal(self.rig, state.cameras)
            matrix.diagonal[:] += known
            gradient += pull
        total[: 6 * n] += gradient.ravel()
        return (
            Normal(self._plan, replace(matrix, between=blocks[n:]), self.held),
            total,
            elimination,
        )


def _observation_pairs(start: Index, lengths: Index) -> tuple[Index, Index]:
    """All pairs (a <= b) of observations of a track, track by track, a slow and b fast."""
    # observation k of its track pairs with itself and everything after it
    after = np.repeat(start[1:], lengths) - np.arange(start[-1])
    first = np.repeat(np.arange(start[-1]), after)
    offset = np.arange(len(first)) - np.repeat(np.cumsum(after) - after, after)
    return first.astype(np.int64), (first + offset).astype(np.int64)
