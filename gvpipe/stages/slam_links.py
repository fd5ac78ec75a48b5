"""Links between pictures: those that other stages found, and new ones where a map suggests them."""

from collections.abc import Iterator, Sequence

from gvpipe.core.slam.links import Link, link_kind
from gvpipe.core.slam.location_graph import MapResult
from gvpipe.core.slam.loops import gap_candidates, loop_candidates, without_bridges
from gvpipe.core.types import PairMatch
from gvpipe.records import MatchBody, OverlapBody, OverlapRow
from gvpipe.stages.contract import Context
from gvpipe.stages.pairing import count_steps, match_pairs

LOOPS_PER_IMAGE = 6
"""New links tried an image and round: more hardly add to the accuracy, and each costs a match."""

MIN_SHARED_GROUND = 0.15
"""Share of its ground a picture must have in common with another for the pair to be tried."""

MAX_GAP = 3
"""Pictures of a robot at most this far apart in its sequence are tried across a gap."""

MAX_STRIDE = 2
"""And at most this far to confirm a link that nothing else does: were it wrong, the map on either
side would look sound, and show no common ground."""


class LinkSearch:
    """Finds links, and tries no pair of pictures twice.

    Parameters
    ----------
    context : Context
        Of the stage; holds the artefacts of match and, for several robots, of overlap.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        entries = context.dataset.entries
        self._place = {entry.image_id: k for k, entry in enumerate(entries)}
        self._cameras = {entry.image_id: entry.camera for entry in entries}
        pairs = context.artefact(MatchBody).body.pairs
        self._tried = {(row.image_i, row.image_j) for row in pairs}
        for overlap in self._overlaps():
            self._tried |= {(c.image_i, c.image_j) for c in overlap.candidates}

    def given(self) -> list[Link]:
        """Turn matched pairs and validated overlaps into links."""
        return [*self._matched(), *self._overlapping()]

    def allow_again(self, links: Sequence[Link], result: MapResult) -> None:
        """Let pairs be matched once more whose link turned out wrong, where that may bridge a gap.

        Parameters
        ----------
        links : sequence of Link
            Those of a map.
        result : MapResult
            The map.
        """
        self._tried -= {
            (link.image_i, link.image_j)
            for link, judged in zip(links, result.links, strict=True)
            if not judged.kept and judged.residual_m is None
        }

    def suggested(self, result: MapResult) -> list[Link]:
        """Link pairs whose ground overlaps on a map, and pairs that may bridge a gap in a chain."""
        pairs = []
        for component in result.components:
            poses = {image: result.poses[image].map_from_camera for image in component}
            pairs += loop_candidates(
                self._cameras,
                poses,
                self._tried,
                min_share=MIN_SHARED_GROUND,
                max_per_image=LOOPS_PER_IMAGE,
            )
        pairs += gap_candidates(list(self._place), result.components, self._tried, max_gap=MAX_GAP)
        return self._found(list(dict.fromkeys((c.image_i, c.image_j) for c in pairs)))

    def confirming(self, links: Sequence[Link], result: MapResult) -> list[Link]:
        """Link pairs that may confirm what only one link of a map holds together."""
        order = list(self._place)
        judged = zip(links, result.links, strict=True)
        kept = {(link.image_i, link.image_j) for link, verdict in judged if verdict.kept}
        parts = without_bridges(order, sorted(kept))
        pairs = gap_candidates(order, parts, self._tried, max_gap=MAX_STRIDE)
        return self._found([(c.image_i, c.image_j) for c in pairs])

    def _found(self, pairs: list[tuple[str, str]]) -> list[Link]:
        """Match pairs and return the links between those that do."""
        if not pairs:
            return []
        self._tried.update(pairs)
        links = []
        with self._context.progress("loops", count_steps(pairs)) as ticker:
            verdicts = match_pairs(self._context, pairs, ticker.advance)
            for pair, verdict in zip(pairs, verdicts, strict=True):
                if isinstance(verdict, PairMatch):
                    kind = link_kind(self._place, *pair)
                    points = verdict.points_i, verdict.points_j
                    links.append(Link(*pair, kind, verdict.homography, *points))
        return links

    def _overlaps(self) -> tuple[OverlapRow, ...]:
        """Overlaps of each two robots; one robot has none."""
        if OverlapBody.stage not in self._context.upstream:
            return ()
        return self._context.artefact(OverlapBody).body.overlaps

    def _matched(self) -> Iterator[Link]:
        """Turn matched pairs into links."""
        match = self._context.artefact(MatchBody)
        points = match.arrays("match.npz")
        for k, row in enumerate(match.body.pairs):
            if row.H is not None:
                pair = row.image_i, row.image_j
                kind = link_kind(self._place, *pair)
                yield Link(*pair, kind, row.H, points[f"{k}/points_i"], points[f"{k}/points_j"])

    def _overlapping(self) -> Iterator[Link]:
        """Turn validated overlaps into links."""
        overlaps = self._overlaps()
        if not overlaps:
            return
        points = self._context.artefact(OverlapBody).arrays("overlap.npz")
        for row in overlaps:
            name = "-".join(row.robots)
            for k, candidate in enumerate(row.candidates):
                if candidate.H is not None:
                    yield Link(
                        candidate.image_i,
                        candidate.image_j,
                        "overlap",
                        candidate.H,
                        points[f"{name}/{k}/points_i"],
                        points[f"{name}/{k}/points_j"],
                    )
