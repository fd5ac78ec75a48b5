"""What a command would do, without doing it: freshness, pairs, time and memory."""

from collections.abc import Collection, Iterator, Sequence
from math import prod

from gvpipe.chain import Chain, stage_module
from gvpipe.config import Config
from gvpipe.dataset import Dataset
from gvpipe.errors import InputError
from gvpipe.memory import PROCESS_BYTES
from gvpipe.report import Reporter
from gvpipe.session import Session
from gvpipe.stages.match import planned_pairs

START_S = 0.75
DESCRIBE_S_PER_MPX = 0.05
EXTRACT_S_PER_MPX = 0.13
COMPOSE_S_PER_MPX = 0.15
CARVE_S_PER_MPX = 5.0
MATCH_S = 0.06
DECOMPOSE_S = 0.003
VALIDATE_S = 0.11
LINK_S = 0.15
LINK_KNOWN_S = 0.08
"""CPU seconds on a core of 2024: to start; for each Mpx of pictures; for each pair; for each
picture tried against another robot's, linked with others, or that has all its links. Measured on
sets of 8 to 60 pictures of 0.3 to 0.7 Mpx, each command alone with its loops compiled: right within
a factor of two there. In one run of several commands, those after the first cost less."""

BYTES_PER_PIXEL = 24
BYTES_PER_VOXEL = 42
"""Memory of the reconstruction beside its libraries, measured likewise: within a quarter."""


def plan_stages(names: Sequence[str], session: Session, reporter: Reporter, *, force: bool) -> None:
    """Say what commands of the chain would do, one after the other; write nothing.

    Parameters
    ----------
    names : sequence of str
        Of :data:`gvpipe.chain.STAGES`, in its order.
    session : Session
        Configuration and images.
    reporter : Reporter
        Where it is said.
    force : bool
        Whether they would run even if their artefacts are fresh.

    Raises
    ------
    InputError
        If there is no usable picture; after all is said, if a command could not run: the run would
        end with this error's exit code, too.
    ConfigError
        If the configuration names a picture that is not there.
    """
    refusals: list[str] = []
    times = [
        _plan_stage(name, session, reporter, refusals, force=force, before=names[:k])
        for k, name in enumerate(names)
    ]
    if len(names) > 1:
        run = sum(time is not None for time in times)
        said = f"about {sum(time or 0.0 for time in times):.0f} s in all"
        rows = [("commands", f"{run} of {len(names)} would run")]
        reporter.result("gvpipe run", rows + [("time", said)] * bool(run), [])
    if refusals:
        raise InputError(refusals[0])


def _plan_stage(
    name: str,
    session: Session,
    reporter: Reporter,
    refusals: list[str],
    *,
    force: bool,
    before: Collection[str],
) -> float | None:
    """Say what one command would do after those before it, add to `refusals` why it could not.

    Returns seconds, None if it would do nothing.
    """
    config, dataset, jobs = session.config, session.dataset, session.jobs
    chain = Chain(config, dataset)
    rows = [("images", f"{len(dataset.entries)} used, {len(dataset.skipped)} skipped")]
    lacking, renewed = [], False
    for stage in _upstream(name, config):
        state = _state(chain, stage)
        runs = stage in before and (force or state is not None)
        lacking += [state] if state and not runs else []
        renewed |= runs
        rows.append((stage, "would run before" if runs else state or "fresh"))
    refusals += lacking
    why = "after what it reads" if renewed else _state(chain, name) or ("forced" if force else None)
    if lacking:
        rows.append((name, "cannot run before what it reads is fresh"))
    else:
        rows.append((name, f"would run: {why}" if why else "fresh, nothing to do"))
    if name == "match":
        rows.append(("pairs", str(len(planned_pairs(config, dataset)))))
    seconds, size = estimate(name, config, dataset, jobs)
    if why or lacking:
        until = ", if it runs" if lacking else ""
        rows.append(("time", f"about {seconds:.0f} s with {jobs} job{'s' * (jobs > 1)}{until}"))
        rows.append(("memory", f"about {size / 2**20:.0f} MB"))
    rows.append(("wrote", "nothing: --dry-run"))
    reporter.result(f"gvpipe {name}", rows, [])
    return seconds if why and not lacking else None


def estimate(name: str, config: Config, dataset: Dataset, jobs: int) -> tuple[float, int]:
    """Estimate what a command takes.

    Parameters
    ----------
    name : str
        The command.
    config, dataset : Config, Dataset
        Settings and pictures.
    jobs : int
        Processes.

    Returns
    -------
    seconds : float
        Of wall time.
    size : int
        Bytes of main memory, all processes together.
    """
    images = len(dataset.entries)
    pixels = sum(entry.camera.width * entry.camera.height for entry in dataset.entries)
    mpx = pixels / 1e6
    linked = config.match.pairs == "exhaustive"
    work = {
        "match": EXTRACT_S_PER_MPX * mpx + MATCH_S * len(planned_pairs(config, dataset)),
        "localize": DECOMPOSE_S * len(planned_pairs(config, dataset)),
        "overlap": DESCRIBE_S_PER_MPX * mpx
        + (EXTRACT_S_PER_MPX * mpx + VALIDATE_S * images) * (len(dataset.robots) > 1),
        "slam": LINK_KNOWN_S * images if linked else LINK_S * images + EXTRACT_S_PER_MPX * mpx,
        "mosaic": COMPOSE_S_PER_MPX * mpx,
        "reconstruct": CARVE_S_PER_MPX * mpx,
    }
    parallel = stage_module(name).PARALLEL
    processes = jobs + 1 if jobs > 1 and parallel == "processes" else 1
    size = PROCESS_BYTES * processes
    if name == "reconstruct":
        size += BYTES_PER_PIXEL * pixels + BYTES_PER_VOXEL * prod(config.reconstruct.grid)
    return START_S + work[name] / (jobs if parallel else 1), size


def _upstream(name: str, config: Config) -> Iterator[str]:
    """Give the stages that one needs, those they need first."""
    seen: set[str] = set()
    for body in stage_module(name).needs(config):
        for stage in (*_upstream(body.stage, config), body.stage):
            if stage not in seen:
                seen.add(stage)
                yield stage


def _state(chain: Chain, name: str) -> str | None:
    """Say what is wrong with an artefact; None if it is fresh."""
    try:
        chain.fresh(stage_module(name).BODY)
    except InputError as error:
        return str(error)
    return None
