"""Whether candidates of an overlap hold: by homography, and by how much ground they share."""

from collections.abc import Callable, Mapping, Sequence

from gvpipe.core.overlap.signature import Signature, common_ground
from gvpipe.core.types import PairMatch, Rejected
from gvpipe.stages.contract import Context
from gvpipe.stages.pairing import count_steps, match_pairs

MIN_COMMON_GROUND = 0.08
"""Share of either picture's ground that both must see for an overlap to count."""

BATCH = 8
"""Candidates validated before looking again whether their robots are joined."""

ENOUGH = 3
"""Validated pairs that join two robots: one alone may be chance."""

NOT_TRIED = "not tried: the robots are joined already"

Robots = tuple[str, str]
Pair = tuple[str, str]
Verdicts = list[PairMatch | Rejected]


def validated(
    context: Context,
    asked: Mapping[Robots, Sequence[Pair]],
    signatures: Mapping[str, Signature],
) -> dict[Robots, Verdicts]:
    """Give the verdicts on the candidates of every two robots.

    Parameters
    ----------
    context : Context
        Its configuration says whether all are validated or only as many as join the robots.
    asked : mapping of two robots to sequence of (image id i, image id j)
        Candidates, best first.
    signatures : mapping of image id to Signature
        Of all images asked about.

    Returns
    -------
    found : dict of two robots to list of PairMatch or Rejected
        One for each candidate, in order.
    """
    validate = _first if context.config.overlap.validate == "first" else _all
    return validate(context, asked, signatures)


def _all(
    context: Context,
    asked: Mapping[Robots, Sequence[Pair]],
    signatures: Mapping[str, Signature],
) -> dict[Robots, Verdicts]:
    """Validate every candidate."""
    every = [pair for pairs in asked.values() for pair in pairs]
    with context.progress("validate", count_steps(every)) as ticker:
        verdicts = iter(_match(context, every, signatures, ticker.advance))
        return {robots: [next(verdicts) for _ in pairs] for robots, pairs in asked.items()}


def _first(
    context: Context,
    asked: Mapping[Robots, Sequence[Pair]],
    signatures: Mapping[str, Signature],
) -> dict[Robots, Verdicts]:
    """Validate best first, until every two robots are joined, be it by way of others."""
    found: dict[Robots, Verdicts] = {robots: [] for robots in asked}
    with context.progress("validate", sum(map(len, asked.values()))) as ticker:
        while True:
            group = _joined(found)
            # all robots take turns, so that a chain of them is found before its ends are tried
            batch = {
                robots: pairs[len(found[robots]) :][:BATCH]
                for robots, pairs in asked.items()
                if len(found[robots]) < len(pairs) and group[robots[0]] != group[robots[1]]
            }
            if not batch:
                break
            every = [pair for pairs in batch.values() for pair in pairs]
            verdicts = iter(_match(context, every, signatures, lambda: None))
            for robots, pairs in batch.items():
                found[robots] += [next(verdicts) for _ in pairs]
                ticker.advance(len(pairs))
    for robots, pairs in asked.items():
        found[robots] += [Rejected(NOT_TRIED)] * (len(pairs) - len(found[robots]))
    return found


def _joined(found: Mapping[Robots, Verdicts]) -> dict[str, str]:
    """Name for each robot the group that validated pairs have joined it to."""
    group = {robot: robot for robots in found for robot in robots}
    for robots, verdicts in found.items():
        if sum(isinstance(verdict, PairMatch) for verdict in verdicts) >= ENOUGH:
            a, b = (group[robot] for robot in robots)
            group = {robot: a if name == b else name for robot, name in group.items()}
    return group


def _match(
    context: Context,
    pairs: Sequence[Pair],
    signatures: Mapping[str, Signature],
    on_step: Callable[[], object],
) -> Verdicts:
    """Give the verdicts on some pairs."""
    verdicts = match_pairs(context, pairs, on_step)
    return [_sharing(p, verdict, signatures) for p, verdict in zip(pairs, verdicts, strict=True)]


def _sharing(
    pair: Pair, verdict: PairMatch | Rejected, signatures: Mapping[str, Signature]
) -> PairMatch | Rejected:
    """Reject a pair whose pictures hardly share any ground: it would join two maps by an edge."""
    if isinstance(verdict, Rejected):
        return verdict
    i, j = (signatures[image] for image in pair)
    share = common_ground(i, j, verdict.overhead_j_from_i)
    if share >= MIN_COMMON_GROUND:
        return verdict
    return Rejected(
        f"the pictures share {share:.1%} of their ground, {MIN_COMMON_GROUND:.0%} are needed",
        verdict.candidates,
        verdict.trials,
        len(verdict.points_i),
    )
