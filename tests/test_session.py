"""A session owns processes and features, and lets go of them."""

from multiprocessing import active_children
from pathlib import Path

from gvpipe.configfile import load_config
from gvpipe.core.matching.features import MatchOptions
from gvpipe.dataset import Dataset
from gvpipe.session import Session
from tests.faults.rig import make_small_set
from tests.test_featurestore import features


def width(dataset: Dataset, image: str) -> int:
    return dataset.entry(image).camera.width


def test_processes_and_features_go_when_room_is_needed_and_at_the_end(tmp_path: Path) -> None:
    config = load_config(make_small_set(tmp_path))
    before = set(active_children())
    with Session(config, 2) as session:
        images = [entry.image_id for entry in session.dataset.entries]
        assert set(session.workers.map(width, images)) == {200}
        session.features.add(images[0], MatchOptions(), features(1))
        assert len(set(active_children()) - before) == 2
        session.make_room()
        assert set(active_children()) <= before
        assert session.features.get(images[0], MatchOptions()) is None
        assert set(session.workers.map(width, images)) == {200}
        assert len(set(active_children()) - before) == 2
    assert set(active_children()) <= before


def test_a_session_that_did_nothing_opens_nothing(tmp_path: Path) -> None:
    config = load_config(make_small_set(tmp_path))
    for image in (tmp_path / "A").iterdir():
        image.unlink()
    with Session(config, 2) as session:
        pass
    assert not {"dataset", "workers"} & vars(session).keys()
